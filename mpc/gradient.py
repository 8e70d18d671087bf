"""Gradient descent on the best candidates' knots, through the model."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from larp_model.errors import InputError
from mpc.search import Problem, Search, best_first

# Of RMSprop: share of the old mean square in the new, and what is added to it.
DECAY, EPSILON = 0.9, 1e-8


@dataclass(frozen=True)
class Gradient:
    """RMSprop steps on the elites (Bharadhwaj et al. 2020, "CEM and gradient-based optimization").

    Unlike there, every candidate is evaluated again after its steps, and its cheapest knots so far are the result:
    a bad step costs time, never quality. Where a gradient is not finite its candidate stays.

    The gradient of a long rollout through contact is exact and still of little use: a learned ball on the ground turns
    a height of 1 mm into 10 rad/s within a step, and such factors multiply. Of kicks drawn around the reference the
    median is some 20 per spread, one in ten beyond 1e4, the largest observed 1e29. `clip` bounds each knot's part:
    its direction stays, its size does not.
    """

    differentiates: ClassVar[bool] = True
    terminal: ClassVar[bool] = False

    steps: int = 4
    learning_rate: float = 0.05
    """Length of a first step, as a share of the joint's spread in a first plan."""
    clip: float = 1.0
    """Largest norm of a knot's gradient, in cost per spread."""
    elites: int = 8
    """Candidates that are refined."""

    def __post_init__(self) -> None:
        for name in ("steps", "elites"):
            if getattr(self, name) < 1:
                raise InputError(f"{name}: got {getattr(self, name)}, needs at least 1")
        for name in ("learning_rate", "clip"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name}: got {getattr(self, name)}, needs a finite number > 0")

    def improve(self, search: Search, _random: np.random.Generator, problem: Problem) -> Search:
        """Return the search after all steps; every candidate is evaluated before each of them and after the last."""
        best = knots = self.sample(search)
        best_costs, mean_square = np.full(len(knots), np.inf, np.float32), np.zeros_like(knots)
        for step in range(self.steps + 1):
            if step < self.steps:
                costs, gradient = problem.gradients(knots)
            else:
                costs = problem.evaluate(knots).costs
            improved = costs < best_costs
            best = np.where(improved[:, None, None, None], knots, best)
            best_costs = np.where(improved, costs, best_costs)
            if step < self.steps:
                change, mean_square, lost_count = self.update(search.scale, gradient, mean_square, step)
                problem.lost(lost_count)
                knots = knots + change
        elites, elite_costs = best_first(
            np.concatenate([best, search.elites[len(best) :]]),
            np.concatenate([best_costs, search.costs[len(best) :]]),
            len(search.elites),
        )
        return search._replace(elites=elites, costs=elite_costs)

    def sample(self, search: Search) -> np.ndarray:
        """Return the candidates (N, K, J, 3) [rad] to refine: the best of the search."""
        return search.elites[: self.elites]

    def update(
        self, scale: np.ndarray, gradient: np.ndarray, mean_square: np.ndarray, step: int
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Return a step [rad] down the cost's gradient (N, K, J, 3) [1/rad], in units of the scale (J, 3) [rad].

        Also the running mean square, whose start is zero, and how many gradients were not finite.
        """
        scaled, lost_count = self.clipped(gradient * scale)
        mean_square = DECAY * mean_square + (1.0 - DECAY) * scaled**2
        unbiased = mean_square / (1.0 - DECAY ** (step + 1))
        return -self.learning_rate * scaled / np.sqrt(unbiased + EPSILON) * scale, mean_square, lost_count

    def clipped(self, gradient: np.ndarray) -> tuple[np.ndarray, int]:
        """Return gradients (N, K, J, 3) [1/spread], each knot's at most `clip` long, and how many were not finite.

        Those are zero: their candidates do not move.
        """
        usable = np.isfinite(gradient).all(axis=(1, 2, 3))
        gradient = np.where(usable[:, None, None, None], gradient, 0.0)
        # Squared, a large gradient would overflow 32 bits: divide by its largest component first.
        largest = np.maximum(np.abs(gradient).max(axis=(2, 3), keepdims=True), self.clip)
        gradient = gradient / largest
        norm = np.sqrt((gradient**2).sum(axis=(2, 3), keepdims=True))
        return gradient * self.clip / np.maximum(norm, self.clip / largest), int((~usable).sum())

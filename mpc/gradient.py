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

    Unlike there, every candidate is scored again after its steps, and the cheapest knots on its way are kept:
    a step that lands badly costs time, never quality. Where a gradient is not finite its candidate stands
    still.

    The gradient of a long rollout through contact is true and still of little use: a learned ball on the ground turns a
    height of 1 mm into 10 rad/s within a step, and such factors multiply. Of kicks drawn around the reference the
    median is some 20 per spread, one in ten beyond 1e4, the largest seen 1e29. `clip` holds each knot's part:
    the direction is kept, the size is not believed.
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
        """Return the search after all steps; every candidate is tried before each of them and after the last."""
        best = knots = self.sample(search)
        best_costs, square = np.full(len(knots), np.inf, np.float32), np.zeros_like(knots)
        for step in range(self.steps + 1):
            if step < self.steps:
                costs, gradient = problem.gradients(knots)
            else:
                costs = problem.evaluate(knots).costs
            won = costs < best_costs
            best = np.where(won[:, None, None, None], knots, best)
            best_costs = np.where(won, costs, best_costs)
            if step < self.steps:
                change, square, lost = self.update(search.scale, gradient, square, step)
                problem.lost(lost)
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
        self, scale: np.ndarray, gradient: np.ndarray, square: np.ndarray, step: int
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Return a step [rad] down the cost's gradient (N, K, J, 3) [1/rad], in units of the scale (J, 3) [rad].

        Also the running mean square, whose start is zero, and how many gradients were not finite.
        """
        scaled, lost = self.clipped(gradient * scale)
        square = DECAY * square + (1.0 - DECAY) * scaled**2
        mean = square / (1.0 - DECAY ** (step + 1))
        return -self.learning_rate * scaled / np.sqrt(mean + EPSILON) * scale, square, lost

    def clipped(self, gradient: np.ndarray) -> tuple[np.ndarray, int]:
        """Return gradients (N, K, J, 3) [1/spread], each knot's at most `clip` long, and how many were not finite.

        Those are zero: their candidates stand still.
        """
        usable = np.isfinite(gradient).all(axis=(1, 2, 3))
        gradient = np.where(usable[:, None, None, None], gradient, 0.0)
        # Squared, a large gradient would overflow 32 bits: divide by its largest component first.
        largest = np.maximum(np.abs(gradient).max(axis=(2, 3), keepdims=True), self.clip)
        gradient = gradient / largest
        norm = np.sqrt((gradient**2).sum(axis=(2, 3), keepdims=True))
        return gradient * self.clip / np.maximum(norm, self.clip / largest), int((~usable).sum())

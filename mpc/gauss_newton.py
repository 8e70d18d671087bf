"""Levenberg-Marquardt on the residuals of the named costs, through the model."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from larp_model.errors import InputError
from mpc.search import COLOUR, Evaluations, Problem, Residuals, Search, coloured_noise, merged

# Dampings of a round, tried side by side, as multiples of the last one that served best; it is expected to do so again.
FACTORS = np.array([1e-2, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1000.0])
EXPECTED = 3
# A step that gains more, or less, of what its quadratic promises divides, or multiplies, the next damping, down to a
# floor; where no step gains anything it is ten times as large.
GOOD, BAD, CHANGE, FAILED, FLOOR = 0.75, 0.25, 3.0, 10.0, 1e-6
# No step is longer, in spreads (root mean square over the knots).
LONGEST = 3.0


class Linearization(NamedTuple):
    """Residuals around knots, taken as linear along directions from them."""

    knots: np.ndarray  # (K, J, 3)
    here: Evaluations  # what they came to, N = 1
    directions: np.ndarray  # (D, K, J, 3)
    there: Evaluations  # what their neighbours came to, N = D, or none where derivatives are not differences


class Quadratic(NamedTuple):
    """The cost as a quadratic of D coordinates a, around a = 0: gradient . a + a . curvature a / 2."""

    gradient: np.ndarray  # (D,)
    curvature: np.ndarray  # (D, D)

    def gain(self, coordinates: np.ndarray) -> float:
        """Return by how much coordinates (D,) lower the cost."""
        return float(-self.gradient @ coordinates - 0.5 * coordinates @ self.curvature @ coordinates)


@dataclass(frozen=True)
class GaussNewton:
    """Steps of damped least squares on the best candidates (D. Marquardt 1963), in a subspace drawn anew each round.

    A term's cost w n(r) is taken as the parabola in its residual r that touches it there (iteratively reweighted least
    squares), and r as linear in the coordinates a of D directions B_d, drawn as candidates are, with the search's
    spread and the noise's colour, so that |a| counts in spreads:

        minimise over a   sum_i weight_i (r_i + J_i a)^2 / 2 + damping |a|^2 / 2,   J = dr/dtheta B

    `FACTORS` dampings are solved for and tried side by side, and the cheapest wins if it is cheaper than where it came
    from. J comes from forward derivatives of the rollout (`forward`), or from differences of `step` spreads, which any
    dynamics have and which see the same candidates' programs (`differences`): R rounds try R + 1 batches.
    """

    terminal: ClassVar[bool] = False

    rounds: int = 3
    directions: int = 24
    jacobian: Literal["forward", "differences"] = "differences"
    step: float = 0.02
    """Of the differences, in spreads."""
    damping: float = 1e-2
    """At first, as a share of the curvature's mean over the directions."""
    exponent: float = COLOUR
    """Colour of the directions; 0 is white."""
    elites: int = 1
    """Candidates that are refined, one after the other."""

    def __post_init__(self) -> None:
        for name, least in {"rounds": 1, "directions": 1, "elites": 1}.items():
            if getattr(self, name) < least:
                raise InputError(f"{name}: got {getattr(self, name)}, needs at least {least}")
        for name in ("step", "damping"):
            if not 0 < getattr(self, name) < math.inf:
                raise InputError(f"{name}: got {getattr(self, name)}, needs a finite number > 0")
        if self.jacobian not in ("forward", "differences"):
            raise InputError(f"jacobian: got {self.jacobian!r}, needs 'forward' or 'differences'")

    @property
    def differentiates(self) -> bool:
        """Return whether it needs gradients of the dynamics, which forward derivatives alone do."""
        return self.jacobian == "forward"

    def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Return the search after all rounds of every candidate that is refined."""
        for start in search.elites[: self.elites]:
            search = self.refine(start, search, random, problem)
        return search

    def refine(self, knots: np.ndarray, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Return the search after all rounds from knots (K, J, 3) on; every step that was tried may become an elite.

        The neighbours that a round takes differences to are tried with the steps of the round before, when none of them
        has won yet: around the step that is expected to, or around where the steps came from if no step of the last
        round was any good. The winner's residuals are then taken to fall as those there do.
        """
        directions = self.drawn(search, random)
        begun = np.concatenate([knots[None], self.neighbours(knots, directions)])
        tried = problem.evaluate(begun)
        search, here = merged(search, begun, tried.costs), tried.row(0)
        if not np.isfinite(here.costs[0]):
            return self.look_around(knots, search, random, problem)
        linearization = Linearization(knots, here, directions, tried.rows(slice(1, None)))
        damping, missed = self.damping, False
        for number in range(self.rounds):
            model = quadratic(here, self.derivatives(linearization, problem))
            steps, coordinates, dampings = self.steps(model, damping, linearization.directions, search.scale)
            if not len(steps):
                break
            directions = self.drawn(search, random)
            ahead = knots if missed else knots + steps[EXPECTED]
            neighbours = self.neighbours(ahead, directions)[: 0 if number + 1 == self.rounds else None]
            together = np.concatenate([knots + steps, neighbours])
            tried = problem.evaluate(together)
            search, best = merged(search, together, tried.costs), int(np.argmin(tried.costs[: len(steps)]))
            there, expected = tried.rows(slice(len(steps), None)), here if missed else tried.row(EXPECTED)
            gained = float(here.costs[0] - tried.costs[best])
            if (missed or gained > 0.0) and np.isfinite(expected.costs[0]):
                linearization = Linearization(ahead, expected, directions, there)
            missed = not gained > 0.0
            if missed:
                damping *= FAILED
            else:
                knots, here = knots + steps[best], tried.row(best)
                promised = model.gain(coordinates[best])
                damping = dampings[best] * (CHANGE if gained < BAD * promised else 1.0)
                damping = max(damping / CHANGE, FLOOR) if gained > GOOD * promised else damping
            if self.differentiates:
                linearization = Linearization(knots, here, directions, there)
        return search

    def look_around(self, knots: np.ndarray, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Refine the best candidate around knots whose own rollout is lost, so that nothing is linear there."""
        for left in reversed(range(self.rounds)):
            around = knots + self.drawn(search, random)
            tried = problem.evaluate(around)
            search, best = merged(search, around, tried.costs), int(np.argmin(tried.costs))
            if np.isfinite(tried.costs[best]):
                return replace(self, rounds=left).refine(around[best], search, random, problem) if left else search
        return search

    def drawn(self, search: Search, random: np.random.Generator) -> np.ndarray:
        """Return the directions (D, K, J, 3) [rad] of a round."""
        return search.spread * coloured_noise(random, (self.directions, *search.mean.shape), self.exponent)

    def neighbours(self, knots: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the knots (D, K, J, 3) that differences are taken to, none (0, K, J, 3) where they are not taken."""
        return knots + self.step * (directions[:0] if self.differentiates else directions)

    def derivatives(self, linearization: Linearization, problem: Problem) -> Residuals:
        """Return those of the residuals along the directions, (D, ...) by term; zero where they are not finite."""
        count = len(linearization.directions)
        if self.differentiates:
            found, usable = problem.tangents(linearization.knots, linearization.directions), np.ones(count, bool)
        else:
            at, there = linearization.here.residuals, linearization.there
            found = {name: (each - at[name]) / self.step for name, each in there.residuals.items()}
            usable = np.isfinite(there.costs)  # the residuals of what is lost may be anything
        usable &= np.all([np.isfinite(_flat(each)).all(axis=1) for each in found.values()], axis=0)
        if self.differentiates:
            problem.lost(int((~usable).sum()))
        return {name: np.where(usable.reshape(-1, *(1,) * (r.ndim - 1)), r, 0.0) for name, r in found.items()}

    def steps(
        self, model: Quadratic, damping: float, directions: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return steps (S, K, J, 3) [rad], coordinates (S, D) and dampings (S,); none where nothing has a slope."""
        mean = np.trace(model.curvature) / len(model.gradient)
        none = directions[:0], np.zeros((0, len(directions))), np.zeros(0)
        if not (np.isfinite(model.gradient).all() and 0.0 < mean < np.inf):
            return none
        dampings = damping * FACTORS
        # One decomposition serves all dampings.
        value, vector = np.linalg.eigh(model.curvature)
        along = vector.T @ model.gradient
        coordinates = -(along / (np.maximum(value, 0.0) + dampings[:, None] * mean)) @ vector.T
        steps = np.einsum("sd,dkjx->skjx", coordinates.astype(np.float32), directions)
        moving = scale > 0.0
        if not (moving.any() and np.any(steps)):
            return none
        length = np.sqrt(np.mean((steps[..., moving] / scale[moving]) ** 2, axis=(1, 2)))
        share = np.minimum(1.0, LONGEST / np.maximum(length, 1e-12))
        return steps * share[:, None, None, None].astype(np.float32), coordinates * share[:, None], dampings


def quadratic(here: Evaluations, derivatives: Residuals) -> Quadratic:
    """Return the quadratic around one candidate from its residuals (1, ...) and their derivatives (D, ...)."""
    slopes = [
        (_flat(derivatives[name]).astype(float), _flat(here.residuals[name])[0], _flat(here.curvatures[name])[0])
        for name in derivatives
    ]
    return Quadratic(
        np.sum([jacobian @ (weight * residual) for jacobian, residual, weight in slopes], axis=0),
        np.sum([(jacobian * weight) @ jacobian.T for jacobian, _, weight in slopes], axis=0),
    )


def _flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1)

"""Levenberg-Marquardt on the residuals of the named costs, through the model."""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from larp_model.errors import InputError
from mpc.search import COLOUR, Problem, Residuals, Search, Tried, coloured_noise, merged

# Dampings of a round, tried side by side, as multiples of the last one that served best.
FACTORS = np.array([1e-2, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1000.0])
# A step that gains more, or less, of what its quadratic promises divides, or multiplies, the next damping, down to a
# floor; where no step gains anything it is ten times as large.
GOOD, BAD, CHANGE, FAILED, FLOOR = 0.75, 0.25, 3.0, 10.0, 1e-6
# No step is longer, in spreads (root mean square over the knots).
LONGEST = 3.0


class Slopes(NamedTuple):
    """The cost as a quadratic of D coordinates a, around a = 0: gradient . a + a . curvature a / 2."""

    gradient: np.ndarray  # (D,)
    curvature: np.ndarray  # (D, D)


@dataclass(frozen=True)
class GaussNewton:
    """Steps of damped least squares on the best candidates (D. Marquardt 1963), in a subspace drawn anew each round.

    A term's cost w n(r) is taken as the parabola in its residual r that touches it there (iteratively reweighted least
    squares), and r as linear in the coordinates a of D directions B_d, drawn as candidates are, with the search's
    spread and the noise's colour, so that |a| counts in spreads:

        minimise over a   sum_i weight_i (r_i + J_i a)^2 / 2 + damping |a|^2 / 2,   J = dr/dtheta B

    `FACTORS` dampings are solved for and tried side by side, and the cheapest wins if it is cheaper than where it came
    from. J comes from forward derivatives of the rollout (`forward`), or from differences of `step` spreads, which any
    dynamics have and which see the same candidates' programs (`differences`). Reverse derivatives of a kick would give
    the three rows of its miss along all axes for the price of some thirty forward ones, but compile for 40 s.
    """

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
        """Forward derivatives alone need gradients of the dynamics."""
        return self.jacobian == "forward"

    def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """All rounds of every candidate that is refined."""
        for start in search.elites[: self.elites]:
            search = self.refine(start, search, random, problem)
        return search

    def refine(self, knots: np.ndarray, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """All rounds from knots (K, J, 3) on; every step that was tried may become an elite."""
        here, damping = None, self.damping
        for _ in range(self.rounds):
            noise = coloured_noise(random, (self.directions, *knots.shape), self.exponent)
            directions, there = search.spread * noise, None
            if here is None:  # the start and its neighbours are rolled out side by side
                together = np.concatenate([knots[None], self.neighbours(knots, directions)])
                tried = problem.tries(together)
                search = merged(search, together, tried.costs)
                here, there = tried.row(0), tried.rows(slice(1, None))
            if not np.isfinite(here.costs[0]):  # no slope where nothing comes back: look around
                tried = problem.tries(knots + directions)
                search = merged(search, knots + directions, tried.costs)
                best = int(np.argmin(tried.costs))
                if np.isfinite(tried.costs[best]):
                    knots, here = knots + directions[best], tried.row(best)
                continue
            search, derivatives = self.derivatives(knots, here, directions, search, problem, there)
            slopes = quadratic(here, derivatives)
            steps, coordinates, dampings = self.steps(slopes, damping, directions, search.scale)
            if not len(steps):
                break
            tried = problem.tries(knots + steps)
            search = merged(search, knots + steps, tried.costs)
            best = int(np.argmin(tried.costs))
            gained = float(here.costs[0] - tried.costs[best])
            a = coordinates[best]
            promised = float(-slopes.gradient @ a - 0.5 * a @ slopes.curvature @ a)
            if not gained > 0.0:
                damping *= FAILED
                continue
            damping = dampings[best]
            if gained < BAD * promised:
                damping *= CHANGE
            elif gained > GOOD * promised:
                damping = max(damping / CHANGE, FLOOR)
            knots = knots + steps[best]
            here = tried.row(best)
        return search

    def neighbours(self, knots: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the knots (D, K, J, 3) that differences are taken to, none (0, K, J, 3) where they are not taken."""
        return knots + self.step * (directions if self.jacobian == "differences" else directions[:0])

    def derivatives(
        self,
        knots: np.ndarray,
        here: Tried,
        directions: np.ndarray,
        search: Search,
        problem: Problem,
        there: Tried | None = None,
    ) -> tuple[Search, Residuals]:
        """Return those of the residuals along the directions, (D, ...) by term; zero where they are not finite.

        there: what the neighbours came to, if they are tried already. They may become elites.
        """
        usable = np.ones(len(directions), bool)
        if self.jacobian == "forward":
            found = problem.tangents(knots, directions)
        else:
            if there is None:
                neighbours = self.neighbours(knots, directions)
                there = problem.tries(neighbours)
                search = merged(search, neighbours, there.costs)
            found = {name: (each - here.residuals[name]) / self.step for name, each in there.residuals.items()}
            usable = np.isfinite(there.costs)  # the residuals of what is lost may be anything
        usable &= np.all([np.isfinite(_flat(each)).all(axis=1) for each in found.values()], axis=0)
        if self.jacobian == "forward":
            problem.lost(int((~usable).sum()))
        return search, {name: np.where(usable.reshape(-1, *(1,) * (r.ndim - 1)), r, 0.0) for name, r in found.items()}

    def steps(
        self, slopes: Slopes, damping: float, directions: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Steps (S, K, J, 3) [rad], their coordinates (S, D) and dampings (S,); none where nothing has a slope."""
        mean = np.trace(slopes.curvature) / len(slopes.gradient)
        none = directions[:0], np.zeros((0, len(directions))), np.zeros(0)
        if not (np.isfinite(slopes.gradient).all() and 0.0 < mean < np.inf):
            return none
        dampings = damping * FACTORS
        # One decomposition serves all dampings.
        value, vector = np.linalg.eigh(slopes.curvature)
        along = vector.T @ slopes.gradient
        coordinates = -(along / (np.maximum(value, 0.0) + dampings[:, None] * mean)) @ vector.T
        steps = np.einsum("sd,dkjx->skjx", coordinates.astype(np.float32), directions)
        moving = scale > 0.0
        if not (moving.any() and np.any(steps)):
            return none
        length = np.sqrt(np.mean((steps[..., moving] / scale[moving]) ** 2, axis=(1, 2)))
        share = np.minimum(1.0, LONGEST / np.maximum(length, 1e-12))
        return steps * share[:, None, None, None].astype(np.float32), coordinates * share[:, None], dampings


def quadratic(here: Tried, derivatives: Residuals) -> Slopes:
    """The cost around one candidate, whose residuals are (1, ...), along derivatives (D, ...) of them."""
    slopes = [
        (_flat(derivatives[name]).astype(float), _flat(here.residuals[name])[0], _flat(here.curvatures[name])[0])
        for name in derivatives
    ]
    return Slopes(
        np.sum([jacobian @ (weight * residual) for jacobian, residual, weight in slopes], axis=0),
        np.sum([(jacobian * weight) @ jacobian.T for jacobian, _, weight in slopes], axis=0),
    )


def _flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1)

"""Levenberg-Marquardt on the residuals of the named costs, through the model."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar, Literal, NamedTuple

import numpy as np

from larp_model.errors import InputError
from mpc.damping import next_damping
from mpc.search import COLOUR, Evaluations, Problem, Residuals, Search, coloured_noise, merged

# Dampings of a round, evaluated side by side, as multiples of the last best one, which is expected to be best again.
FACTORS = np.array([1e-2, 0.1, 0.3, 1.0, 3.0, 10.0, 100.0, 1000.0])
EXPECTED = 3
# No step is longer, in spreads (root mean square over the knots).
LONGEST_STEP = 3.0


class Linearization(NamedTuple):
    """Residuals around knots, taken as linear along directions from them."""

    knots: np.ndarray  # (K, J, 3)
    results: Evaluations  # of the knots, N = 1
    directions: np.ndarray  # (D, K, J, 3)
    neighbour_results: Evaluations  # of their neighbours, N = D, or none where derivatives are not differences


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

    `FACTORS` dampings are solved for and evaluated side by side, and the cheapest step is taken if it lowers the cost.
    J comes from forward derivatives of the rollout (`forward`), or from differences of `step` spreads, which any
    dynamics have and which see the same candidates' programs (`differences`): R rounds evaluate R + 1 batches.
    """

    terminal: ClassVar[bool] = False

    rounds: int = 3
    directions: int = 24
    jacobian: Literal["forward", "differences"] = "differences"
    step: float = 0.02
    """Length of the differences, in spreads."""
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
        """Return the search after all rounds from knots (K, J, 3) on; every evaluated step may become an elite.

        The neighbours that a round takes differences to are evaluated with the steps of the round before, when the best
        of them is not known yet: around the step that is expected to be best, or around the knots that the steps start
        from if the last round lowered no cost. The best step's residuals then get the derivatives found there.
        """
        directions = self.draw_directions(search, random)
        batch = np.concatenate([knots[None], self.neighbours(knots, directions)])
        evaluations = problem.evaluate(batch)
        search, results = merged(search, batch, evaluations.costs), evaluations.row(0)
        if not np.isfinite(results.costs[0]):
            return self.restart_nearby(knots, search, random, problem)
        linearization = Linearization(knots, results, directions, evaluations.rows(slice(1, None)))
        damping, failed = self.damping, False
        for number in range(self.rounds):
            model = quadratic(results, self.derivatives(linearization, problem))
            steps, coordinates, dampings = self.steps(model, damping, linearization.directions, search.scale)
            if not len(steps):
                break
            directions = self.draw_directions(search, random)
            centre = knots if failed else knots + steps[EXPECTED]
            neighbours = self.neighbours(centre, directions)[: 0 if number + 1 == self.rounds else None]
            batch = np.concatenate([knots + steps, neighbours])
            evaluations = problem.evaluate(batch)
            search, cheapest = merged(search, batch, evaluations.costs), int(np.argmin(evaluations.costs[: len(steps)]))
            neighbour_results, expected = (
                evaluations.rows(slice(len(steps), None)),
                results if failed else evaluations.row(EXPECTED),
            )
            gain = float(results.costs[0] - evaluations.costs[cheapest])
            if (failed or gain > 0.0) and np.isfinite(expected.costs[0]):
                linearization = Linearization(centre, expected, directions, neighbour_results)
            failed = not gain > 0.0
            damping = next_damping(
                damping if failed else float(dampings[cheapest]), gain, model.gain(coordinates[cheapest])
            )
            if not failed:
                knots, results = knots + steps[cheapest], evaluations.row(cheapest)
            if self.differentiates:
                linearization = Linearization(knots, results, directions, neighbour_results)
        return search

    def restart_nearby(
        self, knots: np.ndarray, search: Search, random: np.random.Generator, problem: Problem
    ) -> Search:
        """Refine the best candidate drawn around knots whose own rollout is not finite, and so has no derivatives."""
        for rounds_left in reversed(range(self.rounds)):
            candidates = knots + self.draw_directions(search, random)
            evaluations = problem.evaluate(candidates)
            search, best = merged(search, candidates, evaluations.costs), int(np.argmin(evaluations.costs))
            if np.isfinite(evaluations.costs[best]):
                return (
                    replace(self, rounds=rounds_left).refine(candidates[best], search, random, problem)
                    if rounds_left
                    else search
                )
        return search

    def draw_directions(self, search: Search, random: np.random.Generator) -> np.ndarray:
        """Return the directions (D, K, J, 3) [rad] of a round."""
        noise = coloured_noise(random, (self.directions, *search.mean.shape), self.exponent)
        directions: np.ndarray = search.spread * noise
        return directions

    def neighbours(self, knots: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Return the knots (D, K, J, 3) that differences are taken to, none (0, K, J, 3) where they are not taken."""
        return knots + self.step * (directions[:0] if self.differentiates else directions)

    def derivatives(self, linearization: Linearization, problem: Problem) -> Residuals:
        """Return those of the residuals along the directions, (D, ...) by term; zero where they are not finite."""
        count = len(linearization.directions)
        if self.differentiates:
            slopes, usable = problem.tangents(linearization.knots, linearization.directions), np.ones(count, bool)
        else:
            residuals, neighbours = linearization.results.residuals, linearization.neighbour_results
            slopes = {name: (values - residuals[name]) / self.step for name, values in neighbours.residuals.items()}
            usable = np.isfinite(neighbours.costs)  # the residuals of a diverged neighbour may be anything
        usable &= np.all([np.isfinite(_flat(values)).all(axis=1) for values in slopes.values()], axis=0)
        if self.differentiates:
            problem.lost(int((~usable).sum()))
        return {name: np.where(usable.reshape(-1, *(1,) * (r.ndim - 1)), r, 0.0) for name, r in slopes.items()}

    def steps(
        self, model: Quadratic, damping: float, directions: np.ndarray, scale: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return steps (S, K, J, 3) [rad], coordinates (S, D) and dampings (S,); none where nothing has a slope."""
        mean = np.trace(model.curvature) / len(model.gradient)
        no_steps = directions[:0], np.zeros((0, len(directions))), np.zeros(0)
        if not (np.isfinite(model.gradient).all() and 0.0 < mean < np.inf):
            return no_steps
        dampings = damping * FACTORS
        # One decomposition serves all dampings.
        value, vector = np.linalg.eigh(model.curvature)
        slopes = vector.T @ model.gradient
        coordinates = -(slopes / (np.maximum(value, 0.0) + dampings[:, None] * mean)) @ vector.T
        steps = np.einsum("sd,dkjx->skjx", coordinates.astype(np.float32), directions)
        moving = scale > 0.0
        if not (moving.any() and np.any(steps)):
            return no_steps
        length = np.sqrt(np.mean((steps[..., moving] / scale[moving]) ** 2, axis=(1, 2)))
        shortening = np.minimum(1.0, LONGEST_STEP / np.maximum(length, 1e-12))
        return steps * shortening[:, None, None, None].astype(np.float32), coordinates * shortening[:, None], dampings


def quadratic(results: Evaluations, derivatives: Residuals) -> Quadratic:
    """Return the quadratic around one candidate from its residuals (1, ...) and their derivatives (D, ...)."""
    slopes = [
        (_flat(derivatives[name]).astype(float), _flat(results.residuals[name])[0], _flat(results.curvatures[name])[0])
        for name in derivatives
    ]
    return Quadratic(
        np.sum([jacobian @ (weight * residual) for jacobian, residual, weight in slopes], axis=0),
        np.sum([(jacobian * weight) @ jacobian.T for jacobian, _, weight in slopes], axis=0),
    )


def _flat(values: np.ndarray) -> np.ndarray:
    return values.reshape(len(values), -1)

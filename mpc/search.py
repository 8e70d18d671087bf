"""Interfaces of optimisers: the state of a search, the problem that they see, ranking of candidates, noise.

Optimisers run on the host, in NumPy; the model's work is done by the problem's compiled programs, which all rounds,
optimisers and planners of a problem share.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np

from larp_model.errors import InputError

# Colour of the noise where an optimiser does not say it.
COLOUR = 2.0


class Search(NamedTuple):
    """The state of a search, handed from one optimiser to the next within a plan."""

    mean: np.ndarray  # (K, J, 3) rad, centre of the sampling distribution
    spread: np.ndarray  # (K, J, 3) rad, its standard deviation
    elites: np.ndarray  # (M, K, J, 3) rad, the best candidates, best first; first of all, the warm start
    costs: np.ndarray  # (M,) of the elites, +inf while unknown
    scale: np.ndarray  # (J, 3) rad, the spread of a first plan: how far each joint is worth moving


Residuals = dict[str, np.ndarray]
"""By term, (N, R) or (N, T, R), of N candidates."""


Tolerance = tuple[tuple[str, float], ...]
"""Residuals by name, with the length that each may have where a search has converged."""


class Evaluations(NamedTuple):
    """Results of N candidates."""

    costs: np.ndarray  # (N,), +inf where a candidate is not finite
    residuals: Residuals
    curvatures: Residuals  # c of each residual r: near the candidate its cost is a constant + sum(c r^2) / 2

    def rows(self, which: slice) -> Evaluations:
        """Return some of the candidates."""
        residuals, curvatures = ({name: leaf[which] for name, leaf in values.items()} for values in self[1:])
        return Evaluations(self.costs[which], residuals, curvatures)

    def row(self, index: int) -> Evaluations:
        """Return one of the candidates alone, N = 1."""
        return self.rows(slice(index, index + 1))


class Problem(Protocol):
    """The problem as an optimiser sees it. The planner counts every cost that is computed."""

    def evaluate(self, knots: np.ndarray) -> Evaluations:
        """Return the results of knots (N, K, J, 3) [rad], rolled out in the planner's own dynamics."""

    def gradients(self, knots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return costs (N,) of knots (N, K, J, 3) and their gradients (N, K, J, 3) [1/rad], unclipped."""

    def tangents(self, knots: np.ndarray, directions: np.ndarray) -> Residuals:
        """Return derivatives of the residuals at knots (K, J, 3) along D directions (D, K, J, 3), (D, ...) by term."""

    def lost(self, count: int) -> None:
        """Count candidates that could not be evaluated, because a gradient was not finite."""

    @property
    def warm_start(self) -> np.ndarray:
        """Return knots (K, J, 3) [rad] of the last plan, shifted to now."""

    def validate(self, dynamics: Any, knots: np.ndarray) -> Evaluations:
        """Return `evaluate` in other dynamics, without corrections; counted apart."""

    def corrected(self, corrections: Residuals) -> Problem:
        """Return the problem with something added to the residuals of every candidate, (1, ...) by term."""


@runtime_checkable
class Optimizer(Protocol):
    """An optimiser: the candidates that it returns are no worse than those it gets. Its fields are its settings."""

    @property
    def terminal(self) -> bool:
        """Return whether it must be the last, because it ranks by other dynamics than the planner's own."""

    @property
    def differentiates(self) -> bool:
        """Return whether it needs gradients of the dynamics."""

    @property
    def elites(self) -> int:
        """Return how many of the best candidates it needs."""

    def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Return the search after all rounds, with as many elites as before, ranked by what they cost."""


def require_tolerance(tolerance: Tolerance) -> None:
    """Raise InputError for lengths that are negative or not finite."""
    for name, length in tolerance:
        if not 0.0 <= length < np.inf:
            raise InputError(f"tolerance: got {length} for {name!r}, needs a finite number >= 0")


def converged(tolerance: Tolerance, cost: float, residuals: Residuals) -> bool:
    """Return whether one candidate, of this cost and residuals (1, ...), is within the tolerance."""
    for name, _ in tolerance:
        if name not in residuals:
            raise InputError(f"tolerance: got {name!r}, needs names of cost terms: {', '.join(residuals)}")
    within = [np.linalg.norm(residuals[name]) <= length for name, length in tolerance]
    return bool(within) and bool(np.isfinite(cost)) and all(within)


def best_first(knots: np.ndarray, costs: np.ndarray, count: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Return the `count` cheapest of knots (N, K, J, 3) and costs (N,), or all; infinite ones last, ties in order."""
    order = np.argsort(costs, kind="stable")[:count]
    return knots[order], costs[order]


def distinct(knots: np.ndarray) -> np.ndarray:
    """Return the numbers (M,) of the knots (N, K, J, 3) that are not copies of an earlier one, in their order."""
    first: dict[bytes, int] = {}
    for row, candidate in enumerate(knots):
        first.setdefault(candidate.tobytes(), row)
    return np.array(list(first.values()), int)


def merged(search: Search, knots: np.ndarray, costs: np.ndarray) -> Search:
    """Return the search with candidates (N, K, J, 3) of costs (N,) among its elites; copies last, at cost inf."""
    all_knots, all_costs = best_first(
        np.concatenate([search.elites, knots]), np.concatenate([search.costs, costs]), None
    )
    first = distinct(all_knots)
    copies = np.setdiff1d(np.arange(len(all_knots)), first)
    order = np.concatenate([first, copies])[: len(search.elites)]
    return search._replace(elites=all_knots[order], costs=np.where(np.isin(order, copies), np.inf, all_costs[order]))


def coloured_noise(random: np.random.Generator, shape: tuple[int, ...], exponent: float) -> np.ndarray:
    """Return normal noise (N, K, J, 3) of unit variance whose power along the K knots falls as frequency^-exponent.

    0 is white, 2 a random walk's: neighbouring knots move together (Pinneri et al. 2020, "iCEM").
    """
    white = random.standard_normal(shape, dtype=np.float32)
    noise: np.ndarray = np.einsum("kl,nljd->nkjd", _colour(shape[1], exponent), white)
    return noise


@functools.cache
def _colour(count: int, exponent: float) -> np.ndarray:
    """Return the square root (K, K) of the noise's covariance, cut from twice the length so that the ends differ."""
    index = np.arange(2 * count)
    frequency = np.maximum(np.minimum(index, 2 * count - index), 1)
    covariance = np.fft.ifft(frequency.astype(float) ** -exponent).real[:count]
    lag = np.abs(index[:count, None] - index[:count])
    value, vector = np.linalg.eigh(covariance[lag] / covariance[0])
    root: np.ndarray = (vector * np.sqrt(np.maximum(value, 0))) @ vector.T
    return root.astype(np.float32)

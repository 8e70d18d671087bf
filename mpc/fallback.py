"""Optimisers that run only where the search has not converged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from larp_model.errors import InputError
from mpc.search import Optimizer, Problem, Search, Tolerance, converged, require_tolerance


@dataclass(frozen=True)
class Fallback:
    """Run these optimisers, one after the other, unless the best candidate's residuals are within `tolerance`.

    A way out of local minima, for the price of one candidate everywhere else.
    """

    tolerance: Tolerance
    optimizers: tuple[Optimizer, ...]

    def __post_init__(self) -> None:
        require_tolerance(self.tolerance)
        if not (self.tolerance and self.optimizers):
            raise InputError(f"tolerance, optimizers: got {self.tolerance}, {self.optimizers}, needs some of both")
        for optimizer in self.optimizers:
            if optimizer.terminal:
                raise InputError(f"optimizers: got {type(optimizer).__name__}, which must come last of all")

    terminal: ClassVar[bool] = False

    @property
    def differentiates(self) -> bool:
        """Return whether any of its optimisers needs gradients."""
        return any(optimizer.differentiates for optimizer in self.optimizers)

    @property
    def elites(self) -> int:
        """Return the largest number that any of its optimisers needs."""
        return max(optimizer.elites for optimizer in self.optimizers)

    def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Return the search as it is, or after all rounds of all optimisers."""
        best = problem.evaluate(search.elites[:1])
        if converged(self.tolerance, float(best.costs[0]), best.residuals):
            return search
        for optimizer in self.optimizers:
            search = optimizer.improve(search, random, problem)
        return search

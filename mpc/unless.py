"""Optimisers that run only where the plan is not good enough yet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from larp_model.errors import InputError
from mpc.search import Enough, Optimizer, Problem, Search, require_enough, suffices


@dataclass(frozen=True)
class Unless:
    """A fallback: these optimisers, one after the other, unless the best candidate's residuals are short `enough`.

    A way out of where descent got stuck, for the price of one candidate everywhere else.
    """

    enough: Enough
    """Residuals by name, and the length that each may have."""
    optimizers: tuple[Optimizer, ...]

    def __post_init__(self) -> None:
        require_enough(self.enough)
        if not (self.enough and self.optimizers):
            raise InputError(f"enough, optimizers: got {self.enough}, {self.optimizers}, needs some of both")
        for each in self.optimizers:
            if getattr(each, "settles", False):
                raise InputError(f"optimizers: got {type(each).__name__}, which must come last of all")

    @property
    def differentiates(self) -> bool:
        """Return whether any of its optimisers needs gradients."""
        return any(each.differentiates for each in self.optimizers)

    @property
    def elites(self) -> int:
        """Return the largest number that any of its optimisers needs."""
        return max(each.elites for each in self.optimizers)

    def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Return the search as it is, or after all rounds of all optimisers."""
        best = problem.tries(search.elites[:1])
        if suffices(self.enough, float(best.costs[0]), best.residuals):
            return search
        for each in self.optimizers:
            search = each.improve(search, random, problem)
        return search

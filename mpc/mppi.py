"""Model predictive path integrals (G. Williams et al. 2018, "Information-Theoretic Model Predictive Control")."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from larp_model.errors import InputError
from mpc.search import COLOUR, Problem, Search, coloured_noise, merged


@dataclass(frozen=True)
class MPPI:
    """Draw candidates around the mean, move it to their average, each weighted by exp(-cost / temperature).

    The spread stays as it is. The mean is a candidate in the next round, and the result is the best candidate.
    """

    differentiates: ClassVar[bool] = False
    terminal: ClassVar[bool] = False

    samples: int = 64
    """Candidates of a round."""
    rounds: int = 4
    temperature: float = 0.1
    """In units of the standard deviation of a round's finite costs."""
    exponent: float = COLOUR
    """Colour of the noise; 0 is white."""
    elites: int = 8
    """Number of the best candidates that the search returns."""

    def __post_init__(self) -> None:
        least_of = {"samples": 2, "rounds": 1, "elites": 1, "temperature": 1e-6, "exponent": 0}
        for name, least in least_of.items():
            if not least <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: got {getattr(self, name)}, needs a finite number >= {least:g}")

    def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Return the search after all rounds, with the last mean evaluated."""
        search = search._replace(mean=search.elites[0])
        for _ in range(self.rounds):
            noise = coloured_noise(random, (self.samples, *search.mean.shape), self.exponent)
            candidates = search.mean + search.spread * noise
            candidates[0] = search.mean
            costs = problem.evaluate(candidates).costs
            search = self.update(merged(search, candidates, costs), candidates, costs)
        last = search.mean[None]
        return merged(search, last, problem.evaluate(last).costs)

    def update(self, search: Search, candidates: np.ndarray, costs: np.ndarray) -> Search:
        """Return the search with its mean at the weighted average; where no candidate is finite it stays."""
        finite = np.isfinite(costs)
        if not finite.any():
            return search
        finite_costs = costs[finite].astype(float)
        scale = self.temperature * max(finite_costs.std(), 1e-12)
        weights = np.exp((finite_costs.min() - finite_costs) / scale)
        shares = (weights / weights.sum()).astype(np.float32)
        return search._replace(mean=np.einsum("n,nkjd->kjd", shares, candidates[finite]))

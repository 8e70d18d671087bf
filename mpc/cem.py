"""The cross-entropy method with the refinements of iCEM (Pinneri et al. 2020, "Sample-efficient CEM")."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from larp_model.errors import InputError
from mpc.search import COLOUR, Problem, Search, best_first, coloured_noise


@dataclass(frozen=True)
class CEM:
    """Draw candidates from a normal distribution over the knots, refit it to the best of them, repeat.

    Refinements: noise coloured along the knots, a shrinking population, a share of the elites as candidates again
    (the best always), momentum on the old distribution, the mean itself as a candidate of the last round, a floor
    on the spread. The result is the best candidate, not the mean.
    """

    differentiates: ClassVar[bool] = False
    terminal: ClassVar[bool] = False

    samples: int = 256
    """Candidates of the first round."""
    rounds: int = 6
    elites: int = 24
    """Candidates that the distribution is refitted to."""
    decay: float = 1.25
    """By how much the population shrinks each round; see `sizes`."""
    keep: float = 0.3
    """Share of the elites that are candidates again in the next round, and in the next plan."""
    momentum: float = 0.1
    """Share of the old mean and spread in the new."""
    exponent: float = COLOUR
    """Colour of the noise; 0 is white."""
    floor: float = 0.05
    """Least spread, as a share of the first plan's."""

    def __post_init__(self) -> None:
        least_of = {"rounds": 1, "elites": 2, "samples": 2 * self.elites, "decay": 1, "exponent": 0}
        for name, least in least_of.items():
            if not least <= getattr(self, name) < math.inf:
                raise InputError(f"{name}: got {getattr(self, name)}, needs a finite number >= {least}")
        for name in ("keep", "momentum", "floor"):
            if not 0 <= getattr(self, name) < 1:
                raise InputError(f"{name}: got {getattr(self, name)}, needs a share in [0, 1)")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Return the number of candidates in each round: samples / decay^round, at least twice the elites.

        Rounded up to a half, a quarter ... of `samples`, because every size is compiled apart.
        """
        halvings = (math.floor(r * math.log2(self.decay)) for r in range(self.rounds))
        return tuple(max(2 * self.elites, self.samples >> h) for h in halvings)

    @property
    def retained(self) -> int:
        """Return how many elites are candidates of the next round again."""
        return max(1, math.ceil(self.keep * self.elites))

    def improve(self, search: Search, random: np.random.Generator, problem: Problem) -> Search:
        """Return the search after all rounds."""
        for index, size in enumerate(self.sizes):
            candidates = self.sample(search, random, size, last=index == self.rounds - 1)
            search = self.update(search, candidates, problem.evaluate(candidates).costs)
        return search

    def sample(self, search: Search, random: np.random.Generator, size: int, last: bool) -> np.ndarray:
        """Return candidates (N, K, J, 3) [rad]: elites, best first, then draws, in the last round the mean as well."""
        noise = coloured_noise(random, (size, *search.mean.shape), self.exponent)
        candidates: np.ndarray = search.mean + search.spread * noise
        candidates[: self.retained] = search.elites[: self.retained]
        if last:
            candidates[self.retained] = search.mean
        return candidates

    def update(self, search: Search, candidates: np.ndarray, costs: np.ndarray) -> Search:
        """Refit the distribution to the best candidates that are finite; if none is, it and the elites stay.

        Where a search has more elites than there are candidates, the last of them stay too.
        """
        elites, elite_costs = best_first(candidates, costs, len(search.elites))
        count = int(np.isfinite(elite_costs[: self.elites]).sum())
        if count == 0:
            return search._replace(costs=np.full(len(search.costs), np.inf, np.float32))
        best = elites[:count][: self.elites]
        mean = self.momentum * search.mean + (1 - self.momentum) * best.mean(axis=0)
        spread = self.momentum * search.spread + (1 - self.momentum) * best.std(axis=0)
        return search._replace(
            mean=mean,
            spread=np.maximum(spread, self.floor * search.scale) if count > 1 else search.spread,
            elites=np.concatenate([elites, search.elites[len(elites) :]]),
            costs=np.concatenate([elite_costs, np.full(len(search.elites) - len(elites), np.inf, np.float32)]),
        )

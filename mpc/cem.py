"""The cross-entropy method with the refinements of iCEM (Pinneri et al. 2020, "Sample-efficient CEM")."""

import itertools
import math
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp

from mpc.search import Score, Search, best_first, coloured_noise


@dataclass(frozen=True)
class CEM:
    """Draw candidates from a normal distribution over the knots, refit it to the best of them, repeat.

    Refinements: noise coloured along the knots, a shrinking population, a share of the elites tried again
    (the best always is), momentum on the old distribution, the mean itself tried in the last round, a floor
    on the spread. What comes out is the best candidate, not the mean.
    """

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
    exponent: float = 2.0
    """Colour of the noise; 0 is white."""
    floor: float = 0.05
    """Least spread, as a share of the first plan's."""

    def __post_init__(self) -> None:
        least_of = {"rounds": 1, "elites": 2, "samples": 2 * self.elites, "decay": 1, "exponent": 0}
        for name, least in least_of.items():
            if not least <= getattr(self, name) < math.inf:
                raise ValueError(f"{name}: got {getattr(self, name)}, needs a finite number >= {least}")
        for name in ("keep", "momentum", "floor"):
            if not 0 <= getattr(self, name) < 1:
                raise ValueError(f"{name}: got {getattr(self, name)}, needs a share in [0, 1)")

    @property
    def sizes(self) -> tuple[int, ...]:
        """Candidates in each round: samples / decay^round, at least twice the elites.

        Rounded up to a half, a quarter ... of `samples`, because every size is compiled apart.
        """
        halvings = (math.floor(r * math.log2(self.decay)) for r in range(self.rounds))
        return tuple(max(2 * self.elites, self.samples >> h) for h in halvings)

    @property
    def kept(self) -> int:
        """Elites among the candidates of the next round."""
        return max(1, math.ceil(self.keep * self.elites))

    def improve(self, search: Search, key: jax.Array, score: Score) -> tuple[Search, list[jax.Array]]:
        """All rounds; also returns every candidate's cost, (N,) a round."""

        def one_round(size: int, search: Search, inputs: tuple[jax.Array, jax.Array]) -> tuple[Search, jax.Array]:
            key, last = inputs
            candidates = self.sample(search, key, size, last)
            costs = score(candidates)
            return self.update(search, candidates, costs), costs

        history: list[jax.Array] = []
        keys, last = jax.random.split(key, self.rounds), jnp.arange(self.rounds) == self.rounds - 1
        for size, group in itertools.groupby(self.sizes):
            rounds = slice(len(history), len(history) + len(list(group)))
            search, costs = jax.lax.scan(partial(one_round, size), search, (keys[rounds], last[rounds]))
            history.extend(costs)
        return search, history

    def sample(self, search: Search, key: jax.Array, size: int, last: jax.Array) -> jax.Array:
        """Candidates (N, K, J, 3) [rad]: the kept elites, best first, draws, and at last the mean."""
        noise = coloured_noise(key, (size, *search.mean.shape), self.exponent)
        candidates = search.mean + search.spread * noise
        candidates = candidates.at[: self.kept].set(search.elites[: self.kept])
        return candidates.at[self.kept].set(jnp.where(last, search.mean, candidates[self.kept]))

    def update(self, search: Search, candidates: jax.Array, costs: jax.Array) -> Search:
        """Refits the distribution to the best that are finite; if none is, it and the elites stay."""
        elites, elite_costs = best_first(candidates, costs, len(search.elites))
        chosen = elites[: self.elites]
        finite = jnp.isfinite(elite_costs[: self.elites])
        count = jnp.sum(finite)
        share = (finite / jnp.maximum(count, 1))[:, None, None, None]
        mean = jnp.sum(share * chosen, axis=0)
        spread = jnp.sqrt(jnp.sum(share * (chosen - mean) ** 2, axis=0))
        mean = self.momentum * search.mean + (1 - self.momentum) * mean
        spread = self.momentum * search.spread + (1 - self.momentum) * spread
        return search._replace(
            mean=jnp.where(count > 0, mean, search.mean),
            spread=jnp.where(count > 1, jnp.maximum(spread, self.floor * search.scale), search.spread),
            elites=jnp.where(count > 0, elites, search.elites),
            costs=elite_costs,
        )

"""Candidates tried in truer dynamics than the planner's own, and what that teaches the search."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp

from mpc.cem import CEM
from mpc.dynamics import Dynamics
from mpc.gradient import Gradient
from mpc.search import Score, Search, best_first

Residuals = dict[str, jax.Array]
Trial = Callable[[Dynamics | None, jax.Array], tuple[jax.Array, Residuals]]
"""Costs (N,) and residuals (N, ...) of knots (N, K, J, 3) in these dynamics; None: in the planner's own."""


class Best(NamedTuple):
    """The cheapest candidate tried so far: knots (K, J, 3) [rad], its cost () and its residuals."""

    knots: jax.Array
    cost: jax.Array
    residuals: Residuals


@dataclass(frozen=True)
class Verified:
    """The planner's own dynamics propose, truer ones decide, and their verdict corrects the next proposal.

    Each round tries the best candidates in `dynamics`. Between two rounds `optimizer` searches on in the planner's own
    dynamics, whose residuals are moved to where they are right for the best candidate so far, theta*:

        r(theta) = r_model(theta) + r_true(theta*) - r_model(theta*)

    So a model that errs much alike for neighbouring candidates finds a plan that is good in truth after a few trials,
    as an archer corrects the aim by the last miss (model management of order zero: N. Alexandrov and R. Lewis, "An
    Overview of First-Order Model Management for Engineering Optimization", 2001).
    """

    dynamics: Dynamics
    optimizer: CEM | Gradient
    rounds: int = 3
    """Trials of candidates; one only ranks what was found."""
    candidates: int = 8
    """Tried in each round; the plan that is carried on is one of the first round's."""

    def __post_init__(self) -> None:
        for name, least in {"rounds": 1, "candidates": 2}.items():
            if getattr(self, name) < least:
                raise ValueError(f"{name}: got {getattr(self, name)}, needs at least {least}")

    @property
    def elites(self) -> int:
        """How many of the best candidates it needs."""
        return max(self.candidates, self.optimizer.elites)

    @property
    def rollouts(self) -> int:
        """How many it asks of the truer dynamics."""
        return self.rounds * self.candidates

    def improve(
        self, search: Search, last: jax.Array, key: jax.Array, trial: Trial, score: Callable[[Residuals], Score]
    ) -> tuple[Search, list[jax.Array]]:
        """All rounds; also returns every candidate's cost, (N,) a round, the truer dynamics' and the planner's.

        last: knots (K, J, 3) of the plan carried on. score: costs in the planner's own dynamics, corrected.
        """
        count = self.candidates
        elites = jnp.concatenate([search.elites[: count - 1], last[None], search.elites[count - 1 : -1]])
        _, believed = trial(None, last[None])
        best = Best(last, jnp.float32(jnp.inf), _first(believed))

        def try_them(search: Search, best: Best) -> tuple[Search, Best, jax.Array]:
            costs, residuals = trial(self.dynamics, search.elites[:count])
            first = jnp.argmin(costs)
            found = Best(search.elites[first], costs[first], jax.tree.map(lambda leaf: leaf[first], residuals))
            best = jax.tree.map(partial(jnp.where, found.cost < best.cost), found, best)
            return _ranked(search, best, costs), best, costs

        def one_round(carry: tuple[Search, Best], key: jax.Array) -> tuple[tuple[Search, Best], list[jax.Array]]:
            search, best, costs = try_them(*carry)
            _, believed = trial(None, best.knots[None])
            corrections = jax.tree.map(lambda true, mine: true - mine, best.residuals, _first(believed))
            search = search._replace(mean=best.knots, costs=jnp.full(len(search.costs), jnp.inf))
            search, tried = self.optimizer.improve(search, key, score(corrections))
            return (search, best), [costs, *tried]

        start = search._replace(elites=elites), best
        # A scan, because every round would be compiled apart.
        (search, best), rounds = jax.lax.scan(one_round, start, jax.random.split(key, self.rounds - 1))
        search, _, costs = try_them(search, best)
        return search, [*(each for column in rounds for each in column), costs]


def _first(residuals: Residuals) -> Residuals:
    return jax.tree.map(lambda leaf: leaf[0], residuals)


def _ranked(search: Search, best: Best, costs: jax.Array) -> Search:
    """The search with its first elites in the order of their costs (N,), the best of all before them."""
    count = len(costs)
    tried, costs = best_first(search.elites[:count], costs, count)
    elites = jnp.concatenate([best.knots[None], tried[:-1], search.elites[count:]])
    return search._replace(elites=elites, costs=jnp.concatenate([best.cost[None], costs[:-1], search.costs[count:]]))

"""Gradient descent on the best candidates' knots, through the model."""

import math
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import optax

from mpc.search import Score, Search, best_first


@dataclass(frozen=True)
class Gradient:
    """RMSprop steps on the elites (Bharadhwaj et al. 2020, "CEM and gradient-based optimization").

    Unlike there, every candidate is scored again after its steps, and the cheapest knots on its way are kept:
    a step that lands badly costs time, never quality. Where a gradient is not finite its candidate stands
    still.

    The gradient of a long rollout through contact is true and still of little use: a learned ball on the ground turns a
    height of 1 mm into 10 rad/s within a step, and such factors multiply. Of kicks drawn around the reference the
    median is some 20 per spread, one in ten beyond 1e4, the largest seen 1e29. `clip` holds each knot's part:
    the direction is kept, the size is not believed.
    """

    steps: int = 4
    learning_rate: float = 0.05
    """Length of a first step, as a share of the joint's spread in a first plan."""
    clip: float = 1.0
    """Largest norm of a knot's gradient, in cost per spread."""
    elites: int = 8
    """Candidates that are refined."""

    def __post_init__(self) -> None:
        for name in ("steps", "elites"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: got {getattr(self, name)}, needs at least 1")
        for name in ("learning_rate", "clip"):
            if not 0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name}: got {getattr(self, name)}, needs a finite number > 0")

    def improve(self, search: Search, _key: jax.Array, score: Score) -> tuple[Search, list[jax.Array]]:
        """All steps; also returns every candidate's cost, (N,) before each step and after the last."""

        def summed(knots: jax.Array) -> tuple[jax.Array, jax.Array]:
            costs = score(knots)
            return jnp.sum(costs), costs

        def one_step(carry: Carry, _: None) -> tuple[Carry, jax.Array]:
            knots, memory, best, best_costs = carry
            gradient, costs = jax.grad(summed, has_aux=True)(knots)
            best, best_costs = _cheaper(knots, costs, best, best_costs)
            knots, memory = self.update(search, knots, gradient, memory)
            return (knots, memory, best, best_costs), costs

        knots = self.sample(search)
        start = knots, self._optimizer.init(knots), knots, jnp.full(len(knots), jnp.inf)
        (knots, _, best, best_costs), history = jax.lax.scan(one_step, start, length=self.steps)
        costs = score(knots)
        best, best_costs = _cheaper(knots, costs, best, best_costs)
        elites, elite_costs = best_first(
            jnp.concatenate([best, search.elites[len(best) :]]),
            jnp.concatenate([best_costs, search.costs[len(best) :]]),
            len(search.elites),
        )
        return search._replace(elites=elites, costs=elite_costs), [*history, costs]

    def sample(self, search: Search) -> jax.Array:
        """The candidates (N, K, J, 3) [rad] to refine: the best of the search."""
        return search.elites[: self.elites]

    def update(
        self, search: Search, knots: jax.Array, gradient: jax.Array, memory: optax.OptState
    ) -> tuple[jax.Array, optax.OptState]:
        """One step of knots (N, K, J, 3) [rad] down the cost's `gradient` [1/rad], in units of the scale."""
        scaled = gradient * search.scale
        usable = jnp.all(jnp.isfinite(scaled), axis=(1, 2, 3), keepdims=True)
        scaled = jnp.where(usable, scaled, 0.0)
        # Against the clip squared, a large gradient would overflow: divide by its largest component first.
        largest = jnp.maximum(jnp.max(jnp.abs(scaled), axis=(2, 3), keepdims=True), self.clip)
        scaled = scaled / largest
        norm = jnp.sqrt(jnp.sum(scaled**2, axis=(2, 3), keepdims=True))
        step, memory = self._optimizer.update(scaled * self.clip / jnp.maximum(norm, self.clip / largest), memory)
        return knots + step * search.scale, memory

    @property
    def _optimizer(self) -> optax.GradientTransformation:
        return optax.rmsprop(self.learning_rate, bias_correction=True)


Carry = tuple[jax.Array, optax.OptState, jax.Array, jax.Array]


def _cheaper(knots: jax.Array, costs: jax.Array, best: jax.Array, best_costs: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Per candidate the cheaper of two, the best so far in a tie."""
    won = costs < best_costs
    return jnp.where(won[:, None, None, None], knots, best), jnp.where(won, costs, best_costs)

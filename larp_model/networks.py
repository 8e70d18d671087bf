"""Multi-layer perceptrons with ELU, the statistics that normalise their inputs and outputs, and their weights."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
from jax import Array

from larp_model.errors import InputError


class Statistics(NamedTuple):
    """Mean and spread of a feature vector (F,), from data; see `floored`."""

    mean: Array
    spread: Array

    @staticmethod
    def of(samples: Array, weight: Array | None = None) -> Statistics:
        """Return the statistics of samples (N, F), each counted by its weight (N,)."""
        share = jnp.ones(samples.shape[0]) if weight is None else weight
        share = (share / share.sum())[:, None]
        mean = jnp.sum(share * samples, axis=0)
        spread = jnp.sqrt(jnp.sum(share * (samples - mean) ** 2, axis=0))
        return Statistics(mean, spread)

    @property
    def floored(self) -> Statistics:
        """Return the statistics to normalise with: features that never vary have spread 1."""
        return self._replace(spread=jnp.where(self.spread > 1e-5, self.spread, 1.0))

    def beside(self, more: int) -> Statistics:
        """Return the statistics with `more` features added that normalising leaves unchanged."""
        return Statistics(jnp.concatenate([self.mean, jnp.zeros(more)]), jnp.concatenate([self.spread, jnp.ones(more)]))

    def normalise(self, features: Array) -> Array:
        """Return features (*, F) in standard deviations from the mean."""
        return (features - self.mean) / self.spread

    def novelty(self, data: Statistics) -> Array:
        """Return the root mean square of features of data with these statistics, in standard deviations of our own."""
        return jnp.sqrt(jnp.mean((data.spread**2 + (data.mean - self.mean) ** 2) / self.spread**2))

    def restore(self, outputs: Array) -> Array:
        """Return outputs (*, F) in their own units."""
        return outputs * self.spread + self.mean


Measured = dict[str, tuple[Statistics, Statistics | None]]
"""Statistics of a network's inputs and, where they are changes of state, of its outputs, by its name."""


class Weights(NamedTuple):
    """Parameters and statistics of all networks of a model, by name.

    networks: {"dynamics/human": flax parameters, "contact/ball-human": ...}. inputs: Statistics by the same names.
    outputs: those of the networks whose outputs are changes of state.
    """

    networks: dict[str, Any]
    inputs: dict[str, Statistics]
    outputs: dict[str, Statistics]


@dataclass(frozen=True)
class Size:
    """The size of a perceptron: number of dense layers, and width of those before the last.

    skip: residual connections. reach: inputs are clipped to so many standard deviations.
    """

    layers: int
    width: int
    skip: bool = True
    reach: float = 10.0

    def __post_init__(self) -> None:
        for field in ("layers", "width"):
            value = getattr(self, field)
            if not (isinstance(value, int) and value >= 1):
                raise InputError(f"size.{field} is {value!r}, but must be an integer of at least 1")

    def network(self, outputs: int) -> Perceptron:
        """Return the perceptron with this number of outputs."""
        return Perceptron(self.layers, self.width, outputs, self.skip, self.reach)


class Perceptron(nn.Module):
    """`layers` dense layers of `width` with ELU between them, the last one of `outputs` values; see `Size`."""

    layers: int
    width: int
    outputs: int
    skip: bool
    reach: float

    @nn.compact
    def __call__(self, inputs: Array) -> Array:
        """Return outputs (*, outputs) for inputs (*, F)."""
        hidden = jnp.clip(inputs, -self.reach, self.reach)
        for index in range(self.layers - 1):
            new = jax.nn.elu(nn.Dense(self.width)(hidden))
            hidden = hidden + new if self.skip and index else new
        last = nn.initializers.variance_scaling(0.01, "fan_in", "truncated_normal")
        return nn.Dense(self.outputs, kernel_init=last)(hidden)


def evaluate(network: Perceptron, weights: Weights, name: str, inputs: Array) -> Array:
    """Return outputs (*, O) of a network for its inputs (*, F), normalised first."""
    outputs = network.apply(weights.networks[name], weights.inputs[name].normalise(inputs))
    assert isinstance(outputs, jax.Array)
    return outputs


def bounded(outputs: Array, bounds: tuple[float, ...] | float) -> Array:
    """Return outputs (*, O) within +-bounds, smoothly, and unchanged near zero."""
    limit = jnp.asarray(bounds, outputs.dtype)
    return limit * jnp.tanh(outputs / limit)


def side_by_side(*parts: Array) -> Array:
    """Return features (B, ...) as one vector (B, F)."""
    return jnp.concatenate([part.reshape(part.shape[0], -1) for part in parts], axis=-1)

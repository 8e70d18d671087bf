"""Losses of an unrolled trajectory against the truth (equations 2 to 5 of the paper)."""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from larp_model import features
from larp_model import state as packed
from larp_model.scene import Scene


class LossWeights(NamedTuple):
    """Weights of the terms. velocity [s^2] is not in the paper, which rightly finds that it cannot replace position."""

    position: float = 1.0
    rotation: float = 1.0
    displacement: float = 0.1
    velocity: float = 0.0


def position(predicted: Array, true: Array) -> Array:
    """Squared distance (*, L) [m^2] of the links' centres."""
    return jnp.sum((packed.position(predicted) - packed.position(true)) ** 2, axis=-1)


def rotation(predicted: Array, true: Array) -> Array:
    """1 - |q . q'| (*, L)."""
    return 1.0 - jnp.abs(jnp.sum(packed.orientation(predicted) * packed.orientation(true), axis=-1))


def velocity(predicted: Array, true: Array) -> Array:
    """Difference (*, L) of the links' velocities, squared [m^2/s^2] below 1 m/s and linear above.

    So an impact that is missed by a step does not drown everything else.
    """
    squared = jnp.sum((packed.velocity(predicted) - packed.velocity(true)) ** 2, axis=-1)
    return 2.0 * (jnp.sqrt(1.0 + squared) - 1.0)


def displacement(scene: Scene, predicted: Array, shape: Array) -> Array:
    """Squared joint displacement (*, number of joints) [m^2]."""
    return jnp.sum(features.displacement(scene, predicted, shape) ** 2, axis=-1)


def total(
    scene: Scene, weights: LossWeights, emphasis: Array, predicted: Array, true: Array
) -> tuple[Array, dict[str, Array]]:
    """The weighted sum and its terms, averaged over states (B, H, L, 13); `emphasis` (L,) weighs the links."""
    shape = features.morphology(scene)
    fast = velocity(predicted, true)
    terms = {
        "position": jnp.mean(emphasis * position(predicted, true)),
        "rotation": jnp.mean(rotation(predicted, true)),
        "displacement": jnp.sum(displacement(scene, predicted, shape)) / fast.size,
        "velocity": jnp.mean(emphasis * fast),
    }
    return sum(getattr(weights, name) * value for name, value in terms.items()), terms  # type: ignore[return-value]

"""Losses of an unrolled trajectory against the truth (equations 2 to 5 of the paper)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from larp_model import state as packed
from larp_model.physics import kinematics
from larp_model.scene import Scene

# Where a predicted link is further than this from the truth, the sequence has gone another way [m].
LOST = 1.0


class LossWeights(NamedTuple):
    """Weights of the terms: squared distance [m^2], 1 - |q . q'|, and squared joint displacement [m^2]."""

    position: float = 1.0
    rotation: float = 1.0
    displacement: float = 0.1


def pseudo_huber(squared: Array, limit: float) -> Array:
    """Return squared errors that become linear beyond `limit`."""
    return 2.0 * limit**2 * (jnp.sqrt(1.0 + squared / limit**2) - 1.0)


def position(predicted: Array, true: Array) -> Array:
    """Return the squared distance (*, L) [m^2] of the links' centres."""
    return jnp.sum((packed.position(predicted) - packed.position(true)) ** 2, axis=-1)


def rotation(predicted: Array, true: Array) -> Array:
    """Return 1 - |q . q'| (*, L) of the links' orientations."""
    return 1.0 - jnp.abs(jnp.sum(packed.orientation(predicted) * packed.orientation(true), axis=-1))


def displacement(scene: Scene, predicted: Array, morphology: Array) -> Array:
    """Return the squared joint displacement (*, number of joints) [m^2]."""
    return jnp.sum(kinematics.displacement(scene, predicted, morphology) ** 2, axis=-1)


def total(
    scene: Scene, weights: LossWeights, emphasis: Array, predicted: Array, true: Array, morphology: Array
) -> tuple[Array, dict[str, Array]]:
    """Return the weighted sum and its terms, means over states (B, H, L, 13); `emphasis` (L,) weighs positions.

    morphology (B or 1, L, 3).
    From where a sequence strays further than `LOST` it teaches nothing: that is left out, and "lost" is its share.
    """
    places = position(predicted, true)
    near = jnp.cumprod(jnp.max(places, axis=2) < LOST**2, axis=1)
    kept = jax.lax.stop_gradient(near).astype(places.dtype)

    def mean(values: Array) -> Array:
        return jnp.sum(kept * jnp.sum(values, axis=2)) / (jnp.maximum(jnp.sum(kept), 1.0) * places.shape[2])

    terms = {
        "position": mean(emphasis * places),
        "rotation": mean(rotation(predicted, true)),
        "displacement": mean(displacement(scene, predicted, morphology[:, None])),
    }
    loss = jnp.sum(jnp.stack([weight * terms[name] for name, weight in weights._asdict().items()]))
    return loss, terms | {"lost": 1.0 - jnp.mean(kept)}

"""Losses of an unrolled trajectory against the ground truth (equations 2 to 5 of the paper)."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from larp_model import state as packed
from larp_model.physics import kinematics
from larp_model.scene import Scene

# Distance of a predicted link from the ground truth beyond which a sequence is lost [m].
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
    States from the first with an error beyond `LOST` on are left out; "lost" is their share.
    """
    squared_distances = position(predicted, true)
    on_track = jnp.cumprod(jnp.max(squared_distances, axis=2) < LOST**2, axis=1)
    valid = jax.lax.stop_gradient(on_track).astype(squared_distances.dtype)

    def mean(values: Array) -> Array:
        return jnp.sum(valid * jnp.sum(values, axis=2)) / (
            jnp.maximum(jnp.sum(valid), 1.0) * squared_distances.shape[2]
        )

    terms = {
        "position": mean(emphasis * squared_distances),
        "rotation": mean(rotation(predicted, true)),
        "displacement": mean(displacement(scene, predicted, morphology[:, None])),
    }
    loss = jnp.sum(jnp.stack([weight * terms[name] for name, weight in weights._asdict().items()]))
    return loss, terms | {"lost": 1.0 - jnp.mean(valid)}

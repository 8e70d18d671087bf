"""Residuals of cost terms that tasks share."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
from jax import Array

from larp_model import state as packed
from mpc import nearest_on_path


def pose(states: Array, controls: Array, context: Any, human: slice = slice(None)) -> Array:
    """Return how far the human's links, seen from the pelvis, are from the reference's (H, 3 n) [m].

    context: `reference` (H, n, 3) [m], and `counted` (H,), the share to which each step counts. human: rows of its n
    links in states (H', L, 13).
    """
    links = packed.position(states[: len(controls), human])
    apart = links - links[:, :1] - context["reference"]
    return (apart * context["counted"][:, None, None]).reshape(len(controls), -1)


def effort(states: Array, controls: Array, context: Any) -> Array:
    """Return how far joint targets (H, J, 3) are from the reference's, the context's `controls`, (H, 3 J) [rad]."""
    return (controls - context["controls"]).reshape(len(controls), -1)


def apart(states: Array, controls: Array, context: Any, link: int, other: int) -> Array:
    """Return the vector (3,) [m] from link `other` to `link`, by rows, where they are nearest within the controls."""
    found = states[: len(controls), link, packed.POSITION] - states[: len(controls), other, packed.POSITION]
    return found[jnp.argmin(jnp.sum(found**2, axis=-1))]


def miss(states: Array, controls: Array, context: Any, ball: int) -> Array:
    """Return the vector (3,) [m] from the context's `goal` (3,) [m] to the nearest point of the path of row `ball`."""
    nearest, _ = nearest_on_path(states[:, ball, packed.POSITION], context["goal"])
    return nearest - context["goal"]


def upright(states: Array, controls: Array, context: Any) -> Array:
    """Return how far the pelvis, row 0, is below the context's `height` [m], (H, 1) [m]."""
    return jnp.maximum(context["height"] - states[: len(controls), 0, 2:3], 0.0)

"""Residuals of cost terms that tasks share, and the context that they are given."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array

from larp_model import expected_error as by_step
from larp_model import state as packed
from larp_model.scene import Scene


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Context:
    """Data of a task that residuals need beside the states (H', L, 13) and controls (H, J, 3) of a candidate."""

    goal: Any  # pytree of arrays, as `Task.check` returns it
    times: Any  # (H',) of the states, from the start [s]
    reference: Any  # (H, n, 3) links of the human in the reference motion, from its pelvis [m]
    reference_share: Any  # (H,) by which the distance from the reference counts
    pelvis_height: Any  # () least height of the pelvis [m]
    controls: Any  # (H, J, 3) of the reference [rad]


def pose(states: Array, controls: Array, context: Context, human: slice = slice(None)) -> Array:
    """Return the root-aligned distances of the human's links from the reference's (H, 3 n) [m].

    human: rows of its n links in states (H', L, 13).
    """
    links = packed.position(states[: len(controls), human])
    apart = links - links[:, :1] - context.reference
    weighted: Array = apart * context.reference_share[:, None, None]
    return weighted.reshape(len(controls), -1)


def effort(states: Array, controls: Array, context: Any) -> Array:
    """Return the differences of joint targets (H, J, 3) from the context's `controls`, (H, 3 J) [rad]."""
    difference: Array = controls - context.controls
    return difference.reshape(len(controls), -1)


def apart(states: Array, controls: Array, context: Any, link: int, other: int) -> Array:
    """Return the vector (3,) [m] from link `other` to `link`, by rows, where they are nearest within the controls."""
    vectors = states[: len(controls), link, packed.POSITION] - states[: len(controls), other, packed.POSITION]
    return vectors[jnp.argmin(jnp.sum(vectors**2, axis=-1))]


def upright(states: Array, controls: Array, context: Any) -> Array:
    """Return the depth of the pelvis, row 0, below the context's `pelvis_height` [m], (H, 1) [m]."""
    return jnp.maximum(context.pelvis_height - states[: len(controls), 0, 2:3], 0.0)


def expected_errors(states: Array, controls: Array, context: Any, scene: Scene) -> Array:
    """Return the errors of the model to expect in the steps from the second on, (H - 1, 1) [mm]; see `expected_error`.

    As a cost, it keeps a plan where the model is to be trusted: without hard contacts and sudden motion.
    """
    errors: Array = by_step.expected_errors(scene, states[: len(controls)], jnp.asarray(scene.morphology))
    return 1e3 * errors[:, None]

"""Error against the ground truth: by horizon, in joints, and of the velocity with which a struck body leaves."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import launches, rotation
from larp_model import state as packed
from larp_model.errors import InputError
from larp_model.learned.model import Model
from larp_model.networks import Weights
from larp_model.physics import kinematics
from larp_model.prediction import predict
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from larp_model.state import Trajectories

# Error beyond which a prediction has diverged [m].
DIVERGED = 20.0


def evaluate(simulator: Simulator, episodes: Trajectories, windows: Sequence[int]) -> dict[str, Any]:
    """Return errors over the first n steps of every episode, n in `windows`, and of launches.

    windows: {n: {body: mean distance of its links [m]}}; rotation_rad and displacement_m over the longest window. None
    where all predictions diverged. launch: `Launches.summary` from the true state 0 and 3 steps before first contact.
    """
    longest = max(windows)
    if episodes.controls.shape[1] < longest:
        raise InputError(f"episodes have {episodes.controls.shape[1]} steps, but the windows need {longest}")
    scene = simulator.scene
    controls, torques = episodes.controls[:, :longest], episodes.torques[:, :longest]
    predicted = predict(simulator, episodes.states[:, 0], controls, torques, episodes.morphology)
    distance, finite = distances(predicted, episodes, longest)
    true = episodes.states[:, 1 : longest + 1]
    relative = rotation.multiply(
        jnp.asarray(predicted[finite][..., packed.ORIENTATION]),
        rotation.conjugate(jnp.asarray(true[finite][..., packed.ORIENTATION])),
    )
    displacements = kinematics.displacement(
        scene, jnp.asarray(predicted[finite]), jnp.asarray(episodes.morphology[finite][:, None])
    )
    return {
        "windows": by_window(scene, distance[finite], windows),
        "rotation_rad": {
            body.name: mean(
                jnp.linalg.norm(rotation.to_rotation_vector(relative[:, :, scene.rows(body.name)]), axis=-1)
            )
            for body in scene.bodies
            if not body.is_ball
        },
        "displacement_m": mean(jnp.linalg.norm(displacements, axis=-1)) if displacements.shape[-2] else 0.0,
        "sequences": len(episodes.states),
        "diverged": int((~finite).sum()),
        "launch": launched(simulator, episodes),
    }


def launched(simulator: Simulator, episodes: Trajectories) -> dict[str, Any]:
    """Return `Launches.summary` from the true state 0 and 3 steps before contact; empty if nothing can be struck."""
    if launches.struck(simulator.scene) is None:
        return {}
    return {str(before): launches.launches_of(simulator, episodes, before).summary for before in (0, 3)}


def novelty(simulator: Simulator, states: np.ndarray, controls: np.ndarray) -> float:
    """Return how far states (T + 1, L, 13) under controls (T, J, 3) [rad] are from the training data.

    Root mean square, over steps and features, of the inputs of the bodies' networks, in standard deviations of their
    training data, over which it is 1; the largest of all bodies. Contacts are left out: where links are apart, the
    inputs of their networks are arbitrary and have no effect.
    """
    arrays = (
        jnp.asarray(array, jnp.float32) for array in (states[:-1], states[1:], controls, simulator.morphology[None])
    )
    return float(_novelty(simulator.model, simulator.weights, *arrays))


@partial(jax.jit, static_argnums=0)
def _novelty(model: Model, weights: Weights, before: Array, after: Array, controls: Array, sizes: Array) -> Array:
    measured = model.measure(before, after, controls, jnp.zeros((*before.shape[:2], 3)), sizes)
    names = [name for name in model.networks() if name.startswith("dynamics/")]
    return jnp.stack([weights.inputs[name].novelty(measured[name][0]) for name in sorted(names)]).max()


def distances(predicted: np.ndarray, episodes: Trajectories, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the links' distance (E, steps, L) [m] from the ground truth, and a mask (E,): no divergence."""
    offset = predicted[:, :steps, :, packed.POSITION] - episodes.states[:, 1 : steps + 1, :, packed.POSITION]
    distance = np.linalg.norm(offset, axis=-1)
    return distance, np.isfinite(distance).all(axis=(1, 2)) & (distance.max(axis=(1, 2)) < DIVERGED)


def by_window(scene: Scene, distance: np.ndarray, windows: Sequence[int]) -> dict[str, dict[str, float | None]]:
    """Return the mean distance [m] of each body's links over the first n steps, n in `windows`, of (E, H, L)."""
    return {str(n): {body.name: mean(distance[:, :n, scene.rows(body.name)]) for body in scene.bodies} for n in windows}


def mean(values: np.ndarray | jax.Array) -> float | None:
    """Return the mean of all values; None where there are none."""
    return float(values.mean()) if values.size else None

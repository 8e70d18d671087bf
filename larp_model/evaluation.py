"""Error against the truth: by horizon, in joints, and of the velocity with which a struck body leaves."""

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

# Beyond this a prediction has diverged [m].
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
    distance, kept = distances(predicted, episodes, longest)
    true = episodes.states[:, 1 : longest + 1]
    relative = rotation.multiply(
        jnp.asarray(predicted[kept][..., packed.ORIENTATION]),
        rotation.conjugate(jnp.asarray(true[kept][..., packed.ORIENTATION])),
    )
    apart = kinematics.displacement(
        scene, jnp.asarray(predicted[kept]), jnp.asarray(episodes.morphology[kept][:, None])
    )
    return {
        "windows": by_window(scene, distance[kept], windows),
        "rotation_rad": {
            body.name: mean(
                jnp.linalg.norm(rotation.to_rotation_vector(relative[:, :, scene.rows(body.name)]), axis=-1)
            )
            for body in scene.bodies
            if not body.is_ball
        },
        "displacement_m": mean(jnp.linalg.norm(apart, axis=-1)) if apart.shape[-2] else 0.0,
        "sequences": len(episodes.states),
        "diverged": int((~kept).sum()),
        "launch": launched(simulator, episodes),
    }


def launched(simulator: Simulator, episodes: Trajectories) -> dict[str, Any]:
    """Return `Launches.summary` from the true state 0 and 3 steps before contact; empty if nothing can be struck."""
    if launches.struck(simulator.scene) is None:
        return {}
    return {str(before): launches.launches_of(simulator, episodes, before).summary for before in (0, 3)}


def novelty(simulator: Simulator, states: np.ndarray, controls: np.ndarray) -> float:
    """Return how far states (T + 1, L, 13) under controls (T, J, 3) [rad] are from the training data.

    Root mean square, over steps and features, of what the networks of the bodies see, in standard deviations of their
    training data, over which it is 1; of the body that is furthest from its own. Contacts are left out: where links
    are apart their networks see anything, and are not heard.
    """
    given = (jnp.asarray(each, jnp.float32) for each in (states[:-1], states[1:], controls, simulator.morphology[None]))
    return float(_novelty(simulator.model, simulator.weights, *given))


@partial(jax.jit, static_argnums=0)
def _novelty(model: Model, weights: Weights, before: Array, after: Array, controls: Array, sizes: Array) -> Array:
    seen = model.measure(before, after, controls, jnp.zeros((*before.shape[:2], 3)), sizes)
    names = [name for name in model.networks() if name.startswith("dynamics/")]
    return jnp.stack([weights.inputs[name].novelty(seen[name][0]) for name in sorted(names)]).max()


def distances(predicted: np.ndarray, episodes: Trajectories, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the links' distance from the ground truth (E, steps, L) [m], and (E,) which episodes did not diverge."""
    apart = predicted[:, :steps, :, packed.POSITION] - episodes.states[:, 1 : steps + 1, :, packed.POSITION]
    distance = np.linalg.norm(apart, axis=-1)
    return distance, np.isfinite(distance).all(axis=(1, 2)) & (distance.max(axis=(1, 2)) < DIVERGED)


def by_window(scene: Scene, distance: np.ndarray, windows: Sequence[int]) -> dict[str, dict[str, float | None]]:
    """Return the mean distance [m] of each body's links over the first n steps, n in `windows`, of (E, H, L)."""
    return {str(n): {body.name: mean(distance[:, :n, scene.rows(body.name)]) for body in scene.bodies} for n in windows}


def mean(values: np.ndarray | jax.Array) -> float | None:
    """Return the mean of all values; None where there are none."""
    return float(values.mean()) if values.size else None

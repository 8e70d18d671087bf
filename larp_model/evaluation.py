"""Error against the truth: by horizon, in joints, and of the velocity with which a struck body leaves."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import kinematics, rotation
from larp_model import state as packed
from larp_model.errors import InputError
from larp_model.meeting import first_contacts
from larp_model.networks import Weights
from larp_model.parts.part import Model, measure
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from larp_model.state import Trajectories

# The launch is read this many steps after first contact, of balls faster than this [m/s].
LAUNCH_STEPS = 8
LAUNCH_SPEED = 1.5
# Beyond this a prediction has diverged [m].
DIVERGED = 20.0
# Steps, to whose multiples rollouts are filled up: one program, then, serves all windows of a kick.
PADDED = 64


def predict(
    simulator: Simulator, states: np.ndarray, controls: np.ndarray, torques: np.ndarray, morphology: np.ndarray,
    chunk: int = 128,
) -> np.ndarray:  # fmt: skip
    """States (E, H, L, 13) that the simulator predicts from states (E, L, 13), chunk by chunk.

    What is compiled serves any H up to a multiple of `PADDED`.
    """
    parts, steps = [], controls.shape[1]
    rest = ((0, 0), (0, -steps % PADDED), (0, 0), (0, 0))
    controls, torques = np.pad(controls, rest), np.pad(torques, rest)
    for begin in range(0, len(states), chunk):
        rows = np.minimum(np.arange(begin, begin + chunk), len(states) - 1)
        start, targets, pushes, sizes = (jnp.asarray(each[rows]) for each in (states, controls, torques, morphology))
        rolled = _roll(simulator.model, simulator.weights, start, targets, pushes, sizes, jnp.asarray(steps))
        parts.append(np.asarray(rolled)[:, :steps])
    return np.concatenate(parts)[: len(states)]


@partial(jax.jit, static_argnums=0)
def _roll(
    model: Model, weights: Weights, start: Array, targets: Array, pushes: Array, sizes: Array, steps: Array
) -> Array:
    """Compiled once for all weights of a model."""
    return Simulator(model, weights).rollout(start, targets, torques=pushes, morphology=sizes, steps=steps)


def evaluate(simulator: Simulator, episodes: Trajectories, windows: Sequence[int]) -> dict[str, Any]:
    """Errors over the first n steps of every episode, n in `windows`, and of the launch; see `launch`.

    windows: {n: {body: mean distance of its links [m]}}; rotation_rad and displacement_m over the longest window. None
    where all predictions diverged.
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
        "launch": {str(before): launch(simulator, episodes, before) for before in (0, 3)} if struck(scene) else {},
    }


def novelty(simulator: Simulator, states: np.ndarray, controls: np.ndarray) -> float:
    """How far a trajectory of states (T + 1, L, 13) under controls (T, J, 3) [rad] is from what was learned.

    Root mean square, over steps and features, of what the networks of the bodies see, in standard deviations of their
    training data, over which it is 1; of the body that is furthest from its own. Contacts are left out: where links
    are apart their networks see anything, and are not heard.
    """
    given = (jnp.asarray(each, jnp.float32) for each in (states[:-1], states[1:], controls))
    return float(_novelty(simulator.model, simulator.weights, *given))


@partial(jax.jit, static_argnums=0)
def _novelty(model: Model, weights: Weights, before: Array, after: Array, controls: Array) -> Array:
    seen = measure(model, before, after, controls, jnp.zeros((*before.shape[:2], 3)))
    names = {name for part in model.bodies for name in part.networks()}
    return jnp.stack([weights.inputs[name].novelty(seen[name][0]) for name in sorted(names)]).max()


def distances(predicted: np.ndarray, episodes: Trajectories, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """How far links are from the truth, (E, steps, L) [m], and (E,) which episodes were predicted without diverging."""
    apart = predicted[:, :steps, :, packed.POSITION] - episodes.states[:, 1 : steps + 1, :, packed.POSITION]
    distance = np.linalg.norm(apart, axis=-1)
    return distance, np.isfinite(distance).all(axis=(1, 2)) & (distance.max(axis=(1, 2)) < DIVERGED)


def by_window(scene: Scene, distance: np.ndarray, windows: Sequence[int]) -> dict[str, dict[str, float | None]]:
    """Mean distance [m] of every body's links over the first n steps, n in `windows`; of distances (E, H, L)."""
    return {str(n): {body.name: mean(distance[:, :n, scene.rows(body.name)]) for body in scene.bodies} for n in windows}


def struck(scene: Scene) -> int | None:
    """The row of the link that others strike: the second body of the first pair of two, if of one link; or none."""
    for pair in scene.between.pairs[:1]:
        if len(scene.body(pair.second).links) == 1:
            return scene.index(pair.second, pair.second_links[0])
    return None


def launch(simulator: Simulator, episodes: Trajectories, before: int) -> dict[str, Any]:
    """Error of a struck body's velocity `LAUNCH_STEPS` after first contact, from the truth `before` steps ahead of it.

    Over bodies that leave faster than `LAUNCH_SPEED`; relative_error is |v - v'| / |v|, angle_deg between them.
    """
    scene = simulator.scene
    row = struck(scene)
    if row is None:
        raise InputError("simulator.scene has no body of one link that another can strike")
    contacts = first_contacts(scene.between, episodes)
    steps = before + LAUNCH_STEPS
    rows = np.flatnonzero((contacts >= before) & (contacts + LAUNCH_STEPS <= episodes.controls.shape[1]))
    rows = rows[speed(episodes.states[rows, contacts[rows] + LAUNCH_STEPS, row]) > LAUNCH_SPEED]
    if not len(rows):
        return {"count": 0}
    start = contacts[rows] - before
    columns = start[:, None] + np.arange(steps)
    predicted = predict(
        simulator, episodes.states[rows, start], episodes.controls[rows[:, None], columns],
        episodes.torques[rows[:, None], columns], episodes.morphology[rows],
    )[:, -1, row, packed.VELOCITY]  # fmt: skip
    true = episodes.states[rows, start + steps, row, packed.VELOCITY]
    size = np.linalg.norm(true, axis=-1)
    error = np.linalg.norm(predicted - true, axis=-1) / size
    cosine = np.sum(predicted * true, axis=-1) / np.maximum(size * np.linalg.norm(predicted, axis=-1), 1e-9)
    angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    diverged = ~np.isfinite(error)
    return {
        "count": len(rows),
        "relative_error": quantiles(np.where(diverged, np.inf, error)),
        "angle_deg": quantiles(np.where(diverged, 180.0, angle)),
    }


def mean(values: np.ndarray | jax.Array) -> float | None:
    """Mean of all values; None where there are none."""
    return float(values.mean()) if values.size else None


def speed(links: np.ndarray) -> np.ndarray:
    """Speed (*,) [m/s] of links (*, 13)."""
    return np.linalg.norm(links[..., packed.VELOCITY], axis=-1)


def quantiles(values: np.ndarray) -> dict[str, float]:
    """Median, 75th and 90th percentile."""
    return {name: float(np.quantile(values, q)) for name, q in (("median", 0.5), ("p75", 0.75), ("p90", 0.9))}

"""Ground-truth episodes around the reference kick, on which the learned simulator is trained and evaluated."""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.detection import contact_points
from larp_model.engines.episodes import Episodes, record
from larp_model.engines.mujoco import Truth, closed
from larp_model.physics.kinematics import morphology_of
from larp_model.rotation import turned_about_z
from larp_model.scene import Link, Scene
from tasks.episodes.people import random_people
from tasks.exploration import exploration_std, smooth_noise
from tasks.motions.references import Reference, clearance, resting_height

STEPS = 70
# A link that weighs less [kg] is pushed less, in proportion: a thumb would rotate too fast.
FULL_PUSH_MASS = 0.5


def random_starts(
    random: np.random.Generator, scene: Scene, reference: Reference, count: int, steps: int,
    sizes: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return states (count, L, 13) of the reference, disturbed and turned about z, and their steps (count,) in it.

    The link that the human may strike, if any, rests where a foot will pass or near the ball's spot, or comes from
    anywhere. sizes: (count, L, 3) of other bodies, placed as far above the ground as the reference is.
    """
    latest_start = max(len(reference.controls) - steps - 1, 1)
    from_start = random.random(count) < 0.5
    first_steps = np.where(from_start, 0, random.integers(0, min(120, latest_start), count))
    rows = scene.rows("human")
    human = len(scene.body("human").links)
    states = np.zeros((count, len(scene.links), packed.SIZE))
    states[:, rows] = reference.states[first_steps, :human]
    size = np.where(random.random(count) < 0.3, 0.0, random.uniform(0.0, 1.0, count))[:, None, None]
    tilt = Rotation.from_rotvec((0.06 * size * random.standard_normal((count, human, 3))).reshape(-1, 3))
    orientations = tilt * Rotation.from_quat(states[:, rows, packed.ORIENTATION].reshape(-1, 4), scalar_first=True)
    states[:, rows, packed.ORIENTATION] = orientations.as_quat(scalar_first=True).reshape(count, human, 4)
    states[:, rows, packed.ANGULAR_VELOCITY] += 1.0 * size * random.standard_normal((count, human, 3))
    states[:, rows.start, packed.VELOCITY] += 0.3 * size[:, 0] * random.standard_normal((count, 3))
    states[:, rows, 2] += 0.02 * size[:, 0] * random.random((count, 1))
    if sizes is None:
        size_ratio = np.ones((count, 1, 1))
        states[:, rows] = closed(scene.only("human"), states[:, rows])
    else:
        body, usual_sizes = scene.body("human"), np.broadcast_to(scene.morphology[rows], (count, human, 3))
        size_ratio = (sizes[:, rows, 0].sum(axis=1) / usual_sizes[..., 0].sum(axis=1))[:, None, None]
        height = clearance(body, states[:, rows], usual_sizes)
        states[:, rows] = closed(scene.only("human"), states[:, rows], sizes[:, rows])
        states[:, rows, 2] += (height - clearance(body, states[:, rows], sizes[:, rows]))[:, None]
    for pair in scene.between.pairs:
        struck_link = scene.index(pair.second, pair.second_links[0])
        foot = scene.index("human", "right_foot")
        path_rows = np.minimum(first_steps[:, None] + np.arange(steps), len(reference.controls))
        paths = size_ratio * reference.states[path_rows, foot, :3]
        spot = size_ratio[:, 0] * reference.ball_spot[:2]
        states[:, struck_link] = random_places(random, scene.links[struck_link], spot, paths, scene.dt)
        states = out_of_legs(scene, states, sizes)
    return turned_about_z(states, random.uniform(-np.pi, np.pi, count)), first_steps


def random_places(
    random: np.random.Generator, link: Link, spot: np.ndarray, paths: np.ndarray, dt: float
) -> np.ndarray:
    """Return random states (count, 13) of a link that a human may strike with a foot on paths (count, steps, 3) [m].

    The link rests near the spot (2,) or (count, 2) [m] or where the foot will pass, or comes from anywhere.
    """
    count, steps = len(paths), paths.shape[1]
    states = np.zeros((count, packed.SIZE))
    states[:, packed.ORIENTATION] = (1.0, 0.0, 0.0, 0.0)
    if link.length:
        level_rotation = Rotation.from_rotvec(0.5 * np.pi * np.cross(link.axis, (1.0, 0.0, 0.0)))
        heading = Rotation.from_rotvec(random.uniform(-np.pi, np.pi, (count, 1)) * (0.0, 0.0, 1.0))
        any_rotation = Rotation.from_quat(random.standard_normal((count, 4)))
        is_level = random.random((count, 1)) < 0.6
        states[:, packed.ORIENTATION] = np.where(
            is_level, (heading * level_rotation).as_quat(scalar_first=True), any_rotation.as_quat(scalar_first=True)
        )
    lowest = resting_height(link, states)
    draw = random.random(count)
    states[:, :2] = spot + random.uniform(-0.06, 0.06, (count, 2))
    states[:, 2] = lowest
    crossing_step = random.integers(2, steps, count)
    is_on_path = draw > 0.35
    path_point = np.array(
        paths[np.arange(count), crossing_step] + 0.08 * random.standard_normal((count, 3)) + (0.08, 0.0, 0.0)
    )
    path_point[:, 2] = np.where(random.random(count) < 0.6, lowest, np.maximum(path_point[:, 2], lowest))
    states[is_on_path, :3] = path_point[is_on_path]
    is_moving = draw > 0.6
    velocity = np.array((2.0, 2.0, 1.0)) * random.standard_normal((count, 3))
    states[is_moving, 7:10] = velocity[is_moving]
    distance_back = (crossing_step * dt * random.uniform(0.0, 1.0, count))[:, None] * velocity * (1.0, 1.0, 0.0)
    states[is_moving, :3] -= distance_back[is_moving]
    is_flying = draw > 0.85
    states[is_flying, 2] += random.uniform(0.0, 1.0, count)[is_flying]
    states[is_moving, 10:13] = 8.0 * random.standard_normal((count, 3))[is_moving]
    states[:, 2] = np.maximum(states[:, 2], lowest)
    return states


def out_of_legs(scene: Scene, states: np.ndarray, morphology: np.ndarray | None = None) -> np.ndarray:
    """Return the states (N, L, 13), the struck link moved out of reach in those where links overlap.

    A link inside a leg would be no valid initial state. morphology: (N, L, 3); the scene's by default.
    """
    pair = scene.between.pairs[0]
    states, struck_link = states.copy(), scene.index(pair.second, pair.second_links[0])
    overlapping = overlaps(scene.between, states, morphology)
    states[overlapping, struck_link, :2] = (3.0, 0.0)
    states[overlapping, struck_link, 2] = resting_height(scene.links[struck_link], states[overlapping, struck_link])
    return states


def overlaps(scene: Scene, states: np.ndarray, morphology: np.ndarray | None = None) -> np.ndarray:
    """Return which of the states (N, L, 13) have a link inside another that it can touch, as a mask (N,).

    morphology: (N, L, 3); the scene's by default.
    """
    sizes = morphology_of(scene)[None] if morphology is None else jnp.asarray(morphology, jnp.float32)
    return np.asarray(_overlaps(scene, jnp.asarray(states), sizes))


@partial(jax.jit, static_argnums=0)  # which compiles in a tenth of the time that its operations take one by one
def _overlaps(scene: Scene, states: Array, sizes: Array) -> Array:
    lowest = jnp.full(len(states), jnp.inf)
    for _, points in contact_points(scene, states, sizes):
        lowest = jnp.minimum(lowest, points.gap.min(axis=1))
    return lowest < 0.0


def random_episodes(
    scene: Scene, reference: Reference, count: int, seed: int, steps: int = STEPS, varied: bool = False
) -> tuple[Episodes, int]:
    """Record episodes from `random_starts` under the reference's targets plus smooth noise, some with `pushes`.

    varied: every human has another body. Returns the episodes, and how many were dropped because they began with one
    leg in the other, or diverged.
    """
    random = np.random.default_rng(seed)
    sizes = random_people(np.random.default_rng((seed, 1)), scene, count) if varied else None
    states, first_steps = random_starts(random, scene, reference, count, steps, sizes)
    valid = ~overlaps(scene, states, sizes)  # no initial state has one leg in the other
    states, first_steps, overlapping = states[valid], first_steps[valid], int((~valid).sum())
    count -= overlapping
    sizes = None if sizes is None else sizes[valid]
    rows = np.minimum(first_steps[:, None] + np.arange(steps), len(reference.controls) - 1)
    size = random.uniform(0.0, 1.2, (count, 1, 1, 1))
    controls = reference.controls[rows] + size * smooth_noise(random, count, steps, 8, exploration_std(scene))
    controls = np.clip(controls, *scene.limits)
    torques = pushes(random, scene, count, steps)
    episodes, diverged = record(Truth(scene, batch=min(count, 256)), states, controls, torques, sizes)
    return episodes, overlapping + diverged


def pushes(random: np.random.Generator, scene: Scene, count: int, steps: int) -> np.ndarray:
    """Return torques (count, steps, L, 3) [N m] on the human in the first 10 steps of about every tenth episode."""
    torques = np.zeros((count, steps, len(scene.links), 3))
    pushed_rows = np.flatnonzero(random.random(count) < 0.1)
    human = scene.rows("human")
    directions = random.standard_normal((len(pushed_rows), 1, human.stop - human.start, 3))
    torques[pushed_rows, :10, human] = 4.0 * np.minimum(scene.morphology[human, 2:] / FULL_PUSH_MASS, 1.0) * directions
    return torques

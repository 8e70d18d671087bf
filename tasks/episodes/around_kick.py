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
from tasks.motions.references import Reference, clearance, resting

STEPS = 70
# A link that weighs less [kg] is pushed less, in proportion: a thumb would spin like a top.
LIGHT = 0.5


def random_starts(
    random: np.random.Generator, scene: Scene, reference: Reference, count: int, steps: int,
    sizes: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return states (count, L, 13) of the reference, disturbed and turned about z, and their steps (count,) in it.

    The link that the human may strike, if any, rests where a foot will pass or near the ball's spot, or comes from
    anywhere. sizes: (count, L, 3) of other bodies, placed as far above the ground as the reference is.
    """
    latest = len(reference.controls) - steps - 1
    from_start = random.random(count) < 0.5
    begin = np.where(from_start, 0, random.integers(0, min(120, latest), count))
    rows = scene.rows("human")
    human = len(scene.body("human").links)
    states = np.zeros((count, len(scene.links), packed.SIZE))
    states[:, rows] = reference.states[begin, :human]
    size = np.where(random.random(count) < 0.3, 0.0, random.uniform(0.0, 1.0, count))[:, None, None]
    tilt = Rotation.from_rotvec((0.06 * size * random.standard_normal((count, human, 3))).reshape(-1, 3))
    turned = tilt * Rotation.from_quat(states[:, rows, packed.ORIENTATION].reshape(-1, 4), scalar_first=True)
    states[:, rows, packed.ORIENTATION] = turned.as_quat(scalar_first=True).reshape(count, human, 4)
    states[:, rows, packed.ANGULAR_VELOCITY] += 1.0 * size * random.standard_normal((count, human, 3))
    states[:, rows.start, packed.VELOCITY] += 0.3 * size[:, 0] * random.standard_normal((count, 3))
    states[:, rows, 2] += 0.02 * size[:, 0] * random.random((count, 1))
    if sizes is None:
        larger = np.ones((count, 1, 1))
        states[:, rows] = closed(scene.only("human"), states[:, rows])
    else:
        body, usual = scene.body("human"), np.broadcast_to(scene.morphology[rows], (count, human, 3))
        larger = (sizes[:, rows, 0].sum(axis=1) / usual[..., 0].sum(axis=1))[:, None, None]
        above = clearance(body, states[:, rows], usual)
        states[:, rows] = closed(scene.only("human"), states[:, rows], sizes[:, rows])
        states[:, rows, 2] += (above - clearance(body, states[:, rows], sizes[:, rows]))[:, None]
    for pair in scene.between.pairs:
        struck = scene.index(pair.second, pair.second_links[0])
        foot = scene.index("human", "right_foot")
        paths = larger * reference.states[begin[:, None] + np.arange(steps), foot, :3]
        spot = larger[:, 0] * reference.ball_spot[:2]
        states[:, struck] = random_places(random, scene.links[struck], spot, paths, scene.dt)
        states = out_of_legs(scene, states, sizes)
    return turned_about_z(states, random.uniform(-np.pi, np.pi, count)), begin


def random_places(
    random: np.random.Generator, link: Link, spot: np.ndarray, paths: np.ndarray, dt: float
) -> np.ndarray:
    """Return random states (count, 13) of a link that a human may strike with a foot on paths (count, steps, 3) [m].

    The link rests near the spot (2,) or (count, 2) [m] or where the foot will pass, or comes from anywhere.
    """
    count, steps = len(paths), paths.shape[1]
    found = np.zeros((count, packed.SIZE))
    found[:, packed.ORIENTATION] = (1.0, 0.0, 0.0, 0.0)
    if link.length:
        lying = Rotation.from_rotvec(0.5 * np.pi * np.cross(link.axis, (1.0, 0.0, 0.0)))
        about = Rotation.from_rotvec(random.uniform(-np.pi, np.pi, (count, 1)) * (0.0, 0.0, 1.0))
        any_way = Rotation.from_quat(random.standard_normal((count, 4)))
        flat = random.random((count, 1)) < 0.6
        found[:, packed.ORIENTATION] = np.where(
            flat, (about * lying).as_quat(scalar_first=True), any_way.as_quat(scalar_first=True)
        )
    lowest = resting(link, found)
    kind = random.random(count)
    found[:, :2] = spot + random.uniform(-0.06, 0.06, (count, 2))
    found[:, 2] = lowest
    met = random.integers(2, steps, count)
    crossing = kind > 0.35
    place = np.array(paths[np.arange(count), met] + 0.08 * random.standard_normal((count, 3)) + (0.08, 0.0, 0.0))
    place[:, 2] = np.where(random.random(count) < 0.6, lowest, np.maximum(place[:, 2], lowest))
    found[crossing, :3] = place[crossing]
    rolling = kind > 0.6
    motion = np.array((2.0, 2.0, 1.0)) * random.standard_normal((count, 3))
    found[rolling, 7:10] = motion[rolling]
    away = (met * dt * random.uniform(0.0, 1.0, count))[:, None] * motion * (1.0, 1.0, 0.0)
    found[rolling, :3] -= away[rolling]
    flying = kind > 0.85
    found[flying, 2] += random.uniform(0.0, 1.0, count)[flying]
    found[rolling, 10:13] = 8.0 * random.standard_normal((count, 3))[rolling]
    found[:, 2] = np.maximum(found[:, 2], lowest)
    return found


def out_of_legs(scene: Scene, states: np.ndarray, morphology: np.ndarray | None = None) -> np.ndarray:
    """Return the states (N, L, 13), the struck link moved out of reach in those where links overlap.

    A link inside a leg would be no valid initial state. morphology: (N, L, 3); the scene's by default.
    """
    pair = scene.between.pairs[0]
    states, struck = states.copy(), scene.index(pair.second, pair.second_links[0])
    inside = overlaps(scene.between, states, morphology)
    states[inside, struck, :2] = (3.0, 0.0)
    states[inside, struck, 2] = resting(scene.links[struck], states[inside, struck])
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
    states, begin = random_starts(random, scene, reference, count, steps, sizes)
    apart = ~overlaps(scene, states, sizes)  # no initial state has one leg in the other
    states, begin, tangled = states[apart], begin[apart], int((~apart).sum())
    count -= tangled
    sizes = None if sizes is None else sizes[apart]
    rows = np.minimum(begin[:, None] + np.arange(steps), len(reference.controls) - 1)
    size = random.uniform(0.0, 1.2, (count, 1, 1, 1))
    controls = reference.controls[rows] + size * smooth_noise(random, count, steps, 8, exploration_std(scene))
    controls = np.clip(controls, *scene.limits)
    torques = pushes(random, scene, count, steps)
    episodes, diverged = record(Truth(scene, batch=min(count, 256)), states, controls, torques, sizes)
    return episodes, tangled + diverged


def pushes(random: np.random.Generator, scene: Scene, count: int, steps: int) -> np.ndarray:
    """Return torques (count, steps, L, 3) [N m] on the human in the first 10 steps of about every tenth episode."""
    torques = np.zeros((count, steps, len(scene.links), 3))
    pushed = np.flatnonzero(random.random(count) < 0.1)
    human = scene.rows("human")
    drawn = random.standard_normal((len(pushed), 1, human.stop - human.start, 3))
    torques[pushed, :10, human] = 4.0 * np.minimum(scene.morphology[human, 2:] / LIGHT, 1.0) * drawn
    return torques

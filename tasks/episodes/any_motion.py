"""Ground-truth episodes of humans of any size in any motion, who may strike a ball: training data of wide coverage."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import bodies
from larp_model import state as packed
from larp_model.engines.episodes import Episodes, record
from larp_model.engines.mujoco import Truth, closed
from larp_model.rotation import turned_about_z
from larp_model.scene import Body, Scene
from tasks.episodes.around_kick import STEPS, out_of_legs, overlaps, pushes, random_places
from tasks.episodes.people import random_people
from tasks.exploration import exploration_std, smooth_noise
from tasks.motions import styles
from tasks.motions.details import in_detail
from tasks.motions.references import Reference, clearance, standing_on_ground

# Shares of kicks and of walks; the rest moves from pose to pose.
KICKS, GAITS = 0.45, 0.3
# Kicks begin anywhere in the first steps of the reference.
BEGUN = 120
# Engine steps per step of the scene that suffice to predict the path of a foot.
COARSE = 5


def any_episodes(scene: Scene, reference: Reference, count: int, seed: int, steps: int = STEPS) -> tuple[Episodes, int]:
    """Return episodes of humans of every size in motion, and how many were dropped.

    Joint targets have smooth noise added; some episodes have external pushes. The body that the human may strike, if
    any, rests where a foot will pass, or comes from anywhere. Episodes are dropped that begin with overlapping legs, or
    diverge.
    """
    random = np.random.default_rng(seed)
    sizes = random_people(random, scene, count)
    states, targets = in_motion(random, scene, reference, sizes, steps)
    noise = smooth_noise(random, count, steps, 8, exploration_std(scene))
    targets += random.uniform(0.0, 1.2, (count, 1, 1, 1)) * noise
    targets = np.clip(targets, *scene.body("human").limits)
    for pair in scene.between.pairs:
        struck = scene.index(pair.second, pair.second_links[0])
        paths = feet(random, scene, states, targets, sizes)
        middle = paths[:, steps // 2, :2]
        states[:, struck] = random_places(random, scene.links[struck], middle, paths, scene.dt)
        states = out_of_legs(scene, states, sizes)
    apart = ~overlaps(scene, states, sizes)  # no initial state has one leg in the other
    states, targets, sizes, tangled = states[apart], targets[apart], sizes[apart], int((~apart).sum())
    count -= tangled
    states = turned_about_z(states, random.uniform(-np.pi, np.pi, count))
    torques = pushes(random, scene, count, steps)
    episodes, diverged = record(Truth(scene, batch=min(count, 256)), states, targets, torques, sizes)
    return episodes, tangled + diverged


def in_motion(
    random: np.random.Generator, scene: Scene, reference: Reference, sizes: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return initial states (N, L, 13) of humans in motion, and their joint targets (N, steps, J, 3) [rad].

    sizes: (N, L, 3). Kicks begin in states of the reference, other motions in the pose of their first targets, often
    with one foot standing. Half of them, at random, are mirrored. All other bodies are far away.
    """
    human, rows, count = scene.body("human"), scene.rows("human"), len(sizes)
    kicking, walking = round(KICKS * count), round(GAITS * count)
    begin = np.where(random.random(kicking) < 0.4, 0, random.integers(0, BEGUN, kicking))
    usual = bodies.human()
    performed = (
        styles.kicks(random, usual, begin, steps, scene.dt),
        styles.gaits(random, usual, walking, steps, scene.dt),
        styles.moves(random, usual, count - kicking - walking, steps, scene.dt),
    )
    targets = np.clip(in_detail(human, np.concatenate(performed)), *human.limits)
    falling = np.where(random.random((count, 1)) < 0.15, 4.0, 1.0)
    lean = Rotation.from_rotvec(falling * random.standard_normal((count, 3)) * (0.12, 0.15, 0.0))
    states = standing_on_ground(scene, targets[:, 0], lean, sizes)
    own = states[:, rows]
    own[..., packed.ANGULAR_VELOCITY] = spins(random, human, own, (targets[:, 1] - targets[:, 0]) / scene.dt)
    own[:kicking] = reference.states[begin, rows]
    own[:kicking, 0, packed.VELOCITY] *= random.uniform(0.0, 2.0, (kicking, 1))
    own = closed(scene.only("human"), disturbed(random, own), sizes[:, rows])
    above = np.where(random.random(count) < 0.6, 0.0, random.exponential(0.04, count))
    own[..., 2] += (above - clearance(human, own, sizes[:, rows]))[:, None]
    own[kicking:] = planted(random, human, own[kicking:])
    left = random.random(count) < 0.5
    own[left], targets[left] = styles.reflected(human, own[left]), styles.mirrored(human, targets[left])
    states[:, rows] = own
    for body in scene.bodies:
        if body.name != "human":
            states[:, scene.rows(body.name), packed.POSITION] = (-50.0, 0.0, body.links[0].radius)
    return states, targets


def spins(random: np.random.Generator, human: Body, states: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return angular velocities (N, n, 3) [rad/s] of links in states (N, n, 13), from joint rates (N, J, 3) [rad/s].

    Each state scales the rates by a random factor from 0 to 1.2; the root's angular velocity is random.
    """
    found, motors = np.zeros((*states.shape[:2], 3)), styles.rows_of(human)
    eager = random.uniform(0.0, 1.2, (len(states), 1))
    found[:, 0] = random.standard_normal((len(states), 3)) * (0.5, 0.7, 0.7)
    for child, joint in enumerate(human.joints, start=1):
        parent = Rotation.from_quat(states[:, joint.parent, packed.ORIENTATION], scalar_first=True)
        turning = parent.apply(rates[:, motors[human.links[child].name]])
        found[:, child] = found[:, joint.parent] + eager * turning
    return found


def disturbed(random: np.random.Generator, states: np.ndarray) -> np.ndarray:
    """Return states (N, n, 13) with random rotations and velocities added, of a random size in each state."""
    found, (count, links) = states.copy(), states.shape[:2]
    size = np.where(random.random(count) < 0.2, 0.0, random.uniform(0.0, 1.0, count))[:, None, None]
    tilt = Rotation.from_rotvec((0.08 * size * random.standard_normal((count, links, 3))).reshape(-1, 3))
    turned = tilt * Rotation.from_quat(found[..., packed.ORIENTATION].reshape(-1, 4), scalar_first=True)
    found[..., packed.ORIENTATION] = turned.as_quat(scalar_first=True).reshape(count, links, 4)
    found[..., packed.ANGULAR_VELOCITY] += 1.5 * size * random.standard_normal((count, links, 3))
    found[:, 0, packed.VELOCITY] += 0.4 * size[:, 0] * random.standard_normal((count, 3))
    return found


def planted(random: np.random.Generator, human: Body, states: np.ndarray) -> np.ndarray:
    """Return states (N, n, 13), most with the lower foot's centre nearly at rest, the others moving anywhere."""
    found, count = states.copy(), np.arange(len(states))
    sides = np.array([human.link("left_foot"), human.link("right_foot")])
    foot = sides[np.argmin(found[:, sides, 2], axis=1)]
    resting = random.random((len(found), 1, 1)) < 0.7
    found[..., packed.VELOCITY] -= np.where(resting, found[count, foot, packed.VELOCITY][:, None], 0.0)
    found[..., packed.VELOCITY] += 0.2 * random.standard_normal((len(found), 1, 3))
    found[..., packed.VELOCITY] += np.where(resting, 0.0, random.standard_normal((len(found), 1, 3)) * (1.5, 0.7, 0.4))
    return found


def feet(
    random: np.random.Generator, scene: Scene, states: np.ndarray, targets: np.ndarray, sizes: np.ndarray
) -> np.ndarray:
    """Return the path (N, T, 3) [m] of a random foot of each human, from a coarse rollout."""
    names = np.where(random.random(len(states)) < 0.5, "left_foot", "right_foot")
    rows = np.array([scene.index("human", str(name)) for name in names])
    alone = scene.only("human")
    own, first = scene.rows("human"), []
    truth = Truth(alone, 256, COARSE)
    for start in range(0, len(states), truth.batch):
        chosen = np.minimum(np.arange(start, start + truth.batch), len(states) - 1)
        truth.resize(sizes[chosen][:, own])
        first.append(truth.rollout(states[chosen][:, own], targets[chosen])[0])
    paths = np.concatenate(first)[: len(states)]
    paths = paths[np.arange(len(states)), :, rows - own.start, :3]
    return np.where(np.isfinite(paths).all(axis=(1, 2), keepdims=True), paths, states[:, rows[0], None, :3])

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
KICK_SHARE, GAIT_SHARE = 0.45, 0.3
# Kicks begin anywhere in the first steps of the reference.
LATEST_KICK_STEP = 120
# Engine steps per step of the scene with which the path of a foot is predicted.
COARSE_SUBSTEPS = 5


def any_episodes(scene: Scene, reference: Reference, count: int, seed: int, steps: int = STEPS) -> tuple[Episodes, int]:
    """Return episodes of humans of every size in motion, and how many were dropped.

    Joint targets have smooth noise added; some episodes have external pushes. The body that the human may strike, if
    any, rests where a foot will pass, or comes from anywhere. Episodes are dropped that begin with overlapping legs, or
    diverge.
    """
    random = np.random.default_rng(seed)
    sizes = random_people(random, scene, count)
    states, targets = states_in_motion(random, scene, reference, sizes, steps)
    noise = smooth_noise(random, count, steps, 8, exploration_std(scene))
    targets += random.uniform(0.0, 1.2, (count, 1, 1, 1)) * noise
    targets = np.clip(targets, *scene.body("human").limits)
    for pair in scene.between.pairs:
        struck_link = scene.index(pair.second, pair.second_links[0])
        paths = foot_paths(random, scene, states, targets, sizes)
        spots = paths[:, steps // 2, :2]
        states[:, struck_link] = random_places(random, scene.links[struck_link], spots, paths, scene.dt)
        states = out_of_legs(scene, states, sizes)
    valid = ~overlaps(scene, states, sizes)  # no initial state has one leg in the other
    states, targets, sizes, overlapping = states[valid], targets[valid], sizes[valid], int((~valid).sum())
    count -= overlapping
    states = turned_about_z(states, random.uniform(-np.pi, np.pi, count))
    torques = pushes(random, scene, count, steps)
    episodes, diverged = record(Truth(scene, batch=min(count, 256)), states, targets, torques, sizes)
    return episodes, overlapping + diverged


def states_in_motion(
    random: np.random.Generator, scene: Scene, reference: Reference, sizes: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return initial states (N, L, 13) of humans in motion, and their joint targets (N, steps, J, 3) [rad].

    sizes: (N, L, 3). Kicks begin in states of the reference, other motions in the pose of their first targets, often
    with one foot standing. Half of them, at random, are mirrored. All other bodies are far away.
    """
    human, rows, count = scene.body("human"), scene.rows("human"), len(sizes)
    kick_count, gait_count = round(KICK_SHARE * count), round(GAIT_SHARE * count)
    first_steps = np.where(random.random(kick_count) < 0.4, 0, random.integers(0, LATEST_KICK_STEP, kick_count))
    default_human = bodies.human()
    targets_by_style = (
        styles.kicks(random, default_human, first_steps, steps, scene.dt),
        styles.gaits(random, default_human, gait_count, steps, scene.dt),
        styles.moves(random, default_human, count - kick_count - gait_count, steps, scene.dt),
    )
    targets = np.clip(in_detail(human, np.concatenate(targets_by_style)), *human.limits)
    lean_factor = np.where(random.random((count, 1)) < 0.15, 4.0, 1.0)
    rotation = Rotation.from_rotvec(lean_factor * random.standard_normal((count, 3)) * (0.12, 0.15, 0.0))
    states = standing_on_ground(scene, targets[:, 0], rotation, sizes)
    human_states = states[:, rows]
    human_states[..., packed.ANGULAR_VELOCITY] = angular_velocities(
        random, human, human_states, (targets[:, 1] - targets[:, 0]) / scene.dt
    )
    human_states[:kick_count] = reference.states[first_steps, rows]
    human_states[:kick_count, 0, packed.VELOCITY] *= random.uniform(0.0, 2.0, (kick_count, 1))
    human_states = closed(scene.only("human"), disturbed(random, human_states), sizes[:, rows])
    height = np.where(random.random(count) < 0.6, 0.0, random.exponential(0.04, count))
    human_states[..., 2] += (height - clearance(human, human_states, sizes[:, rows]))[:, None]
    human_states[kick_count:] = with_planted_foot(random, human, human_states[kick_count:])
    is_mirrored = random.random(count) < 0.5
    human_states[is_mirrored] = styles.reflected(human, human_states[is_mirrored])
    targets[is_mirrored] = styles.mirrored(human, targets[is_mirrored])
    states[:, rows] = human_states
    for body in scene.bodies:
        if body.name != "human":
            states[:, scene.rows(body.name), packed.POSITION] = (-50.0, 0.0, body.links[0].radius)
    return states, targets


def angular_velocities(random: np.random.Generator, human: Body, states: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """Return angular velocities (N, n, 3) [rad/s] of links in states (N, n, 13), from joint rates (N, J, 3) [rad/s].

    Each state scales the rates by a random factor from 0 to 1.2; the root's angular velocity is random.
    """
    velocities, motor_rows = np.zeros((*states.shape[:2], 3)), styles.rows_of(human)
    factor = random.uniform(0.0, 1.2, (len(states), 1))
    velocities[:, 0] = random.standard_normal((len(states), 3)) * (0.5, 0.7, 0.7)
    for child, joint in enumerate(human.joints, start=1):
        parent = Rotation.from_quat(states[:, joint.parent, packed.ORIENTATION], scalar_first=True)
        joint_rate = parent.apply(rates[:, motor_rows[human.links[child].name]])
        velocities[:, child] = velocities[:, joint.parent] + factor * joint_rate
    return velocities


def disturbed(random: np.random.Generator, states: np.ndarray) -> np.ndarray:
    """Return states (N, n, 13) with random rotations and velocities added, of a random size in each state."""
    disturbed_states, (count, links) = states.copy(), states.shape[:2]
    size = np.where(random.random(count) < 0.2, 0.0, random.uniform(0.0, 1.0, count))[:, None, None]
    tilt = Rotation.from_rotvec((0.08 * size * random.standard_normal((count, links, 3))).reshape(-1, 3))
    orientations = tilt * Rotation.from_quat(
        disturbed_states[..., packed.ORIENTATION].reshape(-1, 4), scalar_first=True
    )
    disturbed_states[..., packed.ORIENTATION] = orientations.as_quat(scalar_first=True).reshape(count, links, 4)
    disturbed_states[..., packed.ANGULAR_VELOCITY] += 1.5 * size * random.standard_normal((count, links, 3))
    disturbed_states[:, 0, packed.VELOCITY] += 0.4 * size[:, 0] * random.standard_normal((count, 3))
    return disturbed_states


def with_planted_foot(random: np.random.Generator, human: Body, states: np.ndarray) -> np.ndarray:
    """Return states (N, n, 13), most with the lower foot's centre nearly at rest, the others moving anywhere."""
    planted_states, rows = states.copy(), np.arange(len(states))
    sides = np.array([human.link("left_foot"), human.link("right_foot")])
    foot = sides[np.argmin(planted_states[:, sides, 2], axis=1)]
    is_planted = random.random((len(planted_states), 1, 1)) < 0.7
    planted_states[..., packed.VELOCITY] -= np.where(
        is_planted, planted_states[rows, foot, packed.VELOCITY][:, None], 0.0
    )
    planted_states[..., packed.VELOCITY] += 0.2 * random.standard_normal((len(planted_states), 1, 3))
    planted_states[..., packed.VELOCITY] += np.where(
        is_planted, 0.0, random.standard_normal((len(planted_states), 1, 3)) * (1.5, 0.7, 0.4)
    )
    return planted_states


def foot_paths(
    random: np.random.Generator, scene: Scene, states: np.ndarray, targets: np.ndarray, sizes: np.ndarray
) -> np.ndarray:
    """Return the path (N, T, 3) [m] of a random foot of each human, from a coarse rollout."""
    names = np.where(random.random(len(states)) < 0.5, "left_foot", "right_foot")
    foot_links = np.array([scene.index("human", str(name)) for name in names])
    human_scene = scene.only("human")
    human_rows, rollouts = scene.rows("human"), []
    truth = Truth(human_scene, 256, COARSE_SUBSTEPS)
    for start in range(0, len(states), truth.batch):
        batch_rows = np.minimum(np.arange(start, start + truth.batch), len(states) - 1)
        truth.resize(sizes[batch_rows][:, human_rows])
        rollouts.append(truth.rollout(states[batch_rows][:, human_rows], targets[batch_rows])[0])
    paths = np.concatenate(rollouts)[: len(states)]
    paths = paths[np.arange(len(states)), :, foot_links - human_rows.start, :3]
    return np.where(np.isfinite(paths).all(axis=(1, 2), keepdims=True), paths, states[:, foot_links[0], None, :3])

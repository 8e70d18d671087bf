"""Ground-truth episodes of thrown bodies without motors, which tumble, fall, and collide if there are several."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.engines.episodes import Episodes, record
from larp_model.engines.mujoco import Truth, closed
from larp_model.scene import Scene
from tasks.episodes.around_kick import overlaps
from tasks.motions.references import clearance

STEPS = 200
# Ranges of time [s] and height above the ground [m] at which bodies collide; deviation of their places then [m].
COLLISION_TIME, COLLISION_HEIGHT, PLACE_STD = (0.1, 0.6), (0.3, 1.2), 0.1
# Standard deviations: velocities along the ground and upwards [m/s], angular velocity [rad/s], bend of a joint [rad].
SPEED_STD, VERTICAL_STD, ANGULAR_VELOCITY_STD, BEND_STD = 1.5, 0.5, 2.0, 0.4
# Torque on the first link of each body, standard deviation [N m], for so many steps.
TORQUE_STD, TORQUE_STEPS = 0.5, 10
# Lengths and radii differ by up to this share.
SIZE_VARIATION = 0.3


def random_sizes(random: np.random.Generator, scene: Scene, count: int) -> np.ndarray:
    """Return morphologies (count, L, 3) with lengths and radii varied by up to `SIZE_VARIATION`, same densities."""
    sizes = np.broadcast_to(scene.morphology, (count, len(scene.links), 3)).astype(float)
    factors = random.uniform(1.0 - SIZE_VARIATION, 1.0 + SIZE_VARIATION, (*sizes.shape[:2], 2))
    length, radius = np.moveaxis(sizes[..., :2] * factors, -1, 0)
    volume = radius**2 * (length + 4.0 / 3.0 * radius)
    usual = sizes[..., 1] ** 2 * (sizes[..., 0] + 4.0 / 3.0 * sizes[..., 1])
    return np.stack([length, radius, sizes[..., 2] * volume / usual], axis=-1)


def thrown_starts(random: np.random.Generator, scene: Scene, morphology: np.ndarray) -> np.ndarray:
    """Return states (N, L, 13) of bodies of sizes (N, L, 3) on their ways to one place, above ground, joints closed."""
    count = len(morphology)
    states = np.zeros((count, len(scene.links), packed.SIZE))
    collision_time = random.uniform(*COLLISION_TIME, (count, 1))
    collision_height = random.uniform(*COLLISION_HEIGHT, count)
    for body in scene.bodies:
        rows = scene.rows(body.name)
        rotations = [Rotation.from_quat(random.standard_normal((count, 4)))]
        for joint in body.joints:
            rotations.append(
                rotations[joint.parent] * Rotation.from_rotvec(BEND_STD * random.standard_normal((count, 3)))
            )
        states[:, rows, packed.ORIENTATION] = np.stack(
            [rotation.as_quat(scalar_first=True) for rotation in rotations], axis=1
        )
        velocity = random.standard_normal((count, 3)) * (SPEED_STD, SPEED_STD, VERTICAL_STD)
        velocity[:, 2] += 0.5 * scene.gravity * collision_time[:, 0]  # as high at the collision as at the start
        states[:, rows, packed.VELOCITY] = velocity[:, None]
        angular_velocity = ANGULAR_VELOCITY_STD * random.standard_normal((count, 1, 3))
        states[:, rows, packed.ANGULAR_VELOCITY] = (
            angular_velocity + 0.5 * ANGULAR_VELOCITY_STD * random.standard_normal((count, len(body.links), 3))
        )
        place = PLACE_STD * random.standard_normal((count, 3)) - velocity * collision_time
        place[:, 2] += collision_height + 0.5 * scene.gravity * collision_time[:, 0] ** 2
        states[:, rows.start, packed.POSITION] = place
    states = closed(scene, states, morphology)
    # A body that starts in the ground is lifted out of it.
    for body in scene.bodies:
        rows = scene.rows(body.name)
        lowest = clearance(body, states[:, rows], morphology[:, rows])
        states[:, rows, 2] -= np.minimum(lowest, 0.0)[:, None]
    return states


def thrown_episodes(
    scene: Scene, count: int, seed: int, steps: int = STEPS, varied: bool = False
) -> tuple[Episodes, int]:
    """Record episodes from `thrown_starts`, with a torque on the first link of every chain in `TORQUE_STEPS` steps.

    varied: bodies have `random_sizes`. Returns the episodes and how many diverged and were dropped.
    """
    random = np.random.default_rng(seed)
    if varied:
        morphology = random_sizes(random, scene, 2 * count)
    else:
        morphology = np.broadcast_to(scene.morphology, (2 * count, len(scene.links), 3))
    states = thrown_starts(random, scene, morphology)
    valid_rows = np.flatnonzero(~overlaps(scene, states, morphology))[:count]
    states, morphology = states[valid_rows], morphology[valid_rows]
    torques = np.zeros((len(states), steps, len(scene.links), 3))
    for body in scene.bodies:
        if body.joints:
            torque = TORQUE_STD * random.standard_normal((len(states), 1, 3))
            torques[:, :TORQUE_STEPS, scene.rows(body.name).start] = torque
    controls = np.zeros((len(states), steps, 0, 3))
    return record(Truth(scene, batch=min(count, 256)), states, controls, torques, morphology if varied else None)

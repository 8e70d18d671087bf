"""Sensing noise between the ground truth and the planner."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.engines.mujoco import Truth
from larp_model.scene import Scene

# Standard deviations: the ball's place [m], joint angles about each axis [degrees], velocities as shares of themselves.
BALL, JOINTS, VELOCITIES = 0.005, 0.5, 0.02


def noisy(scene: Scene, random: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that adds sensing noise to a true state (L, 13).

    Joints stay closed, and the position and orientation of the first body's root are exact.
    """
    truth = Truth(scene, threads=1)
    body, human = scene.human, scene.rows(scene.human.name)

    def sense(state: np.ndarray) -> np.ndarray:
        noisy_state: np.ndarray = state.copy()
        for columns in (packed.VELOCITY, packed.ANGULAR_VELOCITY):
            noisy_state[:, columns] *= 1.0 + VELOCITIES * random.standard_normal((len(state), 3))
        true = Rotation.from_quat(state[human, packed.ORIENTATION], scalar_first=True)
        rotations = [true[0]]
        for child, joint in enumerate(body.joints, start=1):
            error = Rotation.from_rotvec(np.radians(JOINTS) * random.standard_normal(3))
            rotations.append(rotations[joint.parent] * true[joint.parent].inv() * true[child] * error)
        noisy_state[human, packed.ORIENTATION] = [rotation.as_quat(scalar_first=True) for rotation in rotations]
        truth.reset(noisy_state[None])
        noisy_state = truth.state()[0]
        noisy_state[-1, packed.POSITION] += BALL * random.standard_normal(3)
        return noisy_state

    return sense

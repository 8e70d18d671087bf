"""Reference kicks: the project's own, authored as key poses and refined in the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.scene import Body, Scene
from larp_model.truth.mujoco import Truth
from tasks.key_poses import KEY_POSES, KEY_TIMES, START


@dataclass(frozen=True, eq=False)
class Reference:
    """A kick to stay near to, as the servo-driven human performs it in the truth.

    states: (T + 1, L, 13) of the whole scene, world frame, the human's pelvis above the origin at first, facing x.
    controls: (T, J, 3) joint targets [rad]. strike: the step in which the foot first pushes the ball.
    """

    states: np.ndarray
    controls: np.ndarray
    strike: int

    @property
    def ball_spot(self) -> np.ndarray:
        """Where the ball's centre rests before the kick (3,) [m]."""
        return self.states[0, -1, packed.POSITION]

    def window(self, start: int, steps: int) -> tuple[np.ndarray, np.ndarray]:
        """States (steps, L, 13) after each step and controls (steps, J, 3) from step `start`; the last is held."""
        rows = np.minimum(np.arange(start, start + steps), len(self.controls) - 1)
        return self.states[rows + 1], self.controls[rows]


def key_pose_controls(body: Body, steps: int, dt: float) -> np.ndarray:
    """Joint targets (steps, J, 3) [rad] splined through the key poses, monotone between them."""
    names = [body.links[child].name for child, _, _ in body.motors]
    times = np.minimum(np.arange(steps) * dt, KEY_TIMES[-1])
    controls = np.zeros((steps, len(names), 3))
    for (joint, axis), angles in KEY_POSES.items():
        controls[:, names.index(joint), axis] = PchipInterpolator(KEY_TIMES, angles)(times)
    lower = np.array([motor.lower for _, _, motor in body.motors])
    upper = np.array([motor.upper for _, _, motor in body.motors])
    return np.clip(controls, lower, upper)


def standing_on_ground(scene: Scene, targets: np.ndarray, root: Rotation) -> np.ndarray:
    """The scene's state (L, 13) at rest with its human in the pose of joint targets (J, 3) [rad], on the ground.

    root: orientation of the pelvis, which is above the origin.
    """
    human = scene.bodies[0]
    state = np.zeros((len(scene.links), packed.SIZE))
    state[:, packed.ORIENTATION] = (1.0, 0.0, 0.0, 0.0)
    rotations = [root]
    for child, joint in enumerate(human.joints, start=1):
        motors = [index for index, (row, _, _) in enumerate(human.motors) if row == child]
        turn = Rotation.from_rotvec(targets[motors[0]] if motors else np.zeros(3))
        rotations.append(rotations[joint.parent] * turn)
    for row, rotation in enumerate(rotations):
        state[row, packed.ORIENTATION] = rotation.as_quat(scalar_first=True)
    truth = Truth(scene.only(human.name))
    truth.reset(state[: len(human.links)])
    closed = truth.state()[0]
    lowest = min(
        (closed[row, 2] - abs(0.5 * link.length * rotations[row].apply(link.axis)[2])) - link.radius
        for row, link in enumerate(human.links)
    )
    closed[:, 2] -= lowest
    state[: len(human.links)] = closed
    return state


def embedded(scene: Scene, steps: int = 300) -> Reference:
    """The embedded kick, performed in the truth by the human of `scene` (its first body; its last is the ball)."""
    human, ball = scene.bodies[0], scene.bodies[-1]
    controls = key_pose_controls(human, steps, scene.dt)
    state = standing_on_ground(scene, controls[0], Rotation.from_euler("xy", START["lean"]))
    state[: len(human.links), packed.VELOCITY] = START["velocity"]
    state[-1, packed.POSITION] = (*START["ball"], ball.links[0].radius)
    truth = Truth(scene)
    after, finite = truth.rollout(state[None], controls[None])
    if not finite[0]:
        raise ValueError("scene: its human cannot perform the embedded reference kick; the truth diverged")
    states = np.concatenate([state[None], after[0]])
    moving = np.linalg.norm(states[:, -1, packed.VELOCITY], axis=-1) > 0.5
    if not moving.any():
        raise ValueError("scene: its human misses the ball in the embedded reference kick")
    return Reference(states, controls, int(moving.argmax()) - 1)

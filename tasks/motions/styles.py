"""Joint targets of many motions: variations of the embedded kick, walks and runs, moves from pose to pose.

Angles are components of rotation vectors: about x a limb rolls, about y it pitches (a thigh forwards is negative, a
knee bends positive), about z it yaws; see `bodies`.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline, PchipInterpolator

from larp_model import state as packed
from larp_model.bodies import segment_of
from larp_model.scene import Body
from tasks.exploration import EXPLORATION_STD
from tasks.motions import key_poses


def rows_of(body: Body) -> dict[str, int]:
    """Return the row of every motor in the control, by the name of its child link."""
    return {body.links[child].name: row for row, (child, _, _) in enumerate(body.motors)}


def mirrored(body: Body, targets: np.ndarray) -> np.ndarray:
    """Return the joint targets (*, J, 3) [rad] with left and right exchanged."""
    return targets[..., _opposite(list(rows_of(body))), :] * (-1.0, 1.0, -1.0)


def reflected(body: Body, states: np.ndarray) -> np.ndarray:
    """Return the states (*, n, 13) mirrored in the plane y = 0, with left and right exchanged."""
    mirrored_states = states[..., _opposite([link.name for link in body.links]), :].copy()
    mirrored_states[..., [1, 8]] *= -1.0  # y of position and velocity
    mirrored_states[..., packed.ORIENTATION] *= (1.0, -1.0, 1.0, -1.0)
    mirrored_states[..., packed.ANGULAR_VELOCITY] *= (-1.0, 1.0, -1.0)
    return mirrored_states


def _opposite(names: list[str]) -> list[int]:
    """Return, for each name, the index of the same part on the other side."""
    opposite_side = {"left": "right", "right": "left"}
    parts = (name.partition("_") for name in names)
    return [names.index(opposite_side.get(side, side) + line + rest) for side, line, rest in parts]


def kicks(random: np.random.Generator, body: Body, first_steps: np.ndarray, steps: int, dt: float) -> np.ndarray:
    """Return joint targets (N, steps, J, 3) [rad] of variations of the embedded kick.

    first_steps: (N,) step of the kick from which each variation starts. Each has random offsets of its key poses and a
    random pace.
    """
    poses, rows = key_poses.load(), rows_of(body)
    times = np.array(poses.times)
    authored = np.zeros((len(times), len(rows), 3))
    for (joint, axis), angles in poses.angles.items():
        authored[:, rows[joint], axis] = angles
    std = style_std(body)
    targets = []
    for first_step in first_steps:
        angles_of_variation = authored + random.uniform(0.0, 1.0) * std * random.standard_normal(authored.shape)
        pace = random.uniform(0.75, 1.3)
        pose_times = np.minimum((first_step + pace * np.arange(steps)) * dt, times[-1])
        targets.append(PchipInterpolator(times, angles_of_variation)(pose_times))
    within_limits: np.ndarray = np.clip(np.array(targets), *body.limits)
    return within_limits


def gaits(random: np.random.Generator, body: Body, count: int, steps: int, dt: float) -> np.ndarray:
    """Return joint targets (N, steps, J, 3) [rad] of walks, runs and steps on the spot.

    Every joint swings at the same pace. Forwards, backwards and sideways; contact with the ground is not planned for,
    it results from the simulation.
    """
    rows = rows_of(body)
    frequency, phase = random.uniform(0.6, 2.6, (count, 1)), random.uniform(0.0, 2.0 * np.pi, (count, 1))
    phases = phase + 2.0 * np.pi * frequency * dt * np.arange(steps)
    targets = np.zeros((count, steps, len(rows), 3))

    def uniform(low: float, high: float) -> np.ndarray:
        return random.uniform(low, high, (count, 1))

    stride, bend, lift = uniform(0.0, 0.8), uniform(0.0, 0.6), uniform(0.2, 1.4)
    lift_phase, roll, swing, ankle = uniform(0.8, 2.2), uniform(-0.25, 0.25), uniform(0.0, 0.8), uniform(-0.4, 0.4)
    for side, sign, half_cycle in (("left", 1.0, 0.0), ("right", -1.0, np.pi)):
        leg_phase = phases + half_cycle
        raised = np.maximum(np.sin(leg_phase + lift_phase), 0.0)
        thigh, shin = -bend - stride * np.sin(leg_phase) - 0.3 * lift * raised, 2.0 * bend + lift * raised
        targets[..., rows[f"{side}_thigh"], 1] = thigh
        targets[..., rows[f"{side}_shin"], 1] = shin
        targets[..., rows[f"{side}_foot"], 1] = 0.7 * (-thigh - shin) + ankle * np.sin(leg_phase + lift_phase)
        targets[..., rows[f"{side}_thigh"], 0] = sign * 0.08 + roll * np.sin(leg_phase)
        targets[..., rows[f"{side}_upper_arm"], 1] = swing * np.sin(leg_phase)
        targets[..., rows[f"{side}_upper_arm"], 0] = sign * uniform(0.0, 0.6)
        targets[..., rows[f"{side}_lower_arm"], 1] = -uniform(0.1, 1.6)
    targets[..., rows["torso"], 1] = uniform(-0.1, 0.4)
    targets[..., rows["torso"], 2] = uniform(0.0, 0.3) * np.sin(phases)
    targets += uniform(0.0, 0.5)[..., None, None] * style_std(body) * random.standard_normal((count, 1, len(rows), 3))
    return np.clip(targets, *body.limits)


def moves(random: np.random.Generator, body: Body, count: int, steps: int, dt: float) -> np.ndarray:
    """Return joint targets (N, steps, J, 3) [rad] of moves from pose to pose, with knees bent to random depths.

    They cover steps aside, squats and recoveries.
    """
    rows, knots = rows_of(body), 4
    pause = random.uniform(0.1, 0.5, (count, 1))
    poses = 1.5 * random.uniform(0.0, 1.0, (count, 1, 1, 1)) * style_std(body)
    poses = poses * random.standard_normal((count, knots, len(rows), 3))
    depth = random.uniform(0.0, 1.0, (count, 1)) * random.uniform(0.0, 1.2, (count, knots))
    for side in ("left", "right"):
        for segment, factor in (("thigh", -1.0), ("shin", 2.0), ("foot", -0.8)):
            poses[..., rows[f"{side}_{segment}"], 1] += factor * depth
    poses[..., rows["torso"], 1] += 0.4 * depth
    times = random.uniform(0.0, 1.0, (count, 1)) * pause + np.arange(steps) * dt
    knot_times = np.clip(times / pause, 0.0, knots - 1.0)
    knot = np.arange(knots)
    targets = [
        CubicSpline(knot, poses_of_motion, bc_type="clamped")(motion_times)
        for poses_of_motion, motion_times in zip(poses, knot_times, strict=True)
    ]
    return np.clip(np.reshape(targets, (count, steps, len(rows), 3)), *body.limits)


def style_std(body: Body) -> np.ndarray:
    """Return the standard deviation (J, 3) [rad] by which angles differ from motion to motion."""
    lower, upper = body.limits
    exploration = [EXPLORATION_STD[segment_of(body.links[child].name)] for child, _, _ in body.motors]
    std: np.ndarray = np.minimum(1.5 * np.array(exploration)[:, None], 0.2 * (upper - lower))
    return std

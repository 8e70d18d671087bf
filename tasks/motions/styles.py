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
    found = states[..., _opposite([link.name for link in body.links]), :].copy()
    found[..., [1, 8]] *= -1.0  # y of position and velocity
    found[..., packed.ORIENTATION] *= (1.0, -1.0, 1.0, -1.0)
    found[..., packed.ANGULAR_VELOCITY] *= (-1.0, 1.0, -1.0)
    return found


def _opposite(names: list[str]) -> list[int]:
    """Return, for each name, the index of the same part on the other side."""
    other = {"left": "right", "right": "left"}
    parts = (name.partition("_") for name in names)
    return [names.index(other.get(side, side) + line + rest) for side, line, rest in parts]


def kicks(random: np.random.Generator, body: Body, begin: np.ndarray, steps: int, dt: float) -> np.ndarray:
    """Return joint targets (N, steps, J, 3) [rad] of variations of the embedded kick.

    begin: (N,) step of the kick from which each starts. Each has random offsets of its key poses and a random pace.
    """
    poses, rows = key_poses.load(), rows_of(body)
    times = np.array(poses.times)
    authored = np.zeros((len(times), len(rows), 3))
    for (joint, axis), angles in poses.angles.items():
        authored[:, rows[joint], axis] = angles
    wide = spreads(body)
    found = []
    for first in begin:
        bent = authored + random.uniform(0.0, 1.0) * wide * random.standard_normal(authored.shape)
        pace = random.uniform(0.75, 1.3)
        at = np.minimum((first + pace * np.arange(steps)) * dt, times[-1])
        found.append(PchipInterpolator(times, bent)(at))
    return np.clip(np.array(found), *body.limits)


def gaits(random: np.random.Generator, body: Body, count: int, steps: int, dt: float) -> np.ndarray:
    """Return joint targets (N, steps, J, 3) [rad] of walks, runs and steps on the spot.

    Every joint swings at the same pace. Forwards, backwards and sideways; contact with the ground is not planned for,
    it results from the simulation.
    """
    rows = rows_of(body)
    pace, phase = random.uniform(0.6, 2.6, (count, 1)), random.uniform(0.0, 2.0 * np.pi, (count, 1))
    turn = phase + 2.0 * np.pi * pace * dt * np.arange(steps)
    found = np.zeros((count, steps, len(rows), 3))

    def any_of(low: float, high: float) -> np.ndarray:
        return random.uniform(low, high, (count, 1))

    stride, bend, lift = any_of(0.0, 0.8), any_of(0.0, 0.6), any_of(0.2, 1.4)
    late, roll, swing, ankle = any_of(0.8, 2.2), any_of(-0.25, 0.25), any_of(0.0, 0.8), any_of(-0.4, 0.4)
    for side, sign, half in (("left", 1.0, 0.0), ("right", -1.0, np.pi)):
        leg = turn + half
        raised = np.maximum(np.sin(leg + late), 0.0)
        thigh, shin = -bend - stride * np.sin(leg) - 0.3 * lift * raised, 2.0 * bend + lift * raised
        found[..., rows[f"{side}_thigh"], 1] = thigh
        found[..., rows[f"{side}_shin"], 1] = shin
        found[..., rows[f"{side}_foot"], 1] = 0.7 * (-thigh - shin) + ankle * np.sin(leg + late)
        found[..., rows[f"{side}_thigh"], 0] = sign * 0.08 + roll * np.sin(leg)
        found[..., rows[f"{side}_upper_arm"], 1] = swing * np.sin(leg)
        found[..., rows[f"{side}_upper_arm"], 0] = sign * any_of(0.0, 0.6)
        found[..., rows[f"{side}_lower_arm"], 1] = -any_of(0.1, 1.6)
    found[..., rows["torso"], 1] = any_of(-0.1, 0.4)
    found[..., rows["torso"], 2] = any_of(0.0, 0.3) * np.sin(turn)
    found += any_of(0.0, 0.5)[..., None, None] * spreads(body) * random.standard_normal((count, 1, len(rows), 3))
    return np.clip(found, *body.limits)


def moves(random: np.random.Generator, body: Body, count: int, steps: int, dt: float) -> np.ndarray:
    """Return joint targets (N, steps, J, 3) [rad] of moves from pose to pose, with knees bent to random depths.

    They cover steps aside, squats and recoveries.
    """
    rows, knots = rows_of(body), 4
    pause = random.uniform(0.1, 0.5, (count, 1))
    poses = 1.5 * random.uniform(0.0, 1.0, (count, 1, 1, 1)) * spreads(body)
    poses = poses * random.standard_normal((count, knots, len(rows), 3))
    depth = random.uniform(0.0, 1.0, (count, 1)) * random.uniform(0.0, 1.2, (count, knots))
    for side in ("left", "right"):
        for segment, share in (("thigh", -1.0), ("shin", 2.0), ("foot", -0.8)):
            poses[..., rows[f"{side}_{segment}"], 1] += share * depth
    poses[..., rows["torso"], 1] += 0.4 * depth
    times = random.uniform(0.0, 1.0, (count, 1)) * pause + np.arange(steps) * dt
    at = np.clip(times / pause, 0.0, knots - 1.0)
    knot = np.arange(knots)
    found = [CubicSpline(knot, own, bc_type="clamped")(when) for own, when in zip(poses, at, strict=True)]
    return np.clip(np.reshape(found, (count, steps, len(rows), 3)), *body.limits)


def spreads(body: Body) -> np.ndarray:
    """Return the standard deviation (J, 3) [rad] by which angles differ from motion to motion."""
    lower, upper = body.limits
    usual = [EXPLORATION_STD[segment_of(body.links[child].name)] for child, _, _ in body.motors]
    return np.minimum(1.5 * np.array(usual)[:, None], 0.2 * (upper - lower))

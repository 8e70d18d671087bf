"""Metrics of a reconstructed motion: errors against the true one, and plausibility; the paper's, and ours.

Unknown true points are NaN. Means are over the known ones and, for errors aligned by the pelvis, over frames in which
the pelvis is known.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from tasks.pose.points import POINTS

# Joints that are compared; poses are aligned by the hips.
JOINTS = [row for row, name in enumerate(POINTS) if name.partition("_")[2] not in ("heel", "toe", "ear")]
HIPS = [POINTS.index("left_hip"), POINTS.index("right_hip")]
FEET = {side: [POINTS.index(f"{side}_heel"), POINTS.index(f"{side}_toe")] for side in ("left", "right")}
# A foot skates where it is in contact in two successive frames and moves farther than this in between [m].
SKATE = 0.02
# A foot is in contact where both its heel and its toe are below this height above the ground [m].
CONTACT = 0.05
# Time over which a foot's speed is averaged [s].
STRIDE = 0.1


def pelvis(points: np.ndarray) -> np.ndarray:
    """Return the midpoint of the hips (*, 1, 3) of points (*, P, 3)."""
    middle: np.ndarray = points[..., HIPS, :].mean(axis=-2, keepdims=True)
    return middle


def position_errors(estimated: np.ndarray, true: np.ndarray) -> dict[str, float]:
    """Return mean joint errors [mm] of points (T, P, 3) [m]: `mpjpe_g_mm`, `mpjpe_mm` and `mpjpe_pa_mm`.

    They are aligned by the pelvis of the first frame in which it is known, by the pelvis of each frame, and by each
    frame's best rotation, translation and scale (Procrustes).
    """

    def mean(first_points: np.ndarray, second_points: np.ndarray) -> float:
        return 1e3 * float(np.nanmean(np.linalg.norm(first_points[:, JOINTS] - second_points[:, JOINTS], axis=-1)))

    aligned = np.stack([procrustes(points, true_points) for points, true_points in zip(estimated, true, strict=True)])
    first = int(np.argmax(np.isfinite(pelvis(true)).all(axis=(1, 2))))
    return {
        "mpjpe_g_mm": mean(estimated - pelvis(estimated[first]), true - pelvis(true[first])),
        "mpjpe_mm": mean(estimated - pelvis(estimated), true - pelvis(true)),
        "mpjpe_pa_mm": mean(aligned, true),
    }


def procrustes(estimated: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return points (P, 3) rotated, translated and scaled so that their joints best fit the true ones.

    All are NaN where fewer than three of the true joints are known.
    """
    known_rows = [row for row in JOINTS if np.isfinite(true[row]).all()]
    if len(known_rows) < 3:
        return np.full_like(estimated, np.nan)
    estimated_joints, true_joints = estimated[known_rows], true[known_rows]
    estimated_mean, true_mean = estimated_joints.mean(axis=0), true_joints.mean(axis=0)
    rotation, _ = Rotation.align_vectors(true_joints - true_mean, estimated_joints - estimated_mean)
    rotated = rotation.apply(estimated_joints - estimated_mean)
    scale = np.sum(rotated * (true_joints - true_mean)) / np.sum(rotated**2)
    aligned: np.ndarray = scale * rotation.apply(estimated - estimated_mean) + true_mean
    return aligned


def velocity_error(estimated: np.ndarray, true: np.ndarray, rate: float) -> float:
    """Return the mean error [m/s] of joint velocities of points (T, P, 3) [m], aligned by the pelvis of each frame."""
    aligned = ((points - pelvis(points))[:, JOINTS] for points in (estimated, true))
    velocities, true_velocities = (rate * np.diff(points, axis=0) for points in aligned)
    return float(np.nanmean(np.linalg.norm(velocities - true_velocities, axis=-1)))


def foot_skate(points: np.ndarray) -> float:
    """Return the share of frames [%] in which a foot in contact moves over 2 cm to the next; points (T, P, 3) [m].

    It is NaN where heels or toes are not known.
    """
    if not all(np.isfinite(points[:, rows]).all() for rows in FEET.values()):
        return np.nan
    skating = np.zeros(len(points) - 1, bool)
    for rows in FEET.values():
        in_contact: np.ndarray = np.all(points[:, rows, 2] < CONTACT, axis=1)
        moved = np.linalg.norm(np.diff(points[:, rows].mean(axis=1), axis=0), axis=-1)
        skating = np.logical_or(skating, in_contact[:-1] & in_contact[1:] & (moved > SKATE))
    return 100.0 * float(skating.mean())


def slip(points: np.ndarray, rate: float) -> float:
    """Return the 75th percentile over frames of the speed [m/s] of the slowest heel or toe; points (T, P, 3) [m].

    A person on foot has a heel or toe that nearly stands most of the time, whatever the motion; not so if the camera
    moves.
    """
    feet = points[:, [row for rows in FEET.values() for row in rows]]
    frames = min(max(1, round(STRIDE * rate)), len(points) - 1)  # films may be shorter than a stride
    slowest = np.linalg.norm(feet[frames:] - feet[:-frames], axis=-1).min(axis=1) * rate / frames
    return float(np.percentile(slowest, 75.0))


def pixel_error(places: np.ndarray, true: np.ndarray) -> float:
    """Return the mean distance [px] of the joints' places (*, P, 2) from the true ones."""
    return float(np.nanmean(np.linalg.norm(places[..., JOINTS, :] - true[..., JOINTS, :], axis=-1)))


def off_the_ground(points: np.ndarray) -> dict[str, float]:
    """Return the mean depth of feet in the ground [mm] and the share of frames [%] in which it is over 2 cm.

    points: (T, P, 3) [m]. The keys are `sunk_mm` and `sunk`.
    """
    lowest = points[:, [row for rows in FEET.values() for row in rows], 2].min(axis=1)
    return {"sunk_mm": 1e3 * float(np.maximum(-lowest, 0.0).mean()), "sunk": 100.0 * float((lowest < -0.02).mean())}

"""Synthetic keypoints of motions: a camera, noise, and points that are missed or swapped between the sides."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tasks.motions.skeleton import Motion
from tasks.pose.camera import Camera, focal_length, looking_at
from tasks.pose.metrics import pelvis
from tasks.pose.points import POINTS, SIDES, Keypoints

# A skeleton's names of the joints at which our points are.
JOINT_NAMES = {
    "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand", "hip": "UpLeg", "knee": "Leg", "ankle": "Foot",
}  # fmt: skip
# Points that skeletons lack, in the rest pose ahead, aside and above a joint, in shares of the hips' height.
OFFSETS = {
    "nose": ("Head", (0.105, 0.0, 0.07)),
    "left_ear": ("Head", (0.02, 0.08, 0.08)),
    "right_ear": ("Head", (0.02, -0.08, 0.08)),
    "heel": ("Foot", (-0.045, 0.0, -0.07)),
    "toe": ("ToeBase", (0.06, 0.0, 0.0)),
}
SIZE = (1000.0, 1000.0)


class Noise(NamedTuple):
    """Noise of a detector: standard deviation of its points [px], and shares that are missed, or swapped in side."""

    pixels: float = 4.0
    missed: float = 0.03
    swapped: float = 0.01


USUAL_NOISE = Noise()


def points_of(motion: Motion) -> np.ndarray:
    """Return `POINTS` (T, P, 3) [m] of a captured motion; those that its skeleton lacks move with the nearest joint."""
    points, hips = [], motion.hip_height
    for name in POINTS:
        side, _, limb = name.partition("_")
        if limb in JOINT_NAMES:
            points.append(motion.path(side.capitalize() + JOINT_NAMES[limb]))
            continue
        joint, offset = OFFSETS[limb if side in SIDES and limb in OFFSETS else name]
        joint = joint if joint == "Head" else side.capitalize() + joint
        points.append(motion.path(joint) + motion.rotation(joint).apply(hips * np.array(offset)))
    return np.stack(points, axis=1)


def camera_around(random: np.random.Generator, points: np.ndarray) -> Camera:
    """Return a random camera around points (T, P, 3) [m], at knee to above head height, far enough to see them all."""
    middle = 0.5 * (points.min(axis=(0, 1)) + points.max(axis=(0, 1)))
    angle, field_of_view = random.uniform(-np.pi, np.pi), random.uniform(40.0, 75.0)
    height, focal = random.uniform(0.6, 2.2), focal_length(field_of_view, SIZE[0])
    direction = np.array([np.cos(angle), np.sin(angle), 0.0])
    for distance in np.arange(2.5, 30.0, 0.25):
        position = np.array([*(middle + distance * direction)[:2], height])
        camera = looking_at(position, middle, focal, SIZE)
        depth = (points - position) @ camera.turn[2]
        if depth.min() > 1.0 and abs(camera.project(points) - camera.centre).max() < 0.46 * min(SIZE):
            break
    return camera


def detected(
    random: np.random.Generator, camera: Camera, points: np.ndarray, rate: float, noise: Noise = USUAL_NOISE
) -> Keypoints:
    """Return the keypoints of a simulated detector for points (T, P, 3) [m]; rate: frames per second.

    Errors are partly independent between frames, partly correlated over some. Confidence falls with the error.
    """
    frames, count = points.shape[:2]
    window = np.ones(5) / np.sqrt(5.0)
    signals = _normal(random, 2 * count, frames)
    correlated_noise = np.array([np.convolve(signal, window, "same")[:frames] for signal in signals])
    error = 0.8 * random.standard_normal((frames, count, 2)) + 0.6 * correlated_noise.T.reshape(frames, count, 2)
    places = camera.project(points) + noise.pixels * error
    confidence = np.clip(0.95 - 0.12 * np.linalg.norm(error, axis=-1) + 0.05 * _normal(random, frames, count), 0.1, 1.0)
    for limbs in (("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle", "heel", "toe")):
        left, right = ([POINTS.index(f"{side}_{limb}") for limb in limbs] for side in SIDES)
        for frame in np.flatnonzero(random.random(frames) < noise.swapped):
            places[frame, left + right] = places[frame, right + left]
    missed = random.random((frames, count)) < noise.missed
    for point in range(count):  # some are hidden for a while
        if random.random() < 10.0 * noise.missed:
            begin = random.integers(frames)
            missed[begin : begin + round(0.3 * rate), point] = True
    places[missed], confidence[missed] = np.nan, 0.0
    return Keypoints(places, confidence, rate, SIZE)


def panned(camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return points (T, P, 3) [m] whose image is that of `points` by a camera that pans after the pelvis."""
    turns = [looking_at(camera.position, target[0], camera.focal, SIZE).turn for target in pelvis(points)]
    moved: np.ndarray = camera.position + np.einsum("ji,tjk,tpk->tpi", camera.turn, turns, points - camera.position)
    return moved


def _normal(random: np.random.Generator, *shape: int) -> np.ndarray:
    return random.standard_normal(shape)

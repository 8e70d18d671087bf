"""Picture of a reconstruction: keypoints, the figure over them, and the motion from the side."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from larp_model.files import write_whole
from tasks.pose.camera import Camera
from tasks.pose.points import POINTS, SIDES, Keypoints

BONES = [
    *(
        (f"{side}_{first}", f"{side}_{second}")
        for side in SIDES
        for first, second in (
            ("shoulder", "elbow"), ("elbow", "wrist"), ("shoulder", "hip"), ("hip", "knee"), ("knee", "ankle"),
            ("ankle", "toe"), ("heel", "toe"), ("ankle", "heel"),
        )
    ),
    ("left_shoulder", "right_shoulder"), ("left_hip", "right_hip"), ("left_ear", "nose"), ("right_ear", "nose"),
]  # fmt: skip
ROWS = [(POINTS.index(first), POINTS.index(second)) for first, second in BONES]
FRAMES = 6
KINEMATIC, PHYSICAL, DETECTED = "#9aa5b1", "#1f6fb2", "#d1495b"


def pose_picture(keypoints: Keypoints, camera: Camera, executed: np.ndarray, kinematic: np.ndarray, path: Path) -> None:
    """Draw some frames of a film, in the image above and from the camera's side below, and write them to a PNG file.

    executed, kinematic: points (T, P, 3) [m] of the executed motion, and of the kinematic start.
    """
    frames = np.linspace(0, len(keypoints) - 1, FRAMES).astype(int)
    drawing = Figure(figsize=(14.0, 6.2), layout="constrained")
    axes = drawing.subplots(2, FRAMES)
    images = [camera.project(executed), camera.project(kinematic), keypoints.places]
    figures = np.concatenate(images[:2], axis=1)  # keypoints may be anywhere
    low, high = figures.min(axis=1), figures.max(axis=1)
    half_size = 0.5 * (high - low).max(axis=0) + 40.0
    forwards = camera.turn[2] * (1.0, 1.0, 0.0)
    forwards = forwards / np.linalg.norm(forwards)
    side_views = [points @ np.stack([forwards, (0.0, 0.0, 1.0)]).T for points in (executed, kinematic)]
    for column, frame in enumerate(frames):
        image_axes, side_axes = axes[0, column], axes[1, column]
        image_axes.set_title(f"{frame / keypoints.rate:.2f} s")
        _bones(image_axes, images[1][frame], KINEMATIC)
        _bones(image_axes, images[0][frame], PHYSICAL)
        image_axes.scatter(*keypoints.places[frame].T, s=12, color=DETECTED, zorder=3)
        (left, top), (right, bottom) = (0.5 * (low + high)[frame] + side * half_size for side in (-1.0, 1.0))
        image_axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
        _bones(side_axes, side_views[1][frame], KINEMATIC)
        _bones(side_axes, side_views[0][frame], PHYSICAL)
        centre = side_views[0][frame, :, 0].mean()
        side_axes.axhline(0.0, color="#c8ccd0", lw=1)
        side_axes.set(xlim=(centre - 1.0, centre + 1.0), ylim=(-0.1, 2.1), aspect="equal", xticks=[])
        if column:
            side_axes.set_yticks([])
    axes[0, 0].set_ylabel("in the image")
    axes[1, 0].set_ylabel("from the camera's side, height [m]")
    names = ("keypoints", DETECTED), ("kinematic start", KINEMATIC), ("physical motion, MuJoCo", PHYSICAL)
    handles = [axes[0, 0].plot([], [], color=color, lw=2, label=name)[0] for name, color in names]
    drawing.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    buffer = io.BytesIO()
    drawing.savefig(buffer, format="png", dpi=90)
    write_whole(path, buffer.getvalue())


def _bones(axes: Axes, places: np.ndarray, color: str) -> None:
    for first, second in ROWS:
        axes.plot(*places[[first, second]].T, color=color, lw=2, solid_capstyle="round")

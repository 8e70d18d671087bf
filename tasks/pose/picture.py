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
        (f"{side}_{one}", f"{side}_{other}")
        for side in SIDES
        for one, other in (
            ("shoulder", "elbow"), ("elbow", "wrist"), ("shoulder", "hip"), ("hip", "knee"), ("knee", "ankle"),
            ("ankle", "toe"), ("heel", "toe"), ("ankle", "heel"),
        )
    ),
    ("left_shoulder", "right_shoulder"), ("left_hip", "right_hip"), ("left_ear", "nose"), ("right_ear", "nose"),
]  # fmt: skip
ROWS = [(POINTS.index(one), POINTS.index(other)) for one, other in BONES]
FRAMES = 6
KINEMATIC, PHYSICAL, SEEN = "#9aa5b1", "#1f6fb2", "#d1495b"


def pose_picture(keypoints: Keypoints, camera: Camera, found: np.ndarray, start: np.ndarray, path: Path) -> None:
    """Draw some frames of a film, in the image above and from the camera's side below, and write them to a PNG file.

    found, start: points (T, P, 3) [m] of the executed motion, and of the kinematic start.
    """
    frames = np.linspace(0, len(keypoints) - 1, FRAMES).astype(int)
    drawing = Figure(figsize=(14.0, 6.2), layout="constrained")
    axes = drawing.subplots(2, FRAMES)
    images = [camera.project(found), camera.project(start), keypoints.places]
    figures = np.concatenate(images[:2], axis=1)  # keypoints may be anywhere
    low, high = figures.min(axis=1), figures.max(axis=1)
    reach = 0.5 * (high - low).max(axis=0) + 40.0
    ahead = camera.turn[2] * (1.0, 1.0, 0.0)
    ahead = ahead / np.linalg.norm(ahead)
    sides = [each @ np.stack([ahead, (0.0, 0.0, 1.0)]).T for each in (found, start)]
    for column, frame in enumerate(frames):
        above, below = axes[0, column], axes[1, column]
        above.set_title(f"{frame / keypoints.rate:.2f} s")
        _bones(above, images[1][frame], KINEMATIC)
        _bones(above, images[0][frame], PHYSICAL)
        above.scatter(*keypoints.places[frame].T, s=12, color=SEEN, zorder=3)
        (left, top), (right, bottom) = (0.5 * (low + high)[frame] + side * reach for side in (-1.0, 1.0))
        above.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
        _bones(below, sides[1][frame], KINEMATIC)
        _bones(below, sides[0][frame], PHYSICAL)
        middle = sides[0][frame, :, 0].mean()
        below.axhline(0.0, color="#c8ccd0", lw=1)
        below.set(xlim=(middle - 1.0, middle + 1.0), ylim=(-0.1, 2.1), aspect="equal", xticks=[])
        if column:
            below.set_yticks([])
    axes[0, 0].set_ylabel("in the image")
    axes[1, 0].set_ylabel("from the camera's side, height [m]")
    names = ("keypoints", SEEN), ("kinematic start", KINEMATIC), ("physical motion, MuJoCo", PHYSICAL)
    handles = [axes[0, 0].plot([], [], color=color, lw=2, label=name)[0] for name, color in names]
    drawing.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    buffer = io.BytesIO()
    drawing.savefig(buffer, format="png", dpi=90)
    write_whole(path, buffer.getvalue())


def _bones(axes: Axes, places: np.ndarray, color: str) -> None:
    for one, other in ROWS:
        axes.plot(*places[[one, other]].T, color=color, lw=2, solid_capstyle="round")

"""Picture of a reconstruction: keypoints, the figure over them, and the motion from the side."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from larp_model.files import write_whole
from tasks.pose.camera import Camera
from tasks.pose.points import POINTS, SIDES, Keypoints
from tasks.pose.views import Views

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


def pose_picture(views: Views, executed: np.ndarray, kinematic: np.ndarray, path: Path) -> None:
    """Draw some frames of a film, in each image above and from the first camera's side below, and write them to a PNG.

    executed, kinematic: points (T, P, 3) [m] of the executed motion, and of the kinematic start.
    """
    (films, cameras), frames = views.as_images(), np.linspace(0, len(views) - 1, FRAMES).astype(int)
    drawing = Figure(figsize=(14.0, 0.4 + 2.9 * (len(films) + 1)), layout="constrained")
    axes = drawing.subplots(len(films) + 1, FRAMES)
    for column, frame in enumerate(frames):
        axes[0, column].set_title(f"{frame / views.rate:.2f} s")
    for film, camera, row in zip(films, cameras, axes[:-1], strict=True):
        _draw_images(row, film, frames, camera.project(executed), camera.project(kinematic))
    _draw_from_the_side(axes[-1], frames, cameras[0], executed, kinematic)
    for number, row in enumerate(axes[:-1], start=1):
        row[0].set_ylabel("in the image" if len(films) == 1 else f"image of film {number}")
    axes[-1, 0].set_ylabel("from the camera's side, height [m]")
    names = ("keypoints", DETECTED), ("kinematic start", KINEMATIC), ("physical motion, MuJoCo", PHYSICAL)
    handles = [axes[0, 0].plot([], [], color=color, lw=2, label=name)[0] for name, color in names]
    drawing.legend(handles=handles, loc="outside lower center", ncols=3, frameon=False)
    buffer = io.BytesIO()
    drawing.savefig(buffer, format="png", dpi=90)
    write_whole(path, buffer.getvalue())


def _draw_images(
    row: Sequence[Axes], film: Keypoints, frames: np.ndarray, executed: np.ndarray, kinematic: np.ndarray
) -> None:
    """Draw the places (T, P, 2) [px] of both motions in the images of one film, under its keypoints."""
    figures = np.concatenate([executed, kinematic], axis=1)  # keypoints may be anywhere
    low, high = figures.min(axis=1), figures.max(axis=1)
    half_size = 0.5 * (high - low).max(axis=0) + 40.0
    for axes, frame in zip(row, frames, strict=True):
        _bones(axes, kinematic[frame], KINEMATIC)
        _bones(axes, executed[frame], PHYSICAL)
        horizontal, vertical = film.places[frame].T
        axes.scatter(horizontal, vertical, s=12, color=DETECTED, zorder=3)
        (left, top), (right, bottom) = (0.5 * (low + high)[frame] + side * half_size for side in (-1.0, 1.0))
        axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])


def _draw_from_the_side(
    row: Sequence[Axes], frames: np.ndarray, camera: Camera, executed: np.ndarray, kinematic: np.ndarray
) -> None:
    """Draw points (T, P, 3) [m] of both motions as seen at a right angle to the camera."""
    forwards = camera.turn[2] * (1.0, 1.0, 0.0)
    forwards = forwards / np.linalg.norm(forwards)
    side_views = [points @ np.stack([forwards, (0.0, 0.0, 1.0)]).T for points in (executed, kinematic)]
    for column, (axes, frame) in enumerate(zip(row, frames, strict=True)):
        _bones(axes, side_views[1][frame], KINEMATIC)
        _bones(axes, side_views[0][frame], PHYSICAL)
        centre = side_views[0][frame, :, 0].mean()
        axes.axhline(0.0, color="#c8ccd0", lw=1)
        axes.set(xlim=(centre - 1.0, centre + 1.0), ylim=(-0.1, 2.1), aspect="equal", xticks=[])
        if column:
            axes.set_yticks([])


def _bones(axes: Axes, places: np.ndarray, color: str) -> None:
    for first, second in ROWS:
        axes.plot(*places[[first, second]].T, color=color, lw=2, solid_capstyle="round")

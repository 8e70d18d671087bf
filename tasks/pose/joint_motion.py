"""Motions of our human from files of joints or markers in space."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model.bodies import human, standing_height
from tasks.motions import angles
from tasks.motions.skeleton import Motion
from tasks.pose import joint_files
from tasks.pose.figure import figure
from tasks.pose.lift import lift
from tasks.pose.points import POINTS, SIDES, Keypoints
from tasks.pose.space import Space
from tasks.pose.views import Views

# Of a longer recording, the time [s] before and after the fastest ankle is taken.
AROUND_KICK = 4.0


def source_of(reference: str | Path | Motion, names: Mapping[str, str] | None = None) -> str | Path | Motion:
    """Return a source of `references.captured`: the motion of a file of points in space, any other source as it is."""
    if isinstance(reference, Motion) or not joint_files.is_joint_file(reference):
        return reference
    return motion_of(reference, names)


def motion_of(path: str | Path, names: Mapping[str, str] | None = None) -> Motion:
    """Return the motion, around its fastest step or kick, of the figure that fits the points of a file best.

    path, names: see `joint_files.load`. Sizes are in proportion to the default human, of 1.75 m.
    """
    joints = joint_files.load(path, names=names)
    views = Views((_around_the_fastest(joints.keypoints),), (Space(),)).with_person()
    pose, proportions, *_ = lift(views)
    body = figure().body_of(proportions)
    motion = angles.motion(
        views.rate,
        standing_height(human()) / standing_height(body) * pose.place,
        Rotation.from_matrix(pose.turn).as_quat(scalar_first=True),
        pose.angles,
    )
    return replace(motion, read="; ".join(joints.notes))


def _around_the_fastest(film: Keypoints) -> Keypoints:
    ankles = film.places[:, [POINTS.index(f"{side}_ankle") for side in SIDES]]
    steps = np.linalg.norm(np.diff(ankles, axis=0), axis=-1)
    fastest = int(np.where(np.isfinite(steps), steps, 0.0).max(axis=1, initial=0.0).argmax()) if len(steps) else 0
    frames = round(AROUND_KICK * film.rate)
    return film.cut(fastest - frames, fastest + frames)

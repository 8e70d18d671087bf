"""Stationary pinhole camera, and its JSON file."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np

from larp_model.errors import InputError
from larp_model.names import require_file, require_known

# Horizontal field of view of a phone's camera [degrees] and its height [m], where they are not given.
FIELD_OF_VIEW, HANDHELD_HEIGHT = 65.0, 1.4
FIELDS = ("size", "field_of_view", "focal", "centre", "position", "look_at")


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Camera:
    """Pinhole camera without distortion.

    focal: length [px]. centre: of the image (2,) [px]. turn: rotation matrix (3, 3) from the world, z up, to the
    camera's axes: to the right, down, ahead. position: (3,) [m], in the world.
    """

    focal: float
    centre: Any
    turn: Any
    position: Any

    def project(self, points: Any) -> Any:
        """Return places (*, 2) [px] of points (*, 3) [m], arrays of NumPy or JAX.

        Points beside or behind the camera are projected far outside the image.
        """
        xp = points.__array_namespace__()
        local = (points - self.position) @ self.turn.T
        return self.focal * local[..., :2] / xp.maximum(local[..., 2:], 0.05) + self.centre

    def ray(self, places: np.ndarray) -> np.ndarray:
        """Return rays (*, 3) of places (*, 2) [px], in the world frame, each reaching one metre ahead of the camera."""
        ahead = np.ones((*places.shape[:-1], 1))
        return np.concatenate([(places - self.centre) / self.focal, ahead], axis=-1) @ self.turn


def looking_at(position: np.ndarray, at: np.ndarray, focal: float, size: tuple[float, float]) -> Camera:
    """Return an upright camera at a position (3,) that looks at a point (3,) [m]; size: of its images [px]."""
    ahead = np.asarray(at, float) - position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-3:
        raise InputError(f"look_at is {list(at)}, straight above or below the camera: which way is up is not known")
    right /= np.linalg.norm(right)
    return Camera(
        focal, 0.5 * np.asarray(size, float), np.stack([right, np.cross(ahead, right), ahead]), np.asarray(position)
    )


def focal_length(field_of_view: float, width: float) -> float:
    """Return the focal length [px] of a horizontal field of view [degrees] and an image width [px]."""
    if not 10.0 <= field_of_view <= 150.0:
        raise InputError(f"field_of_view is {field_of_view:g}, but must be from 10 to 150 degrees")
    return 0.5 * width / math.tan(math.radians(0.5 * field_of_view))


def handheld(focal: float, size: tuple[float, float]) -> Camera:
    """Return a level camera at the usual height `HANDHELD_HEIGHT`, which looks along x."""
    position = np.array([0.0, 0.0, HANDHELD_HEIGHT])
    return looking_at(position, position + np.array([1.0, 0.0, 0.0]), focal, size)


def load(path: str | Path, size: tuple[float, float] | None = None) -> tuple[Camera, bool]:
    """Return the camera of a JSON file, and whether the file gives its position.

    {"size": [width, height] in px, "field_of_view": degrees or "focal": px, "centre": [x, y] in px, "position": [x, y,
    z] and "look_at": [x, y, z] in m}: size may be left out where the keypoints have it (argument `size`), the centre
    where it is the image's, position and look_at where they are to be estimated.
    """
    path = Path(path)
    require_file("camera", path)
    try:
        given = json.loads(path.read_bytes())
    except ValueError:
        raise InputError(f"camera: {path.name} is no JSON file") from None
    if not isinstance(given, dict):
        raise InputError(f"camera: {path.name} needs an object with some of {', '.join(FIELDS)}")
    for name in given:
        require_known(f"camera: a field of {path.name}", name, FIELDS)

    def numbers(name: str, count: int) -> np.ndarray:
        value = given[name]
        listed = value if isinstance(value, list) else [value]
        good = all(isinstance(each, int | float) and math.isfinite(each) for each in listed)
        if not good or len(listed) != count or isinstance(value, list) != (count > 1):
            raise InputError(f"camera: {name} is {value!r}, but needs {count} finite number{'s' if count > 1 else ''}")
        return np.array(listed, float)

    if "size" in given:
        width, height = numbers("size", 2)
        size = width, height
    if size is None:
        raise InputError(f"camera: {path.name} has no size, but needs the images' [width, height]")
    if not min(size) > 0.0:
        raise InputError(f"camera: size is {list(size)}, but needs numbers above 0")
    if "focal" in given and "field_of_view" in given:
        raise InputError(f"camera: {path.name} has both focal and field_of_view, but needs one of them")
    if "focal" in given:
        (focal,) = numbers("focal", 1)
        if not focal > 0.0:
            raise InputError(f"camera: focal is {focal:g}, but must be above 0")
    else:
        (angle,) = numbers("field_of_view", 1) if "field_of_view" in given else (FIELD_OF_VIEW,)
        focal = focal_length(angle, size[0])
    if ("position" in given) != ("look_at" in given):
        raise InputError(f"camera: {path.name} has one of position and look_at, but needs both or neither")
    if "position" in given:
        position, at = numbers("position", 3), numbers("look_at", 3)
        if not position[2] > 0.0:
            raise InputError(f"camera: position is {position.tolist()}, but must be above the ground, z = 0")
        found = looking_at(position, at, focal, size)
    else:
        found = handheld(focal, size)
    if "centre" in given:
        found = Camera(focal, numbers("centre", 2), found.turn, found.position)
    return found, "position" in given

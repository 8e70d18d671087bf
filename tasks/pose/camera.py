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

# Horizontal field of view of a phone's camera [degrees] and its height [m], where the file has neither.
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
        rays: np.ndarray = np.concatenate([(places - self.centre) / self.focal, ahead], axis=-1) @ self.turn
        return rays


def looking_at(position: np.ndarray, target: np.ndarray, focal: float, size: tuple[float, float]) -> Camera:
    """Return an upright camera at a position (3,) that looks at a point (3,) [m]; size: of its images [px]."""
    ahead = np.asarray(target, float) - position
    ahead /= np.linalg.norm(ahead)
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    if np.linalg.norm(right) < 1e-3:
        raise InputError(f"look_at is {list(target)}, straight above or below the camera: which way is up is not known")
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
    fields = _fields(path)
    width, height = _image_size(fields, path.name, size)
    focal = _focal_length(fields, path.name, width)
    camera = _placed(fields, path.name, focal, (width, height))
    if "centre" in fields:
        camera = Camera(focal, _numbers(fields, "centre", 2), camera.turn, camera.position)
    return camera, "position" in fields


def _fields(path: Path) -> dict[str, Any]:
    """Return the content of a camera's file; an InputError names a field that is not one of `FIELDS`."""
    try:
        fields = json.loads(path.read_bytes())
    except ValueError:
        raise InputError(f"camera: {path.name} is no JSON file") from None
    if not isinstance(fields, dict):
        raise InputError(f"camera: {path.name} needs an object with some of {', '.join(FIELDS)}")
    for name in fields:
        require_known(f"camera: a field of {path.name}", name, FIELDS)
    return fields


def _numbers(fields: dict[str, Any], name: str, count: int) -> np.ndarray:
    """Return the numbers (count,) of a field; one number is no list."""
    value = fields[name]
    values = value if isinstance(value, list) else [value]
    finite = all(isinstance(number, int | float) and math.isfinite(number) for number in values)
    if not finite or len(values) != count or isinstance(value, list) != (count > 1):
        raise InputError(f"camera: {name} is {value!r}, but needs {count} finite number{'s' if count > 1 else ''}")
    return np.array(values, float)


def _image_size(fields: dict[str, Any], file_name: str, default: tuple[float, float] | None) -> tuple[float, float]:
    """Return width and height of the images [px]."""
    size = default
    if "size" in fields:
        width, height = _numbers(fields, "size", 2)
        size = width, height
    if size is None:
        raise InputError(f"camera: {file_name} has no size, but needs the images' [width, height]")
    if not min(size) > 0.0:
        raise InputError(f"camera: size is {list(size)}, but needs numbers above 0")
    return size


def _focal_length(fields: dict[str, Any], file_name: str, width: float) -> float:
    """Return the focal length [px], from that of the file or the field of view; width: of the images [px]."""
    if "focal" in fields and "field_of_view" in fields:
        raise InputError(f"camera: {file_name} has both focal and field_of_view, but needs one of them")
    if "focal" not in fields:
        (angle,) = _numbers(fields, "field_of_view", 1) if "field_of_view" in fields else (FIELD_OF_VIEW,)
        return focal_length(angle, width)
    focal: float = _numbers(fields, "focal", 1)[0]
    if not focal > 0.0:
        raise InputError(f"camera: focal is {focal:g}, but must be above 0")
    return focal


def _placed(fields: dict[str, Any], file_name: str, focal: float, size: tuple[float, float]) -> Camera:
    """Return the camera at the file's position, or one held by hand where it has none."""
    if ("position" in fields) != ("look_at" in fields):
        raise InputError(f"camera: {file_name} has one of position and look_at, but needs both or neither")
    if "position" not in fields:
        return handheld(focal, size)
    position, target = _numbers(fields, "position", 3), _numbers(fields, "look_at", 3)
    if not position[2] > 0.0:
        raise InputError(f"camera: position is {position.tolist()}, but must be above the ground, z = 0")
    return looking_at(position, target, focal, size)

"""Stationary pinhole camera, the distortion of its lens, and its file."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from larp_model.names import require_known
from larp_model.rotation import from_rotation_vector, matrix
from tasks.pose.calibration import fields_of
from tasks.pose.points import Keypoints

# Horizontal field of view of a phone's camera [degrees] and its height [m], where the file has neither.
FIELD_OF_VIEW, HANDHELD_HEIGHT = 65.0, 1.4
FIELDS = ("size", "field_of_view", "focal", "centre", "distortion", "position", "look_at", "rotation")
# Standard deviation of a detector's points, as a share of the image's larger side.
PIXEL_STD = 0.004
# Largest error of places whose distortion is removed, in focal lengths; beyond, a lens distorts too much there.
UNDISTORTED = 1e-3


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

    def tilted(self, corrections: Any) -> Camera:
        """Return the camera with pitch, roll [rad] and the logarithm of its height changed by (3,) values."""
        turn = matrix(from_rotation_vector(jnp.stack([corrections[0], jnp.zeros(()), corrections[1]])))
        position = jnp.asarray(self.position) * jnp.stack([1.0, 1.0, jnp.exp(corrections[2])])
        return Camera(self.focal, jnp.asarray(self.centre), turn @ jnp.asarray(self.turn), position)

    def noise(self, size: tuple[float, float] | None) -> float:
        """Return the standard deviation [px] of a detector's points in images of a size [px], by default its own."""
        return PIXEL_STD * float(max(size or 2.0 * np.asarray(self.centre)))

    def placed(self, places: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the translations (S, 3) [m] that move points (S, N, 3) so that they are as large as places (N, 2)."""
        local = points @ self.turn.T
        spread = np.sqrt(local[..., :2].var(axis=1).sum(axis=-1))
        depth = np.clip(self.focal * spread / max(np.sqrt(places.var(axis=0).sum()), 1.0), 1.0, 60.0)
        translations: np.ndarray = self.position + depth[:, None] * self.ray(places.mean(axis=0)) - points.mean(axis=1)
        return translations

    def image_of(self, film: Keypoints) -> tuple[Keypoints, Camera]:
        """Return the film and the camera, as its keypoints are already those of an image."""
        return film, self


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


def undistorted(places: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Return normalised image places (*, 2) with the distortion (k1, k2, p1, p2, k3 of OpenCV) removed.

    Uses fixed-point iteration, which converges for small distortion; NaN where it does not.
    """
    result = places
    with np.errstate(all="ignore"):
        for _ in range(20):
            radial, tangential = _bent(result, distortion)
            result = (places - tangential) / radial
        radial, tangential = _bent(result, distortion)
        error = np.abs(result * radial + tangential - places).max(axis=-1, keepdims=True)
    return np.where(error < UNDISTORTED, result, np.nan)


def _bent(places: np.ndarray, distortion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the factor (*, 1) and the shift (*, 2) by which OpenCV's distortion moves normalised image places."""
    k1, k2, p1, p2, k3 = distortion
    x, y = places[..., 0], places[..., 1]
    square = x**2 + y**2
    radial = 1.0 + square * (k1 + square * (k2 + square * k3))
    shift = [2.0 * p1 * x * y + p2 * (square + 2.0 * x**2), p1 * (square + 2.0 * y**2) + 2.0 * p2 * x * y]
    return radial[..., None], np.stack(shift, axis=-1)


class Lens(NamedTuple):
    """Lens of a camera: focal lengths (2,) and centre (2,) [px], distortion k1, k2, p1, p2, k3 of OpenCV."""

    focal: np.ndarray
    centre: np.ndarray
    distortion: np.ndarray

    def straightened(self, film: Keypoints) -> Keypoints:
        """Return keypoints as a pinhole camera of the first focal length sees them; lost where distorted too much."""
        if self.focal[0] == self.focal[1] and not self.distortion.any():
            return film
        places = self.focal[0] * undistorted((film.places - self.centre) / self.focal, self.distortion) + self.centre
        return replace(film, places=places, confidence=np.where(np.isnan(places[..., 0]), 0.0, film.confidence))


class LoadedCamera(NamedTuple):
    """Camera of a file: as a pinhole, its lens, its images' size [px], and whether its position is known."""

    camera: Camera
    lens: Lens
    size: tuple[float, float]
    position_known: bool

    def turned(self, degrees: int) -> LoadedCamera:
        """Return the camera of images that were turned clockwise by a multiple of 90 degrees.

        A camera whose position is not known stays upright.
        """
        result = self
        for _ in range(degrees // 90 % 4):
            result = result._turned_once()
        return result

    def _turned_once(self) -> LoadedCamera:
        # What lies at x to the right and y down lies at -y to the right and x down afterwards.
        width, height = self.size
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        k1, k2, p1, p2, k3 = self.lens.distortion
        centre = np.array([height - self.lens.centre[1], self.lens.centre[0]])
        lens = Lens(self.lens.focal[::-1], centre, np.array([k1, k2, p2, -p1, k3]))
        turn = quarter @ self.camera.turn if self.position_known else self.camera.turn
        camera = replace(self.camera, focal=float(lens.focal[0]), centre=centre, turn=turn)
        return LoadedCamera(camera, lens, (height, width), self.position_known)


def load(path: str | Path, size: tuple[float, float] | None = None) -> LoadedCamera:
    """Return the camera of a file: a calibration in one of the forms of `calibration`, or a JSON object.

    {"size": [width, height] in px, "field_of_view": degrees or "focal": px, one number or along x and y, "centre": [x,
    y] in px, "distortion": [k1, k2, p1, p2] or with k3 as OpenCV has them, "position": [x, y, z] in m, and "look_at":
    [x, y, z] in m or "rotation": a rotation vector in rad, from the world, z up, to the camera's axes}: size may be
    left out where the keypoints have it (argument `size`), the centre where it is the image's, position and where it
    looks where they are to be estimated.
    """
    file_name, fields = fields_of(path)
    for name in fields:
        require_known(f"camera: a field of {file_name}", name, FIELDS)
    size = _image_size(fields, file_name, size)
    focal = _focal_lengths(fields, file_name, size[0])
    camera = _placed(fields, file_name, float(focal[0]), size)
    if "centre" in fields:
        camera = replace(camera, centre=_numbers(fields, "centre", 2))
    distortion = np.zeros(5)
    if "distortion" in fields:
        count = 5 if isinstance(fields["distortion"], list) and len(fields["distortion"]) == 5 else 4
        distortion[:count] = _numbers(fields, "distortion", count)
    return LoadedCamera(camera, Lens(focal, camera.centre, distortion), size, "position" in fields)


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


def _focal_lengths(fields: dict[str, Any], file_name: str, width: float) -> np.ndarray:
    """Return the focal lengths (2,) [px], from those of the file or the field of view; width: of the images [px]."""
    if "focal" in fields and "field_of_view" in fields:
        raise InputError(f"camera: {file_name} has both focal and field_of_view, but needs one of them")
    if "focal" not in fields:
        (angle,) = _numbers(fields, "field_of_view", 1) if "field_of_view" in fields else (FIELD_OF_VIEW,)
        return np.full(2, focal_length(angle, width))
    focal = np.broadcast_to(_numbers(fields, "focal", 2 if isinstance(fields["focal"], list) else 1), 2)
    if not (focal > 0.0).all():
        raise InputError(f"camera: focal is {fields['focal']}, but must be above 0")
    return focal


def _placed(fields: dict[str, Any], file_name: str, focal: float, size: tuple[float, float]) -> Camera:
    """Return the camera at the file's position, or one held by hand where it has none."""
    ways = [name for name in ("look_at", "rotation") if name in fields]
    if len(ways) != ("position" in fields):
        found = ", ".join(name for name in ("position", *ways) if name in fields)
        raise InputError(
            f"camera: {file_name} has {found}, but needs both or neither: position, and one of look_at and rotation"
        )
    if not ways:
        return handheld(focal, size)
    position = _numbers(fields, "position", 3)
    if not position[2] > 0.0:
        raise InputError(f"camera: position is {position.tolist()}, but must be above the ground, z = 0")
    if ways == ["look_at"]:
        return looking_at(position, _numbers(fields, "look_at", 3), focal, size)
    turn = Rotation.from_rotvec(_numbers(fields, "rotation", 3)).as_matrix()
    return Camera(focal, 0.5 * np.asarray(size, float), turn, position)

"""Points that are known in space, from motion capture or triangulated elsewhere, in the place of a camera's images."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from tasks.pose.camera import Camera, looking_at
from tasks.pose.points import Keypoints

# Standard deviation of points in space [m].
POINT_STD = 0.012
# Image in which they are shown: width and height [px], focal length [px], distance [m] and height [m] of its camera.
SIZE, FOCAL, DISTANCE, HEIGHT = (1000.0, 1000.0), 1200.0, 6.0, 1.5


@jax.tree_util.register_dataclass
@dataclass(frozen=True, eq=False)
class Space:
    """Stands for a `Camera` where points (T, P, 3) [m] themselves are known."""

    def project(self, points: Any) -> Any:
        """Return the points (*, 3) [m] as they are."""
        return points

    def tilted(self, corrections: Any) -> Space:
        """Return itself, whose directions are known."""
        return self

    def noise(self, size: tuple[float, float] | None) -> float:
        """Return the standard deviation [m] of the points."""
        return POINT_STD

    def placed(self, places: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the translations (S, 3) [m] that move points (S, N, 3) onto places (N, 3), in the mean."""
        translations: np.ndarray = places.mean(axis=0) - points.mean(axis=1)
        return translations

    def image_of(self, film: Keypoints) -> tuple[Keypoints, Camera]:
        """Return points in space as a camera beside them sees them, and that camera."""
        middle = np.nanmean(film.places, axis=(0, 1))
        camera = looking_at(np.array([middle[0] - DISTANCE, middle[1], HEIGHT]), middle, FOCAL, SIZE)
        places = np.where(film.detected[..., None], camera.project(film.places), np.nan)
        return replace(film, places=places, size=SIZE), camera

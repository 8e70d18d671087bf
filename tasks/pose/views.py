"""Views of a person: films of one camera, or of several at the same times, or points that are known in space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np

from larp_model.errors import InputError
from tasks.pose.camera import Camera
from tasks.pose.points import Keypoints
from tasks.pose.space import Space

Viewpoint = Camera | Space
# Fewest frames that show a person.
MIN_FRAMES = 10
# A point's place is an outlier beyond this number of standard deviations, and counts less.
OUTLIER = 6.0


def places_in_all(cameras: Sequence[Viewpoint], points: Any) -> Any:
    """Return places (*, C, P, 2) [px], or (*, C, P, 3) [m], of points (*, P, 3) [m] as seen by C cameras."""
    return points.__array_namespace__().stack([camera.project(points) for camera in cameras], axis=-3)


@dataclass(frozen=True, eq=False)
class Views:
    """Keypoints of one person in C films, whose frames were taken at the same times, and the films' cameras.

    Where points are known in space, there is one such film, and `Space` in the place of a camera. Raises an InputError
    where the films differ in rate or number of frames.
    """

    films: tuple[Keypoints, ...]
    cameras: tuple[Viewpoint, ...]

    def __post_init__(self) -> None:
        if not self.films or len(self.films) != len(self.cameras):
            raise InputError(f"cameras are {len(self.cameras)}, but must be as many as films, here {len(self.films)}")
        if len({(len(film), film.rate) for film in self.films}) > 1:
            raise InputError("films have different lengths or rates, but need frames at the same times")

    def __len__(self) -> int:
        return len(self.films[0])

    @property
    def rate(self) -> float:
        """Return the frames per second."""
        return self.films[0].rate

    @property
    def times(self) -> np.ndarray:
        """Return the times (T,) [s] of the frames, the first at 0."""
        return self.films[0].times

    @property
    def places(self) -> np.ndarray:
        """Return the places (T, C, P, 2) [px], or (T, C, P, 3) [m], of the points, NaN where they were not detected."""
        return np.stack([film.places for film in self.films], axis=1)

    @property
    def confidence(self) -> np.ndarray:
        """Return the confidence (T, C, P) of the points, 0 where they were not detected."""
        return np.stack([film.confidence for film in self.films], axis=1)

    @property
    def sigma(self) -> np.ndarray:
        """Return the standard deviation (C,) [px or m] of the detected points in each film."""
        return np.array([camera.noise(film.size) for film, camera in zip(self.films, self.cameras, strict=True)])

    @property
    def in_space(self) -> bool:
        """Return whether points are known in space, in the place of images."""
        return isinstance(self.cameras[0], Space)

    @property
    def frames_with_person(self) -> np.ndarray:
        """Return the indices of the frames in which some film shows a person, 6 points or more."""
        return np.flatnonzero(((self.confidence > 0.3).sum(axis=-1) >= 6).any(axis=1))

    def with_person(self) -> Views:
        """Return the views from the first frame with a person to the last; raises InputError if too few show one."""
        frames = self.frames_with_person
        if len(frames) < MIN_FRAMES:
            raise InputError(
                f"keypoints show 6 or more points in {len(frames)} frames, but need {MIN_FRAMES} such frames"
            )
        return self.cut(int(frames[0]), int(frames[-1]))

    def cut(self, first: int, last: int) -> Views:
        """Return the views of the frames from `first` to `last`, both included, as far as they exist."""
        return replace(self, films=tuple(film.cut(first, last) for film in self.films))

    def corrected(self, corrections: np.ndarray) -> Views:
        """Return the views by cameras with their tilts and heights changed; corrections (3,): see `Camera.tilted`."""
        if not corrections.any():
            return self
        tilted = (camera.tilted(corrections) for camera in self.cameras)
        return replace(self, cameras=jax.tree.map(lambda value: np.asarray(value, float), tuple(tilted)))

    def as_images(self) -> tuple[tuple[Keypoints, ...], tuple[Camera, ...]]:
        """Return films and cameras; points in space as a camera beside them sees them."""
        images = [camera.image_of(film) for film, camera in zip(self.films, self.cameras, strict=True)]
        return tuple(film for film, _ in images), tuple(camera for _, camera in images)

"""Views of a person: the films of one camera, or of several at the same times."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from larp_model.errors import InputError
from tasks.pose.camera import Camera
from tasks.pose.points import Keypoints

# Standard deviation of a detector's points, as a share of the image's larger side.
PIXEL_STD = 0.004


@dataclass(frozen=True, eq=False)
class Views:
    """Keypoints of one person in C films, whose frames were taken at the same times, and the films' cameras.

    Raises an InputError where the films differ in rate or number of frames.
    """

    films: tuple[Keypoints, ...]
    cameras: tuple[Camera, ...]

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
        """Return the places (T, C, P, 2) [px] of the points, NaN where they were not detected."""
        return np.stack([film.places for film in self.films], axis=1)

    @property
    def confidence(self) -> np.ndarray:
        """Return the confidence (T, C, P) of the points, 0 where they were not detected."""
        return np.stack([film.confidence for film in self.films], axis=1)

    @property
    def sigma(self) -> np.ndarray:
        """Return the standard deviation (C,) [px] of the detected points in each film."""
        sizes = [
            film.size or 2.0 * np.asarray(camera.centre) for film, camera in zip(self.films, self.cameras, strict=True)
        ]
        return PIXEL_STD * np.array([max(size) for size in sizes], float)

    @property
    def frames_with_person(self) -> np.ndarray:
        """Return the indices of the frames in which some film shows 6 points or more."""
        return np.flatnonzero(((self.confidence > 0.3).sum(axis=-1) >= 6).any(axis=1))

    def cut(self, first: int, last: int) -> Views:
        """Return the views of the frames from `first` to `last`, both included, as far as they exist."""
        return replace(self, films=tuple(film.cut(first, last) for film in self.films))

"""Keypoints of a person that detectors find in images: their names and their values in a film."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from larp_model.errors import InputError

SIDES = ("left", "right")
LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel", "toe")
# Names of the keypoints, the sides being the person's own; the toe is the tip of the big one.
POINTS = ("nose", "left_ear", "right_ear", *(f"{side}_{limb}" for limb in LIMBS for side in SIDES))
# Rows of heels and toes, side by side.
FEET = [POINTS.index(f"{side}_{end}") for side in SIDES for end in ("heel", "toe")]
# Frames a second that a recording may have.
RATES = (5.0, 1000.0)


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Keypoints of one person in the images of a film, or in space.

    places: (T, P, 2) [px], in the order of `POINTS`, x to the right and y down from the upper left corner, or (T, P, 3)
    [m], z up, the ground at 0; NaN where a point was not detected. confidence: (T, P) from 0, not detected, to 1. rate:
    frames per second. size: width and height of the images [px], if they are known. Raises an InputError where these do
    not fit together.
    """

    places: np.ndarray
    confidence: np.ndarray
    rate: float
    size: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        frames = len(self.places)
        if (
            self.places.shape[:2] != (frames, len(POINTS))
            or self.places.shape[2:] not in ((2,), (3,))
            or self.confidence.shape != (frames, len(POINTS))
        ):
            raise InputError(
                f"places and confidence have shapes {self.places.shape} and {self.confidence.shape}, but need "
                f"(T, {len(POINTS)}, 2 or 3) and (T, {len(POINTS)})"
            )
        if not (RATES[0] <= self.rate <= RATES[1]):
            raise InputError(f"rate is {self.rate:g}, but must be from {RATES[0]:g} to {RATES[1]:g} frames a second")
        if not ((self.confidence >= 0.0) & (self.confidence <= 1.0)).all():
            raise InputError("confidence holds numbers that are not from 0 to 1")
        if not np.isfinite(self.places[self.confidence > 0.0]).all():
            raise InputError("places holds numbers that are not finite, of points that were detected")

    def __len__(self) -> int:
        return len(self.places)

    @property
    def detected(self) -> np.ndarray:
        """Return a mask (T, P) of the points that were detected."""
        return self.confidence > 0.0

    @property
    def times(self) -> np.ndarray:
        """Return the times (T,) [s] of the frames, the first at 0."""
        return np.arange(len(self)) / self.rate

    def cut(self, first: int, last: int) -> Keypoints:
        """Return the keypoints of the frames from `first` to `last`, both included, as far as they exist."""
        frames = slice(max(first, 0), last + 1)
        return replace(self, places=self.places[frames], confidence=self.confidence[frames])


def require_rate(rate: float | None, name: str) -> float:
    """Return the frames per second of a file, of this name; raises InputError where they are not known, or unusual."""
    if rate is None:
        raise InputError(f"rate is not known, {name} does not hold it: give frames a second")
    if not RATES[0] <= rate <= RATES[1]:
        raise InputError(f"rate is {rate:g}, but must be from {RATES[0]:g} to {RATES[1]:g} frames a second")
    return float(rate)


def require_inside(film: Keypoints, size: Sequence[float] | np.ndarray, name: str) -> None:
    """Raise InputError where most of the detected points lie outside images of this size [px]."""
    places = film.places[film.detected]
    outside = np.any((places < 0.0) | (places > np.asarray(size)), axis=-1).mean()
    if outside > 0.5:
        share, (width, height) = f"{100.0 * outside:.0f} %", size
        raise InputError(f"{name} has {share} of its points outside images of a size of {width:g} x {height:g} px")


def interpolated(values: np.ndarray, rate: float, times: np.ndarray) -> np.ndarray:
    """Return values (T, ...) of a rate [1/s] interpolated linearly at times (N,) [s] from 0; the last one continues."""
    position = np.minimum(times * rate, len(values) - 1)
    before = position.astype(int)
    share = (position - before).reshape(-1, *(1,) * (values.ndim - 1))
    result: np.ndarray = (1.0 - share) * values[before] + share * values[np.minimum(before + 1, len(values) - 1)]
    return result

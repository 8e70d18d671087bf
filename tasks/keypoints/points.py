"""Points of a person that detectors find in images, and where they are on our human."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from larp_model.errors import InputError

SIDES = ("left", "right")
LIMBS = ("shoulder", "elbow", "wrist", "hip", "knee", "ankle", "heel", "toe")
# What we know of a person, the sides being the person's own; the toe is the tip of the big one.
POINTS = ("nose", "left_ear", "right_ear", *(f"{side}_{limb}" for limb in LIMBS for side in SIDES))
# Rows of heels and toes, side by side.
FEET = [POINTS.index(f"{side}_{end}") for side in SIDES for end in ("heel", "toe")]
# Frames a second that a recording may have.
RATES = (5.0, 1000.0)


@dataclass(frozen=True, eq=False)
class Keypoints:
    """Where one person's points are in the images of a film.

    places: (T, P, 2) [px], in the order of `POINTS`, x to the right and y down from the upper left corner; NaN where a
    point was not found. confidence: (T, P) from 0, not found, to 1. rate: frames a second. size: width and height of
    the images [px], if they are known. InputError where these do not fit together.
    """

    places: np.ndarray
    confidence: np.ndarray
    rate: float
    size: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        frames = len(self.places)
        if self.places.shape != (frames, len(POINTS), 2) or self.confidence.shape != (frames, len(POINTS)):
            raise InputError(
                f"places and confidence have shapes {self.places.shape} and {self.confidence.shape}, but need "
                f"(T, {len(POINTS)}, 2) and (T, {len(POINTS)})"
            )
        if not (RATES[0] <= self.rate <= RATES[1]):
            raise InputError(f"rate is {self.rate:g}, but must be from {RATES[0]:g} to {RATES[1]:g} frames a second")
        if not ((self.confidence >= 0.0) & (self.confidence <= 1.0)).all():
            raise InputError("confidence holds numbers that are not from 0 to 1")
        if not np.isfinite(self.places[self.confidence > 0.0]).all():
            raise InputError("places holds numbers that are not finite, of points that were found")

    def __len__(self) -> int:
        return len(self.places)

    @property
    def seen(self) -> np.ndarray:
        """Which points were found (T, P)."""
        return self.confidence > 0.0

    @property
    def times(self) -> np.ndarray:
        """When the frames were taken (T,) [s], the first at 0."""
        return np.arange(len(self)) / self.rate

    def cut(self, first: int, last: int) -> Keypoints:
        """The frames from `first` to `last`, both included, or what there is of them."""
        frames = slice(max(first, 0), last + 1)
        return replace(self, places=self.places[frames], confidence=self.confidence[frames])


def interpolated(values: np.ndarray, rate: float, times: np.ndarray) -> np.ndarray:
    """Values (T, ...), so many a second, at times (N,) [s] from 0 on: in between linearly, and the last from its on."""
    at = np.minimum(times * rate, len(values) - 1)
    before = at.astype(int)
    share = (at - before).reshape(-1, *(1,) * (values.ndim - 1))
    return (1.0 - share) * values[before] + share * values[np.minimum(before + 1, len(values) - 1)]

"""Synchronisation of films of one person by several cameras: who is who, and when each film began.

A point's places in two images, at the right time and of the right person, have rays that meet. Of all people of another
film and all times at which it may have begun, the one is taken with which the rays of all points pass nearest to each
other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from larp_model.errors import InputError
from tasks.pose.camera import Camera
from tasks.pose.points import Keypoints
from tasks.pose.views import MIN_FRAMES, OUTLIER, Views

# Films have this share of the shorter one in common, and at least `MIN_FRAMES`.
COMMON_SHARE = 0.4
# Number of frames that are compared, of all that two films have in common.
COMPARED_FRAMES = 120


class Match(NamedTuple):
    """Person of another film who is the first film's, and how much later that film began.

    person: index. delay: [s], time of the first film at the other's first frame. misfit: from 0, where all rays meet,
    to 1. distance: of the other film's points from where the first one sees them [px], half of them are nearer.
    """

    person: int
    delay: float
    misfit: float
    distance: float


def resampled(film: Keypoints, times: np.ndarray, rate: float) -> Keypoints:
    """Return the keypoints at times [s] from the film's first frame, interpolated linearly.

    A point is not detected where it is missing in one of the two frames around, nor before and after the film.
    """
    position = np.round(times * film.rate, 6)
    before, after = (np.clip(rounded(position).astype(int), 0, len(film) - 1) for rounded in (np.floor, np.ceil))
    share, inside = (position - before)[:, None], (position >= 0.0) & (position <= len(film) - 1)
    confidence = np.where(inside[:, None], np.minimum(film.confidence[before], film.confidence[after]), 0.0)
    places = (1.0 - share[..., None]) * film.places[before] + share[..., None] * film.places[after]
    return replace(film, places=np.where(confidence[..., None] > 0.0, places, np.nan), confidence=confidence, rate=rate)


def match(first: Keypoints, camera: Camera, people: Sequence[Keypoints], other: Camera) -> Match:
    """Return who of the people of another film is the first one's person, and the delay between the films.

    camera, other: of the two films. Raises an InputError where no person is seen long enough by both.
    """
    matches = [
        candidate
        for person, film in enumerate(people)
        if (candidate := _best_delay(first, camera, film, other, person)) is not None
    ]
    if not matches:
        raise InputError(f"has nobody in it for {MIN_FRAMES} frames of the first film")
    return min(matches, key=lambda candidate: candidate.misfit)


def synchronised(films: Sequence[Keypoints], cameras: Sequence[Camera], delays: Sequence[float]) -> Views:
    """Return views of films at the times of the first one's frames; delays: see `Match`, of all films, the first 0."""
    first = films[0]
    return Views(
        tuple(
            film if film is first else resampled(film, first.times - delay, first.rate)
            for film, delay in zip(films, delays, strict=True)
        ),
        tuple(cameras),
    )


def _best_delay(first: Keypoints, camera: Camera, film: Keypoints, other: Camera, person: int) -> Match | None:
    durations = first.times[-1], film.times[-1]
    common = max(COMMON_SHARE * min(durations), (MIN_FRAMES - 1) / first.rate)
    frames = np.arange(np.ceil((common - durations[1]) * first.rate), (durations[0] - common) * first.rate + 1e-6)
    cameras = camera, other
    misfits = np.array([_misfit(_in_common(first, film, cameras, frame / first.rate)) for frame in frames])
    if not np.isfinite(misfits).any():
        return None
    best = int(misfits.argmin())
    # Points interpolated between frames are less noisy, so that films of one rate are compared at whole frames alone.
    around = misfits[max(best - 1, 0) : best + 2]
    bend = around[0] - 2.0 * around[1] + around[2] if len(around) == 3 and np.isfinite(around).all() else 0.0
    vertex = 0.5 * (around[0] - around[2]) / bend if bend > 0.0 else 0.0
    delay = float((frames[best] + vertex) / first.rate)
    views = _in_common(first, film, cameras, delay)
    seen = (views.confidence > 0.0).all(axis=1)
    return Match(person, delay, float(misfits[best]), float(views.sigma[1] * np.median(_gaps(views)[seen])))


def _in_common(first: Keypoints, film: Keypoints, cameras: tuple[Camera, Camera], delay: float) -> Views:
    """Return both films at times of the first one's frames, some of those that they have in common."""
    frames = np.flatnonzero((first.times >= delay) & (first.times <= delay + film.times[-1]))
    frames = frames[:: max(1, len(frames) // COMPARED_FRAMES)]
    shown = replace(first, places=first.places[frames], confidence=first.confidence[frames])
    return Views((shown, resampled(film, first.times[frames] - delay, first.rate)), cameras)


def _misfit(views: Views) -> float:
    """Return the mean misfit of the rays of all points, infinite where there are too few to say."""
    weights = views.confidence.prod(axis=1)
    seen = weights > 0.0
    if seen.any(axis=1).sum() < MIN_FRAMES:
        return np.inf
    squares = _gaps(views)[seen] ** 2
    return float(np.average(squares / (squares + OUTLIER**2), weights=weights[seen]))


def _gaps(views: Views) -> np.ndarray:
    """Return the distances (T, P) between the rays of two films' points, in standard deviations of their places."""
    (_, cameras), places = views.as_images(), np.nan_to_num(views.places)
    one, two = (camera.ray(places[:, view]) for view, camera in enumerate(cameras))
    between = cameras[1].position - cameras[0].position
    normal = np.cross(one, two)
    square = np.maximum((normal**2).sum(axis=-1), 1e-9)
    # The depths at which the rays are nearest to each other; a ray reaches one metre ahead.
    depths = (
        (np.cross(between, two) * normal).sum(axis=-1) / square,
        (np.cross(between, one) * normal).sum(axis=-1) / square,
    )
    sizes = [
        np.maximum(depth, 0.1) * sigma / camera.focal
        for depth, sigma, camera in zip(depths, views.sigma, cameras, strict=True)
    ]
    gap = abs(normal @ between) / np.sqrt(square)
    in_front = (depths[0] > 0.0) & (depths[1] > 0.0)
    return np.where(in_front, gap / np.hypot(*sizes), 1e3)

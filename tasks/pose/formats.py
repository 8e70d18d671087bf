"""Keypoints of a film from the files in which pose detectors store them: see `detectors`, or an npz file of our own.

The format is recognised by the file's content, not by its name, the order of a person's points by which of those with
as many points makes a person, and whether places are pixels or parts of the image by their size.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from larp_model.errors import InputError
from larp_model.files import arrays_of
from larp_model.names import require_file, require_known
from tasks.pose.detectors import (
    DetectedFilm,
    checked_numbers,
    detection,
    folder_film,
    json_content,
    json_film,
    shortened,
)
from tasks.pose.people import Detection, Track, is_crossed, prominence, tracks_of
from tasks.pose.point_orders import ORDERS, in_our_order, order_of
from tasks.pose.points import POINTS, Keypoints, require_inside, require_rate

_MIN_POINTS = 6
_NOBODY = "has no person in any frame"
_MAX_FRAMES = 100_000
_MAX_SIZE = 1e6
# Places are parts of the image where half of them are no larger: nobody is so small in pixels.
_LARGEST_PART = 2.0


class LoadedKeypoints(NamedTuple):
    """Keypoints of one person, with the number of people in the file.

    crossed: number of frames in which another person's bounding box and this one's share more than half of the smaller
    of them: there the two may have been mixed up. notes: how the file was read, where it does not say it itself.
    """

    keypoints: Keypoints
    people: int
    crossed: int
    notes: tuple[str, ...]


class LoadedPeople(NamedTuple):
    """People of a film, in order of appearance.

    name: of the file. tracks: each person's points by frame. frames: of the film, with all people's points. rate:
    frames per second. size: width and height of the images [px], if they are known. notes: see `LoadedKeypoints`.
    """

    name: str
    tracks: list[Track]
    frames: list[list[Detection]]
    rate: float
    size: tuple[float, float] | None
    notes: tuple[str, ...]

    @property
    def most_prominent(self) -> int:
        """Return the index of the person who is seen best."""
        return self.by_prominence[0]

    @property
    def by_prominence(self) -> list[int]:
        """Return the people's indices by the sum of confidence times height in the image, the greatest first."""
        return sorted(range(len(self.tracks)), key=lambda person: -prominence(self.tracks[person]))

    def keypoints(self, person: int) -> LoadedKeypoints:
        """Return the keypoints of a person, by index; an InputError names a person of whom too little is seen."""
        if person not in range(len(self.tracks)):
            raise InputError(
                f"person is {person}, but must be from 0 to below {len(self.tracks)}, the people in {self.name}"
            )
        track = self.tracks[person]
        rows = np.full((len(self.frames), len(POINTS), 3), (np.nan, np.nan, 0.0))
        rows[list(track)] = [one.points for one in track.values()]
        detected = np.flatnonzero(rows[..., 2].any(axis=0))
        if len(detected) < _MIN_POINTS:
            detected_names = ", ".join(POINTS[point] for point in detected)
            raise InputError(
                f"{self.name} has only {detected_names} of this person, but needs {_MIN_POINTS} points or more"
            )
        keypoints = Keypoints(rows[..., :2], rows[..., 2], self.rate, self.size)
        if self.size is not None:
            require_inside(keypoints, self.size, self.name)
        crossed = sum(is_crossed(one, self.frames[frame]) for frame, one in track.items())
        return LoadedKeypoints(keypoints, len(self.tracks), crossed, self.notes)


def load(
    path: str | Path,
    rate: float | None = None,
    size: tuple[float, float] | None = None,
    person: int | None = None,
    points: str | None = None,
) -> LoadedKeypoints:
    """Read one person's points, by index from 0 in order of appearance, or the most prominent; see `load_people`."""
    people = load_people(path, rate, size, points)
    return people.keypoints(people.most_prominent if person is None else person)


def load_people(
    path: str | Path,
    rate: float | None = None,
    size: tuple[float, float] | None = None,
    points: str | None = None,
) -> LoadedPeople:
    """Read the points of all people; an InputError of one line names what is missing, damaged or not understood.

    path: a file, or a folder with one for each frame. rate: frames per second. size: width and height of the images
    [px]. Only npz files store these two, and the arguments take precedence. points: the name of their order, one of
    `point_orders.ORDERS`; recognised by default. The frame with the lowest number in the file comes first.

    An npz file has names (P,) out of `POINTS`, and places (T, P, 2), NaN where not detected, optionally with confidence
    (T, P), or points (T, P, 3) that contain both; optionally also rate and size (2,).
    """
    path = Path(path)
    name = path.absolute().name
    if not path.is_dir():
        require_file("path", path)
    size = None if size is None else _checked_size(size)
    if points is not None:
        require_known("points", points, ORDERS)
    try:
        film = _read(path)
        frames, notes = _understood(_in_order(film.frames), film, size or film.size, points)
    except InputError as error:
        raise InputError(f"{name} {error}") from None
    rate = require_rate(film.rate if rate is None else rate, name)
    return LoadedPeople(name, tracks_of(frames, rate), frames, rate, size or film.size, notes)


def _read(path: Path) -> DetectedFilm:
    if path.is_dir():
        return folder_film(path)
    with path.open("rb") as file:
        zipped = file.read(2) == b"PK"
    return _npz(path) if zipped else json_film(json_content(path))


def _in_order(frames: Mapping[int, list[Detection]]) -> list[list[Detection]]:
    """Return all frames from the first number to the last, missing ones empty, without people who have no points."""
    if not frames:
        raise InputError("has no frames")
    first, last = min(frames), max(frames)
    if last - first >= _MAX_FRAMES:
        raise InputError(f"has frames from {first} to {last}, but may have {_MAX_FRAMES} at most")
    numbers = range(first, last + 1)
    return [[one for one in frames.get(number, []) if one.points[:, 2].any()] for number in numbers]


def _understood(
    frames: list[list[Detection]], film: DetectedFilm, size: tuple[float, float] | None, points: str | None
) -> tuple[list[list[Detection]], tuple[str, ...]]:
    """Return the frames with people's points in our order, in pixels, and notes of what was taken for what."""
    frames, unit = _in_pixels(frames, film.centred, size)
    people = [one.points for frame in frames for one in frame]
    names, order = _names_of(people, film, points)
    ours = [[one._replace(points=in_our_order(one.points, names)) for one in frame] for frame in frames]
    ours = [[one for one in frame if one.points[:, 2].any()] for frame in ours]
    if not any(ours):
        raise InputError(_NOBODY)
    return ours, (*order, *unit, *film.notes)


def _in_pixels(
    frames: list[list[Detection]], centred: bool, size: tuple[float, float] | None
) -> tuple[list[list[Detection]], tuple[str, ...]]:
    """Return the frames with places in pixels, and notes. centred: whether parts may count from the image's middle."""
    people = [one.points for frame in frames for one in frame]
    if not people:
        raise InputError(_NOBODY)
    places = np.concatenate([rows[rows[:, 2] > 0.0, :2] for rows in people])
    if np.median(abs(places)) > _LARGEST_PART:
        return frames, ()
    if size is None:
        raise InputError("has places as parts of the image: give size, its width and height in pixels")
    # OpenPose counts from 0 or, as another choice, from the middle.
    first = -1.0 if centred and np.mean(places < 0.0) > 0.01 else 0.0
    scale = np.array([*size, 1.0]) / [1.0 - first, 1.0 - first, 1.0]
    offset = np.array([first, first, 0.0])
    scaled = [[one._replace(points=(one.points - offset) * scale) for one in frame] for frame in frames]
    return scaled, (f"places are parts of the image, from {first:g} to 1",)


def _names_of(
    people: list[np.ndarray], film: DetectedFilm, points: str | None
) -> tuple[Sequence[str], tuple[str, ...]]:
    """Return the names of the points that people (N, 3) have, and notes."""
    if film.names is None:
        order, names = order_of(people, points)
        return names, (f"{len(people[0])} points a person, read as {order}",)
    if points is not None:
        raise InputError(f"names its points itself, but points is {points!r}: leave it out")
    for rows in people:
        if len(rows) != len(film.names):
            raise InputError(f"has a person of {len(rows)} points, but needs {len(film.names)}, as many as it names")
    return film.names, ()


def _npz(path: Path) -> DetectedFilm:
    try:
        content = arrays_of(path)
    except Exception:  # Each part of an archive is damaged in its own way.
        raise InputError("is no whole npz file of numbers and names") from None
    kind, columns = ("points", 3) if "points" in content else ("places", 2)
    if not {"names", kind} <= content.keys():
        raise InputError("is npz without names, and places or points")
    names = tuple(str(name) for name in content["names"].ravel())
    for name in names:
        require_known("has a name that", name, POINTS)
    if len(set(names)) < len(names):
        raise InputError("has a name twice")
    rows = checked_numbers(kind, content[kind])
    if rows.ndim != 3 or rows.shape[1:] != (len(names), columns):
        raise InputError(f"has {kind} {rows.shape}, but needs (T, {len(names)}, {columns})")
    if kind == "places":
        confidence = checked_numbers("confidence", content.get("confidence", np.ones(rows.shape[:2])))
        if confidence.shape != rows.shape[:2]:
            raise InputError(f"has confidence {confidence.shape}, but needs {rows.shape[:2]}")
        rows = np.dstack([rows, confidence])
    rows[np.isnan(rows[..., :2]).any(axis=-1)] = 0.0
    rate = checked_numbers("rate", content.get("rate", np.nan))
    if rate.shape:
        raise InputError(f"has a rate {rate.shape}, but needs one number")
    return DetectedFilm(
        {number: [detection(frame, 0.0)] for number, frame in enumerate(rows)},
        float(rate) if "rate" in content else None,
        _checked_size(content["size"]) if "size" in content else None,
        names,
    )


def _checked_size(value: object) -> tuple[float, float]:
    numbers = checked_numbers("size", value)
    if numbers.shape != (2,) or not ((numbers > 0.0) & (numbers < _MAX_SIZE)).all():
        raise InputError(f"size is {shortened(value)}, but must be a width and a height above 0, in pixels")
    return float(numbers[0]), float(numbers[1])

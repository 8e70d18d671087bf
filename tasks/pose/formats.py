"""Strict readers of the files in which pose detectors store keypoints of a film.

OpenPose writes a folder with one JSON file a frame, AlphaPose one list in the form of COCO's results, MMPose one list
of frames for a film and one file for each of several images; MediaPipe's landmarks come as a list of frames; our own
format is an npz file. The format is recognised by the file's content, not by its name.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from larp_model.errors import InputError
from larp_model.files import arrays_of
from larp_model.names import require_file, require_known
from tasks.pose.points import POINTS, RATES, SIDES, Keypoints


def _pairs(*parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for part in parts for side in SIDES)


def _sides(first: str, second: str, *parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for side in (first, second) for part in parts)


_ARM, _LEG, _FOOT = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"), ("toe", "small_toe", "heel")
_ARMS, _LEGS = _sides("right", "left", *_ARM), _sides("right", "left", *_LEG)
_HEAD = ("right_eye", "left_eye", "right_ear", "left_ear")
_COCO = ("nose", *_pairs("eye", "ear", *_ARM, *_LEG))
_HALPE = (*_COCO, "head", "neck", "pelvis", *_pairs(*_FOOT))
# Names of a person's points, by how many there are. Those of whole bodies, 133 and 136, go on with faces and hands.
ORDERS = {
    17: _COCO,
    18: ("nose", "neck", *_ARMS, *_LEGS, *_HEAD),  # OpenPose's COCO
    25: ("nose", "neck", *_ARMS, "pelvis", *_LEGS, *_HEAD, *_sides("left", "right", *_FOOT)),  # OpenPose's BODY_25
    26: _HALPE,
    33: (  # MediaPipe
        "nose",
        *_sides("left", "right", "inner_eye", "eye", "outer_eye"),
        *_pairs("ear", "mouth", *_ARM, "little_finger", "index_finger", "thumb", *_LEG, "heel", "toe"),
    ),
    133: (*_COCO, *_sides("left", "right", *_FOOT)),
    136: _HALPE,
}

_SUPPORTED = "understood are OpenPose's folder of JSON files, JSON of AlphaPose, MMPose or MediaPipe, and npz"
_MIN_POINTS = 6
_MAX_FRAMES = 100_000
_MAX_VALUE = 1e6
# A person may be lost for this time [s]. Then the points may be this far from where they were, on average: at once
# [the person's size], and more with the time [sizes a second].
_LOST_SECONDS, _REACH_AT_ONCE, _REACH_PER_SECOND = 0.5, 0.25, 3.0


class LoadedKeypoints(NamedTuple):
    """Keypoints of one person, with the number of people in the file.

    crossed: number of frames in which another person's bounding box and this one's share more than half of the smaller
    of them: there the two may have been mixed up.
    """

    keypoints: Keypoints
    people: int
    crossed: int


class _Detection(NamedTuple):
    """Person in a frame: places [px] and confidence of `POINTS` (P, 3), and a tracker's number if the file has one."""

    points: np.ndarray
    identity: float | None


class _Film(NamedTuple):
    """Content of a file: people by frame number; frames per second and size [px] where the file has them."""

    frames: Mapping[int, list[_Detection]]
    rate: float | None = None
    size: tuple[float, float] | None = None


_Track = dict[int, _Detection]  # one person's, by frame, in the order of the frames


def load(
    path: str | Path, rate: float | None = None, size: tuple[float, float] | None = None, person: int | None = None
) -> LoadedKeypoints:
    """Read one person's points; an InputError of one line names what is missing, damaged or not understood.

    path: a file, or a folder with one for each frame. rate: frames per second. size: width and height of the images
    [px]. Only npz files store these two, and the arguments take precedence. person: index from 0 in order of
    appearance; by default the one with the greatest sum of confidence times height in the image. The frame with the
    lowest number in the file comes first.

    An npz file has names (P,) out of `POINTS`, and places (T, P, 2), NaN where not detected, optionally with confidence
    (T, P), or points (T, P, 3) that contain both; optionally also rate and size (2,).
    """
    path = Path(path)
    name = path.absolute().name
    if not path.is_dir():
        require_file("path", path)
    size = None if size is None else _checked_size(size)
    try:
        film = _read(path, size)
        frames = _in_order(film.frames)
    except InputError as error:
        raise InputError(f"{name} {error}") from None
    rate = film.rate if rate is None else rate
    if rate is None:
        raise InputError(f"rate is not known, {name} does not hold it: give frames a second")
    if not RATES[0] <= rate <= RATES[1]:
        raise InputError(f"rate is {rate:g}, but must be from {RATES[0]:g} to {RATES[1]:g} frames a second")
    tracks = _tracks(frames, rate)
    if person is not None and person not in range(len(tracks)):
        raise InputError(f"person is {person}, but must be from 0 to below {len(tracks)}, the people in {name}")
    track = max(tracks, key=_prominence) if person is None else tracks[person]
    points = np.full((len(frames), len(POINTS), 3), (np.nan, np.nan, 0.0))
    points[list(track)] = [detection.points for detection in track.values()]
    detected = np.flatnonzero(points[..., 2].any(axis=0))
    if len(detected) < _MIN_POINTS:
        detected_names = ", ".join(POINTS[point] for point in detected)
        raise InputError(f"{name} has only {detected_names} of this person, but needs {_MIN_POINTS} points or more")
    keypoints = Keypoints(points[..., :2], points[..., 2], float(rate), size or film.size)
    return LoadedKeypoints(
        keypoints, len(tracks), sum(_is_crossed(detection, frames[frame]) for frame, detection in track.items())
    )


def _read(path: Path, size: tuple[float, float] | None) -> _Film:
    if path.is_dir():
        return _Film(_folder_frames(path))
    with path.open("rb") as file:
        zipped = file.read(2) == b"PK"
    return _npz(path) if zipped else _Film(_json_frames(_json_content(path), size))


def _in_order(frames: Mapping[int, list[_Detection]]) -> list[list[_Detection]]:
    """Return all frames from the first number to the last, missing ones empty, without people who have no points."""
    if not frames:
        raise InputError("has no frames")
    first, last = min(frames), max(frames)
    if last - first >= _MAX_FRAMES:
        raise InputError(f"has frames from {first} to {last}, but may have {_MAX_FRAMES} at most")
    numbers = range(first, last + 1)
    ordered = [
        [detection for detection in frames.get(number, []) if detection.points[:, 2].any()] for number in numbers
    ]
    if not any(ordered):
        raise InputError("has no person in any frame")
    return ordered


def _folder_frames(path: Path) -> dict[int, list[_Detection]]:
    frames = {}
    names = sorted(file.name for file in path.glob("*.json") if not file.name.startswith("."))
    for number, name in _by_number(names).items():
        try:
            match _json_content(path / str(name)):
                case {"people": people} | [*people]:
                    frames[number] = _people(people)
                case _:
                    raise InputError("has no list of people")
        except InputError as error:
            raise InputError(f"has {name}, which {error}") from None
    return frames


def _by_number(labels: Iterable[object]) -> dict[int, object]:
    """Return the frames' labels (names of images or files) by the last number in each, extensions ignored."""
    numbered: dict[int, object] = {}
    for label in labels:
        numbers = re.findall(r"\d+", Path(str(label)).stem)
        if not numbers:
            raise InputError(f"has {_shortened(label)} as a frame, but needs the frame's number in the name")
        if int(numbers[-1]) in numbered:
            raise InputError(f"has two frames with number {int(numbers[-1])}, but needs the frames of one film")
        numbered[int(numbers[-1])] = label
    return numbered


def _json_content(path: Path) -> object:
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not whole as JSON ({error}); {_SUPPORTED}") from None


def _json_frames(content: object, size: tuple[float, float] | None) -> dict[int, list[_Detection]]:
    """Return the frames of a JSON file that contains all of them."""
    match content:
        case {"instance_info": [*entries], **more}:
            return _mmpose_frames(entries, _own_point_names(more.get("meta_info")))
        case [*entries]:
            match next((entry for entry in entries if entry), []):
                case {"image_id": _}:
                    return _alphapose_frames(entries)
                case {"frame_id": _}:
                    return _mmpose_frames(entries)
                case {"landmarks": _} | [{"x": _}, *_]:
                    return {number: _mediapipe_people(entry, size) for number, entry in enumerate(entries)}
                case [] | [{"keypoints": _}, *_]:
                    return {number: _people(entry) for number, entry in enumerate(entries)}
    raise InputError(f"is JSON of another kind; {_SUPPORTED}")


def _alphapose_frames(entries: list[Any]) -> dict[int, list[_Detection]]:
    if not all(isinstance(entry, dict) and "image_id" in entry for entry in entries):
        raise InputError("has an entry without image_id")
    people: dict[object, list[Any]] = {}
    for entry in entries:
        people.setdefault(str(entry["image_id"]), []).append(entry)
    return {number: _people(people[image]) for number, image in _by_number(people).items()}


def _mmpose_frames(entries: list[Any], names: tuple[str, ...] | None = None) -> dict[int, list[_Detection]]:
    if not all(isinstance(entry, dict) and {"frame_id", "instances"} <= entry.keys() for entry in entries):
        raise InputError("has an entry without frame_id and instances")
    numbers = _by_number(entry["frame_id"] for entry in entries)
    return {number: _people(entry["instances"], names) for number, entry in zip(numbers, entries, strict=True)}


def _own_point_names(meta: object) -> tuple[str, ...] | None:
    """Return MMPose's own names of the points, in their order; None where the file has none."""
    match meta:
        case {"keypoint_id2name": {**table}}:
            order = [str(number) for number in range(len(table))]
            if set(order) != set(table):
                raise InputError("has keypoint_id2name, but needs a name there for each number from 0")
            return tuple(str(table[number]).replace("_big_toe", "_toe") for number in order)
    return None


def _people(entries: object, names: tuple[str, ...] | None = None) -> list[_Detection]:
    """Return the people of a frame of OpenPose, AlphaPose or MMPose."""
    people = []
    for entry in _checked_list(entries):
        match entry:
            case {"keypoints": places, "keypoint_scores": scores}:
                places, scores = _checked_numbers("keypoints", places), _checked_numbers("keypoint_scores", scores)
                if scores.ndim != 1 or places.shape != (len(scores), 2):
                    raise InputError(f"has keypoints {places.shape}, but needs (P, 2), and keypoint_scores (P,)")
                rows = np.column_stack([places, scores])
            case {"pose_keypoints_2d": numbers} | {"keypoints": numbers}:
                rows = _checked_numbers("keypoints", numbers)
                if rows.size % 3:
                    raise InputError(f"has keypoints of {rows.size} numbers, but needs x, y and confidence of each")
                rows = rows.reshape(-1, 3)
            case _:
                raise InputError("has a person without keypoints")
        rows[(rows[:, :2] == 0.0).all(axis=1)] = 0.0
        identity = next((entry[key] for key in ("person_id", "idx", "track_id") if key in entry), None)
        people.append(_Detection(_in_our_order(rows, names), _identity(identity)))
    return people


def _mediapipe_people(frame: object, size: tuple[float, float] | None) -> list[_Detection]:
    landmarks = _checked_list(frame.get("landmarks", frame) if isinstance(frame, dict) else frame)
    if size is None:
        raise InputError("has places as parts of the image: give size, its width and height in pixels")
    try:
        rows = [[landmark[key] for key in ("x", "y", "visibility")] for landmark in landmarks]
    except (KeyError, TypeError):
        raise InputError("has a landmark without x, y and visibility") from None
    # One person, who may be lost for long.
    return [_Detection(_in_our_order(_checked_numbers("landmarks", rows) * (*size, 1.0)), 0.0)] if rows else []


def _npz(path: Path) -> _Film:
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
    rows = _checked_numbers(kind, content[kind])
    if rows.ndim != 3 or rows.shape[1:] != (len(names), columns):
        raise InputError(f"has {kind} {rows.shape}, but needs (T, {len(names)}, {columns})")
    if kind == "places":
        confidence = _checked_numbers("confidence", content.get("confidence", np.ones(rows.shape[:2])))
        if confidence.shape != rows.shape[:2]:
            raise InputError(f"has confidence {confidence.shape}, but needs {rows.shape[:2]}")
        rows = np.dstack([rows, confidence])
    rows[np.isnan(rows[..., :2]).any(axis=-1)] = 0.0
    rate = _checked_numbers("rate", content.get("rate", np.nan))
    if rate.shape:
        raise InputError(f"has a rate {rate.shape}, but needs one number")
    return _Film(
        {number: [_Detection(_in_our_order(frame, names), 0.0)] for number, frame in enumerate(rows)},
        float(rate) if "rate" in content else None,
        _checked_size(content["size"]) if "size" in content else None,
    )


def _checked_size(value: object) -> tuple[float, float]:
    numbers = _checked_numbers("size", value)
    if numbers.shape != (2,) or not ((numbers > 0.0) & (numbers < _MAX_VALUE)).all():
        raise InputError(f"size is {_shortened(value)}, but must be a width and a height above 0, in pixels")
    return float(numbers[0]), float(numbers[1])


def _shortened(value: object) -> str:
    return shorten(str(value), 60, placeholder=" ...") or "nothing"


def _checked_list(value: object) -> list[Any]:
    if not isinstance(value, list | None):
        raise InputError(f"has {_shortened(value)} where it needs a list")
    return value or []


def _checked_numbers(what: str, value: object) -> np.ndarray:
    try:
        numbers = np.array(value)
        return numbers.astype(float, casting="safe" if numbers.dtype.kind == "c" else "unsafe")
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"has {what} with something that is not a number") from None


def _in_our_order(rows: np.ndarray, names: tuple[str, ...] | None = None) -> np.ndarray:
    """Return places [px] and confidence of `POINTS` (P, 3) from a detector's rows; NaN and 0 where not detected."""
    if len(rows) not in (ORDERS if names is None else {len(names)}):
        accepted = ", ".join(map(str, ORDERS)) if names is None else f"{len(names)}, as many as it names"
        raise InputError(f"has a person of {len(rows)} points, but needs {accepted}")
    if not (abs(rows) < _MAX_VALUE).all():
        raise InputError(f"has places or confidences that are not finite, or not below {_MAX_VALUE:g}")
    detected = np.zeros((len(POINTS), 3))
    for row, name in enumerate(ORDERS[len(rows)] if names is None else names):
        if name in POINTS:
            detected[POINTS.index(name)] = rows[row]
    detected[:, 2] = detected[:, 2].clip(0.0, 1.0)
    detected[detected[:, 2] == 0.0, :2] = np.nan
    return detected


def _identity(value: object) -> float | None:
    """Return a tracker's number of a person; AlphaPose lists those of all detections it merged, the first is taken."""
    while isinstance(value, list):
        value = value[0] if value else None
    return value if isinstance(value, int | float) and value >= 0 else None


def _tracks(frames: list[list[_Detection]], rate: float) -> list[_Track]:
    """Return the people in order of appearance: by the file's own numbers, else by distance from frame to frame."""
    identities = [[detection.identity for detection in frame if detection.identity is not None] for frame in frames]
    # Without its tracker, AlphaPose gives everybody the same number.
    if not any(identities) or any(
        len(set(frame_identities)) < len(frame_identities) for frame_identities in identities
    ):
        return _tracks_by_distance(frames, rate)
    tracks: dict[float, _Track] = {}
    for number, frame in enumerate(frames):
        for detection in frame:
            if detection.identity is not None:
                tracks.setdefault(detection.identity, {})[number] = detection
    return list(tracks.values())


def _tracks_by_distance(frames: list[list[_Detection]], rate: float) -> list[_Track]:
    tracks: list[_Track] = []
    sizes: list[float] = []  # of each person, the largest so far [px]
    for number, frame in enumerate(frames):
        detected_sizes = [float(np.linalg.norm(np.ptp(_box(detection.points), axis=0))) for detection in frame]
        ages = [number - next(reversed(track_frames)) for track_frames in tracks]
        recent = [track for track, age in enumerate(ages) if age - 1 <= _LOST_SECONDS * rate]
        # Relative to the reach: a person who was lost for long must not take the place of one who is still there.
        costs = np.ones((len(recent), len(frame)))
        for row, track in enumerate(recent):
            last, reach = tracks[track][number - ages[track]], _REACH_AT_ONCE + _REACH_PER_SECOND * ages[track] / rate
            for column, detection in enumerate(frame):
                relative_distance = _distance(last.points, detection.points) / max(
                    sizes[track], detected_sizes[column], 1.0
                )
                costs[row, column] = min(relative_distance / reach, 1.0)
        pairs = zip(*linear_sum_assignment(costs), strict=True)
        track_of_column = {column: recent[row] for row, column in pairs if costs[row, column] < 1.0}
        for column, detection in enumerate(frame):
            track = track_of_column.get(column, len(tracks))
            if track == len(tracks):
                tracks.append({})
                sizes.append(0.0)
            tracks[track][number] = detection
            sizes[track] = max(sizes[track], detected_sizes[column])
    return tracks


def _distance(points: np.ndarray, others: np.ndarray) -> float:
    """Return the mean distance [px] of the points that both have, weighted by confidence; infinite without any."""
    weights = points[:, 2] * others[:, 2]
    in_both = weights > 0.0
    if not in_both.any():
        return np.inf
    return float(
        np.average(np.linalg.norm(points[in_both, :2] - others[in_both, :2], axis=-1), weights=weights[in_both])
    )


def _box(points: np.ndarray) -> np.ndarray:
    """Return the upper left and lower right corner (2, 2) [px] of the box around the detected points."""
    detected = points[points[:, 2] > 0.0, :2]
    return np.array([detected.min(axis=0), detected.max(axis=0)])


def _prominence(track: _Track) -> float:
    return sum(
        float(detection.points[:, 2].mean() * np.ptp(_box(detection.points)[:, 1])) for detection in track.values()
    )


def _is_crossed(detection: _Detection, frame: list[_Detection]) -> bool:
    own_box = _box(detection.points)
    for box in [_box(other.points) for other in frame if other is not detection]:
        overlap = (np.minimum(box[1], own_box[1]) - np.maximum(box[0], own_box[0])).clip(0.0)
        if np.prod(overlap) > 0.5 * min(np.prod(np.ptp(corners, axis=0)) for corners in (box, own_box)):
            return True
    return False

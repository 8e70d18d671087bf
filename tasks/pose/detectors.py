"""Strict readers of the files that pose detectors write: people by frame, as the file has them.

| detector | what is read |
|---|---|
| OpenPose | a folder with one JSON file a frame; its older key `pose_keypoints` too |
| AlphaPose | one list in the form of COCO's results; its forms `cmu` and `open`, by image |
| MMPose | one list of frames for a film; one file for each of several images |
| MediaPipe | a list of frames: landmarks, people, or objects that hold them under any of its names |
| YOLO | a list of frames of `to_json()`; a folder of JSON, or of `save_txt`'s labels, one a frame |
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from textwrap import shorten
from typing import Any, NamedTuple

import numpy as np

from larp_model.errors import InputError
from tasks.pose.people import Detection

SUPPORTED = (
    "understood are OpenPose's folder of JSON files, JSON of AlphaPose, MMPose, MediaPipe or YOLO, YOLO's labels, npz"
)
# Keys under which MediaPipe's versions keep a frame's landmarks.
_LANDMARKS = ("landmarks", "landmark", "poseLandmarks", "pose_landmarks")
_MAX_VALUE = 1e6
# Files of a folder that are named otherwise than its frames are left out where they are so few, as a share.
_FEW = 0.1


class DetectedFilm(NamedTuple):
    """Content of a file: people by frame number, and what else it says.

    names: of the points, in their order; None where only their number tells it. centred: places that are parts of the
    image may count from its middle. notes: lines that the user should read.
    """

    frames: Mapping[int, list[Detection]]
    rate: float | None = None
    size: tuple[float, float] | None = None
    names: tuple[str, ...] | None = None
    centred: bool = False
    notes: tuple[str, ...] = ()


def folder_film(path: Path) -> DetectedFilm:
    """Return the film of a folder with one file for each frame."""
    kind = "*.json" if any(path.glob("*.json")) else "*.txt"
    names = sorted(file.name for file in path.glob(kind) if not file.name.startswith("."))
    frame_names, others = _alike(names)
    frames = {}
    for number, name in by_number(frame_names).items():
        try:
            frames[number] = _people_of_file(path / str(name))
        except InputError as error:
            raise InputError(f"has {name}, which {error}") from None
    notes = (f"left out, as named otherwise than the frames: {', '.join(others)}",) if others else ()
    return DetectedFilm(frames, centred=kind == "*.json", notes=notes)


def _people_of_file(path: Path) -> list[Detection]:
    if path.suffix == ".txt":
        return [_yolo_label(line) for line in path.read_text("utf-8", errors="replace").splitlines() if line.strip()]
    people = _people_of_image(json_content(path))
    if people is None:
        raise InputError("has no list of people")
    return _people(people)


def _alike(names: list[str]) -> tuple[list[str], list[str]]:
    """Return the names that differ in their numbers alone, and the few others; all names where the others are many."""
    patterns = [re.sub(r"\d+", "#", Path(name).stem) for name in names]
    usual = Counter(patterns).most_common(1)[0][0] if names else ""
    alike = [name for name, pattern in zip(names, patterns, strict=True) if pattern == usual]
    others = [name for name, pattern in zip(names, patterns, strict=True) if pattern != usual]
    return (alike, others) if len(others) <= _FEW * len(alike) else (names, [])


def by_number(labels: Iterable[object]) -> dict[int, object]:
    """Return the frames' labels (names of images or files) by the number in each, extensions ignored.

    Of several numbers in each label it is the last one that is another in every label.
    """
    labels = list(labels)
    numbers = [[int(number) for number in re.findall(r"\d+", Path(str(label)).stem)] for label in labels]
    for label, found in zip(labels, numbers, strict=True):
        if not found:
            raise InputError(f"has {shortened(label)} as a frame, but needs the frame's number in the name")
    places = range(-1, -1 - min(map(len, numbers), default=0), -1)
    place = next((place for place in places if len({found[place] for found in numbers}) == len(numbers)), -1)
    numbered: dict[int, object] = {}
    for label, found in zip(labels, numbers, strict=True):
        if found[place] in numbered:
            raise InputError(f"has two frames with number {found[place]}, but needs the frames of one film")
        numbered[found[place]] = label
    return numbered


def json_content(path: Path) -> object:
    """Return the content of a JSON file."""
    try:
        return json.loads(path.read_bytes())
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not whole as JSON ({error}); {SUPPORTED}") from None


def json_film(content: object) -> DetectedFilm:
    """Return the film of a JSON file that contains all frames."""
    match content:
        case {"instance_info": [*entries], **more}:
            names = _own_point_names(more.get("meta_info"))
            return DetectedFilm(_mmpose_frames(entries), names=names)
        case {**images} if images and all(
            isinstance(image, dict) and _people_of_image(image) is not None for image in images.values()
        ):
            people = {str(label): _people_of_image(image) for label, image in images.items()}
            return DetectedFilm({number: _people(people[str(label)]) for number, label in by_number(people).items()})
        case [*entries]:
            match next((entry for entry in entries if entry), []):
                case {"image_id": _}:
                    return DetectedFilm(_alphapose_frames(entries))
                case {"frame_id": _}:
                    return DetectedFilm(_mmpose_frames(entries))
                case {**frame} if any(key in frame for key in _LANDMARKS):
                    return DetectedFilm(_mediapipe_frames(entries))
                case [{"x": _}, *_] | [[{"x": _}, *_], *_]:
                    return DetectedFilm(_mediapipe_frames(entries))
                case [] | [{"keypoints": _}, *_]:
                    return DetectedFilm({number: _people(entry) for number, entry in enumerate(entries)})
    raise InputError(f"is JSON of another kind; {SUPPORTED}")


def _people_of_image(content: object) -> object:
    """Return the people of an image, None where there is no list of them."""
    match content:
        case {"people": [*people]} | {"bodies": [*people]} | [*people]:
            return people
    return None


def _alphapose_frames(entries: list[Any]) -> dict[int, list[Detection]]:
    if not all(isinstance(entry, dict) and "image_id" in entry for entry in entries):
        raise InputError("has an entry without image_id")
    people: dict[object, list[Any]] = {}
    for entry in entries:
        people.setdefault(str(entry["image_id"]), []).append(entry)
    return {number: _people(people[image]) for number, image in by_number(people).items()}


def _mmpose_frames(entries: list[Any]) -> dict[int, list[Detection]]:
    if not all(isinstance(entry, dict) and {"frame_id", "instances"} <= entry.keys() for entry in entries):
        raise InputError("has an entry without frame_id and instances")
    numbers = by_number(entry["frame_id"] for entry in entries)
    return {number: _people(entry["instances"]) for number, entry in zip(numbers, entries, strict=True)}


def _own_point_names(meta: object) -> tuple[str, ...] | None:
    """Return MMPose's own names of the points, in their order; None where the file has none."""
    match meta:
        case {"keypoint_id2name": {**table}}:
            order = [str(number) for number in range(len(table))]
            if set(order) != set(table):
                raise InputError("has keypoint_id2name, but needs a name there for each number from 0")
            return tuple(str(table[number]).replace("_big_toe", "_toe") for number in order)
    return None


def _people(entries: object) -> list[Detection]:
    """Return the people of a frame of OpenPose, AlphaPose, MMPose or YOLO."""
    people = []
    for entry in _checked_list(entries):
        rows = _rows(entry)
        rows[(rows[:, :2] == 0.0).all(axis=1)] = 0.0
        identity = next((entry[key] for key in ("person_id", "idx", "track_id") if key in entry), None)
        people.append(detection(rows, _identity(identity)))
    return people


def _rows(entry: object) -> np.ndarray:
    """Return places and confidence (N, 3) of a person."""
    match entry:
        case {"keypoints": {"x": x, "y": y, **more}}:
            x, y = checked_numbers("keypoints", x), checked_numbers("keypoints", y)
            return _with_scores(np.stack([x, y], axis=-1) if x.shape == y.shape else x, more.get("visible"))
        case {"keypoints": places, "keypoint_scores": scores}:
            return _with_scores(checked_numbers("keypoints", places), scores)
        case (
            {"pose_keypoints_2d": numbers} | {"pose_keypoints": numbers} | {"keypoints": numbers} | {"joints": numbers}
        ):
            rows = checked_numbers("keypoints", numbers)
            if rows.size % 3:
                raise InputError(f"has keypoints of {rows.size} numbers, but needs x, y and confidence of each")
            return rows.reshape(-1, 3)
    raise InputError("has a person without keypoints")


def _with_scores(places: np.ndarray, scores: object) -> np.ndarray:
    scores = np.ones(len(np.atleast_1d(places))) if scores is None else checked_numbers("keypoint_scores", scores)
    if scores.ndim != 1 or places.shape != (len(scores), 2):
        raise InputError(f"has keypoints {places.shape}, but needs (P, 2), and keypoint_scores (P,)")
    return np.column_stack([places, scores])


def _yolo_label(line: str) -> Detection:
    """Return the person of a line: class, box (4), x, y and confidence of each point, and a score, a track, or both."""
    numbers = checked_numbers("a label", line.split())
    points, more = numbers[5 : len(numbers) - (len(numbers) - 5) % 3], numbers[len(numbers) - (len(numbers) - 5) % 3 :]
    if not len(points):
        raise InputError(f"has a label of {len(numbers)} numbers, but needs class, box, and x, y, confidence of points")
    rows = points.reshape(-1, 3)
    rows[(rows[:, :2] == 0.0).all(axis=1)] = 0.0
    is_track = len(more) == 2 or (len(more) == 1 and more[0] >= 1.0)
    return detection(rows, _identity(float(more[-1])) if is_track else None)


def _mediapipe_frames(entries: list[Any]) -> dict[int, list[Detection]]:
    frames = {number: _mediapipe_people(entry) for number, entry in enumerate(entries)}
    if all(len(people) <= 1 for people in frames.values()):  # one person, who may be lost for long
        return {number: [person._replace(identity=0.0) for person in people] for number, people in frames.items()}
    return frames


def _mediapipe_people(frame: object) -> list[Detection]:
    landmarks = _checked_list(_unwrapped(frame))
    is_list_of_people = landmarks and (isinstance(landmarks[0], list) or landmarks[0] != _unwrapped(landmarks[0]))
    people = [_checked_list(_unwrapped(person)) for person in (landmarks if is_list_of_people else [landmarks])]
    return [detection(_landmark_rows(person), None) for person in people if person]


def _unwrapped(value: Any) -> Any:
    """Return what is under the first of MediaPipe's keys, or the value itself where there is none."""
    return next((value[key] for key in _LANDMARKS if key in value), value) if isinstance(value, dict) else value


def _landmark_rows(landmarks: list[Any]) -> np.ndarray:
    """Return places and confidence (N, 3), 1 where visibility is not told."""
    try:
        rows = [(landmark["x"], landmark["y"], landmark.get("visibility", 1.0)) for landmark in landmarks]
    except (AttributeError, KeyError, TypeError):
        raise InputError("has a landmark without x and y") from None
    return checked_numbers("landmarks", rows)


def detection(rows: np.ndarray, identity: float | None) -> Detection:
    """Return the person of rows (N, 3), checked."""
    if not (abs(rows) < _MAX_VALUE).all():
        raise InputError(f"has places or confidences that are not finite, or not below {_MAX_VALUE:g}")
    return Detection(rows, identity)


def _identity(value: object) -> float | None:
    """Return a tracker's number of a person; AlphaPose lists those of all detections it merged, the first is taken."""
    while isinstance(value, list):
        value = value[0] if value else None
    return value if isinstance(value, int | float) and value >= 0 else None


def shortened(value: object) -> str:
    """Return a value as a short text for a message."""
    return shorten(str(value), 60, placeholder=" ...") or "nothing"


def _checked_list(value: object) -> list[Any]:
    if not isinstance(value, list | None):
        raise InputError(f"has {shortened(value)} where it needs a list")
    return value or []


def checked_numbers(what: str, value: object) -> np.ndarray:
    """Return a value of a file as an array of numbers. what: they are, for the message."""
    try:
        numbers = np.array(value)
        return numbers.astype(float, casting="safe" if numbers.dtype.kind == "c" else "unsafe")
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"has {what} with something that is not a number") from None

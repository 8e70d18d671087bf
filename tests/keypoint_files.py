"""Files of detectors of people, written from the same points in every format, for the tests of their readers."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from tasks.pose import formats
from tasks.pose.points import POINTS, Keypoints

RATE = 30.0
SIZE = (1280.0, 720.0)
MAX_LOST_FRAMES = int(0.5 * RATE)  # frames for which a person may be lost

# Where our points are in each detector's order, as its documentation has it.
COCO = {
    "nose": 0, "left_ear": 3, "right_ear": 4, "left_shoulder": 5, "right_shoulder": 6, "left_elbow": 7,
    "right_elbow": 8, "left_wrist": 9, "right_wrist": 10, "left_hip": 11, "right_hip": 12, "left_knee": 13,
    "right_knee": 14, "left_ankle": 15, "right_ankle": 16,
}  # fmt: skip
HALPE = {**COCO, "left_toe": 20, "right_toe": 21, "left_heel": 24, "right_heel": 25}
WHOLE_BODY = {**COCO, "left_toe": 17, "left_heel": 19, "right_toe": 20, "right_heel": 22}
OPENPOSE_COCO = {
    "nose": 0, "right_shoulder": 2, "right_elbow": 3, "right_wrist": 4, "left_shoulder": 5, "left_elbow": 6,
    "left_wrist": 7, "right_hip": 8, "right_knee": 9, "right_ankle": 10, "left_hip": 11, "left_knee": 12,
    "left_ankle": 13, "right_ear": 16, "left_ear": 17,
}  # fmt: skip
BODY_25 = {
    "nose": 0, "right_shoulder": 2, "right_elbow": 3, "right_wrist": 4, "left_shoulder": 5, "left_elbow": 6,
    "left_wrist": 7, "right_hip": 9, "right_knee": 10, "right_ankle": 11, "left_hip": 12, "left_knee": 13,
    "left_ankle": 14, "right_ear": 17, "left_ear": 18, "left_toe": 19, "left_heel": 21, "right_toe": 22,
    "right_heel": 24,
}  # fmt: skip
BODY_25B = {**COCO, "left_toe": 19, "left_heel": 21, "right_toe": 22, "right_heel": 24}
H36M = {
    "right_hip": 1, "right_knee": 2, "right_ankle": 3, "left_hip": 4, "left_knee": 5, "left_ankle": 6,
    "left_shoulder": 11, "left_elbow": 12, "left_wrist": 13, "right_shoulder": 14, "right_elbow": 15, "right_wrist": 16,
}  # fmt: skip
MEDIAPIPE = {
    "nose": 0, "left_ear": 7, "right_ear": 8, "left_shoulder": 11, "right_shoulder": 12, "left_elbow": 13,
    "right_elbow": 14, "left_wrist": 15, "right_wrist": 16, "left_hip": 23, "right_hip": 24, "left_knee": 25,
    "right_knee": 26, "left_ankle": 27, "right_ankle": 28, "left_heel": 29, "right_heel": 30, "left_toe": 31,
    "right_toe": 32,
}  # fmt: skip
OUR_ORDER = {name: row for row, name in enumerate(POINTS)}

# A person in one frame: places and confidence (P, 3) in our order, confidence 0 where not found.
Person = np.ndarray
Film = list[list[Person]]
Write = Callable[[Path, Film], Path]
Ends = tuple[float, float]


def rows(person: Person, order: dict[str, int], count: int) -> np.ndarray:
    """The person (count, 3) in a detector's order; what is not ours is far away, and sure."""
    detector_rows = np.full((count, 3), (-777.0, 777.0, 0.9))
    for name, row in order.items():
        x, y, confidence = person[POINTS.index(name)]
        detector_rows[row] = (x, y, confidence) if confidence > 0.0 else 0.0
    return detector_rows


def dump(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def openpose(order: dict[str, int], count: int, key: str = "pose_keypoints_2d", ends: Ends | None = None) -> Write:
    """ends: of the image, where places are parts of it."""

    def keypoints(person: Person) -> list[float]:
        points = rows(person, order, count)
        if ends is not None:
            found = points[:, 2] > 0.0
            points[found, :2] = ends[0] + (ends[1] - ends[0]) * abs(points[found, :2]) / SIZE
        return points.ravel().tolist()

    def write(path: Path, film: Film) -> Path:
        folder = path / "film"
        folder.mkdir()
        for number, frame in enumerate(film):
            people = [{key: keypoints(person)} for person in frame]
            dump(folder / f"film_{number:012}_keypoints.json", {"version": 1.3, "people": people})
        return folder

    return write


def result(image: object, person: Person, order: dict[str, int] = COCO, count: int = 17) -> dict[str, Any]:
    keypoints = rows(person, order, count).ravel().tolist()
    return {"image_id": image, "category_id": 1, "keypoints": keypoints, "score": 2.5, "box": [0, 0, 1, 1]}


def alphapose(order: dict[str, int], count: int) -> Write:
    def write(path: Path, film: Film) -> Path:
        results = [
            result(f"{number}.jpg", person, order, count) for number, frame in enumerate(film) for person in frame
        ]
        return dump(path / "alphapose-results.json", results)

    return write


def instance(person: Person, order: dict[str, int] = COCO, count: int = 17) -> dict[str, Any]:
    person_rows = rows(person, order, count)
    return {
        "keypoints": person_rows[:, :2].tolist(),
        "keypoint_scores": person_rows[:, 2].tolist(),
        "bbox": [[0, 0, 1, 1]],
    }


def mmpose(order: dict[str, int], count: int, form: str) -> Write:
    def write(path: Path, film: Film) -> Path:
        people = [[instance(person, order, count) for person in frame] for frame in film]
        frames = [{"frame_id": number, "instances": instances} for number, instances in enumerate(people, start=1)]
        demo = {"meta_info": {"dataset_name": "coco"}, "instance_info": frames}
        return dump(path / "results.json", {"demo": demo, "film": frames, "list": people}[form])

    return write


def mmpose_with_names(path: Path, film: Film) -> Path:
    """In an order of its own, which the file tells."""
    names = ["left_eye", *(name.replace("_toe", "_big_toe") for name in reversed(POINTS)), "left_small_toe"]
    order = {name.replace("_big_toe", "_toe"): row for row, name in enumerate(names)}
    del order["left_eye"], order["left_small_toe"]
    meta = {"keypoint_id2name": {str(number): name for number, name in enumerate(names)}}
    people = [[instance(person, order, len(names)) for person in frame] for frame in film]
    frames = [{"frame_id": number, "instances": instances} for number, instances in enumerate(people)]
    return dump(path / "results.json", {"meta_info": meta, "instance_info": frames})


def mmpose_of_images(path: Path, film: Film) -> Path:
    folder = path / "predictions"
    folder.mkdir()
    for number, frame in enumerate(film):
        dump(folder / f"image{number}.json", [instance(person) for person in frame])
    return folder


def alphapose_by_image(key: str, points_key: str) -> Write:
    def write(path: Path, film: Film) -> Path:
        images = {
            f"{number}.jpg": {"version": "AlphaPose v0.3", key: [
                {points_key: rows(person, OPENPOSE_COCO, 18).ravel().tolist()} for person in frame
            ]}
            for number, frame in enumerate(film)
        }  # fmt: skip
        return dump(path / "alphapose-results-forms.json", images)

    return write


def landmarks(person: Person, visible: bool = True) -> list[dict[str, float]]:
    return [
        {"x": x / SIZE[0], "y": y / SIZE[1], "z": 0.1} | ({"visibility": visibility} if visible else {})
        for x, y, visibility in rows(person, MEDIAPIPE, 33)
    ]


# A frame of a person in each of MediaPipe's forms.
MEDIAPIPE_FORMS: dict[str, Callable[[list[dict[str, float]]], object]] = {
    "": lambda points: points or None,
    ", wrapped": lambda points: {"landmarks": points},
    ", message": lambda points: {"landmark": points},
    ", web": lambda points: {"poseLandmarks": points},
    ", people": lambda points: {"landmarks": [points] if points else [], "worldLandmarks": []},
    ", people alone": lambda points: [points] if points else [],
    ", people's messages": lambda points: {"pose_landmarks": [{"landmark": points}] if points else []},
}


def mediapipe(form: str, visible: bool = True) -> Write:
    def write(path: Path, film: Film) -> Path:
        frames = [MEDIAPIPE_FORMS[form](landmarks(frame[0], visible) if frame else []) for frame in film]
        return dump(path / "landmarks.json", frames)

    return write


def yolo(path: Path, film: Film) -> Path:
    def person_entry(person: Person) -> dict[str, Any]:
        x, y, visible = rows(person, COCO, 17).T.tolist()
        return {"name": "person", "class": 0, "keypoints": {"x": x, "y": y, "visible": visible}}

    return dump(path / "yolo.json", [[person_entry(person) for person in frame] for frame in film])


def yolo_labels(path: Path, film: Film) -> Path:
    """As `save_txt` writes them: no file where nobody is."""
    folder = path / "labels"
    folder.mkdir()
    for number, frame in enumerate(film, start=1):
        lines = [
            " ".join(map(str, [0, 0.5, 0.5, 0.2, 0.6, *(rows(person, COCO, 17) / (*SIZE, 1.0)).ravel()]))
            for person in frame
        ]
        if lines:
            (folder / f"film_{number}.txt").write_text("\n".join(lines) + "\n")
    return folder


def npz(kind: str) -> Write:
    def write(path: Path, film: Film) -> Path:
        order = list(reversed(range(len(POINTS))))
        points = np.array([frame[0] if frame else np.zeros((len(POINTS), 3)) for frame in film])[:, order]
        arrays: dict[str, Any] = {"points": points}
        if kind == "places":
            undetected = points[..., 2:] == 0.0
            arrays = {"places": np.where(undetected, np.nan, points[..., :2]), "confidence": points[..., 2]}
        np.savez(path / "points.npz", names=[POINTS[row] for row in order], **arrays)
        return path / "points.npz"

    return write


FORMATS: dict[str, tuple[Write, dict[str, int]]] = {
    "OpenPose BODY_25": (openpose(BODY_25, 25), BODY_25),
    "OpenPose BODY_25B": (openpose(BODY_25B, 25), BODY_25B),
    "OpenPose COCO": (openpose(OPENPOSE_COCO, 18), OPENPOSE_COCO),
    "OpenPose, older key": (openpose(OPENPOSE_COCO, 18, "pose_keypoints"), OPENPOSE_COCO),
    "OpenPose, from 0 to 1": (openpose(BODY_25, 25, ends=(0.0, 1.0)), BODY_25),
    "OpenPose, from -1 to 1": (openpose(BODY_25, 25, ends=(-1.0, 1.0)), BODY_25),
    "OpenPose's form of HALPE": (openpose(HALPE, 26), HALPE),
    "AlphaPose COCO": (alphapose(COCO, 17), COCO),
    "AlphaPose HALPE": (alphapose(HALPE, 26), HALPE),
    "AlphaPose 133": (alphapose(WHOLE_BODY, 133), WHOLE_BODY),
    "AlphaPose 136": (alphapose(HALPE, 136), HALPE),
    "AlphaPose, cmu": (alphapose_by_image("bodies", "joints"), OPENPOSE_COCO),
    "AlphaPose, open": (alphapose_by_image("people", "pose_keypoints_2d"), OPENPOSE_COCO),
    "MMPose demo": (mmpose(COCO, 17, "demo"), COCO),
    "MMPose film": (mmpose(HALPE, 26, "film"), HALPE),
    "MMPose list": (mmpose(WHOLE_BODY, 133, "list"), WHOLE_BODY),
    "MMPose with names": (mmpose_with_names, OUR_ORDER),
    "MMPose of images": (mmpose_of_images, COCO),
    "MMPose H36M": (mmpose(H36M, 17, "film"), H36M),
    **{f"MediaPipe{form}": (mediapipe(form), MEDIAPIPE) for form in MEDIAPIPE_FORMS},
    "YOLO": (yolo, COCO),
    "YOLO labels": (yolo_labels, COCO),
    "npz, points": (npz("points"), OUR_ORDER),
    "npz, places": (npz("places"), OUR_ORDER),
}


# A person who stands with the arms away from the body, to our left in the image: x and y of each point, from -1 to 1.
_LEFT_HALF = {
    "ear": (0.1, -0.94), "shoulder": (0.24, -0.66), "elbow": (0.5, -0.34), "wrist": (0.9, -0.1), "hip": (0.14, -0.06),
    "knee": (0.18, 0.44), "ankle": (0.2, 0.9), "heel": (0.16, 0.98), "toe": (0.34, 1.0),
}  # fmt: skip
FIGURE = np.zeros((len(POINTS), 2))
for row, name in enumerate(POINTS):
    side, _, part = name.partition("_")
    x, y = _LEFT_HALF.get(part, (0.0, -1.0))
    FIGURE[row] = -x if side == "right" else x, y


def film_of(seed: int, frames: int, place: float = 400.0) -> list[Person]:
    """A person of about 300 px around x = `place`, who moves a little; each point is missing here and there."""
    random = np.random.default_rng(seed)
    figure = (place, 400.0) + (70.0, 150.0) * FIGURE + random.uniform(-3.0, 3.0, FIGURE.shape)
    places = figure + np.cumsum(random.uniform(-6.0, 6.0, (frames, 1, 2)), axis=0)
    places = places + random.uniform(-2.0, 2.0, places.shape)
    confidence = random.uniform(0.2, 1.0, (frames, len(POINTS))) * (random.random((frames, len(POINTS))) > 0.15)
    return list(np.concatenate([places, confidence[..., None]], axis=-1))


@contextmanager
def folder() -> Iterator[Path]:
    with TemporaryDirectory() as name:
        yield Path(name)


def loaded(write: Write, film: Film, **arguments: Any) -> formats.LoadedKeypoints:
    with folder() as path:
        return formats.load(write(path, film), **{"rate": RATE, "size": SIZE, **arguments})


def expected(people: list[Person | None], order: dict[str, int] = COCO) -> np.ndarray:
    """Return the points (T, P, 3) that a format with these points yields of a person who is missing in some frames."""
    all_points = np.full((len(people), len(POINTS), 3), (np.nan, np.nan, 0.0))
    for frame, person in zip(all_points, people, strict=True):
        for row, name in enumerate(POINTS):
            if person is not None and name in order and person[row, 2] > 0.0:
                frame[row] = person[row]
    return all_points


def points(keypoints: Keypoints) -> np.ndarray:
    return np.concatenate([keypoints.places, keypoints.confidence[..., None]], axis=-1)

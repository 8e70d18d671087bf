"""Files of detectors of people: what was written is read, people are told apart, and what is damaged is refused."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from larp_model.errors import InputError
from tasks.pose import formats
from tasks.pose.points import POINTS, Keypoints

RATE = 30.0
SIZE = (1280.0, 720.0)
LOST = int(0.5 * RATE)  # frames for which a person may be lost

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
MEDIAPIPE = {
    "nose": 0, "left_ear": 7, "right_ear": 8, "left_shoulder": 11, "right_shoulder": 12, "left_elbow": 13,
    "right_elbow": 14, "left_wrist": 15, "right_wrist": 16, "left_hip": 23, "right_hip": 24, "left_knee": 25,
    "right_knee": 26, "left_ankle": 27, "right_ankle": 28, "left_heel": 29, "right_heel": 30, "left_toe": 31,
    "right_toe": 32,
}  # fmt: skip
OWN = {name: row for row, name in enumerate(POINTS)}

# A person in one frame: places and confidence (P, 3) in our order, confidence 0 where not found.
Person = np.ndarray
Film = list[list[Person]]
Write = Callable[[Path, Film], Path]


def rows(person: Person, order: dict[str, int], count: int) -> np.ndarray:
    """The person (count, 3) in a detector's order; what is not ours is far away, and sure."""
    found = np.full((count, 3), (-777.0, 777.0, 0.9))
    for name, row in order.items():
        x, y, confidence = person[POINTS.index(name)]
        found[row] = (x, y, confidence) if confidence > 0.0 else 0.0
    return found


def dump(path: Path, content: object) -> Path:
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def openpose(order: dict[str, int], count: int) -> Write:
    def write(path: Path, film: Film) -> Path:
        folder = path / "film"
        folder.mkdir()
        for number, frame in enumerate(film):
            people = [{"pose_keypoints_2d": rows(one, order, count).ravel().tolist()} for one in frame]
            dump(folder / f"film_{number:012}_keypoints.json", {"version": 1.3, "people": people})
        return folder

    return write


def result(image: object, person: Person, order: dict[str, int] = COCO, count: int = 17) -> dict[str, Any]:
    keypoints = rows(person, order, count).ravel().tolist()
    return {"image_id": image, "category_id": 1, "keypoints": keypoints, "score": 2.5, "box": [0, 0, 1, 1]}


def alphapose(order: dict[str, int], count: int) -> Write:
    def write(path: Path, film: Film) -> Path:
        found = [result(f"{number}.jpg", one, order, count) for number, frame in enumerate(film) for one in frame]
        return dump(path / "alphapose-results.json", found)

    return write


def instance(person: Person, order: dict[str, int] = COCO, count: int = 17) -> dict[str, Any]:
    found = rows(person, order, count)
    return {"keypoints": found[:, :2].tolist(), "keypoint_scores": found[:, 2].tolist(), "bbox": [[0, 0, 1, 1]]}


def mmpose(order: dict[str, int], count: int, form: str) -> Write:
    def write(path: Path, film: Film) -> Path:
        people = [[instance(one, order, count) for one in frame] for frame in film]
        frames = [{"frame_id": number, "instances": each} for number, each in enumerate(people, start=1)]
        demo = {"meta_info": {"dataset_name": "coco"}, "instance_info": frames}
        return dump(path / "results.json", {"demo": demo, "film": frames, "list": people}[form])

    return write


def mmpose_with_names(path: Path, film: Film) -> Path:
    """In an order of its own, which the file tells."""
    names = ["left_eye", *(name.replace("_toe", "_big_toe") for name in reversed(POINTS)), "left_small_toe"]
    order = {name.replace("_big_toe", "_toe"): row for row, name in enumerate(names)}
    del order["left_eye"], order["left_small_toe"]
    meta = {"keypoint_id2name": {str(number): name for number, name in enumerate(names)}}
    people = [[instance(one, order, len(names)) for one in frame] for frame in film]
    frames = [{"frame_id": number, "instances": each} for number, each in enumerate(people)]
    return dump(path / "results.json", {"meta_info": meta, "instance_info": frames})


def mmpose_of_images(path: Path, film: Film) -> Path:
    folder = path / "predictions"
    folder.mkdir()
    for number, frame in enumerate(film):
        dump(folder / f"image{number}.json", [instance(one) for one in frame])
    return folder


def mediapipe(wrapped: bool) -> Write:
    def write(path: Path, film: Film) -> Path:
        frames: list[Any] = []
        for frame in film:
            found = rows(frame[0], MEDIAPIPE, 33) if frame else np.zeros((0, 3))
            marks = [{"x": x / SIZE[0], "y": y / SIZE[1], "z": 0.1, "visibility": seen} for x, y, seen in found]
            frames.append({"landmarks": marks} if wrapped else marks or None)
        return dump(path / "landmarks.json", frames)

    return write


def npz(kind: str) -> Write:
    def write(path: Path, film: Film) -> Path:
        order = list(reversed(range(len(POINTS))))
        points = np.array([frame[0] if frame else np.zeros((len(POINTS), 3)) for frame in film])[:, order]
        held: dict[str, Any] = {"points": points}
        if kind == "places":
            unseen = points[..., 2:] == 0.0
            held = {"places": np.where(unseen, np.nan, points[..., :2]), "confidence": points[..., 2]}
        np.savez(path / "points.npz", names=[POINTS[row] for row in order], **held)
        return path / "points.npz"

    return write


FORMATS: dict[str, tuple[Write, dict[str, int]]] = {
    "OpenPose BODY_25": (openpose(BODY_25, 25), BODY_25),
    "OpenPose COCO": (openpose(OPENPOSE_COCO, 18), OPENPOSE_COCO),
    "OpenPose's form of HALPE": (openpose(HALPE, 26), HALPE),
    "AlphaPose COCO": (alphapose(COCO, 17), COCO),
    "AlphaPose HALPE": (alphapose(HALPE, 26), HALPE),
    "AlphaPose 133": (alphapose(WHOLE_BODY, 133), WHOLE_BODY),
    "AlphaPose 136": (alphapose(HALPE, 136), HALPE),
    "MMPose demo": (mmpose(COCO, 17, "demo"), COCO),
    "MMPose film": (mmpose(HALPE, 26, "film"), HALPE),
    "MMPose list": (mmpose(WHOLE_BODY, 133, "list"), WHOLE_BODY),
    "MMPose with names": (mmpose_with_names, OWN),
    "MMPose of images": (mmpose_of_images, COCO),
    "MediaPipe": (mediapipe(False), MEDIAPIPE),
    "MediaPipe, wrapped": (mediapipe(True), MEDIAPIPE),
    "npz, points": (npz("points"), OWN),
    "npz, places": (npz("places"), OWN),
}


def film_of(seed: int, frames: int, place: float = 400.0) -> list[Person]:
    """A person of about 300 px around x = `place`, who moves a little; each point is missing here and there."""
    random = np.random.default_rng(seed)
    figure = random.uniform((place - 70.0, 250.0), (place + 70.0, 550.0), (len(POINTS), 2))
    places = figure + np.cumsum(random.uniform(-6.0, 6.0, (frames, 1, 2)), axis=0)
    places = places + random.uniform(-4.0, 4.0, places.shape)
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
    """What is to be read (T, P, 3) of one person, who is missing in some frames, in a format with these points."""
    found = np.full((len(people), len(POINTS), 3), (np.nan, np.nan, 0.0))
    for frame, person in zip(found, people, strict=True):
        for row, name in enumerate(POINTS):
            if person is not None and name in order and person[row, 2] > 0.0:
                frame[row] = person[row]
    return found


def points(keypoints: Keypoints) -> np.ndarray:
    return np.concatenate([keypoints.places, keypoints.confidence[..., None]], axis=-1)


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1), gone=st.sets(st.integers(1, 8)))
def test_what_was_written_is_read_in_every_format(name: str, seed: int, gone: set[int]) -> None:
    write, order = FORMATS[name]
    people = [None if frame in gone else person for frame, person in enumerate(film_of(seed, 10))]
    found = loaded(write, [[] if person is None else [person] for person in people])
    np.testing.assert_allclose(points(found.keypoints), expected(people, order), rtol=1e-12, atol=0.0)
    assert found.keypoints.rate == RATE
    assert found.keypoints.size == SIZE
    assert (found.people, found.crossed) == (1, 0)


@pytest.mark.parametrize("name", [name for name in FORMATS if not name.startswith("AlphaPose")])
def test_frames_without_anyone_are_kept_at_both_ends(name: str) -> None:
    write, order = FORMATS[name]
    people = [None, None, *film_of(1, 3), None]
    found = loaded(write, [[] if person is None else [person] for person in people])
    np.testing.assert_allclose(points(found.keypoints), expected(people, order), rtol=1e-12)


@settings(max_examples=20)
@given(order=st.permutations(range(12)), first=st.integers(0, 10**12))
def test_frames_come_in_the_order_of_their_numbers_whatever_the_files(order: list[int], first: int) -> None:
    people = film_of(2, 12)
    wanted = expected(list(people), BODY_25)
    with folder() as path:
        for number in order:
            content = {"people": [{"pose_keypoints_2d": rows(people[number], BODY_25, 25).ravel().tolist()}]}
            dump(path / f"take2_{first + number}_keypoints.json", content)
        np.testing.assert_array_equal(points(formats.load(path, RATE).keypoints), wanted)
    with folder() as path:
        written = [result(f"{first + number}.jpg", people[number], HALPE, 26) for number in order]
        read = formats.load(dump(path / "results.json", written), RATE)
        np.testing.assert_array_equal(points(read.keypoints), wanted)


@pytest.mark.parametrize("label", ["{}.jpg", "frame_{:04}.png", "take2.frame.{:06}.jpg", None])
def test_an_image_is_numbered_by_its_name(tmp_path: Path, label: str | None) -> None:
    people = film_of(3, 12)
    written = [
        result(number if label is None else label.format(number), person) for number, person in enumerate(people, 5)
    ]
    found = formats.load(dump(tmp_path / "results.json", written), RATE)
    np.testing.assert_array_equal(points(found.keypoints), expected(list(people)))


def test_a_frame_whose_number_is_missing_shows_nobody(tmp_path: Path) -> None:
    path = FORMATS["OpenPose BODY_25"][0](tmp_path, [[person] for person in film_of(4, 6)])
    (path / "film_000000000003_keypoints.json").unlink()
    (path / "._film_000000000003_keypoints.json").write_bytes(b"left by a file manager")
    seen = formats.load(path, RATE).keypoints.detected.any(axis=1)
    assert seen.tolist() == [True, True, True, False, True, True]


@pytest.mark.parametrize("name", ["OpenPose BODY_25", "AlphaPose COCO", "MMPose film", "npz, points", "npz, places"])
def test_confidences_are_clipped_to_one(name: str) -> None:
    people = film_of(5, 3)
    for person in people:
        person[:, 2] = 1.02
    found = loaded(FORMATS[name][0], [[person] for person in people]).keypoints
    assert set(found.confidence.ravel()) <= {0.0, 1.0}


def test_openpose_means_not_found_by_no_confidence_or_by_the_corner() -> None:
    people = film_of(6, 3)
    for person in people:
        person[:, 2] = 0.5
    people[1][POINTS.index("nose"), 2] = 0.0
    people[2][POINTS.index("left_knee"), :2] = 0.0
    found = loaded(FORMATS["OpenPose BODY_25"][0], [[person] for person in people]).keypoints
    assert [(frame, POINTS[point]) for frame, point in np.argwhere(~found.detected)] == [(1, "nose"), (2, "left_knee")]
    assert np.isnan(found.places[~found.detected]).all()


def test_places_without_confidence_are_sure(tmp_path: Path) -> None:
    places = np.array(film_of(7, 4))[..., :2]
    places[2, 3] = np.nan
    np.savez(tmp_path / "a.npz", places=places, names=POINTS)
    found = formats.load(tmp_path / "a.npz", RATE).keypoints
    np.testing.assert_array_equal(found.places, places)
    np.testing.assert_array_equal(found.confidence, ~np.isnan(places[..., 0]))


def test_points_that_a_file_does_not_name_are_not_found(tmp_path: Path) -> None:
    some = np.array(film_of(8, 4))[:, :7]
    np.savez(tmp_path / "a.npz", points=some, names=POINTS[:7])
    found = formats.load(tmp_path / "a.npz", RATE).keypoints
    assert not found.detected[:, 7:].any()
    np.testing.assert_array_equal(found.confidence[:, :7], some[..., 2])


def test_arguments_win_over_the_rate_and_the_size_of_a_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", points=np.array(film_of(9, 4)), names=POINTS, rate=25.0, size=(640, 480))
    own = formats.load(tmp_path / "a.npz").keypoints
    assert (own.rate, own.size) == (25.0, (640.0, 480.0))
    told = formats.load(tmp_path / "a.npz", rate=50.0, size=(320.0, 240.0)).keypoints
    assert (told.rate, told.size) == (50.0, (320.0, 240.0))


def test_what_a_file_is_shows_in_its_content(tmp_path: Path) -> None:
    film = [[person] for person in film_of(10, 3)]
    for name in ("npz, points", "MMPose list", "AlphaPose COCO"):
        written = FORMATS[name][0](tmp_path, film)
        renamed = written.rename(tmp_path / f"{written.stem}.data")
        assert len(formats.load(renamed, RATE).keypoints) == 3


# People.


@settings(max_examples=15)
@given(
    seed=st.integers(0, 2**32 - 1),
    gaps=st.lists(st.tuples(st.integers(1, 20), st.integers(1, LOST)), min_size=2, max_size=2),
    order=st.lists(st.booleans(), min_size=39, max_size=39),
)
def test_people_who_keep_apart_are_never_mixed_up(seed: int, gaps: list[tuple[int, int]], order: list[bool]) -> None:
    both: list[list[Person | None]] = [[*film_of(seed, 40, 300.0)], [*film_of(seed + 1, 40, 900.0)]]
    for people, (first, length) in zip(both, gaps, strict=True):
        people[first : first + length] = [None] * length
    film = []
    for turned, pair in zip([False, *order], zip(*both, strict=True), strict=True):
        frame = [person for person in pair if person is not None]
        film.append(frame[::-1] if turned else frame)
    for number, people in enumerate(both):
        found = loaded(FORMATS["MMPose film"][0], film, person=number)
        assert found.people == 2
        np.testing.assert_array_equal(points(found.keypoints), expected(people, HALPE))


@pytest.mark.parametrize(("lost", "people"), [(LOST, 1), (LOST + 1, 2)])
def test_a_person_may_be_lost_for_half_a_second(lost: int, people: int) -> None:
    person = film_of(11, 1)
    film: Film = [person, *[[]] * lost, person]
    assert loaded(FORMATS["AlphaPose COCO"][0], film).people == people


def test_who_runs_through_the_image_stays_one_person() -> None:
    """At 5 m/s, about three times the own size each second, and lost for some frames."""
    people = film_of(27, 40, 200.0)
    for frame, person in enumerate(people):
        person[:, 0] += 800.0 * frame / RATE
    film = [[] if 12 <= frame < 22 else [person] for frame, person in enumerate(people)]
    assert loaded(FORMATS["AlphaPose HALPE"][0], film).people == 1


def test_who_is_suddenly_elsewhere_is_someone_else() -> None:
    person, other = film_of(28, 5), film_of(28, 5, 700.0)
    film = [[each] for each in [*person, *other]]
    assert loaded(FORMATS["AlphaPose HALPE"][0], film).people == 2


def test_who_comes_does_not_take_the_place_of_who_is_there_for_one_who_was_lost() -> None:
    lost, there, new = film_of(29, 12, 300.0), film_of(30, 12, 600.0), film_of(31, 12, 1500.0)
    film = [[lost[0], there[0]], *[[each] for each in there[1:11]], [there[11], new[11]]]
    found = loaded(FORMATS["AlphaPose COCO"][0], film, person=1)
    assert found.people == 3
    np.testing.assert_array_equal(points(found.keypoints), expected(list(there)))


def test_a_person_is_followed_by_most_points_and_by_a_single_one() -> None:
    people = film_of(32, 14)
    wrist, nose = POINTS.index("left_wrist"), POINTS.index("nose")
    for frame, person in enumerate(people):
        person[wrist, 0] += 600.0 * (frame % 2)
        person[nose, 2] = 0.9
        if 5 <= frame < 9:
            person[np.arange(len(POINTS)) != nose, 2] = 0.0
    assert loaded(FORMATS["AlphaPose HALPE"][0], [[person] for person in people]).people == 1
    # As long as a single point was all that was seen, nothing says how large the person is.
    assert loaded(FORMATS["AlphaPose HALPE"][0], [[person] for person in people[7:]]).keypoints.detected[-1].any()


def test_the_only_person_of_mediapipe_and_of_npz_may_be_lost_for_long() -> None:
    person = film_of(12, 1)
    film: Film = [person, *[[]] * 100, person]
    for name in ("MediaPipe", "npz, places"):
        assert loaded(FORMATS[name][0], film).keypoints.detected[-1].any()


def tracked(path: Path, film: list[list[tuple[int, Person]]], form: str) -> Path:
    """People with the numbers that a tracker gave them."""
    match form:
        case "OpenPose":
            for frame, people in enumerate(film):
                found = [
                    {"person_id": [number], "pose_keypoints_2d": rows(person, BODY_25, 25).ravel().tolist()}
                    for number, person in people
                ]
                dump(path / f"film_{frame}_keypoints.json", {"people": found})
            return path
        case "MMPose":
            frames = [[{**instance(person), "track_id": number} for number, person in people] for people in film]
            return dump(path / "results.json", frames)
    merged: dict[str, Callable[[int], object]] = {
        "AlphaPose": lambda number: number,
        "AlphaPose, listed": lambda number: [float(number)],
        "AlphaPose, merged": lambda number: [[float(number)], [float(7 - number)]],
    }
    written = [
        {**result(f"{frame}.jpg", person), "idx": merged[form](number)}
        for frame, people in enumerate(film)
        for number, person in people
    ]
    return dump(path / "results.json", written)


TRACKED = ["OpenPose", "MMPose", "AlphaPose", "AlphaPose, listed", "AlphaPose, merged"]


@pytest.mark.parametrize("form", TRACKED)
def test_the_numbers_of_a_tracker_tell_people_apart(tmp_path: Path, form: str) -> None:
    left, right = film_of(13, 6, 300.0), film_of(14, 6, 900.0)
    third, fourth = [*left[:3], *right[3:]], [*right[:3], *left[3:]]  # who change places at once
    film = [[(3, third[frame]), (4, fourth[frame])][:: (-1) ** frame] for frame in range(6)]
    path = tracked(tmp_path, film, form)
    for number, people in enumerate((third, fourth)):
        found = formats.load(path, RATE, person=number).keypoints
        np.testing.assert_array_equal(points(found), expected(list(people), BODY_25 if form == "OpenPose" else COCO))


@pytest.mark.parametrize("form", TRACKED)
@pytest.mark.parametrize("number", [0, -1])
def test_one_number_for_everybody_tells_nothing(tmp_path: Path, form: str, number: int) -> None:
    left, right = film_of(15, 6, 300.0), film_of(16, 6, 900.0)
    path = tracked(tmp_path, [[(number, one), (number, other)] for one, other in zip(left, right, strict=True)], form)
    found = formats.load(path, RATE, person=1)
    assert found.people == 2
    np.testing.assert_array_equal(found.keypoints.places[:, 3], expected(list(right))[:, 3, :2])


def test_whom_a_tracker_gave_no_number_is_nobody(tmp_path: Path) -> None:
    left, right = film_of(15, 6, 300.0), film_of(16, 6, 900.0)
    path = tracked(tmp_path, [[(2, one), (-1, other)] for one, other in zip(left, right, strict=True)], "MMPose")
    found = formats.load(path, RATE)
    assert found.people == 1
    np.testing.assert_array_equal(points(found.keypoints), expected(list(left)))


def test_people_are_counted_as_they_appear() -> None:
    left, right = film_of(17, 9, 300.0), film_of(18, 9, 900.0)
    film = [[one] if frame < 4 else [other, one] for frame, (one, other) in enumerate(zip(left, right, strict=True))]
    write = FORMATS["AlphaPose HALPE"][0]
    both: list[list[Person | None]] = [[*left], [*[None] * 4, *right[4:]]]
    for number, people in enumerate(both):
        found = loaded(write, film, person=number).keypoints
        np.testing.assert_array_equal(points(found), expected(people, HALPE))


@pytest.mark.parametrize("less", ["time", "size", "confidence"])
def test_by_default_the_person_is_the_one_seen_longest_largest_and_best(less: str) -> None:
    main, other = film_of(19, 9, 300.0), film_of(19, 9, 300.0)
    for person in other:
        if less == "size":
            person[:, :2] *= 0.5
        if less == "confidence":
            person[:, 2] *= 0.5
        person[:, 0] += 600.0
    film = [
        [second, first] if less != "time" or frame < 6 else [first]
        for frame, (first, second) in enumerate(zip(main, other, strict=True))
    ]
    found = loaded(FORMATS["MMPose film"][0], film)
    np.testing.assert_array_equal(points(found.keypoints), expected(list(main), HALPE))


@given(shift=st.floats(0.0, 400.0), small=st.floats(0.2, 1.0))
@settings(max_examples=30)
def test_frames_count_as_crossed_where_half_of_the_smaller_box_is_shared(shift: float, small: float) -> None:
    person = film_of(20, 1)[0]
    person[:, 2] = 1.0
    other = person.copy()
    corner = person[:, :2].min(axis=0)
    other[:, :2] = corner + small * (person[:, :2] - corner) + (shift, 0.0)
    width = np.ptp(person[:, 0])
    shared = np.clip(width - shift, 0.0, small * width) / (small * width)
    far = person + np.array([800.0, 0.0, 0.0])
    film = [[(0, person), (1, far)], [(0, person), (1, other)], [(1, far)], [(1, other), (0, person)]]
    with folder() as path:
        found = formats.load(tracked(path, film, "OpenPose"), RATE, person=0)
    assert found.crossed == (2 if shared > 0.5 else 0)


# Refusals.


def text(content: object) -> bytes:
    return json.dumps(content).encode()


MANY = [[person] for person in film_of(21, 3)]
ONE = MANY[0][0]
MARKS = [{"x": 0.5, "y": 0.5, "visibility": 1.0}] * 33


def changed(key: str, value: object) -> bytes:
    return text([{**result("0.jpg", ONE), key: value}])


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "is not whole as JSON"),
        (text([result("0.jpg", ONE)])[:-9], r"is not whole as JSON \(.*line 1.*understood are Open.* npz"),
        (b"HIERARCHY\nROOT Hips\n", "is not whole as JSON .* understood are"),
        (b"\xff\xfe\x00", "is not whole as JSON"),
        (b"[" * 100_000, "is not whole as JSON"),
        (text({"bodies": []}), "is JSON of another kind; understood are OpenPose's folder .* npz"),
        (text([1, 2]), "is JSON of another kind"),
        (b'"walk"', "is JSON of another kind"),
        (text([]), "has no frames"),
        (text({"meta_info": {}, "instance_info": []}), "has no frames"),
        (text([None, [], []]), "has no person in any frame"),
        (text([result("0.jpg", np.zeros((len(POINTS), 3)))]), "has no person in any frame"),
        (text([result("film.jpg", ONE)]), "has film.jpg as a frame, but needs the frame's number"),
        (text([result("0.jpg", ONE), result("0.png", ONE)]), "has two frames with number 0"),
        (text([result(0, ONE), result(10**9, ONE)]), "has frames from 0 to 1000000000, but may have 100000"),
        (text([result(0, ONE), result(10**30, ONE)]), "has frames from 0 to 1000.*, but may have 100000"),
        (text([result("0.jpg", ONE), {"keypoints": []}]), "has an entry without image_id"),
        (text([{"image_id": "0.jpg"}]), "has a person without keypoints"),
        (changed("keypoints", [1.0] * 50), "has keypoints of 50 numbers"),
        (changed("keypoints", [1.0] * 48), "has a person of 16 points, but needs 17, 18, 25, 26, 33, 133, 136"),
        (changed("keypoints", ["x"] * 51), "has keypoints with something that is not a number"),
        (changed("keypoints", {"x": 1.0}), "has keypoints with something that is not a number"),
        (changed("keypoints", [[1.0], [2.0, 3.0]]), "has keypoints with something that is not a number"),
        (changed("keypoints", [10**400] * 51), "has keypoints with something that is not a number"),
        (changed("keypoints", [float("nan")] * 51), "not finite"),
        (changed("keypoints", [float("inf")] * 51), "not finite"),
        (changed("keypoints", [1e200] * 51), "not finite, or not below 1e.06"),
        (text([{"frame_id": 0, "instances": []}, {"frame_id": 1}]), "has an entry without frame_id and instances"),
        (text({"instance_info": [instance(ONE)]}), "has an entry without frame_id and instances"),
        (text([{"frame_id": 0, "instances": 3}]), "has 3 where it needs a list"),
        (text([{"frame_id": n, "instances": [instance(ONE)]} for n in (1, 1)]), "has two frames with number 1"),
        (text([[instance(ONE), 4]]), "has a person without keypoints"),
        (text([[{**instance(ONE), "keypoint_scores": [1.0]}]]), r"has keypoints \(17, 2\), but needs \(P, 2\)"),
        (
            text({"meta_info": {"keypoint_id2name": {"1": "nose"}}, "instance_info": []}),
            "has keypoint_id2name, but needs a name there for each number from 0",
        ),
        (
            text({
                "meta_info": {"keypoint_id2name": {"0": "nose"}},
                "instance_info": [{"frame_id": 0, "instances": [instance(ONE)]}],
            }),
            "has a person of 17 points, but needs 1, as many as it names",
        ),
        (text([MARKS[1:]]), "has a person of 32 points"),
        (text([MARKS, [{"x": 0.5}]]), "has a landmark without x, y and visibility"),
        (text([MARKS, ["x"]]), "has a landmark without x, y and visibility"),
        (text([MARKS, {"y": 0.5}]), "where it needs a list"),
    ],
)  # fmt: skip
def test_a_file_that_is_damaged_or_of_another_kind_is_refused(tmp_path: Path, content: bytes, said: str) -> None:
    (tmp_path / "clip.json").write_bytes(content)
    refused(tmp_path / "clip.json", f"^clip.json .*{said}", rate=RATE, size=SIZE)


def refused(path: Path, said: str, **arguments: Any) -> None:
    with pytest.raises(InputError, match=said) as error:
        formats.load(path, **arguments)
    assert "\n" not in str(error.value)


class Trap:
    """Leaves a folder behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable, tuple[str]]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize(
    ("held", "said"),
    [
        ({"names": POINTS}, "is npz without names, and places or points"),
        ({"points": np.ones((3, 19, 3))}, "is npz without names, and places or points"),
        ({"points": np.ones((3, 2, 3)), "names": ["nose", "left_hand"]}, "has a name that is 'left_hand', but must be"),
        ({"points": np.ones((3, 2, 3)), "names": ["nose", "nose"]}, "has a name twice"),
        ({"points": np.ones((3, 19, 2)), "names": POINTS}, r"has points \(3, 19, 2\), but needs \(T, 19, 3\)"),
        ({"places": np.ones((3, 18, 2)), "names": POINTS}, r"has places \(3, 18, 2\), but needs \(T, 19, 2\)"),
        ({"places": 1.0, "names": POINTS}, r"has places \(\), but needs"),
        ({"places": np.full((3, 19, 2), "x"), "names": POINTS}, "has places with something that is not a number"),
        (
            {"places": np.ones((3, 19, 2)), "confidence": np.ones(3), "names": POINTS},
            r"has confidence \(3,\), but needs \(3, 19\)",
        ),
        ({"places": np.full((3, 19, 2), np.inf), "names": POINTS}, "not finite"),
        ({"points": np.full((3, 19, 3), (1.0, 1.0, np.nan)), "names": POINTS}, "not finite"),
        ({"places": np.full((3, 19, 2), np.nan), "names": POINTS}, "has no person in any frame"),
        ({"places": np.ones((0, 19, 2)), "names": POINTS}, "has no frames"),
        ({"places": np.ones((3, 19, 2)), "names": POINTS, "rate": [1.0, 2.0]}, r"has a rate \(2,\)"),
        ({"places": np.ones((3, 19, 2)), "names": POINTS, "size": (640, 0)}, r"size is \[640 0\], but must be"),
        ({"places": np.ones((3, 19, 2)), "names": POINTS, "size": 640}, "size is 640, but must be a width"),
    ],
)  # fmt: skip
def test_an_npz_file_that_is_not_ours_is_refused(tmp_path: Path, held: dict[str, Any], said: str) -> None:
    np.savez(tmp_path / "clip.npz", **held)
    refused(tmp_path / "clip.npz", f"^clip.npz {said}|^clip.npz .*{said}", rate=RATE)


def test_an_npz_file_is_never_unpickled(tmp_path: Path) -> None:
    trap = np.array([Trap(tmp_path / "sprung")], dtype=object)
    np.savez(tmp_path / "clip.npz", places=np.ones((3, 19, 2)), names=trap)
    refused(tmp_path / "clip.npz", "is no whole npz file of numbers and names", rate=RATE)
    assert not (tmp_path / "sprung").exists()


def test_a_path_where_there_is_nothing_is_refused(tmp_path: Path) -> None:
    (tmp_path / "clip.json").write_bytes(b"[]")
    refused(tmp_path / "clap.json", "clap.json', but no such file exists; did you mean 'clip.json'", rate=RATE)


def test_a_folder_is_refused_that_is_empty_or_of_another_kind(tmp_path: Path) -> None:
    path = tmp_path / "film"
    path.mkdir()
    refused(path, "^film has no frames", rate=RATE)
    (path / "film_0_keypoints.json").write_bytes(b'{"people": [')
    refused(path, "^film has film_0_keypoints.json, which is not whole as JSON", rate=RATE)
    (path / "film_0_keypoints.json").write_bytes(b'{"version": 1.3}')
    refused(path, "^film has film_0_keypoints.json, which has no list of people", rate=RATE)
    (path / "film_0_keypoints.json").write_bytes(b'{"people": []}')
    refused(path, "^film has no person in any frame", rate=RATE)
    (path / "other_0_keypoints.json").write_bytes(b'{"people": []}')
    refused(path, "^film has two frames with number 0", rate=RATE)
    (path / "notes.json").write_bytes(b"{}")
    refused(path, "^film has notes.json as a frame, but needs the frame's number in the name", rate=RATE)


def test_a_folder_goes_by_its_name_wherever_one_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    refused(Path("."), f"^{tmp_path.name} has no frames", rate=RATE)


@pytest.mark.parametrize("write", [write for write, _ in FORMATS.values()], ids=FORMATS)
def test_fewer_than_six_points_are_refused(tmp_path: Path, write: Write) -> None:
    film = [[np.where(np.arange(len(POINTS))[:, None] < 8, person, 0.0)] for person in film_of(22, 9)]
    for (person,) in film:
        person[[1, 4, 5], 2] = 0.0
    few = ", ".join(POINTS[row] for row in (0, 2, 3, 6, 7))
    refused(write(tmp_path, film), f"has only {few} of this person, but needs 6 points or more", rate=RATE, size=SIZE)


@pytest.mark.parametrize("name", FORMATS)
def test_a_rate_is_needed_and_has_a_range(tmp_path: Path, name: str) -> None:
    path = FORMATS[name][0](tmp_path, MANY)
    refused(path, f"^rate is not known, {path.name} does not hold it: give frames a second", size=SIZE)
    for rate in (0.0, -30.0, 4.9, 1001.0, float("nan")):
        refused(path, "^rate is .* but must be from 5 to 1000 frames a second", rate=rate, size=SIZE)


def test_a_rate_of_a_file_has_the_same_range(tmp_path: Path) -> None:
    np.savez(tmp_path / "clip.npz", points=np.array(film_of(23, 3)), names=POINTS, rate=0.04)
    refused(tmp_path / "clip.npz", "^rate is 0.04, but must be from 5 to 1000 frames a second")


@pytest.mark.parametrize("size", [(0.0, 720.0), (1280.0, -1.0), (float("nan"), 720.0), (float("inf"), 1.0), (1280.0,)])
def test_a_size_is_positive(tmp_path: Path, size: Any) -> None:
    path = FORMATS["MediaPipe"][0](tmp_path, MANY)
    refused(path, "^size is .* but must be a width and a height above 0, in pixels", rate=RATE, size=size)


@pytest.mark.parametrize("name", ["MediaPipe", "MediaPipe, wrapped"])
def test_parts_of_the_image_need_its_size(tmp_path: Path, name: str) -> None:
    path = FORMATS[name][0](tmp_path, MANY)
    refused(path, "has places as parts of the image: give size, its width and height in pixels", rate=RATE)


@pytest.mark.parametrize("person", [-1, 2, 99])
def test_a_person_who_is_not_there_is_refused_with_how_many_there_are(tmp_path: Path, person: int) -> None:
    film = [list(pair) for pair in zip(film_of(24, 3, 300.0), film_of(25, 3, 900.0), strict=True)]
    path = FORMATS["AlphaPose COCO"][0](tmp_path, film)
    refused(path, f"^person is {person}, but must be from 0 to below 2, the people in", rate=RATE, person=person)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


def replaced(content: Any, draw: Callable) -> Any:
    """The content with something else in one place."""
    inner = list(content.items()) if isinstance(content, dict) else list(enumerate(content or []))
    if not inner or draw(st.integers(0, 4)) == 0:
        return draw(JSON)
    key, value = draw(st.sampled_from(inner))
    if draw(st.integers(0, 4)) == 0:
        return type(content)(each for each in inner if each[0] != key) if isinstance(content, dict) else content[:key]
    copy = content.copy()
    copy[key] = replaced(value, draw) if isinstance(value, list | dict) else draw(JSON)
    return copy


@pytest.mark.parametrize("name", [name for name in FORMATS if not name.startswith("npz")])
@settings(max_examples=10)
@given(data=st.data())
def test_nothing_else_in_a_file_fails_but_with_a_refusal_in_one_line(name: str, data: st.DataObject) -> None:
    with folder() as path:
        written = FORMATS[name][0](path, MANY)
        damaged = max(written.iterdir()) if written.is_dir() else written
        dump(damaged, replaced(json.loads(damaged.read_bytes()), data.draw))
        try:
            assert 0 < len(formats.load(written, RATE, SIZE).keypoints) <= formats._MAX_FRAMES
        except InputError as error:
            assert str(error).startswith(f"{written.name} has") or "understood are" in str(error)
            assert "\n" not in str(error)


@settings(max_examples=100)
@given(place=st.integers(0, 10**6), value=st.integers(0, 255), cut=st.booleans())
def test_no_damage_to_an_npz_file_fails_but_with_a_refusal_in_one_line(place: int, value: int, cut: bool) -> None:
    with folder() as path:
        np.savez_compressed(path / "clip.npz", points=np.array(film_of(26, 3)), names=POINTS, rate=RATE)
        content = bytearray((path / "clip.npz").read_bytes())
        place %= len(content)
        content[place] = value
        (path / "clip.npz").write_bytes(content[:place] if cut else content)
        try:
            assert len(formats.load(path / "clip.npz", RATE).keypoints) == 3
        except InputError as error:
            assert "\n" not in str(error)

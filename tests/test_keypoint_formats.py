"""Files of detectors of people: what was written is read, and people are told apart."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from keypoint_files import (
    BODY_25,
    BODY_25B,
    COCO,
    FORMATS,
    HALPE,
    MAX_LOST_FRAMES,
    MEDIAPIPE,
    RATE,
    SIZE,
    Film,
    Person,
    dump,
    expected,
    film_of,
    folder,
    instance,
    loaded,
    mediapipe,
    points,
    result,
    rows,
)

from tasks.kick import Kick
from tasks.motions import angles
from tasks.pose import formats
from tasks.pose.point_orders import ORDERS, order_of
from tasks.pose.points import POINTS
from tasks.pose.reconstruction import angles_of
from tasks.pose.synthetic_film import camera_around, detected, points_of


@pytest.mark.parametrize("name", FORMATS)
@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1), gone=st.sets(st.integers(1, 8)))
def test_what_was_written_is_read_in_every_format(name: str, seed: int, gone: set[int]) -> None:
    write, order = FORMATS[name]
    people = [None if frame in gone else person for frame, person in enumerate(film_of(seed, 10))]
    read = loaded(write, [[] if person is None else [person] for person in people])
    np.testing.assert_allclose(points(read.keypoints), expected(people, order), rtol=1e-12, atol=1e-9)
    assert read.keypoints.rate == RATE
    assert read.keypoints.size == SIZE
    assert (read.people, read.crossed) == (1, 0)


@pytest.mark.parametrize("name", [name for name in FORMATS if not name.startswith(("AlphaPose", "YOLO labels"))])
def test_frames_without_anyone_are_kept_at_both_ends(name: str) -> None:
    write, order = FORMATS[name]
    people = [None, None, *film_of(1, 3), None]
    read = loaded(write, [[] if person is None else [person] for person in people])
    np.testing.assert_allclose(points(read.keypoints), expected(people, order), rtol=1e-12)


def test_landmarks_whose_visibility_is_not_told_are_sure() -> None:
    people = film_of(33, 4)
    for person in people:
        person[:, 2] = 0.5
    read = loaded(mediapipe("", visible=False), [[person] for person in people]).keypoints
    np.testing.assert_allclose(read.places, np.array(people)[..., :2], rtol=1e-12)
    assert (read.confidence == 1.0).all()


def test_landmarks_in_pixels_are_not_multiplied_by_the_size(tmp_path: Path) -> None:
    people = film_of(34, 4)
    frames = [[{"x": x, "y": y, "visibility": seen} for x, y, seen in rows(person, MEDIAPIPE, 33)] for person in people]
    read = formats.load(dump(tmp_path / "landmarks.json", frames), RATE, SIZE)
    np.testing.assert_array_equal(points(read.keypoints), expected(list(people), MEDIAPIPE))
    assert read.notes == ("33 points a person, read as mediapipe",)


@pytest.mark.parametrize(
    ("name", "note"),
    [
        ("OpenPose BODY_25", "25 points a person, read as body_25"),
        ("OpenPose BODY_25B", "25 points a person, read as body_25b"),
        ("AlphaPose COCO", "17 points a person, read as coco"),
        ("MMPose H36M", "17 points a person, read as h36m"),
        ("OpenPose, from 0 to 1", "places are parts of the image, from 0 to 1"),
        ("OpenPose, from -1 to 1", "places are parts of the image, from -1 to 1"),
    ],
)
def test_what_a_file_was_taken_for_is_said(name: str, note: str) -> None:
    assert note in loaded(FORMATS[name][0], [[person] for person in film_of(35, 5)]).notes


@pytest.mark.parametrize("name", ["body_25", "body_25b", "coco", "h36m"])
def test_orders_of_one_length_are_told_apart_from_any_side(name: str) -> None:
    """A kick seen by 12 cameras around, of the points that both orders have."""
    count, names = ORDERS[name]
    kick = Kick.standard()
    motion = angles.motion(**angles_of(kick.reference.states, kick.scene.bodies[0], kick.scene.dt))
    for seed in range(12):
        random = np.random.default_rng(seed)
        places = points_of(motion)
        film = detected(random, camera_around(random, places), places, 100.0)
        order = {point: row for row, point in enumerate(names) if point in POINTS}
        people = [
            rows(np.column_stack([np.nan_to_num(frame), sure]), order, count)
            for frame, sure in zip(film.places, film.confidence, strict=True)
        ]
        assert order_of(people)[0] == name


def test_the_order_of_points_can_be_said(tmp_path: Path) -> None:
    people = film_of(36, 4)
    path = FORMATS["OpenPose BODY_25B"][0](tmp_path, [[person] for person in people])
    for name in ("body_25b", "body_25"):
        read = formats.load(path, RATE, points=name)
        assert read.notes == (f"25 points a person, read as {name}",)
        right = np.array_equal(points(read.keypoints), expected(list(people), BODY_25B), equal_nan=True)
        assert right == (name == "body_25b")


@pytest.mark.parametrize("label", ["frame_{:04}_rendered1.png", "{}_of_12.jpg", "cam2-take3-{:06}.png"])
def test_the_number_of_an_image_is_the_one_that_changes(tmp_path: Path, label: str) -> None:
    people = film_of(37, 12)
    written = [result(label.format(number), person) for number, person in enumerate(people, 5)]
    read = formats.load(dump(tmp_path / "results.json", written), RATE)
    np.testing.assert_array_equal(points(read.keypoints), expected(list(people)))


def test_a_file_that_is_no_frame_is_left_out_and_named(tmp_path: Path) -> None:
    people = film_of(38, 12)
    path = FORMATS["OpenPose BODY_25"][0](tmp_path, [[person] for person in people])
    dump(path / "camera_2.json", {"size": [1280, 720]})
    read = formats.load(path, RATE)
    np.testing.assert_array_equal(points(read.keypoints), expected(list(people), BODY_25))
    assert "left out, as named otherwise than the frames: camera_2.json" in read.notes


@settings(max_examples=20)
@given(order=st.permutations(range(12)), first=st.integers(0, 10**12))
def test_frames_come_in_the_order_of_their_numbers_whatever_the_files(order: list[int], first: int) -> None:
    people = film_of(2, 12)
    expected_points = expected(list(people), BODY_25)
    with folder() as path:
        for number in order:
            content = {"people": [{"pose_keypoints_2d": rows(people[number], BODY_25, 25).ravel().tolist()}]}
            dump(path / f"take2_{first + number}_keypoints.json", content)
        np.testing.assert_array_equal(points(formats.load(path, RATE).keypoints), expected_points)
    with folder() as path:
        written = [result(f"{first + number}.jpg", people[number], HALPE, 26) for number in order]
        read = formats.load(dump(path / "results.json", written), RATE)
        np.testing.assert_array_equal(points(read.keypoints), expected_points)


@pytest.mark.parametrize("label", ["{}.jpg", "frame_{:04}.png", "take2.frame.{:06}.jpg", None])
def test_an_image_is_numbered_by_its_name(tmp_path: Path, label: str | None) -> None:
    people = film_of(3, 12)
    written = [
        result(number if label is None else label.format(number), person) for number, person in enumerate(people, 5)
    ]
    read = formats.load(dump(tmp_path / "results.json", written), RATE)
    np.testing.assert_array_equal(points(read.keypoints), expected(list(people)))


def test_a_frame_whose_number_is_missing_shows_nobody(tmp_path: Path) -> None:
    path = FORMATS["OpenPose BODY_25"][0](tmp_path, [[person] for person in film_of(4, 6)])
    (path / "film_000000000003_keypoints.json").unlink()
    (path / "._film_000000000003_keypoints.json").write_bytes(b"left by a file manager")
    shows_someone = formats.load(path, RATE).keypoints.detected.any(axis=1)
    assert shows_someone.tolist() == [True, True, True, False, True, True]


@pytest.mark.parametrize("name", ["OpenPose BODY_25", "AlphaPose COCO", "MMPose film", "npz, points", "npz, places"])
def test_confidences_are_clipped_to_one(name: str) -> None:
    people = film_of(5, 3)
    for person in people:
        person[:, 2] = 1.02
    read = loaded(FORMATS[name][0], [[person] for person in people]).keypoints
    assert set(read.confidence.ravel()) <= {0.0, 1.0}


def test_openpose_means_not_found_by_no_confidence_or_by_the_corner() -> None:
    people = film_of(6, 3)
    for person in people:
        person[:, 2] = 0.5
    people[1][POINTS.index("nose"), 2] = 0.0
    people[2][POINTS.index("left_knee"), :2] = 0.0
    read = loaded(FORMATS["OpenPose BODY_25"][0], [[person] for person in people]).keypoints
    assert [(frame, POINTS[point]) for frame, point in np.argwhere(~read.detected)] == [(1, "nose"), (2, "left_knee")]
    assert np.isnan(read.places[~read.detected]).all()


def test_places_without_confidence_are_sure(tmp_path: Path) -> None:
    places = np.array(film_of(7, 4))[..., :2]
    places[2, 3] = np.nan
    np.savez(tmp_path / "a.npz", places=places, names=POINTS)
    read = formats.load(tmp_path / "a.npz", RATE).keypoints
    np.testing.assert_array_equal(read.places, places)
    np.testing.assert_array_equal(read.confidence, ~np.isnan(places[..., 0]))


def test_points_that_a_file_does_not_name_are_not_found(tmp_path: Path) -> None:
    some = np.array(film_of(8, 4))[:, :7]
    np.savez(tmp_path / "a.npz", points=some, names=POINTS[:7])
    read = formats.load(tmp_path / "a.npz", RATE).keypoints
    assert not read.detected[:, 7:].any()
    np.testing.assert_array_equal(read.confidence[:, :7], some[..., 2])


def test_arguments_win_over_the_rate_and_the_size_of_a_file(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", points=np.array(film_of(9, 4)), names=POINTS, rate=25.0, size=(640, 680))
    from_file = formats.load(tmp_path / "a.npz").keypoints
    assert (from_file.rate, from_file.size) == (25.0, (640.0, 680.0))
    from_arguments = formats.load(tmp_path / "a.npz", rate=50.0, size=(1280.0, 720.0)).keypoints
    assert (from_arguments.rate, from_arguments.size) == (50.0, (1280.0, 720.0))


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
    gaps=st.lists(st.tuples(st.integers(1, 20), st.integers(1, MAX_LOST_FRAMES)), min_size=2, max_size=2),
    order=st.lists(st.booleans(), min_size=39, max_size=39),
)
def test_people_who_keep_apart_are_never_mixed_up(seed: int, gaps: list[tuple[int, int]], order: list[bool]) -> None:
    tracks: list[list[Person | None]] = [[*film_of(seed, 40, 300.0)], [*film_of(seed + 1, 40, 900.0)]]
    for people, (first, length) in zip(tracks, gaps, strict=True):
        people[first : first + length] = [None] * length
    film = []
    for is_reversed, pair in zip([False, *order], zip(*tracks, strict=True), strict=True):
        frame = [person for person in pair if person is not None]
        film.append(frame[::-1] if is_reversed else frame)
    for number, people in enumerate(tracks):
        read = loaded(FORMATS["MMPose film"][0], film, person=number)
        assert read.people == 2
        np.testing.assert_array_equal(points(read.keypoints), expected(people, HALPE))


@pytest.mark.parametrize(("lost", "people"), [(MAX_LOST_FRAMES, 1), (MAX_LOST_FRAMES + 1, 2)])
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
    film = [[shown] for shown in [*person, *other]]
    assert loaded(FORMATS["AlphaPose HALPE"][0], film).people == 2


def test_who_comes_does_not_take_the_place_of_who_is_there_for_one_who_was_lost() -> None:
    lost, there, new = film_of(29, 12, 300.0), film_of(30, 12, 600.0), film_of(31, 12, 1500.0)
    film = [[lost[0], there[0]], *[[person] for person in there[1:11]], [there[11], new[11]]]
    read = loaded(FORMATS["AlphaPose COCO"][0], film, person=1)
    assert read.people == 3
    np.testing.assert_array_equal(points(read.keypoints), expected(list(there)))


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
                people_entries = [
                    {"person_id": [number], "pose_keypoints_2d": rows(person, BODY_25, 25).ravel().tolist()}
                    for number, person in people
                ]
                dump(path / f"film_{frame}_keypoints.json", {"people": people_entries})
            return path
        case "MMPose":
            frames = [[{**instance(person), "track_id": number} for number, person in people] for people in film]
            return dump(path / "results.json", frames)
    identity_of: dict[str, Callable[[int], object]] = {
        "AlphaPose": lambda number: number,
        "AlphaPose, listed": lambda number: [float(number)],
        "AlphaPose, merged": lambda number: [[float(number)], [float(7 - number)]],
    }
    written = [
        {**result(f"{frame}.jpg", person), "idx": identity_of[form](number)}
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
        read = formats.load(path, RATE, person=number).keypoints
        np.testing.assert_array_equal(points(read), expected(list(people), BODY_25 if form == "OpenPose" else COCO))


@pytest.mark.parametrize("form", TRACKED)
@pytest.mark.parametrize("number", [0, -1])
def test_one_number_for_everybody_tells_nothing(tmp_path: Path, form: str, number: int) -> None:
    left, right = film_of(15, 6, 300.0), film_of(16, 6, 900.0)
    path = tracked(
        tmp_path, [[(number, first), (number, second)] for first, second in zip(left, right, strict=True)], form
    )
    read = formats.load(path, RATE, person=1)
    assert read.people == 2
    np.testing.assert_array_equal(read.keypoints.places[:, 3], expected(list(right))[:, 3, :2])


def test_whom_a_tracker_gave_no_number_is_nobody(tmp_path: Path) -> None:
    left, right = film_of(15, 6, 300.0), film_of(16, 6, 900.0)
    path = tracked(tmp_path, [[(2, first), (-1, second)] for first, second in zip(left, right, strict=True)], "MMPose")
    read = formats.load(path, RATE)
    assert read.people == 1
    np.testing.assert_array_equal(points(read.keypoints), expected(list(left)))


def test_people_are_counted_as_they_appear() -> None:
    left, right = film_of(17, 9, 300.0), film_of(18, 9, 900.0)
    film = [
        [first] if frame < 4 else [second, first] for frame, (first, second) in enumerate(zip(left, right, strict=True))
    ]
    write = FORMATS["AlphaPose HALPE"][0]
    tracks: list[list[Person | None]] = [[*left], [*[None] * 4, *right[4:]]]
    for number, people in enumerate(tracks):
        read = loaded(write, film, person=number).keypoints
        np.testing.assert_array_equal(points(read), expected(people, HALPE))


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
    read = loaded(FORMATS["MMPose film"][0], film)
    np.testing.assert_array_equal(points(read.keypoints), expected(list(main), HALPE))


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
        read = formats.load(tracked(path, film, "OpenPose"), RATE, person=0)
    assert read.crossed == (2 if shared > 0.5 else 0)

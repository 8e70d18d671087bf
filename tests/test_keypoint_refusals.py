"""Files of detectors of people that are damaged or of another kind are refused, in one line that names the cause."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from keypoint_files import (
    FORMATS,
    RATE,
    SIZE,
    dump,
    film_of,
    folder,
    instance,
    result,
)

from larp_model.errors import InputError
from tasks.pose import formats
from tasks.pose.points import POINTS


def text(content: object) -> bytes:
    return json.dumps(content).encode()


FILM = [[person] for person in film_of(21, 3)]
PERSON = FILM[0][0]
LANDMARKS = [{"x": 0.5, "y": 0.5, "visibility": 1.0}] * 33


def changed(key: str, value: object) -> bytes:
    return text([{**result("0.jpg", PERSON), key: value}])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "is not whole as JSON"),
        (text([result("0.jpg", PERSON)])[:-9], r"is not whole as JSON \(.*line 1.*understood are Open.* npz"),
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
        (text([result("film.jpg", PERSON)]), "has film.jpg as a frame, but needs the frame's number"),
        (text([result("0.jpg", PERSON), result("0.png", PERSON)]), "has two frames with number 0"),
        (text([result(0, PERSON), result(10**9, PERSON)]), "has frames from 0 to 1000000000, but may have 100000"),
        (text([result(0, PERSON), result(10**30, PERSON)]), "has frames from 0 to 1000.*, but may have 100000"),
        (text([result("0.jpg", PERSON), {"keypoints": []}]), "has an entry without image_id"),
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
        (text({"instance_info": [instance(PERSON)]}), "has an entry without frame_id and instances"),
        (text([{"frame_id": 0, "instances": 3}]), "has 3 where it needs a list"),
        (text([{"frame_id": n, "instances": [instance(PERSON)]} for n in (1, 1)]), "has two frames with number 1"),
        (text([[instance(PERSON), 4]]), "has a person without keypoints"),
        (text([[{**instance(PERSON), "keypoint_scores": [1.0]}]]), r"has keypoints \(17, 2\), but needs \(P, 2\)"),
        (
            text({"meta_info": {"keypoint_id2name": {"1": "nose"}}, "instance_info": []}),
            "has keypoint_id2name, but needs a name there for each number from 0",
        ),
        (
            text({
                "meta_info": {"keypoint_id2name": {"0": "nose"}},
                "instance_info": [{"frame_id": 0, "instances": [instance(PERSON)]}],
            }),
            "has a person of 17 points, but needs 1, as many as it names",
        ),
        (text([LANDMARKS[1:]]), "has a person of 32 points"),
        (text([LANDMARKS, [{"x": 0.5}]]), "has a landmark without x and y"),
        (text([LANDMARKS, ["x"]]), "has a landmark without x and y"),
        (text([LANDMARKS, {"y": 0.5}]), "where it needs a list"),
    ],
)  # fmt: skip
def test_a_file_that_is_damaged_or_of_another_kind_is_refused(tmp_path: Path, content: bytes, message: str) -> None:
    (tmp_path / "clip.json").write_bytes(content)
    refused(tmp_path / "clip.json", f"^clip.json .*{message}", rate=RATE, size=SIZE)


def refused(path: Path, message: str, **arguments: Any) -> None:
    with pytest.raises(InputError, match=message) as error:
        formats.load(path, **arguments)
    assert "\n" not in str(error.value)


class NpzTrap:
    """Leaves a folder behind when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[str]]:
        return os.mkdir, (str(self.path),)


@pytest.mark.parametrize(
    ("arrays", "message"),
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
def test_an_npz_file_that_is_not_ours_is_refused(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    np.savez(tmp_path / "clip.npz", **arrays)
    refused(tmp_path / "clip.npz", f"^clip.npz {message}|^clip.npz .*{message}", rate=RATE)


def test_an_npz_file_is_never_unpickled(tmp_path: Path) -> None:
    trap = np.array([NpzTrap(tmp_path / "sprung")], dtype=object)
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


# Where so little is seen, points of one number are taken to be in the usual order.
@pytest.mark.parametrize("name", [name for name in FORMATS if name not in ("OpenPose BODY_25B", "MMPose H36M")])
def test_fewer_than_six_points_are_refused(tmp_path: Path, name: str) -> None:
    write, _ = FORMATS[name]
    film = [[np.where(np.arange(len(POINTS))[:, None] < 8, person, 0.0)] for person in film_of(22, 9)]
    for (person,) in film:
        person[[1, 4, 5], 2] = 0.0
    few = ", ".join(POINTS[row] for row in (0, 2, 3, 6, 7))
    refused(write(tmp_path, film), f"has only {few} of this person, but needs 6 points or more", rate=RATE, size=SIZE)


@pytest.mark.parametrize("name", FORMATS)
def test_a_rate_is_needed_and_has_a_range(tmp_path: Path, name: str) -> None:
    path = FORMATS[name][0](tmp_path, FILM)
    refused(path, f"^rate is not known, {path.name} does not hold it: give frames a second", size=SIZE)
    for rate in (0.0, -30.0, 4.9, 1001.0, float("nan")):
        refused(path, "^rate is .* but must be from 5 to 1000 frames a second", rate=rate, size=SIZE)


def test_a_rate_of_a_file_has_the_same_range(tmp_path: Path) -> None:
    np.savez(tmp_path / "clip.npz", points=np.array(film_of(23, 3)), names=POINTS, rate=0.04)
    refused(tmp_path / "clip.npz", "^rate is 0.04, but must be from 5 to 1000 frames a second")


@pytest.mark.parametrize("size", [(0.0, 720.0), (1280.0, -1.0), (float("nan"), 720.0), (float("inf"), 1.0), (1280.0,)])
def test_a_size_is_positive(tmp_path: Path, size: Any) -> None:
    path = FORMATS["MediaPipe"][0](tmp_path, FILM)
    refused(path, "^size is .* but must be a width and a height above 0, in pixels", rate=RATE, size=size)


@pytest.mark.parametrize("name", ["MediaPipe", "MediaPipe, wrapped", "OpenPose, from 0 to 1", "YOLO labels"])
def test_parts_of_the_image_need_its_size(tmp_path: Path, name: str) -> None:
    path = FORMATS[name][0](tmp_path, FILM)
    refused(path, "has places as parts of the image: give size, its width and height in pixels", rate=RATE)


@pytest.mark.parametrize("person", [-1, 2, 99])
def test_a_person_who_is_not_there_is_refused_with_how_many_there_are(tmp_path: Path, person: int) -> None:
    film = [list(pair) for pair in zip(film_of(24, 3, 300.0), film_of(25, 3, 900.0), strict=True)]
    path = FORMATS["AlphaPose COCO"][0](tmp_path, film)
    refused(path, f"^person is {person}, but must be from 0 to below 2, the people in", rate=RATE, person=person)


def test_points_outside_the_image_are_refused(tmp_path: Path) -> None:
    path = FORMATS["OpenPose BODY_25"][0](tmp_path, FILM)
    refused(path, "film has 100 % of its points outside images of a size of 320 x 180 px", rate=RATE, size=(320, 180))


def test_points_that_make_no_person_in_any_order_need_to_be_named(tmp_path: Path) -> None:
    places = [(x, 100.0 + 30.0 * (7 * row % 17), 1.0) for row, x in enumerate(np.linspace(100.0, 300.0, 17))]
    entries = [[{"keypoints": np.ravel(places).tolist()}] for _ in range(20)]
    path = dump(tmp_path / "clip.json", entries)
    refused(path, "clip.json has 17 points a person, but in which order is not clear: give points, coco or h36m",
            rate=RATE)  # fmt: skip
    assert formats.load(path, RATE, points="h36m").notes == ("17 points a person, read as h36m",)
    refused(path, "clip.json has a person of 17 points, but needs 25, as body_25 has", rate=RATE, points="body_25")
    refused(path, "^points is 'body25', but must be one of .*did you mean 'body_25'", rate=RATE, points="body25")


def test_points_that_a_file_names_itself_are_not_named_again(tmp_path: Path) -> None:
    path = FORMATS["npz, points"][0](tmp_path, FILM)
    refused(path, "names its points itself, but points is 'coco': leave it out", rate=RATE, points="coco")


def test_people_of_several_numbers_of_points_are_refused(tmp_path: Path) -> None:
    entries = [[{"keypoints": [9.0] * 51}], [{"keypoints": [9.0] * 75}]]
    message = r"has a person of 17 points, but needs .*, the same in all frames; it has \[17, 25\]"
    refused(dump(tmp_path / "clip.json", entries), message, rate=RATE)


@pytest.mark.parametrize(("line", "message"), [("0 0.5 0.5 1", "has a label of 4 numbers"), ("0 x", "not a number")])
def test_a_damaged_label_is_refused(tmp_path: Path, line: str, message: str) -> None:
    (tmp_path / "film_1.txt").write_text(line)
    refused(tmp_path, f"has film_1.txt, which has a.*{message[6:]}", rate=RATE, size=SIZE)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=3),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=6,
)


def replaced(content: Any, draw: Callable[..., Any]) -> Any:
    """The content with something else in one place."""
    inner = list(content.items()) if isinstance(content, dict) else list(enumerate(content or []))
    if not inner or draw(st.integers(0, 4)) == 0:
        return draw(JSON)
    key, value = draw(st.sampled_from(inner))
    if draw(st.integers(0, 4)) == 0:
        return type(content)(item for item in inner if item[0] != key) if isinstance(content, dict) else content[:key]
    copy = content.copy()
    copy[key] = replaced(value, draw) if isinstance(value, list | dict) else draw(JSON)
    return copy


@pytest.mark.parametrize("name", [name for name in FORMATS if not name.startswith(("npz", "YOLO labels"))])
@settings(max_examples=10)
@given(data=st.data())
def test_nothing_else_in_a_file_fails_but_with_a_refusal_in_one_line(name: str, data: st.DataObject) -> None:
    with folder() as path:
        written = FORMATS[name][0](path, FILM)
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

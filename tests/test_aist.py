"""AIST++: its pickles are read without running them, its dances come into our frame, and the benchmark judges them."""

from __future__ import annotations

import json
import os
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from pickle import dumps
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from tasks.benchmarks import pose as benchmark
from tasks.pose import aist, lift, metrics, safe_pickle
from tasks.pose import figure as figures
from tasks.pose.camera import Camera, looking_at
from tasks.pose.figure import SHARED
from tasks.pose.points import POINTS
from tasks.pose.views import Views

PROTOCOLS = (2, 3, 4, 5)
SEQUENCE, VIDEO, OTHER = "gBR_sBM_cAll_d06_mBR4_ch06", "gBR_sBM_c06_d06_mBR4_ch06", "gLH_sFM_cAll_d18_mLH0_ch15"
VIEW = 5
# Points of COCO by their numbers there.
COCO = {
    "nose": 0, "left_ear": 3, "right_ear": 4, "left_shoulder": 5, "right_shoulder": 6, "left_elbow": 7,
    "right_elbow": 8, "left_wrist": 9, "right_wrist": 10, "left_hip": 11, "right_hip": 12, "left_knee": 13,
    "right_knee": 14, "left_ankle": 15, "right_ankle": 16,
}  # fmt: skip
KNOWN, THEIRS = [POINTS.index(name) for name in COCO], list(COCO.values())
# How AIST++'s axes lie in ours, how far its ground is below what it takes for one [m], and a lens that distorts.
AXES, LOWER = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]), 0.7
SPREAD, DISTORTION = (1480.0, 1500.0), (-0.1, 0.02, 1e-3, -5e-4, 0.003)


class Filmed(NamedTuple):
    """Annotations of a film: their folder, the camera, and the positions of the points (T, P, 3) [m]."""

    folder: Path
    lens: Camera
    points: np.ndarray


def theirs(points: np.ndarray) -> np.ndarray:
    """Points (*, 3) [m] of our world in AIST++'s, in centimetres."""
    return np.asarray(100.0 * (points + np.array([0.0, 0.0, LOWER])) @ AXES)


def images(points: np.ndarray, lens: Camera) -> np.ndarray:
    """Places (*, 2) [px] of points (*, 3) [m] through the lens that distorts."""
    local = (points - lens.position) @ lens.turn.T
    x, y = local[..., 0] / local[..., 2], local[..., 1] / local[..., 2]
    k1, k2, p1, p2, k3 = DISTORTION
    square = x * x + y * y
    radial = 1.0 + k1 * square + k2 * square**2 + k3 * square**3
    bent = (
        x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x * x),
        y * radial + p1 * (square + 2.0 * y * y) + 2.0 * p2 * x * y,
    )
    return np.asarray(np.stack(bent, axis=-1) * SPREAD + lens.centre)


def annotated(folder: Path, points: np.ndarray, protocol: int = 4) -> Filmed:
    """A folder of AIST++ in which one camera of nine has seen points (T, P, 3) [m]."""
    middle = points.mean(axis=(0, 1))
    position, at = middle + np.array([1.5, -4.0, 0.6]), middle + np.array([0.1, 0.0, -0.1])
    lens = looking_at(position, at, SPREAD[0], (1920.0, 1080.0))
    turn = lens.turn @ AXES
    camera = {
        "name": "c06",
        "size": [1920, 1080],
        "matrix": [[SPREAD[0], 0.0, lens.centre[0]], [0.0, SPREAD[1], lens.centre[1]], [0.0, 0.0, 1.0]],
        "rotation": Rotation.from_matrix(turn).as_rotvec().tolist(),
        "translation": (-turn @ theirs(lens.position)).tolist(),
        "distortions": list(DISTORTION),
    }
    count = len(points)
    seen = np.full((9, count, 17, 3), np.nan)
    seen[VIEW][:, THEIRS, :2] = images(points, lens)[:, KNOWN]
    seen[VIEW][..., 2] = 0.9
    true = np.full((count, 17, 3), 7.0)
    true[:, THEIRS] = theirs(points)[:, KNOWN]
    for name in ("cameras", "keypoints2d", "keypoints3d"):
        (folder / name).mkdir(parents=True)
    (folder / "cameras" / "mapping.txt").write_text(f"{SEQUENCE} setting1\n{OTHER} setting6\n")
    (folder / "cameras" / "setting1.json").write_text(json.dumps([camera] * 9))
    times = np.rint(np.arange(count) * 1e6 / 60.0).astype(int)
    of_images = {"keypoints2d": seen, "det_scores": np.ones((9, count)), "timestamps": times}
    (folder / "keypoints2d" / f"{SEQUENCE}.pkl").write_bytes(dumps(of_images, protocol))
    of_space = {"keypoints3d": true + 9.0, "keypoints3d_optim": true}
    (folder / "keypoints3d" / f"{SEQUENCE}.pkl").write_bytes(dumps(of_space, protocol))
    return Filmed(folder, lens, points)


@pytest.fixture(scope="module")
def kick() -> np.ndarray:
    """Points (T, P, 3) [m] of the embedded kick."""
    return benchmark.filmed_points(None, 0.6)


# Pickles.

ARRAYS: dict[str, Any] = {
    "floats": np.random.default_rng(0).standard_normal((9, 4, 17, 3)).astype(np.float32),
    "by column": np.asfortranarray(np.arange(12.0).reshape(3, 4)),
    "not finite": np.array([[np.nan, np.inf], [-np.inf, 0.0]]),
    "whole numbers": np.arange(5),
    "the other way round": np.arange(3, dtype=">i4"),
    "part": np.arange(20.0)[::3],
    "none": np.zeros((0, 3)),
    "one": np.array(3.0),
    "truths": np.array([True, False]),
    "text": np.array(["left", "é"]),
}


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_arrays_come_back_exactly(protocol: int, tmp_path: Path) -> None:
    path = tmp_path / "arrays.pkl"
    path.write_bytes(dumps(ARRAYS | {"again": ARRAYS["floats"]}, protocol))
    found = safe_pickle.load(path)
    assert list(found) == [*ARRAYS, "again"]
    for name, expected in ARRAYS.items():
        assert found[name].dtype == expected.dtype
        np.testing.assert_array_equal(found[name], expected, strict=True)
    np.testing.assert_array_equal(found["again"], ARRAYS["floats"])


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_plain_values_come_back_exactly(protocol: int, tmp_path: Path) -> None:
    held: dict[Any, Any] = {
        "a": [1, -2, 300, 70_000, 2**80, 0.5, None, True, [], [3]],
        4: ((), (1,), (1, 2), (1, 2, 3), (1, 2, 3, 4)),
    }
    held |= {"text\né": {"": {"": ""}}, "bytes": [b"", b"\x00\xff"], "long": list(range(3000))}
    (tmp_path / "values.pkl").write_bytes(dumps(held, protocol))
    assert safe_pickle.load(tmp_path / "values.pkl") == held


class Trap:
    """Calls something when it is unpickled."""

    def __init__(self, call: Callable[..., Any], *arguments: Any) -> None:
        self.called = call, arguments

    def __reduce__(self) -> Any:
        return self.called


def refused(path: Path, content: bytes, said: str) -> None:
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        safe_pickle.load(path)
    assert "\n" not in str(error.value) and str(error.value).startswith(path.name)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_pickle_that_names_a_foreign_callable_is_refused_and_nothing_runs(protocol: int, tmp_path: Path) -> None:
    sprung, path = tmp_path / "sprung", tmp_path / "trap.pkl"
    for call, argument in (
        (os.system, f"touch {sprung}"),
        (os.mkdir, str(sprung)),
        (eval, f"open({str(sprung)!r}, 'w')"),
    ):
        name = rf"it names '\w+\.{call.__name__}'"
        for held in (
            Trap(call, argument),
            {"keypoints2d": Trap(call, argument), **ARRAYS},
            [ARRAYS, Trap(call, argument)],
        ):
            refused(path, dumps(held, protocol), name)
    assert not sprung.exists()


@pytest.mark.parametrize(
    ("held", "said"),
    [
        (OrderedDict(a=1), "it names 'collections.OrderedDict'"),
        (np.array([Trap(os.getcwd)], object), "it has an array of type 'O8'|it names"),
        (np.zeros(2, [("x", "f4")]), "it has an array of type 'V4'"),
        (np.array(["2020-01-01"], "M8[D]"), "it has an array of type 'M8'"),
        ({(1, 2): 3}, "it fills what is no list, and no dict by text or numbers"),
        (np.float64(1.0), "it names 'numpy.*scalar'"),
    ],
)
def test_what_is_no_plain_array_is_refused(held: Any, said: str, tmp_path: Path) -> None:
    refused(tmp_path / "held.pkl", dumps(held, 4), said)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no whole pickle"),
        (b"no pickle", "no whole pickle"),
        (dumps(ARRAYS, 4)[:-40], "no whole pickle"),
        (b"cnumpy\nndarray\n(I5\ntR.", "no whole pickle"),
        (b"\x80\x02cnumpy\nndarray\nK\x05\x85R.", "it makes something that is not known"),
        (b"\x80\x02c_codecs\nencode\nX\x01\x00\x00\x00aX\x03\x00\x00\x00hex\x86R.", "it makes something"),
        (b"\x80\x02}}b.", "it has an array of no plain kind"),
        (b"\x80\x02(c__builtin__\neval\nX\x01\x00\x00\x001o.", "it names '__builtin__.eval'"),
        (b"\x80\x02X\x01\x00\x00\x00aQ.", "it has the step BINPERSID"),
        (b"\x80\x02\x82\x01.", "it has the step EXT1"),
        (b"\x80\x02K\x01K\x02.", "no whole pickle"),
    ],
)
def test_a_damaged_or_contrived_pickle_is_refused(content: bytes, said: str, tmp_path: Path) -> None:
    refused(tmp_path / "held.pkl", content, said)


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_no_damage_to_a_pickle_fails_but_with_a_refusal_in_one_line(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    content = bytearray(dumps({"a": np.arange(3.0), "b": [1, ("x", None)]}, data.draw(st.sampled_from(PROTOCOLS))))
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.getbasetemp() / "damaged.pkl"
    path.write_bytes(content)
    try:
        safe_pickle.load(path)
    except InputError as error:
        assert "\n" not in str(error) and str(error).startswith("damaged.pkl")


# Dances.


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_points_camera_and_keypoints_come_into_our_frame(kick: np.ndarray, protocol: int, tmp_path: Path) -> None:
    made = annotated(tmp_path / "aist", kick, protocol=protocol)
    film, lens, points = aist.load(made.folder, SEQUENCE, VIEW)
    # The ground is not annotated: what is found of it may be off by more than the rest.
    lifted = np.array([0.0, 0.0, np.nanmean((points - made.points)[..., 2])])
    assert abs(lifted[2]) < 0.03
    assert abs((points - made.points - lifted)[:, KNOWN]).max() < 1e-3
    assert np.linalg.norm(lens.position - made.lens.position - lifted) < 1e-3
    np.testing.assert_allclose(lens.turn, made.lens.turn, atol=1e-6)
    assert lens.focal == SPREAD[0] and film.rate == 60.0 and film.size == (1920.0, 1080.0)
    assert np.linalg.norm(film.places - lens.project(points), axis=-1)[:, KNOWN].max() < 0.5
    assert np.linalg.norm(film.places - made.lens.project(made.points), axis=-1)[:, KNOWN].max() < 0.5


def test_what_aist_does_not_know_is_not_known(kick: np.ndarray, tmp_path: Path) -> None:
    film, _, points = aist.load(annotated(tmp_path / "aist", kick).folder, SEQUENCE, VIEW)
    unknown = [row for row in range(len(POINTS)) if row not in KNOWN]
    assert {POINTS[row].partition("_")[2] for row in unknown} == {"heel", "toe"}
    assert np.isnan(points[:, unknown]).all() and np.isfinite(points[:, KNOWN]).all()
    assert not film.detected[:, unknown].any() and film.detected[:, KNOWN].all()
    blind, _, _ = aist.load(tmp_path / "aist", SEQUENCE, 0)
    assert not blind.detected.any()


def test_videos_are_of_a_sequence_and_a_camera() -> None:
    assert aist.sequence_and_camera(VIDEO) == (SEQUENCE, VIEW) and aist.video(SEQUENCE, VIEW) == VIDEO
    assert aist.sequence_and_camera(SEQUENCE) == (SEQUENCE, None)


def test_sequences_that_aist_found_faulty_are_left_out(kick: np.ndarray, tmp_path: Path) -> None:
    folder = annotated(tmp_path / "aist", kick).folder
    assert list(aist.sequences(folder)) == [SEQUENCE, OTHER]
    (folder / "ignore_list.txt").write_text(f"{OTHER}\n")
    assert aist.sequences(folder) == {SEQUENCE: "setting1"}


# Refusals.


def kept(folder: Path, name: str, **changed: Any) -> None:
    """Write a pickle of the folder again, other than it was."""
    path = folder / name / f"{SEQUENCE}.pkl"
    path.write_bytes(dumps(safe_pickle.load(path) | changed, 4))


def lens_with(folder: Path, **changed: Any) -> None:
    path = folder / "cameras" / "setting1.json"
    path.write_text(json.dumps([each | changed for each in json.loads(path.read_text())]))


WRONG: dict[str, tuple[Callable[[Path], object], str]] = {
    "no frames": (lambda at: kept(at, "keypoints2d", keypoints2d=np.ones((9, 0, 17, 3))), "0 frames in keypoints2d"),
    "shape": (lambda at: kept(at, "keypoints2d", keypoints2d=np.ones((8, 36, 17, 3))), r"\(8, 36, 17, 3\), but needs"),
    "kind": (lambda at: kept(at, "keypoints2d", keypoints2d=[1.0]), r"needs keypoints2d, floats \(9, T, 17, 3\)"),
    "infinite": (
        lambda at: kept(at, "keypoints3d", keypoints3d_optim=np.full((36, 17, 3), np.inf)),
        "keypoints3d_optim with numbers that are infinite",
    ),
    "no feet": (
        lambda at: kept(at, "keypoints3d", keypoints3d_optim=np.full((36, 17, 3), np.nan)),
        "no frame in keypoints3d_optim with both ankles",
    ),
    "file": (lambda at: (at / "keypoints3d" / f"{SEQUENCE}.pkl").unlink(), "keypoints3d.*but no such file exists"),
    "trap": (
        lambda at: (at / "keypoints3d" / f"{SEQUENCE}.pkl").write_bytes(dumps(Trap(os.getcwd), 4)),
        r"it names '\w+.getcwd'; nothing in it was run",
    ),
    "matrix": (lambda at: lens_with(at, matrix=[1.0]), "camera 5: matrix needs 3 x 3 finite numbers"),
    "lens": (lambda at: lens_with(at, distortions=[float("nan")] * 5), "distortions needs 5 finite numbers"),
    "size": (lambda at: lens_with(at, size=[0, 1080]), "size and the matrix' focal lengths must be above 0"),
    "lenses": (lambda at: (at / "cameras" / "setting1.json").write_text("[1]"), "needs a list of 9 cameras"),
    "json": (lambda at: (at / "cameras" / "setting1.json").write_text("[1"), "setting1.json is no JSON file"),
    "mapping": (lambda at: (at / "cameras" / "mapping.txt").write_text("one\n"), "mapping.txt needs a sequence"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_is_missing_or_damaged_is_refused_in_one_line(name: str, kick: np.ndarray, tmp_path: Path) -> None:
    folder = annotated(tmp_path / "aist", kick).folder
    damage, said = WRONG[name]
    damage(folder)
    with pytest.raises(InputError, match=said) as error:
        aist.load(folder, SEQUENCE, VIEW)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"aist": Path("nowhere")}, "aist is 'nowhere', but must be the folder of AIST"),
        ({"sequences": (SEQUENCE[:-1],)}, f"sequences has .* no such sequence.*did you mean '{SEQUENCE}'"),
        ({"sequences": (OTHER,)}, "but no such file exists"),
        ({"aist": Path("empty")}, "aist is 'empty', but keypoints2d in it has no sequence that mapping.txt has"),
        ({"sequences": (SEQUENCE,)}, "sequences has 'gBR_sBM_c01_.*show 6 or more points in 0 frames"),
        ({"viewpoints": 10}, "viewpoints is 10, but AIST.. has 9"),
        ({"clips": (Path("kick.bvh"),)}, "clips and aist are both set"),
        ({"aist": None, "sequences": (SEQUENCE,)}, "sequences has .*but aist, the folder they are in, is not set"),
    ],
)
def test_a_benchmark_of_dances_that_makes_no_sense_is_refused(
    arguments: dict[str, Any], said: str, kick: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = annotated(tmp_path / "aist", kick).folder
    annotated(tmp_path / "empty", kick)
    for path in (tmp_path / "empty" / "keypoints2d").iterdir():
        path.unlink()
    with pytest.raises(InputError, match=said) as error:
        benchmark.main(**{"aist": folder, "json": tmp_path / "pose.json"} | arguments)
    assert "\n" not in str(error.value)


# The benchmark.


def test_the_benchmark_judges_dances_as_what_truly_happened_beside_the_figures_of_the_paper(
    kick: np.ndarray, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, count = annotated(tmp_path / "aist", kick), 30
    # Somebody who stands beside the kick: what laying a figure over it leads to is tested elsewhere, and takes long.
    figure, place = figures.figure(), metrics.pelvis(kick[:count])[:, 0] + np.array([0.1, 0.0, 0.0])
    stands = figures.Pose(place, np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, figure.joints, 3)))
    proportions = np.zeros(SHARED)

    def laid(views: Views) -> lift.Lifted:
        assert len(views) == count and np.isfinite(views.places[..., KNOWN, :]).all()
        return lift.Lifted(stands, proportions, np.zeros(3), 0.0)

    monkeypatch.setattr(lift, "lift", laid)
    monkeypatch.chdir(tmp_path)
    Path("RESULTS.md").write_text("# Results\n")
    benchmark.main(aist=made.folder, seconds=0.5, ways=("kinematic",), json=Path("pose.json"), publish=True)
    (row,) = json.loads(Path("pose.json").read_text())["rows"]
    assert row["clip"] == VIDEO and row["frames"] == count and "true_foot_skate" not in row
    points, true, found = figure.all_points(stands, proportions), kick[:count], row["kinematic"]
    expected = metrics.position_errors(points, true)
    assert {name: found[name] for name in expected} == pytest.approx(expected, abs=0.1)
    assert found["velocity"] == pytest.approx(metrics.velocity_error(points, true, 60.0), abs=1e-3)
    assert found["foot_skate"] == metrics.foot_skate(points) and np.isfinite(found["mpjpe_2d_px"])
    results = Path("RESULTS.md").read_text()
    assert "| measure | kinematic | easy: DiffPhy | easy: Bullet | easy: LARP | hard: Bullet | hard: LARP |" in results
    assert "mm | 150 | 154 | 150 | 654 | 643 |" in results and "m/s |  | 0.41 | 0.37 | 0.17 | 0.13 |" in results
    assert "videos that it does not name" in results and "what was filmed" not in results


def test_points_that_are_not_known_are_left_out_of_means(kick: np.ndarray) -> None:
    random = np.random.default_rng(1)
    found = kick + 0.05 * random.standard_normal(kick.shape)
    true = kick.copy()
    true[:, [row for row in range(len(POINTS)) if row not in KNOWN]] = np.nan
    assert metrics.position_errors(found, true) == pytest.approx(metrics.position_errors(found, kick))
    assert metrics.velocity_error(found, true, 60.0) == pytest.approx(metrics.velocity_error(found, kick, 60.0))
    assert np.isnan(metrics.foot_skate(true))
    later = kick.copy()
    later[:4] = np.nan
    assert metrics.position_errors(found, later) == pytest.approx(metrics.position_errors(found[4:], kick[4:]))
    some = kick.copy()
    some[::2, POINTS.index("left_wrist")] = np.nan
    whole, less = metrics.position_errors(found, kick), metrics.position_errors(found, some)
    assert less != whole and less == pytest.approx(whole, rel=0.1)
    places = random.standard_normal((5, len(POINTS), 2))
    apart = places + np.array([3.0, 4.0])
    apart[:2] = np.nan
    assert metrics.pixel_error(places, apart) == pytest.approx(5.0)

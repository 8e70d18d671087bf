"""`tasks.pose`: from the keypoints of a film to a motion under gravity, and to a reference for the kick."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from larp_model.bodies import human_and_ball
from tasks import pose
from tasks.benchmarks import pose as benchmark
from tasks.command import run
from tasks.keypoints import filmed, lift, metrics, physical
from tasks.keypoints.figure import SHARED
from tasks.keypoints.points import POINTS, Keypoints
from tasks.motions import angles, bvh
from tasks.motions.references import embedded


@pytest.fixture(scope="module")
def film() -> dict[str, Any]:
    """Keypoints of the swing and the strike of the embedded kick, its camera, and where its points truly are."""
    reference, figure = embedded(human_and_ball()), lift.figure()
    points = physical.Seen(figure.body, figure, np.zeros(SHARED))
    states = reference.states[: reference.strike + 20 : 2, : len(figure.body.links)]
    true = np.asarray(points.points(states.astype(np.float32)), float)
    random = np.random.default_rng(4)
    lens = filmed.camera_around(random, true)
    return {"keypoints": filmed.seen(random, lens, true, 50.0), "lens": lens, "true": true}


def written(folder: Path, keypoints: Keypoints, **changed: Any) -> Path:
    fields: dict[str, Any] = {"places": keypoints.places, "confidence": keypoints.confidence, "names": np.array(POINTS)}
    fields |= {"rate": keypoints.rate, "size": np.array(keypoints.size)} | changed
    np.savez(folder / "film.npz", **{name: value for name, value in fields.items() if value is not None})
    return folder / "film.npz"


def test_a_film_becomes_a_motion_in_mujoco_and_a_reference(film: dict[str, Any], tmp_path: Path) -> None:
    lens, out = film["lens"], tmp_path / "pose"
    at = (lens.position + 3.0 * lens.turn[2]).tolist()
    camera = tmp_path / "camera.json"
    camera.write_text(json.dumps({"focal": lens.focal, "position": lens.position.tolist(), "look_at": at}))
    pose.main(written(tmp_path, film["keypoints"]), camera=camera, out=out, quiet=True)
    summary = json.loads((out / "summary.json").read_text())
    assert not summary["fell"] and summary["error_px"] < 25.0 and summary["candidates"] > 100
    assert summary["height_m"] == pytest.approx(1.75, abs=0.15)
    assert (out / "pose.png").read_bytes().startswith(b"\x89PNG")
    motion = angles.load(out / "pose.npz")
    assert motion.rate == pytest.approx(100.0)
    written_too = bvh.load(out / "pose.bvh")
    np.testing.assert_allclose(written_too.path("LeftToeBase"), motion.path("LeftToeBase"), atol=1e-4)
    hips, true = motion.path("Hips"), metrics.pelvis(film["true"])[:, 0]
    moved = np.linalg.norm(hips[-1] - hips[0]), np.linalg.norm(true[-1] - true[0])
    assert moved[0] == pytest.approx(moved[1], abs=0.2)


def test_frames_at_the_ends_in_which_nobody_is_seen_are_left_out(film: dict[str, Any]) -> None:
    whole = film["keypoints"]
    hidden = Keypoints(whole.places.copy(), whole.confidence.copy(), whole.rate, whole.size)
    hidden.confidence[:3], hidden.confidence[-5:] = 0.0, 0.0
    left = pose.cut(hidden)
    assert len(left) <= len(whole) - 8
    np.testing.assert_array_equal(left.places[-1], whole.places[len(whole) - 6])


@pytest.mark.parametrize(
    ("changed", "arguments", "said"),
    [
        ({"rate": None}, [], "rate"),
        ({"size": None}, [], "size is not known"),
        ({"confidence": np.zeros((30, len(POINTS)))}, [], "film.npz"),
        ({}, ["--camera", "nowhere.json"], "nowhere.json"),
        ({}, ["--person", "4"], "person"),
    ],
)
def test_what_cannot_be_reconstructed_is_refused_in_one_line_and_nothing_is_written(
    changed: dict[str, Any], arguments: list[str], said: str, film: dict[str, Any], tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    if "confidence" in changed:
        changed = changed | {"confidence": np.zeros_like(film["keypoints"].confidence)}
    path, out = written(tmp_path, film["keypoints"], **changed), tmp_path / "out"
    with pytest.raises(SystemExit) as ended:
        run(pose.main, [str(path), "--out", str(out), *arguments])
    error = capsys.readouterr().err
    assert ended.value.code == 2 and said in error and error.count("\n") == 1 and not out.exists()


def test_the_benchmark_tells_how_far_a_reconstruction_is_from_what_was_filmed(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    benchmark.main(cameras=1, seconds=0.6, ways=("kinematic",), seed=3, json=path)
    found = json.loads(path.read_text())
    (row,) = found["rows"]
    assert (
        row["frames"] == 36
        and row["clip"] == "embedded"
        and found["means"]["kinematic"] == {name: row["kinematic"][name] for name in found["means"]["kinematic"]}
    )
    assert 1.0 < row["kinematic"]["mpjpe_pa_mm"] < 100.0
    assert path.with_suffix(".png").is_file()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"cameras": 0}, "cameras is 0"),
        ({"seconds": 0.1}, "seconds is 0.1, but must be from 0.4 to 60"),
        ({"ways": ("larp", "larp")}, "each once"),
        ({"clips": (Path("nowhere.bvh"),)}, "clips is 'nowhere.bvh', but no such file exists"),
    ],
)
def test_a_benchmark_that_makes_no_sense_is_refused(arguments: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=said):
        benchmark.main(json=tmp_path / "pose.json", **arguments)


def test_too_few_frames_are_refused(film: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="6 or more points in 5 frames, but need 10"):
        pose.cut(film["keypoints"].cut(0, 4))

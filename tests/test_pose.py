"""`tasks.pose`: from the keypoints of a film to a motion under gravity, and to a reference for the kick."""

from __future__ import annotations

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from larp_model.bodies import human_and_ball
from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from mpc import MujocoDynamics, Verified
from mpc.gauss_newton import FACTORS
from tasks.benchmarks import pose as benchmark
from tasks.command import Teller, run
from tasks.motions import angles, bvh
from tasks.motions.references import embedded
from tasks.pose import command, lift, metrics, physical, reconstruction, synthetic_film
from tasks.pose import figure as figures
from tasks.pose.camera import Camera
from tasks.pose.checkpoint import Progress
from tasks.pose.figure import SHARED
from tasks.pose.points import POINTS, Keypoints, interpolated
from tasks.pose.views import Views


@pytest.fixture(scope="module")
def film() -> dict[str, Any]:
    """Keypoints of the swing and the strike of the embedded kick, two cameras, and where its points truly are."""
    reference, figure = embedded(human_and_ball()), figures.figure()
    points = physical.BodyPoints(figure.body, figure, np.zeros(SHARED))
    states = reference.states[: reference.strike + 20 : 2, : len(figure.body.links)]
    true = np.asarray(points.points(states.astype(np.float32)), float)
    random = np.random.default_rng(4)
    lens = synthetic_film.camera_around(random, true)
    film = {"keypoints": synthetic_film.detected(random, lens, true, 50.0), "lens": lens, "true": true}
    second = synthetic_film.camera_around(random, true)
    return film | {"second keypoints": synthetic_film.detected(random, second, true, 50.0), "second": second}


def camera_file(path: Path, lens: Camera) -> Path:
    at = (lens.position + 3.0 * lens.turn[2]).tolist()
    path.write_text(json.dumps({"focal": lens.focal, "position": lens.position.tolist(), "look_at": at}))
    return path


def written(folder: Path, keypoints: Keypoints, name: str = "film", **changed: Any) -> Path:
    fields: dict[str, Any] = {"places": keypoints.places, "confidence": keypoints.confidence, "names": np.array(POINTS)}
    fields |= {"rate": keypoints.rate, "size": np.array(keypoints.size)} | changed
    np.savez(folder / f"{name}.npz", **{field: value for field, value in fields.items() if value is not None})
    return folder / f"{name}.npz"


@pytest.mark.slow
def test_a_film_becomes_a_motion_in_mujoco_and_a_reference(film: dict[str, Any], tmp_path: Path) -> None:
    out, camera = tmp_path / "pose", camera_file(tmp_path / "camera.json", film["lens"])
    command.main((written(tmp_path, film["keypoints"]),), cameras=(camera,), preset="fast", out=out, quiet=True)
    summary = json.loads((out / "summary.json").read_text())
    assert not summary["camera_seems_to_move"] and summary["slip_m_s"] < command.MAX_SLIP
    assert not summary["fell"] and summary["error_px"] < 25.0 and summary["candidates"] > 100
    assert summary["preset"] == "fast" and summary["truth_rollouts"] == 0
    assert summary["height_m"] == pytest.approx(1.75, abs=0.15)
    assert (out / "pose.png").read_bytes().startswith(b"\x89PNG")
    motion = angles.load(out / "pose.npz")
    assert motion.rate == pytest.approx(100.0)
    written_too = bvh.load(out / "pose.bvh")
    np.testing.assert_allclose(written_too.path("LeftToeBase"), motion.path("LeftToeBase"), atol=1e-4)
    hips, true = motion.path("Hips"), metrics.pelvis(film["true"])[:, 0]
    moved = np.linalg.norm(hips[-1] - hips[0]), np.linalg.norm(true[-1] - true[0])
    assert moved[0] == pytest.approx(moved[1], abs=0.2)


@pytest.mark.slow
def test_a_reconstruction_of_two_films_that_was_cut_off_goes_on_as_if_it_had_not_been(
    film: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(reconstruction, "SAVE_INTERVAL", 0.0)
    whole, again = tmp_path / "whole", tmp_path / "again"
    keypoints = tuple(written(tmp_path, film[name].cut(0, 19), name) for name in ("keypoints", "second keypoints"))
    cameras = tuple(camera_file(tmp_path / f"{name}.json", film[name]) for name in ("lens", "second"))
    command.main(keypoints, cameras=cameras, preset="fast", out=whole, quiet=True)

    def interrupted(step: int, steps: int) -> None:
        if step >= 17:
            raise KeyboardInterrupt

    with monkeypatch.context() as changed:
        changed.setattr(Teller, "bar", lambda self, what: nullcontext(interrupted))
        with pytest.raises(KeyboardInterrupt):
            command.main(keypoints, cameras=cameras, preset="fast", out=again, quiet=True)
    assert [path.name for path in again.iterdir()] == ["unfinished.npz"]
    capsys.readouterr()
    command.main(keypoints, cameras=cameras, preset="fast", out=again)
    assert "17 steps done" in capsys.readouterr().out
    assert sorted(path.name for path in again.iterdir()) == sorted(path.name for path in whole.iterdir())
    one, other = (angles.load(folder / "pose.npz") for folder in (whole, again))
    np.testing.assert_allclose(other.path("Hips"), one.path("Hips"), atol=0.01)
    first, second = (json.loads((folder / "summary.json").read_text()) for folder in (whole, again))
    assert first["candidates"] == second["candidates"] and first["films"] == len(first["cameras_m"]) == 2


@pytest.mark.parametrize("moves", [False, True])
def test_a_film_by_a_camera_that_follows_the_person_is_told_of(
    moves: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    random, true = np.random.default_rng(4), benchmark.filmed_points(None, 2.0)[::2]
    lens, camera = synthetic_film.camera_around(random, true), tmp_path / "camera.json"
    camera.write_text(json.dumps({"focal": lens.focal}))
    seen = synthetic_film.detected(
        random, lens, synthetic_film.panned(lens, true) if moves else true, 0.5 * benchmark.RATE
    )

    def enough(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "reconstruct", enough)
    with pytest.raises(KeyboardInterrupt):
        command.main((written(tmp_path, seen),), cameras=(camera,), out=tmp_path / "pose")
    assert ("does the camera move" in capsys.readouterr().out) == moves


def test_what_was_kept_of_another_film_or_is_damaged_is_of_no_use(film: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "unfinished.npz"
    found = lift.Lifted(figures.Pose(*(np.zeros(2),) * 3), np.zeros(11), np.zeros(3), 1.0)
    Progress(path, "one").save(found)
    again = Progress(path, "one")
    assert again.lifted is not None and again.lifted.error == 1.0 and again.checkpoint is None
    assert Progress(path, "other").lifted is None
    path.write_bytes(path.read_bytes()[:-80])
    assert Progress(path, "one").lifted is None


@pytest.mark.parametrize("height", command.HEIGHTS)
def test_people_of_all_heights_are_simulated_as_large_as_they_are(height: float) -> None:
    figure, proportions = figures.figure(), np.zeros(SHARED)
    proportions[0] = np.log(height / figures.USUAL_HEIGHT)
    assert figure.height(np.asarray(proportions)) == pytest.approx(height, rel=0.01)


def test_frames_at_the_ends_in_which_nobody_is_seen_are_left_out(film: dict[str, Any]) -> None:
    whole = film["keypoints"]
    hidden = Keypoints(whole.places.copy(), whole.confidence.copy(), whole.rate, whole.size)
    hidden.confidence[:3], hidden.confidence[-5:] = 0.0, 0.0
    (left,) = Views((hidden,), (film["lens"],)).with_person().films
    assert len(left) <= len(whole) - 8
    np.testing.assert_array_equal(left.places[-1], whole.places[len(whole) - 6])


def test_who_moves_steadily_does_so_at_another_rate_too_and_rests_where_the_motion_ends() -> None:
    times, velocity = np.arange(60) / 60.0, np.array([1.0, -0.5, 0.25])
    executed = np.arange(98)[:, None, None] * 0.01 * np.broadcast_to(velocity, (len(POINTS), 3))
    found = interpolated(executed, 100.0, times)
    np.testing.assert_allclose(60.0 * np.diff(found[:-1], axis=0), np.broadcast_to(velocity, found[1:-1].shape))
    np.testing.assert_array_equal(found[-1], executed[-1])
    np.testing.assert_array_equal(interpolated(executed[:1], 100.0, times), np.repeat(executed[:1], 60, axis=0))


@pytest.mark.parametrize(
    ("changed", "arguments", "said"),
    [
        ({"rate": None}, [], "rate"),
        ({"size": None}, [], "size is not known"),
        ({"confidence": np.zeros((30, len(POINTS)))}, [], "film.npz"),
        ({}, ["--cameras", "nowhere.json"], "nowhere.json"),
        ({}, ["--person", "4"], "person"),
        ({}, ["--height", "3"], "height is 3, but must be from 1.3 to 2.2 m"),
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
        run(command.main, [str(path), "--out", str(out), *arguments])
    error = capsys.readouterr().err
    assert ended.value.code == 2 and said in error and error.count("\n") == 1 and not out.exists()


def test_the_benchmark_tells_how_far_a_reconstruction_is_from_what_was_filmed(tmp_path: Path) -> None:
    path = tmp_path / "pose.json"
    benchmark.main(viewpoints=1, seconds=0.6, ways=("kinematic",), seed=3, json=path)
    found = json.loads(path.read_text())
    (row,) = found["rows"]
    assert (
        row["frames"] == 36
        and row["clip"] == "embedded"
        and found["means"]["kinematic"] == {name: row["kinematic"][name] for name in found["means"]["kinematic"]}
    )
    assert 1.0 < row["kinematic"]["mpjpe_pa_mm"] < 100.0
    assert path.with_suffix(".png").is_file()


def test_plans_of_a_learned_model_alone_are_tried_in_the_truth() -> None:
    preset, truth = physical.PRESETS["accurate"], MujocoDynamics(Truth(human_and_ball(), 1))
    steps, trials = preset.optimizers(truth)
    assert steps == preset.steps and isinstance(trials, Verified) and trials.dynamics is truth
    assert preset.optimizers(None) == (preset.steps,)
    assert physical.PRESETS["balanced"].optimizers(truth) == (physical.PRESETS["balanced"].steps,)


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_slow_model_is_given_as_many_candidates_as_it_has_time_for(share: float) -> None:
    preset = physical.PRESETS["balanced"]

    def candidates(preset: physical.FitPreset) -> int:
        return 1 + preset.steps.rounds * (preset.steps.directions + len(FACTORS))

    assert candidates(benchmark.as_fast(preset, share)) == pytest.approx(share * candidates(preset), abs=1.0)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"viewpoints": 0}, "viewpoints is 0"),
        ({"seconds": 0.1}, "seconds is 0.1, but must be from 0.4 to 60"),
        ({"ways": ("larp", "larp")}, "each once"),
        ({"ways": ("larp", "mujoco_timed", "mujoco")}, "mujoco_timed, but needs larp and mujoco before it"),
        ({"clips": (Path("nowhere.bvh"),)}, "clips is 'nowhere.bvh', but no such file exists"),
        ({"together": 0}, "together is 0, but must be at least 1"),
        ({"film": (Path("film.npz"),)}, "film and truth belong together, but only one of them is set"),
        ({"clips": (Path("a.bvh"),), "film": (Path("b.npz"),)}, "clips and film are both set, but films are of one of"),
    ],
)
def test_a_benchmark_that_makes_no_sense_is_refused(arguments: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        benchmark.main(json=tmp_path / "pose.json", **arguments)


def test_too_few_frames_are_refused(film: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="6 or more points in 5 frames, but need 10"):
        Views((film["keypoints"].cut(0, 4),), (film["lens"],)).with_person()


def test_own_films_are_judged_by_one_camera_by_two_and_by_all(film: dict[str, Any], tmp_path: Path) -> None:
    films = tuple(written(tmp_path, film[name], name) for name in ("keypoints", "second keypoints"))
    cameras = tuple(camera_file(tmp_path / f"{name}.json", film[name]) for name in ("lens", "second"))
    truth = tmp_path / "truth.npz"
    quarter = film["true"] @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.savez(truth, names=np.array(POINTS), positions=quarter, rate=50.0)
    path = tmp_path / "pose.json"
    benchmark.main(film=films, cameras=cameras, truth=truth, ways=("kinematic",), json=path)
    one, other, both = json.loads(path.read_text())["rows"]
    assert [row["clip"] for row in (one, other, both)] == ["1 camera", "1 camera", "2 cameras"]
    assert both["kinematic"]["mpjpe_g_mm"] < min(row["kinematic"]["mpjpe_g_mm"] for row in (one, other)) < 120.0
    np.savez(truth, names=np.array(POINTS), positions=quarter + np.array([1.0, 0.0, 0.0]), rate=50.0)
    with pytest.raises(InputError, match=r"truth is \d+ px off the first film in half of its points"):
        benchmark.main(film=films, cameras=cameras, truth=truth, ways=("kinematic",), json=path)

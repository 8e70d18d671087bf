"""Promises of the speed benchmark: fair questions, rows that say why, and errors that fall with the step."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest

from larp_model.detection import contact_points
from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from larp_model.physics.kinematics import morphology_of
from larp_model.scene import Scene
from tasks.benchmarks import engines, replays, report, speed
from tasks.benchmarks.engines import Course, Question, RefusedError
from tasks.motions.references import Reference


def asked(engine: str = "mujoco", scene: str = "ball", reach: str | None = None, batch: int = 2) -> Question:
    return Question(engine, scene, reach, 1 if engine == "larp" else 2, batch)


def near(what: Course) -> np.ndarray:
    """(T,) in which steps a link is near the ball, in the course as MuJoCo performs it."""
    scene, shape = what.scene, morphology_of(what.scene)[None]
    after, _ = Truth(scene, len(what.states), threads=1).rollout(what.states, what.controls)
    states = np.concatenate([what.states[:, None], after], axis=1)
    times = range(what.controls.shape[1])
    pairs = [(jnp.asarray(states[:, t]), jnp.asarray(states[:, t + 1])) for t in times]
    return np.array([(contact_points(scene, before, shape, after)[0][1].near > 0.0).any() for before, after in pairs])


def test_a_struck_ball_is_near_a_link_in_every_timed_step() -> None:
    assert near(engines.course(asked(scene="human_ball", reach="struck"))).all()


def test_a_ball_out_of_reach_is_near_no_link() -> None:
    assert not near(engines.course(asked(scene="human_ball", reach="far"))).any()


def test_a_gradient_goes_through_the_strike() -> None:
    question = Question("larp", "human_ball", "struck", 1, 1, gradient=True)
    assert near(engines.course(question)).any()


def test_every_row_of_a_batch_has_targets_of_its_own_and_the_seed_repeats_them() -> None:
    first, again = (engines.course(asked(scene="human")).controls for _ in range(2))
    assert (first == again).all() and (first[0] != first[1]).any()


def test_a_row_is_the_median_of_five_runs_of_a_hundred_steps() -> None:
    calls: list[int] = []

    def run(steps: int) -> float:
        calls.append(steps)
        return 1e-4 * steps * len(calls)

    row = engines.timed(run, 1, engines.STEPS)
    assert calls == [1, 1, 100, 100, 100, 100, 100]
    assert (row["steps"], row["runs"]) == (100, 5)
    assert row["ms_per_step"] == pytest.approx(0.5)
    assert row["ms_per_step_range"] == pytest.approx([0.3, 0.7])


@pytest.mark.parametrize("seconds", [0.02, 0.5, 2.0, 100.0])
def test_a_slow_row_says_with_how_few_steps_it_was_measured(seconds: float) -> None:
    spent = []

    def run(steps: int) -> float:
        spent.append(steps * seconds)
        return spent[-1]

    row = engines.timed(run, 4, engines.STEPS)
    assert row["ms_per_step"] == pytest.approx(1e3 * seconds)
    assert row["steps"] % 4 == 0 and 4 <= row["steps"] <= engines.STEPS
    assert sum(spent) <= max(4 * engines.SECONDS, 4 * seconds)


def test_what_does_not_fit_into_memory_is_refused_before_it_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engines, "available_memory", lambda: 1000)
    with pytest.raises(RefusedError, match="of memory"):
        engines.compiled(lambda x: x @ x, jnp.zeros((64, 64)))


def test_time_and_memory_are_taken_in_a_process_of_its_own() -> None:
    row = speed.QuestionRunner()(asked())
    assert row["refused"] is None and row["finite"] and row["coarse"]
    assert row["us_per_scene_step"] == pytest.approx(1e3 * row["ms_per_step"] / 2)
    assert row["peak_memory_mib"] >= row["idle_memory_mib"] > 0.0


def test_a_process_that_dies_becomes_a_row_that_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", "false")
    assert "code 1" in speed.QuestionRunner()(asked())["refused"]


def test_a_process_is_ended_after_the_seconds_that_it_is_given() -> None:
    assert speed.QuestionRunner({False: 1.0})(asked())["refused"] == "took longer than 1 s"


@pytest.mark.parametrize("row", [{"refused": "needs more"}, {"refused": None, "ms_per_step": 1e4}])
def test_what_an_engine_refused_or_is_slow_at_is_not_asked_again_with_a_larger_batch(
    row: report.Row, monkeypatch: pytest.MonkeyPatch
) -> None:
    sizes: list[int] = []

    def answer(self: speed.QuestionRunner, question: Question) -> report.Row:
        sizes.append(question.batch)
        return row

    monkeypatch.setattr(speed.QuestionRunner, "ask", answer)
    ask = speed.QuestionRunner()
    found = [ask(asked(batch=batch))["refused"] for batch in (8, 64, 512)]
    assert found[0] == row["refused"] and found[1] is not None and found[1] == found[2]
    assert sizes == [8]


def test_an_engine_that_is_not_installed_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(engines.STEPPED, "bullet", lambda *_: __import__("no_such_engine"))
    assert engines.answer(asked("bullet"))["refused"] == "is not installed (no_such_engine)"


def test_brax_says_in_its_own_words_why_it_does_not_take_the_human() -> None:
    assert "not supported" in speed.QuestionRunner()(asked("brax spring", "human"))["refused"]


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ({"scenes": "ball,sea"}, "scenes has 'sea'"),
        ({"engines": "larp,abacus"}, "engines has 'abacus'"),
        ({"batch": "1,0"}, "batch is '1,0'"),
        ({"kicks": -1}, "kicks is -1"),
    ],
)
def test_wrong_arguments_are_refused_by_name(arguments: dict[str, str | int], told: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=told):
        speed.main(**arguments, json=tmp_path / "speed.json")  # type: ignore[arg-type]


def test_a_replay_comes_nearer_to_the_limit_with_more_engine_steps(scene: Scene, reference: Reference) -> None:
    kicked = replays.Kicked(np.array([4.0, 0.0, 0.3]), reference.states[0], reference.controls[:60])
    players = {("mujoco", substeps): replays.player_of(scene, "mujoco", substeps) for substeps in (2, 20, 160)}
    coarse, fine, limit = replays.replay_errors(scene, kicked, players)
    assert (limit["error_m"], limit["launch_error"]) == pytest.approx((0.0, 0.0), abs=1e-9)
    assert fine["launch_error"] < coarse["launch_error"] and fine["error_m"] < coarse["error_m"]


def test_a_compiled_engine_is_replayed_as_it_steps(scene: Scene, reference: Reference) -> None:
    alone = scene.only("ball")
    traced = engines.larp(alone, 1)
    states, controls = reference.states[None, 60, -1:], np.zeros((1, 3, 0, 3))
    carried = traced.enter(traced.start(states))
    for _ in range(3):
        carried = traced.step(carried, jnp.zeros((1, 0, 3)))
    played = replays.player_of(alone, "larp", 1)(states, controls)
    assert played[-1] == pytest.approx(np.asarray(traced.ball(carried))[0], abs=1e-4)


def test_a_replay_that_diverged_is_infinitely_far_off_in_the_median_only() -> None:
    def row(error: float) -> list[report.Row]:
        return [{"engine": "larp", "substeps": 1, "error_m": error, "launch_error": error}]

    (found,) = replays.figures_of([row(0.1), row(float("nan")), row(float("inf"))])
    assert found["mean_m"] == pytest.approx(0.1) and found["diverged"] == 2 and found["median_m"] is None


def test_the_benchmark_writes_rows_and_pictures_and_touches_no_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def answer(self: speed.QuestionRunner, question: Question) -> report.Row:
        if question.engine.startswith("brax"):
            return {"refused": "no"}
        time = {"ms_per_step": 1.0, "us_per_scene_step": 1.0, "compile_seconds": 1.0}
        return time | {
            "refused": None,
            "peak_memory_mib": 2.0,
            "idle_memory_mib": 1.0,
            "forward_ms": 1,
            "reverse_ms": 2,
        }

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(speed.QuestionRunner, "ask", answer)
    report.RESULTS.write_text("# Results\n")
    speed.main(batch="1,8", kicks=0, json=Path("speed.json"))
    found = json.loads(Path("speed.json").read_text())
    assert {row["engine"] for row in found["rows"]} > {"larp", "mujoco", "mjx", "brax spring", "bullet"}
    assert {row["batch"] for row in found["rows"]} == {1, 8}
    assert all(row["gradient"] for row in found["gradient"]) and found["replays"] == []
    assert Path("speed.png").stat().st_size > 0
    assert report.RESULTS.read_text() == "# Results\n"

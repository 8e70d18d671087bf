"""The kick: its reference, its report, its command line; end to end with a small budget."""

from __future__ import annotations

import copy
import json
import socket
from pathlib import Path
from pickle import dumps
from typing import Any

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.bodies import human_and_ball, standing_height
from larp_model.errors import InputError
from mpc import CEM
from tasks import kick
from tasks.command import Teller, run
from tasks.motions import references
from tasks.presets import PRESETS, Preset
from tasks.run import replayed, summary_of
from tasks.session import Session
from tasks.targets import random_kick

PROTOCOL = {
    "target",
    "truth_error_m",
    "limit_error_m",
    "model_error_m",
    "reference_deviation_m",
    "ball_speed_m_s",
    "fell",
    "reachable",
    "plan_seconds",
    "replan_ms",
    "compile_seconds",
    "truth_rollouts",
    "preset",
    "dynamics",
    "weights",
    "seed",
}


@pytest.fixture(scope="module")
def task() -> kick.Kick:
    return kick.Kick.standard()


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> None:
    search, less = (CEM(samples=32, rounds=2, elites=8),), (CEM(samples=16, rounds=1, elites=8),)
    monkeypatch.setitem(PRESETS, "fast", Preset(search, less, interval=20, recovery=less))


def test_the_reference_strikes_at_a_kickers_speed_and_is_still_up_half_a_second_later(task: kick.Kick) -> None:
    states, strike = task.reference.states, task.reference.strike
    foot = states[:, task.foot]
    forward = Rotation.from_quat(foot[:, packed.ORIENTATION], scalar_first=True).apply([1.0, 0.0, 0.0])
    link = task.scene.links[task.foot]
    to_toe = (0.5 * link.length + link.radius) * forward
    toe = np.linalg.norm(foot[:, packed.VELOCITY] + np.cross(foot[:, packed.ANGULAR_VELOCITY], to_toe), axis=-1)
    assert 8.0 <= toe[strike] <= 16.0
    assert np.linalg.norm(states[strike + 8, task.ball, packed.VELOCITY]) >= 8.0
    assert states[: strike + 51, 0, 2].min() > 0.75 * task.standing_height


def test_the_standing_height_is_that_of_the_closed_up_rest_pose() -> None:
    scene = human_and_ball()
    state = references.standing_on_ground(scene, np.zeros((1, len(scene.motors), 3)), Rotation.identity(1))[0]
    assert state[0, 2] == pytest.approx(standing_height(scene.human), abs=1e-9)


def test_the_full_human_may_touch_the_ball_with_its_toes() -> None:
    (pair,) = human_and_ball(detail="full").pairs
    assert {"left_toes", "right_toes"} < set(pair.first_links)


def test_the_ball_distance_counts_the_way_between_steps(task: kick.Kick) -> None:
    states = np.zeros((2, 14, 13))
    states[1, task.ball, 0] = 2.0
    assert task.missed(states, 0, np.array([1.0, 0.3, 0.0])) == pytest.approx(0.3, abs=1e-6)
    assert task.missed(states, 0, np.array([3.0, 0.0, 0.0])) == pytest.approx(1.0, abs=1e-6)
    assert task.missed(states[:1], 0, np.array([3.0, 0.0, 0.0])) == pytest.approx(3.0, abs=1e-6)


def test_tasks_are_drawn_within_the_protocols_bounds() -> None:
    random = np.random.default_rng(0)
    for _ in range(200):
        target, shift = random_kick(random)
        assert 2.0 <= np.hypot(*target[:2]) <= 5.0
        assert abs(np.degrees(np.arctan2(target[1], target[0]))) <= 25.0
        assert 0.11 <= target[2] <= 1.0
        assert (np.abs(shift) <= 0.03).all()


def test_fast_hits_its_targets_and_stays_near_the_reference(task: kick.Kick) -> None:
    session, random, reports = Session(task), np.random.default_rng(5), []
    for seed in range(3):
        target, shift = random_kick(random)
        execution = session.execute(session.planners("fast"), target, seed, task.start(shift), recovers=False)
        reports.append(summary_of(task, execution, target))
    assert np.mean([report["truth_error_m"] for report in reports]) <= 0.08
    assert max(report["reference_deviation_m"] for report in reports) <= 0.05
    assert sum(report["compile_seconds"] for report in reports) > 0.0
    assert all(report["candidates_lost"] == report["truth_rollouts"] == 0 for report in reports)


def test_with_the_truth_as_model_what_is_predicted_happens(task: kick.Kick, small: None) -> None:
    session, target = Session(task, "mujoco", substeps=task.substeps), np.array([3.0, 0.2, 0.4])
    execution = session.execute(session.planners("fast")._replace(interval=100), target, seed=0, recovers=False)
    report = summary_of(task, execution, target)
    assert report["touched"]
    assert report["truth_error_m"] == pytest.approx(report["model_error_m"], abs=0.01)


def test_the_limit_is_the_miss_of_the_same_controls_at_the_finer_step(small: None) -> None:
    coarse = kick.Kick.standard(substeps=4)
    session, target = Session(coarse, "mujoco", substeps=4), np.array([3.0, 0.2, 0.4])
    execution = session.execute(session.planners("fast"), target, seed=0, recovers=False)
    report = summary_of(coarse, execution, target)
    assert replayed(coarse, execution, target, substeps=4) == pytest.approx(report["truth_error_m"], abs=1e-6)
    assert report["limit_error_m"] == replayed(coarse, execution, target)
    assert abs(report["limit_error_m"] - report["truth_error_m"]) > 0.01


def test_a_kick_end_to_end_leaves_all_its_files_and_they_agree(
    tmp_path: Path, small: None, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    tell, saved = Teller.result, list[set[str]]()

    def result(self: Teller, *arguments: Any) -> None:
        saved.append({path.name for path in tmp_path.iterdir()})
        tell(self, *arguments)

    monkeypatch.setattr(Teller, "result", result)
    kick.main((3.0, 0.3, 0.4), preset="fast", out=tmp_path, seed=3, json=True)
    assert saved == [{path.name for path in tmp_path.iterdir()}], "what is told may be lost, and is told last"
    assert {path.name for path in tmp_path.iterdir()} == {"summary.json", "kick.npz", "kick.png", "kick.html"}
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert set(summary) >= PROTOCOL
    assert summary["truth_rollouts"] == 0
    said = capsys.readouterr()
    assert json.loads(said.out) == summary, "--json puts the result, and it alone, on stdout"
    for part in ("setting up", "compiling", "planning", "executing", "writing"):
        assert part in said.err
    with np.load(tmp_path / "kick.npz", allow_pickle=False) as file:
        states = file["states"]
    task = kick.Kick.standard()
    assert task.missed(states, 0, np.array(summary["target"])) == pytest.approx(summary["truth_error_m"], abs=1e-3)


@pytest.mark.slow
def test_later_kicks_of_a_preset_compile_nothing_again(small: None) -> None:
    session = Session(kick.Kick.standard(substeps=4), "mujoco")
    first, again = (session.run((3.0, side, 0.4), "fast") for side in (0.2, -0.2))
    assert first.summary["compile_seconds"] > 0.0 == again.summary["compile_seconds"]
    assert first.states.shape[1:] == (14, 13) and first.joint_targets.shape[1:] == (12, 3)
    assert again.truth_error_m == again.summary["truth_error_m"] and again.recording.target[1] == -0.2
    assert "Kick to (3.00, -0.20, 0.40) m" in str(again.table.title)
    for used in (session.task, session, first, session.planners("fast").first):
        assert dumps(used) and copy.deepcopy(used) is not used, "processes of a pool may take and return it"
    assert copy.deepcopy(first).truth_error_m == first.truth_error_m


def test_a_copied_planner_plans_the_same(task: kick.Kick, small: None) -> None:
    coarse = kick.Kick.standard(substeps=4)
    planner, window = Session(coarse, "mujoco").planners("fast").first, coarse.window((3.0, 0.2, 0.4))(0)
    plans = [
        each.step(each.init(jax.random.key(0)), coarse.start(), window)[0] for each in (planner, copy.deepcopy(planner))
    ]
    np.testing.assert_array_equal(plans[0].knots, plans[1].knots)


@pytest.mark.parametrize(
    ("state", "message"),
    [
        (np.zeros((3, 13)), r"state has shape \(3, 13\), but needs \(14, 13\)"),
        ([[1.0], [1.0, 2.0]], "state is of type list, but needs numbers"),
        (np.full((14, 13), np.nan), "state has numbers that are not finite"),
        ("standing", "state is of type str"),
    ],
)
def test_a_state_of_another_scene_is_refused_by_name(task: kick.Kick, state: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        task.check_state(state)  # type: ignore[arg-type]
    np.testing.assert_array_equal(task.check_state(task.start().tolist()), task.start())


def test_a_ball_that_is_moved_by_no_vector_is_refused_by_name(task: kick.Kick) -> None:
    with pytest.raises(InputError, match="ball_offset is"):
        task.start((0.1, 0.0, 0.0))  # type: ignore[arg-type]
    with pytest.raises(InputError, match="ball_velocity is"):
        task.start(ball_velocity=(np.inf, 0.0))


def test_a_target_out_of_reach_is_marked_and_still_gets_a_plan(task: kick.Kick, small: None) -> None:
    session, target = Session(task), np.array([0.0, 0.0, 40.0])
    report = session.run(target, "fast").summary
    assert not report["reachable"]
    assert np.isfinite(report["truth_error_m"])


def test_an_output_folder_that_cannot_be_written_is_refused_before_anything_else(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="out needs the folder"):
        kick.main(out=tmp_path / "file" / "kick", weights=Path("nowhere.json"))


def test_a_port_that_is_taken_is_refused_before_anything_is_set_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(kick.Kick, "standard", lambda *arguments: pytest.fail("it was set up"))
    taken, refused = socket.create_server(("127.0.0.1", 0)), r"port \d+ of host '127\.0\.0\.1' cannot be opened"
    with taken, pytest.raises(InputError, match=refused):
        kick.main(out=tmp_path / "out", view=True, port=taken.getsockname()[1])
    with pytest.raises(InputError, match=r"allow_host has 'https://hub\.example'"):
        kick.main(out=tmp_path / "out", view=True, port=0, allow_host=("https://hub.example",))


@pytest.mark.parametrize(
    ("argument", "values"),
    [
        ("preset", {"preset": "heroic"}),
        ("dynamics", {"dynamics": "wishful"}),
        ("target", {"target": (float("nan"), 0.0, 0.0)}),
        ("reference", {"reference": Path("nowhere.bvh")}),
        ("weights", {"weights": Path("nowhere.json")}),
    ],
)
def test_wrong_values_end_with_one_line_that_names_them_and_code_2(
    argument: str, values: dict[str, object], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def task() -> None:
        kick.main(**{"out": tmp_path / "out"} | values)  # type: ignore[arg-type]

    with pytest.raises(SystemExit) as ended:
        run(task, arguments=[])
    assert ended.value.code == 2
    line = capsys.readouterr().err.strip()
    assert "\n" not in line and argument in line
    assert not (tmp_path / "out").exists()

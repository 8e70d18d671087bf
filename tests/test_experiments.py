"""Experiments: variants of the paper's model, and a runner that goes on where it was cut off."""

from __future__ import annotations

import itertools
import time
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model import rotation
from larp_model import state as packed
from larp_model.engines.episodes import Episodes
from larp_model.errors import InputError
from larp_model.evaluation import DIVERGED, evaluate
from larp_model.learned.model import Model, initial_weights
from larp_model.learned.paper import PaperModel, Sizes, Variant
from larp_model.networks import Size
from larp_model.simulator import Simulator, step
from tasks.benchmarks import engines, report
from tasks.experiments import runner, speed
from tasks.experiments.changes import CHANGES, DESIGNS
from tasks.experiments.lists import EXPERIMENTS, UPDATES, Trial
from tasks.experiments.runner import BudgetSpentError, TrialRunner, chosen_runs, only_one_in
from tasks.experiments.tables import picture, tables_of
from tasks.experiments.tracked import errors, tracked
from tasks.scenarios import scenario

LEAST = Sizes(*[Size(2, 16)] * 3)
TINY = Trial("chain4", "paper", "unroll of 2 steps", 8, 0, 3)


@pytest.fixture(scope="module")
def thrown() -> dict[str, Episodes]:
    """Truth of a chain, and of two that meet."""
    return {name: scenario(name).draw(8, 1)[0] for name in ("chain4", "chains2")}


def after(name: str, variant: Variant, given: Episodes, states: np.ndarray) -> np.ndarray:
    """The states after a step by networks of random weights."""
    model: Model = PaperModel(scenario(name).scene, LEAST, variant=variant)
    arrays = (
        given.states[:, 40],
        given.states[:, 41],
        np.zeros((len(states), 0, 3)),
        given.torques[:, 0],
        given.morphology,
    )
    *_, controls, torques, sizes = inputs = [jnp.asarray(array) for array in arrays]
    measured = model.measure(*inputs)
    weights = initial_weights(model, jax.random.key(0), measured)
    moved = jax.jit(step, static_argnums=0)(model, weights, states, controls, torques, sizes)
    return np.asarray(moved)


@pytest.mark.parametrize("root_frame", [True, False])
def test_turning_the_world_turns_a_step_in_the_roots_frame_alone(thrown: dict[str, Episodes], root_frame: bool) -> None:
    given, variant = thrown["chain4"], Variant(contact="none", root_frame=root_frame, outputs="change")
    states = jnp.asarray(given.states[:, 40])
    turn = jnp.broadcast_to(jnp.array([jnp.cos(1.0), jnp.sin(1.0)]), (len(states), 2))
    given = given._replace(torques=np.zeros_like(given.torques))
    found = after("chain4", variant, given, np.asarray(rotation.turn_states(states, turn)))
    expected = np.asarray(rotation.turn_states(jnp.asarray(after("chain4", variant, given, np.asarray(states))), turn))
    difference = np.abs(np.delete(found - expected, np.s_[packed.ORIENTATION], axis=-1)).max()
    assert (difference < 1e-4) == root_frame


@pytest.mark.parametrize("contact", ["feature", "impulse", "none"])
def test_only_with_a_contact_network_chains_change_each_other(thrown: dict[str, Episodes], contact: str) -> None:
    given, variant = thrown["chains2"], Variant(contact=contact)  # type: ignore[arg-type]
    together = given.states[:, 40].copy()
    together[:, 2:, packed.POSITION] += together[:, :1, packed.POSITION] - together[:, 2:3, packed.POSITION]
    apart = together.copy()
    apart[:, 2:, 0] += 5.0
    changes = [after("chains2", variant, given, states)[:, :2, packed.VELOCITY] for states in (together, apart)]
    assert (np.abs(changes[0] - changes[1]).max() > 1e-6) == (contact != "none")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"contact": "impuls"}, "variant.contact is 'impuls', .* did you mean 'impulse'"),
        ({"left_out": ("torques",)}, "variant.left_out is 'torques', .* did you mean 'torque'"),
        ({"root_frame": True}, "variant.root_frame is set, but needs rotation 'matrix' and contact 'none'"),
    ],
)
def test_a_variant_that_does_not_exist_is_refused(fields: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Variant(**fields)  # type: ignore[arg-type]


def test_every_run_changes_its_design_in_one_way_of_its_own() -> None:
    made: dict[tuple[str, str], set[str]] = {}
    for run in itertools.chain(*(experiment.runs for experiment in EXPERIMENTS.values())):
        design, change = DESIGNS[run.design], CHANGES[run.change]
        model = change.model(design.model(scenario(run.scene).scene))
        made.setdefault((run.scene, run.design), set()).add(f"{model} {change.recipe(design.recipe)}")
    for (scene, name), different in made.items():
        runs = {run.change for experiment in EXPERIMENTS.values() for run in experiment.runs
                if (run.scene, run.design) == (scene, name)}  # fmt: skip
        assert len(different) == len(runs)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("ablation",), "experiment is 'ablation', .* did you mean 'ablations'"),
        (("ablations", ("chain",)), "scenes is 'chain', .* did you mean 'chain4'"),
        (("ablations", (), ("quaternion",)), "changes is 'quaternion', .* did you mean 'quaternions'"),
        (("ablations", ("chain4",), ("contact impulse",)), "ablations has no run with it in chain4"),
        (("ablations", (), (), 0), "seeds is 0, but must be at least 1"),
        (("ablations", (), (), None, 0), "updates is 0, but must be at least 1"),
    ],
)
def test_runs_that_do_not_exist_are_refused_with_the_nearest_names(arguments: tuple[str], message: str) -> None:
    with pytest.raises(InputError, match=message):
        chosen_runs(*arguments)


def test_a_part_of_an_experiment_has_the_runs_that_are_asked_for() -> None:
    runs = chosen_runs("ablations", ("chain4",), ("none", "quaternions"), 2, 50).runs
    assert {run.scene for run in runs} == {"chain4"} and {run.change for run in runs} == {"none", "quaternions"}
    assert {run.seed for run in runs} == {0, 1} and {run.updates for run in runs if run.design != "physics"} == {50}
    assert len(runs) == len(set(runs)) == 7, "of the paper's design with both, of ours as it is, and of physics"
    shorter = chosen_runs("data", (), (), 1, 50).runs
    assert len({run.name for run in shorter}) == len(shorter) == 9, "runs that differ in updates alone are one"


def test_a_second_run_in_a_folder_is_refused(tmp_path: Path) -> None:
    with only_one_in(tmp_path), pytest.raises(InputError, match="another run is in it"), only_one_in(tmp_path):
        pass
    with only_one_in(tmp_path):  # once the first one has ended
        pass


@pytest.mark.slow
def test_a_run_is_trained_once_and_judged_by_its_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "JUDGED", 6)
    experiment = chosen_runs("ablations", ("chain4",), ("unroll of 2 steps",), 1)._replace(windows=(10, 40))
    trained = TrialRunner(experiment, TINY, tmp_path, "ablations", time.monotonic() + 600.0)
    row = trained()
    assert row["sequences"] == 8 and row["judged"] == 6 and 0.0 < row["windows"]["10"]["chain"] < 20.0
    again = trained()  # from the last checkpoint, which is that of all updates
    assert again["windows"] == row["windows"] and again["seconds"] == row["seconds"]
    with pytest.raises(BudgetSpentError):
        TrialRunner(experiment, TINY, tmp_path, "ablations", time.monotonic() - 1.0)()
    slower = DESIGNS["paper"]._replace(recipe=replace(DESIGNS["paper"].recipe, learning_rate=1e-4))
    monkeypatch.setitem(DESIGNS, "paper", slower)
    with pytest.raises(InputError, match=r"made by is .*learning_rate=0.0001.*was begun with .*learning_rate=0.001"):
        trained()


def test_physics_alone_is_judged_without_a_training(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(runner, "JUDGED", 6)
    experiment = chosen_runs("data")._replace(windows=(10, 40))
    row = TrialRunner(experiment, experiment.runs[-1], tmp_path, "data", time.monotonic() + 600.0)()
    assert row["design"] == "physics" and row["windows"]["40"]["chain"] < 0.01 and row["seconds"] == 0.0
    assert not (tmp_path / "data" / experiment.runs[-1].name).exists()


def test_the_human_of_a_simulator_stands_while_it_tracks_squats() -> None:
    scores = tracked(Simulator.of_physics(scenario("any_human_alone").scene), (20, 60))
    assert scores["windows"]["20"]["human"] < 0.03 and scores["windows"]["60"]["human"] < 0.03
    assert scores["displacement_m"] < 1e-3 and scores["diverged"] == 0


def test_where_all_predictions_diverge_there_is_no_error(thrown: dict[str, Episodes]) -> None:
    given = thrown["chain4"]
    elsewhere = given.states + 2.0 * DIVERGED * (np.arange(given.steps + 1) > 0)[:, None, None]
    simulator = Simulator.of_physics(scenario("chain4").scene)
    scores = evaluate(simulator, given._replace(states=elsewhere), (10,))
    assert scores["diverged"] == scores["sequences"] == len(given.states)
    assert scores["windows"]["10"]["chain"] is scores["displacement_m"] is scores["rotation_rad"]["chain"] is None


def test_windows_within_which_a_tracking_diverges_have_no_error() -> None:
    scene = scenario("chain4").scene
    states = np.zeros((30, 4, packed.SIZE), np.float32)
    states[..., packed.ORIENTATION] = (1.0, 0.0, 0.0, 0.0)
    moved = states + np.eye(packed.SIZE, dtype=np.float32)[0] * 0.1
    scores = errors(scene, moved[:20], states, scene.morphology, (20, 30))
    assert scores["windows"]["20"]["chain"] == pytest.approx(0.1) and scores["windows"]["30"]["chain"] is None
    assert scores["diverged"] == 1 and scores["sequences"] == 1
    at_once = errors(scene, moved[:0], states, scene.morphology, (20, 30))
    assert at_once["displacement_m"] is None and at_once["windows"]["20"]["chain"] is None


Errors = dict[str, dict[str, float | None]]


def row_of(scene: str, change: str, seed: int, windows: Errors, **others: float) -> report.Row:
    of_both = {"design": "paper", "sequences": 8, "updates": UPDATES, "displacement_m": 0.001, "judged": 4}
    own = {"scene": scene, "change": change, "seed": seed, "windows": windows, "diverged": seed, "seconds": 60.0}
    return of_both | own | others


def test_tables_say_mean_and_spread_and_what_diverged() -> None:
    experiment = chosen_runs("ablations", ("chain4",), ("none", "12 layers"))._replace(windows=(10, 190))
    rows = [
        row_of("chain4", change, seed, {"10": {"chain": 0.01}, "190": {"chain": error}})
        for change, errors in (("none", (0.2, 0.4)), ("12 layers", (0.3, None))) for seed, error in enumerate(errors)
    ]  # fmt: skip
    (table,) = tables_of(experiment, rows)
    cells = [list(column.cells) for column in table.columns]
    assert cells[0] == ["paper", "paper, 12 layers"]
    assert cells[2] == ["0.3000 ± 0.1000", "diverged"] and cells[4] == ["12 %", "12 %"]
    assert cells[-1] == ["0.11 m", ""]
    (axes,) = picture(experiment, rows).axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["paper", "paper, 12 layers"]


def test_a_scene_has_a_table_of_its_own_and_a_column_of_each_kind_of_body() -> None:
    both: dict[str, float | None] = {"human": 0.1, "ball": 0.2}
    rows = [
        row_of("chains2", "none", 0, {str(n): {"first": 0.1, "second": 0.3} for n in (10, 40, 80, 190)}),
        row_of("human_ball", "none", 0, {str(n): both for n in (10, 38, 60)}),
    ]
    chains, humans = tables_of(EXPERIMENTS["ablations"], rows)
    assert [str(column.header) for column in chains.columns][1:5] == [f"{n} steps [m]" for n in (10, 40, 80, 190)]
    assert [list(column.cells) for column in chains.columns][1] == ["0.2000"]
    by_title = {str(column.header): list(column.cells) for column in humans.columns}
    assert by_title["human, 60 steps [m]"] == ["0.1000"] and by_title["ball, 60 steps [m]"] == ["0.2000"]


def test_physics_alone_is_drawn_among_runs_of_one_number_of_sequences() -> None:
    alone = row_of("chain4", "none", 0, {"190": {"chain": 0.1}}, sequences=0, updates=0) | {"design": "physics"}
    rows = [*(row_of("chain4", "none", seed, {"190": {"chain": 0.3}}) for seed in (0, 1)), alone]
    (axes,) = picture(EXPERIMENTS["ablations"], rows).axes
    assert [text.get_text() for text in axes.get_yticklabels()] == ["paper", "physics"]


def test_errors_are_drawn_over_data_and_over_minutes() -> None:
    numbers = ((1000, UPDATES, 60.0, 0.4), (4000, UPDATES, 70.0, 0.3), (4000, 12000, 240.0, 0.2))
    rows = [
        row_of("chain4", "none", seed, {"190": {"chain": error}}, sequences=count, updates=updates, seconds=seconds)
        for count, updates, seconds, error in numbers for seed in (0, 1)
    ]  # fmt: skip
    rows.append(row_of("chain4", "none", 0, {"190": {"chain": 0.1}}, sequences=0, updates=0) | {"design": "physics"})
    by_data, by_time = picture(EXPERIMENTS["data"]._replace(windows=(190,)), rows).axes
    assert list(np.asarray(by_data.lines[0].get_xdata())) == [1000, 4000]
    assert "physics alone" in by_data.get_legend_handles_labels()[1]
    assert list(np.asarray(by_time.lines[0].get_xdata())) == pytest.approx([70.0 / 60.0, 4.0])
    shorter = [row | {"updates": 50} for row in rows if row["updates"] == UPDATES]
    by_data, _ = picture(EXPERIMENTS["data"]._replace(windows=(190,)), shorter).axes
    assert list(np.asarray(by_data.lines[0].get_xdata())) == [1000, 4000], "whatever --updates is"


def timed(engine: str, substeps: int, batch: int, ms: float | None) -> report.Row:
    refused = None if ms else "is not installed"
    return {"engine": engine, "scene": "human", "reach": None, "substeps": substeps, "batch": batch,
            "gradient": False, "device": "cpu", "refused": refused, "ms_per_step": ms}  # fmt: skip


def test_speed_is_shown_beside_the_papers_in_milliseconds_and_in_simulated_seconds() -> None:
    rows = [timed("larp", 1, 1, 0.05), timed("larp", 1, 4096, 16.0), timed("mjwarp", 20, 1, None)]
    cells = [list(column.cells) for column in speed.speed_table(rows, (1, 4096)).columns]
    assert cells[0][:3] == ["LARP", "MuJoCo Warp 20", "LARP, the paper"]
    assert cells[2][:3] == ["0.05", "is not installed", "0.07"] and cells[3][:3] == ["16", "", "1.3"]
    cells = [list(column.cells) for column in speed.rate_table(rows, (1, 4096)).columns]
    assert cells[0][0] == "LARP" and cells[1][0] == "200" and cells[2][0] == "2.56e+03"
    assert cells[0][1] == "LARP, the paper", "what was refused has no rate"


@pytest.mark.parametrize("engine", ["networks", "networks bfloat16"])
def test_the_papers_networks_are_timed_at_their_own_size(engine: str) -> None:
    row = engines.answer(engines.Question(engine, "ball", None, 1, 2))
    assert row["refused"] is None and row["finite"] and row["ms_per_step"] > 0.0


@pytest.mark.skipif(find_spec("mujoco_warp") is not None, reason="MuJoCo Warp is installed, and compiles for minutes")
def test_without_mujoco_warp_its_row_says_so() -> None:
    assert (
        engines.answer(engines.Question("mjwarp", "ball", None, 20, 2))["refused"] == "is not installed (mujoco_warp)"
    )


def test_options_of_another_experiment_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="seeds is 2, but speed has no seeds: leave it out"):
        runner.main("speed", seeds=2, folder=tmp_path)
    with pytest.raises(InputError, match="batch is 1,8, but data has no batch: leave it out"):
        runner.main("data", batch="1,8", folder=tmp_path)


def test_a_speed_of_no_batch_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="batch is '0'"):
        runner.main("speed", batch="0", folder=tmp_path)

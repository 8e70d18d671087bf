"""Promises of all benchmarks: nothing is lost when they are cut off, and nothing tracked changes unasked."""

from __future__ import annotations

import json
import re
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from rich.table import Table

from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from mpc import CEM
from tasks.benchmarks import compilation, content, kick, realtime, report
from tasks.kick import Kick
from tasks.presets import PRESETS, Preset


class CutOffError(Exception):
    """Error that ends a run before its time."""


def jobs(done: list[int], until: int = 5) -> dict[str, partial[report.Row]]:
    """Five rows, each of which notes that it was computed; the run is cut off at `until`."""

    def one(number: int) -> report.Row:
        if number == until:
            raise CutOffError
        done.append(number)
        return {"number": number}

    return {f"row {number}": partial(one, number) for number in range(5)}


def test_a_run_that_was_cut_off_goes_on_where_it_was(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "some.json"
    done: list[int] = []
    with pytest.raises(CutOffError):
        report.collect(path, "python -m some", jobs(done, until=3))
    assert done == [0, 1, 2] and not path.exists()
    rows = report.collect(path, "python -m some", jobs(done))
    assert done == [0, 1, 2, 3, 4]
    assert [row["number"] for row in rows] == [0, 1, 2, 3, 4]
    assert "left" in capsys.readouterr().err
    report.write_json(path, {"rows": rows})
    assert [file.name for file in tmp_path.iterdir()] == ["some.json"]


@pytest.mark.parametrize("change", ["command", "version", "damage"])
def test_rows_of_another_kind_are_not_taken_over(change: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "some.json"
    done: list[int] = []
    report.collect(path, "python -m some", jobs(done))
    if change == "version":
        monkeypatch.setattr(report, "version", lambda: "another")
    if change == "damage":
        (tmp_path / "some.partial.json").write_text("{")
    report.collect(path, f"python -m {'other' if change == 'command' else 'some'}", jobs(done))
    assert done == 2 * [0, 1, 2, 3, 4]


def test_a_json_that_could_not_be_written_is_refused_before_anything_else(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="json needs the folder"):
        kick.main(json=tmp_path / "file" / "kick.json", weights=Path("nowhere.json"))


def test_results_are_published_only_where_the_project_lies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match="publish"):
        kick.main(publish=True, weights=Path("nowhere.json"))


def test_publishing_replaces_a_part_and_leaves_the_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    report.RESULTS.write_text("# Results\n")
    monkeypatch.setattr(report, "_git", lambda *arguments: "0123456789")
    table = Table("measure", "value")
    table.add_row("speed", "1")
    for name in ("one", "two", "one"):
        report.publish(name, name.title(), f"python -m {name}", table)
    text = report.RESULTS.read_text()
    assert text.count("## One") == text.count("## Two") == 1
    assert text.index("## One") < text.index("## Two")
    assert "| speed | 1 |" in text and not unsigned(text)


def test_of_several_tables_each_has_its_title(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    report.RESULTS.write_text("# Results\n")
    monkeypatch.setattr(report, "_git", lambda *arguments: "0123456789")
    report.publish("both", "One", "python -m both", Table("a", title="One"), Table("b", title="Two"))
    assert report.RESULTS.read_text().count("One") == 1 and "Two:\n\n| b |" in report.RESULTS.read_text()
    report.publish("both", "Both", "python -m both", Table("a", title="One"), Table("b", title="Two"))
    assert "## Both" in report.RESULTS.read_text() and "One:\n\n| a |" in report.RESULTS.read_text()


def unsigned(results: str) -> list[str]:
    """Return the names of published tables that do not say at which commit, and of what, they are."""
    parts = re.findall(r"<!-- (\S+) -->\n(.*?)<!-- end of \1 -->", results, re.DOTALL)
    assert len(parts) == results.count("\n## "), "every table is a published one"
    signed = re.compile(r"\nMeasured on .+, at commit [0-9a-f]{10}, with nothing learned\.\n$")
    return [name for name, text in parts if not signed.search(text)]


def test_every_published_table_names_its_commit_and_is_of_what_ships() -> None:
    results = (report.PROJECT / report.RESULTS).read_text()
    assert results.count("\n## ") >= 3 and not unsigned(results)
    assert unsigned(results.replace("nothing learned", "weights 0123abcd"))


def test_only_what_is_committed_and_ships_is_published(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    report.RESULTS.touch()
    with pytest.raises(InputError, match=r"weights is 'some\.json': results are those of what ships"):
        report.ready(tmp_path / "kick.json", publish=True, weights=Path("some.json"))
    monkeypatch.setattr(report, "_git", lambda *arguments: "M tasks/kick.py")
    with pytest.raises(InputError, match=r"tasks/kick\.py differs from what is committed"):
        report.ready(tmp_path / "kick.json", publish=True)


@pytest.mark.slow
def test_the_kick_benchmark_keeps_its_rows_and_touches_no_results(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    report.RESULTS.write_text("# Results\n")
    search = (CEM(samples=8, rounds=1, elites=2),)
    monkeypatch.setitem(PRESETS, "fast", Preset(search, search, interval=40, recovery=search))
    kick.main(targets=1, preset="fast", dynamics="mujoco", substeps=4)
    found = json.loads(Path("runs/benchmarks/kick_fast_mujoco_substeps_4.json").read_text())
    (row,) = found["rows"]
    assert row["limit_error_m"] == found["mean_limit_error_m"] != row["truth_error_m"]
    assert report.RESULTS.read_text() == "# Results\n"


@pytest.mark.slow
def test_the_benchmark_of_real_time_delays_the_same_kicks_and_counts_missed_deadlines(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    search = (CEM(samples=8, rounds=1, elites=2),)
    monkeypatch.setitem(PRESETS, "fast", Preset(search, search, interval=10, recovery=search))
    realtime.main(targets=1, delay=("0", "40"), dynamics=("mujoco",), substeps=4)
    content = json.loads(Path("runs/benchmarks/realtime_perfect_mujoco_substeps_4.json").read_text())
    instant, delayed = content["points"]
    assert instant["lead_ms"] == 0.0 and delayed["lead_ms"] == pytest.approx(40.0)
    assert instant["deadlines_missed"] == delayed["deadlines_missed"] == 0
    assert instant["prediction_error_m"] == 0.0 < delayed["prediction_error_m"] < 0.02
    one, other = content["rows"]
    assert one["target"] == other["target"] and one["truth_error_m"] != other["truth_error_m"]
    assert Path("runs/benchmarks/realtime_perfect_mujoco_substeps_4.png").is_file()
    points = {
        realtime.RealtimePoint(*(point[name] for name in realtime.RealtimePoint._fields)): point
        for point in content["points"]
    }
    settings = realtime.RealtimeSettings(1, 0, ("0",), ("fast",), ("mujoco",), (), 4, ("perfect",), ("none",), 0.0)
    columns = realtime.table_of(points, settings).columns
    assert all(column.header for column in columns) and [*columns[2].cells] == ["0 ms", "40 ms"]


def test_kicks_of_varied_humans_in_real_time_are_those_of_different_humans_and_expect_the_same_delays() -> None:
    settings = realtime.RealtimeSettings(
        2, 0, ("measured",), ("fast",), ("larp",), (), 4, ("lab",), ("filter",), 1.0, bodies="varied"
    )
    assert settings.name == "realtime_lab_rolling_1_bodies_varied_substeps_4"
    assert settings.command.endswith("--bodies varied")
    usual = realtime.Sessions(settings, Kick.standard())
    (point,) = settings.points()
    usual.times[point.dynamics, point.preset, point.interval] = [0.03]
    tall = usual.of_human(1.1 * np.asarray(usual.kick.scene.morphology))
    assert tall.seconds(point) == [0.03]
    assert tall.kick.scene.morphology[0, 0] > 1.05 * usual.kick.scene.morphology[0, 0]
    assert tall.kick.substeps == usual.kick.substeps


def test_a_planner_that_makes_no_deadline_has_a_row_that_says_so() -> None:
    settings = realtime.RealtimeSettings(1, 0, ("5000",), ("fast",), ("mujoco",), (), 4, ("perfect",), ("none",), 0.0)
    (point,) = settings.points()
    rows = [job() for job in realtime.jobs_of(settings, [point]).values()]
    figures = {point: realtime.point_figures(rows)}
    columns = realtime.table_of(figures, settings).columns
    (last,) = columns[-1].cells
    assert "plans take 500 steps, needs fewer than the planners' horizon" in str(last)
    assert realtime.picture(figures).axes[0].get_xlabel() == ""


@pytest.mark.parametrize("delay", ["-1", "soon", "nan", "inf"])
def test_delays_that_are_none_are_refused(tmp_path: Path, delay: str) -> None:
    with pytest.raises(InputError, match=f"delay is '{delay}', but must be measured, clock or a number of ms"):
        realtime.main(delay=(delay,), json=tmp_path / "some.json")


def test_many_bodies_have_neither_one_height_nor_one_budget(tmp_path: Path) -> None:
    for asked in ({"height": 1.6}, {"budget": 1.0}):
        with pytest.raises(InputError, match="bodies is 'varied', but height and budget are those of one body"):
            kick.main(json=tmp_path / "kick.json", bodies="varied", **asked)  # type: ignore[arg-type]


def test_the_cost_of_compiling_counts_a_loops_body_once_and_measures_all() -> None:
    def loop(value: jax.Array) -> jax.Array:
        return jax.lax.scan(lambda carry, _: (jnp.sin(carry) * 2.0, None), value, length=50)[0]

    row = compilation.cost(compilation.gradient_of(loop), (jnp.ones(4),))
    assert 4 < row["operations"] < 50 < row["hlo"]
    assert min(row["trace_s"], row["xla_s"], row["run_ms"]) > 0.0
    assert row["memory_mb"] >= 1e-6 * 4 * 4 * 50, "reverse mode keeps a number of each step"


def test_operations_are_counted_as_often_as_they_run_and_of_branches_the_larger() -> None:
    def program(matrix: jax.Array) -> Any:
        many = jax.lax.fori_loop(0, 10, lambda _, value: value @ value, matrix)
        return jax.lax.cond(matrix[0, 0] > 0.0, lambda: jnp.sin(many), lambda: jnp.sin(many) + many.T)

    matrix = jnp.eye(4)
    counts = 10 * 2 * 4**3, 1, 2 * 4**2
    assert sum(counts) <= content.arithmetic(jax.make_jaxpr(program)(matrix).jaxpr) <= sum(counts) + 20


def test_a_content_is_simulated_with_a_row_for_each_of_the_batch_and_stays_finite_in_mujoco() -> None:
    builds = content.courses(2)
    for name in ("4 balls, in touch", "chain of 4 links", "two humans, paired, apart"):
        scene, states, controls = builds[name]()
        assert states.shape == (2, len(scene.links), 13) and controls.shape[::2] == (2, len(scene.motors))
        after, ok = Truth(scene, 2, 5).rollout(states, controls[:, :10])
        assert ok.all() and np.isfinite(after).all()


def test_content_without_scenes_or_engine_steps_is_refused(tmp_path: Path) -> None:
    for name, ask in (("batch", partial(content.main, batch=0)), ("substeps", partial(content.main, substeps=0))):
        with pytest.raises(InputError, match=f"{name} is 0, but must be at least 1"):
            ask(json=tmp_path / "content.json")


def test_the_cost_of_compiling_nothing_is_refused(tmp_path: Path) -> None:
    for name, ask in (("batch", partial(compilation.main, batch=0)), ("steps", partial(compilation.main, steps=0))):
        with pytest.raises(InputError, match=f"{name} is 0, but must be at least 1"):
            ask(json=tmp_path / "some.json")

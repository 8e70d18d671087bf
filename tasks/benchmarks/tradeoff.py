"""What a kick's accuracy costs: truth error against planning time, over everything that a preset can say."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from larp_model import weights as stored
from larp_model.truth.mujoco import SUBSTEPS
from mpc import CEM, GaussNewton, Gradient, Optimizer
from tasks.benchmarks import report
from tasks.data import random_task
from tasks.kick import BEYOND, FLIGHT, WEIGHTS, Kick, models_of, planners_of, prepare, remember_compilations, run
from tasks.presets import PRESETS, Preset

# A preset moves where another point is so much better in both error and time.
BETTER = 0.1
FAMILIES = {
    "larp": ("LARP", "o", "#0072b2"),
    "gradient": ("LARP, with gradient steps", "s", "#009e73"),
    "verified": ("LARP, verified in MuJoCo", "D", "#d55e00"),
    "mujoco": ("MuJoCo as the model", "^", "#7f7f7f"),
}


@dataclass(frozen=True)
class Point:
    """A way to plan: a preset, and the model in which it plans with its engine steps, where it is MuJoCo."""

    preset: Preset
    dynamics: str = "larp"
    substeps: int = SUBSTEPS

    @property
    def family(self) -> str:
        """One of `FAMILIES`."""
        if self.dynamics == "mujoco":
            return "mujoco"
        if any(self.preset.verify):
            return "verified"
        stages = (*self.preset.first, *self.preset.again)
        return "gradient" if any(isinstance(each, Gradient) for each in stages) else "larp"

    @property
    def name(self) -> str:
        """Model, optimisers of the first plan and of each replan, steps between replans, rounds of trials in truth."""
        preset = self.preset
        model = "larp" if self.dynamics == "larp" else f"mujoco {self.substeps}"
        trials = f", trials {preset.verify[0]} / {preset.verify[1]}" if any(preset.verify) else ""
        return f"{model}: {_told(preset.first)} / {_told(preset.again)} every {preset.every}{trials}"


def _told(stage: Sequence[Optimizer]) -> str:
    """Candidates x rounds of CEM, steps x elites of gradients, rounds of Gauss-Newton by its directions."""

    def one(each: Optimizer) -> str:
        if isinstance(each, CEM):
            return f"{each.samples}x{each.rounds}"
        if isinstance(each, Gradient):
            return f"{each.steps} gradients of {each.elites}"
        assert isinstance(each, GaussNewton)
        return f"{each.rounds} steps of {each.directions} {each.jacobian}"

    return " + ".join(map(one, stage))


def cem(samples: int, rounds: int, elites: int) -> CEM:
    """Rounds of one size, because every size is compiled apart."""
    return CEM(samples=samples, rounds=rounds, elites=elites, decay=1.0)


def points() -> tuple[Point, ...]:
    """What is measured: the presets, and what lies around them, each once."""
    return tuple(dict.fromkeys((*map(Point, PRESETS.values()), *_around())))


def _around() -> Iterator[Point]:
    # More candidates, more rounds.
    for samples, rounds, elites in (
        (32, 4, 8), (32, 16, 8), (64, 2, 12), (64, 4, 12), (64, 8, 12), (64, 16, 12), (128, 2, 16),
        (128, 4, 16), (128, 8, 16), (256, 4, 24), (512, 4, 32),
    ):  # fmt: skip
        again = cem(max(2 * elites, samples // 2), max(1, rounds // 3), elites)
        yield Point(Preset((cem(samples, rounds, elites),), (again,), every=5))
    quick, few = cem(128, 4, 16), cem(64, 1, 16)
    wide, some = cem(256, 10, 24), cem(128, 3, 24)
    deep, deeper, rest = cem(64, 8, 12), cem(64, 16, 12), cem(32, 2, 12)
    # More replans.
    for every in (1, 2, 3, 8, 12):
        yield Point(Preset((quick,), (few,), every))
    yield Point(Preset((quick,), (cem(128, 2, 16),), every=5))
    for every, again in ((4, some), (8, some), (4, cem(128, 1, 24))):
        yield Point(Preset((wide,), (again,), every))
    # Gradients.
    for elites, steps in ((8, 4), (8, 8), (16, 8)):
        yield Point(Preset((quick, Gradient(steps=steps, elites=elites)), (few,), every=5))
    yield Point(Preset((quick,), (few, Gradient(steps=2, elites=8)), every=5))
    yield Point(Preset((Gradient(steps=16, elites=32),), (Gradient(steps=4, elites=32),), every=5))
    # Trials in the truth.
    for verify in ((1, 1), (2, 1), (4, 2)):
        yield Point(Preset((quick,), (few,), every=5, verify=verify))
    for first, every, verify in ((deep, 5, (2, 2)), (deep, 5, (4, 2)), (deeper, 2, (4, 2))):
        yield Point(Preset((first,), (rest,), every, verify))
    most = cem(512, 12, 32), Gradient(steps=16, elites=32)
    yield Point(Preset(most, (cem(256, 4, 32),), every=2, verify=(4, 2)))
    # MuJoCo as the model; at 20 engine steps the largest of these searches takes minutes a kick.
    sizes = (cem(64, 2, 12), cem(32, 1, 12)), (cem(128, 2, 16), few), (quick, few)
    for substeps, count in ((5, 3), (10, 3), (20, 2)):
        for first, again in sizes[:count]:
            yield Point(Preset((first,), (again,), every=5), "mujoco", substeps)


def measure(kick: Kick, point: Point, weights: Path, targets: int, seed: int) -> report.Row:
    """Kicks to the first `targets` random targets of a seed, without the standing that follows them."""
    models = models_of(kick.scene, point.dynamics, weights, substeps=point.substeps)  # type: ignore[arg-type]
    planners = planners_of(kick, point.preset, models)
    random, kicks = np.random.default_rng(seed), []
    for index in range(targets):
        target, shift = random_task(random)
        steps = kick.reference.strike + BEYOND + FLIGHT
        execution = kick.run(planners, target, seed + index, kick.start(shift), steps, stands=False)
        spent = sum(replan.info.seconds for replan in kick.plans(execution))
        kicks.append(kick.report(execution, target) | {"planning_seconds": spent})
    jax.clear_caches()  # the next point's programs are others, and each holds its memory
    errors = np.array([each["truth_error_m"] for each in kicks])
    return {
        "point": point.name,
        "family": point.family,
        "mean_truth_error_m": float(errors.mean()),
        "standard_error_m": float(errors.std(ddof=1) / np.sqrt(len(errors))) if len(errors) > 1 else None,
        "median_truth_error_m": float(np.median(errors)),
        "planning_seconds": float(np.mean([each["planning_seconds"] for each in kicks])),
        "plan_seconds": float(np.mean([each["plan_seconds"] for each in kicks])),
        "replan_ms": float(np.median([each["replan_ms"]["p50"] for each in kicks])),
        "compile_seconds": float(sum(each["compile_seconds"] for each in kicks)),
        "truth_rollouts": float(np.mean([each["truth_rollouts"] for each in kicks])),
        "truth_errors_m": errors.tolist(),
    }


def front(rows: Sequence[report.Row]) -> list[report.Row]:
    """The rows that no other one beats in both mean error and planning time, the quickest first."""
    best, found = np.inf, []
    for row in sorted(rows, key=lambda row: (row["planning_seconds"], row["mean_truth_error_m"])):
        if row["mean_truth_error_m"] < best:
            best = row["mean_truth_error_m"]
            found.append(row)
    return found


def beaten(row: report.Row, rows: Sequence[report.Row]) -> list[report.Row]:
    """The rows that are better than this one by more than `BETTER` in both mean error and planning time."""
    figures = ("planning_seconds", "mean_truth_error_m")
    return [other for other in rows if all(other[each] < (1.0 - BETTER) * row[each] for each in figures)]


def picture(rows: Sequence[report.Row], presets: dict[str, str], targets: int) -> Figure:
    """Every point, the front, and the presets, by name."""
    figure = Figure(figsize=(9, 5.5), layout="constrained")
    axes = figure.subplots()
    best = front(rows)
    axes.step(
        [row["planning_seconds"] for row in best],
        [100 * row["mean_truth_error_m"] for row in best],
        where="post", color="0.75", linewidth=2, zorder=1, label="front",
    )  # fmt: skip
    for family, (label, marker, colour) in FAMILIES.items():
        chosen = [row for row in rows if row["family"] == family]
        axes.errorbar(
            [row["planning_seconds"] for row in chosen],
            [100 * row["mean_truth_error_m"] for row in chosen],
            [100 * (row["standard_error_m"] or 0.0) for row in chosen],
            fmt=marker, markersize=5, elinewidth=0.6, color=colour, alpha=0.8, label=label, zorder=2,
        )  # fmt: skip
    for row in rows:
        if row["point"] in presets:
            place = row["planning_seconds"], 100 * row["mean_truth_error_m"]
            axes.plot(*place, "o", markersize=14, markerfacecolor="none", markeredgecolor="black", zorder=3)
            axes.annotate(
                presets[row["point"]], place, xytext=(9, 9), textcoords="offset points", fontsize=11, weight="bold"
            )
    axes.set(
        xscale="log", yscale="log", xlabel="planning time of a whole kick [s]", ylabel="mean miss in MuJoCo [cm]",
        title=f"Speed against accuracy: {len(rows)} ways to plan, {targets} kicks each, bars: standard error",
    )  # fmt: skip
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter(lambda value, _: f"{value:g}")
    axes.grid(alpha=0.3, which="both")
    axes.legend(frameon=False)
    return figure


def table_of(rows: Sequence[report.Row], presets: dict[str, str]) -> Table:
    """A row a point, the quickest first; what is on the front and which preset it is."""
    best = [row["point"] for row in front(rows)]
    table = Table(
        "point: first plan / replans", "error, mean +- standard error", "median", "planning", "first plan", "replan",
        "truth rollouts", "front", title="Speed against accuracy",
    )  # fmt: skip
    for row in sorted(rows, key=lambda row: row["planning_seconds"]):
        preset = f"**{presets[row['point']]}** " if row["point"] in presets else ""
        spread = f" +- {row['standard_error_m']:.3f}" if row["standard_error_m"] is not None else ""
        table.add_row(
            preset + row["point"], f"{row['mean_truth_error_m']:.3f}{spread} m", f"{row['median_truth_error_m']:.3f} m",
            f"{row['planning_seconds']:.2f} s", f"{row['plan_seconds']:.2f} s", f"{row['replan_ms']:.0f} ms",
            f"{row['truth_rollouts']:.0f}", "yes" if row["point"] in best else "",
        )  # fmt: skip
    return table


def main(
    targets: int = 16,
    seed: int = 3,
    json: Path = Path("runs/benchmarks/tradeoff.json"),
    weights: Path = stored.SHIPPED / f"{WEIGHTS}.json",
    publish: bool = False,
) -> None:
    """Measure truth error and planning time of many ways to plan, and where the presets stand among them.

    Args:
        targets: kicks a point; the same for all.
        seed: of targets, ball spots and planner.
        json: where the figures go; the picture goes beside them.
        weights: manifest of the weights of the learned model.
        publish: put the table into RESULTS.md and the picture into docs/.
    """
    if targets < 1:
        raise ValueError(f"targets is {targets}, but must be at least 1")
    report.ready(json, publish)
    remember_compilations()
    kick = prepare()
    command = f"python -m tasks.benchmarks.tradeoff --targets {targets} --seed {seed}"
    jobs = {point.name: partial(measure, kick, point, weights, targets, seed) for point in points()}
    rows = report.collect(json, command, jobs)
    presets = {Point(preset).name: name for name, preset in PRESETS.items()}
    better = {
        presets[row["point"]]: [other["point"] for other in beaten(row, rows)]
        for row in rows
        if row["point"] in presets
    }
    content: dict[str, Any] = {"command": command, "hardware": report.hardware(), "better_than_presets": better}
    report.write_json(json, content | {"rows": rows})
    report.write_picture(json.with_suffix(".png"), picture(rows, presets, targets))
    table = table_of(rows, presets)
    report.show(table)
    for name, others in better.items():
        if others:
            print(f"{name} is beaten by more than {100 * BETTER:.0f} % in both error and time by: {'; '.join(others)}")
    if publish:
        report.write_picture(report.PICTURES / "tradeoff.png", picture(rows, presets, targets))
        report.publish("tradeoff", f"Speed against accuracy, {targets} kicks a point", command, table)


if __name__ == "__main__":
    run(main)

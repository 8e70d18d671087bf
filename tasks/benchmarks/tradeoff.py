"""Trade-off of a kick's accuracy and planning time, over a range of presets."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from larp_model.engines.mujoco import SUBSTEPS
from larp_model.errors import InputError
from mpc import CEM, MPPI, Fallback, GaussNewton, Gradient, Optimizer
from tasks.benchmarks import report
from tasks.command import prepare_jax, run
from tasks.kick import Kick
from tasks.models import FLIGHT, DynamicsName
from tasks.presets import FIRST_TOLERANCE, PRESETS, Preset
from tasks.run import plans_of, summary_of
from tasks.session import Session
from tasks.targets import random_kick
from tasks.task import BEYOND

# Share by which another point must be better in both error and time to beat a preset.
BETTER = 0.1
FAMILIES = {
    "sampling": ("LARP, sampling", "o", "#0072b2"),
    "gradient": ("LARP, Gauss-Newton or gradients", "s", "#009e73"),
    "verified": ("LARP, verified in MuJoCo", "D", "#d55e00"),
    "mujoco": ("MuJoCo as the model", "^", "#7f7f7f"),
}


@dataclass(frozen=True)
class Point:
    """A planner's configuration: a preset, its dynamics, and the engine steps of these where they are MuJoCo."""

    preset: Preset
    dynamics: DynamicsName = "larp"
    substeps: int = SUBSTEPS

    @property
    def family(self) -> str:
        """Return the key in `FAMILIES` that this point belongs to."""
        if self.dynamics == "mujoco":
            return "mujoco"
        if any(self.preset.verify):
            return "verified"
        stages = (*self.preset.first, *self.preset.replan)
        return "gradient" if any(isinstance(optimizer, GaussNewton | Gradient) for optimizer in stages) else "sampling"

    @property
    def name(self) -> str:
        """Return a name: model, optimisers of first plan and replans, steps between replans, feedback, validation."""
        preset = self.preset
        model = "larp" if self.dynamics == "larp" else f"mujoco {self.substeps}"
        feedback, validation = ", feedback" if preset.feedback else "", ""
        if any(preset.verify):
            validation = ", trials {} / {} of {} to {:g} mm by {}".format(
                *preset.verify, preset.candidates, 1e3 * preset.tolerance, _text_of((preset.correct,))
            )
        stages = f"{_text_of(preset.first)} / {_text_of(preset.replan)} every {preset.interval}"
        return f"{model}: {stages}{feedback}{validation}"


def _text_of(stage: Sequence[Optimizer]) -> str:
    """Return the optimisers as text.

    Sampling: samples x rounds. Gradients: elites x steps. Gauss-Newton: directions x rounds, and its derivatives.
    """

    def one(optimizer: Optimizer) -> str:
        match optimizer:
            case CEM():
                return f"CEM {optimizer.samples}x{optimizer.rounds}"
            case MPPI():
                return f"MPPI {optimizer.samples}x{optimizer.rounds}"
            case Gradient():
                return f"RMSprop {optimizer.elites}x{optimizer.steps}"
            case GaussNewton():
                slopes = "forward" if optimizer.jacobian == "forward" else f"step {optimizer.step:g}"
                return f"GN {optimizer.directions}x{optimizer.rounds} {slopes}"
            case Fallback():
                return f"if astray {_text_of(optimizer.optimizers)}"
        raise InputError(f"optimizer is {optimizer}, but must be one that has a name here")

    return " + ".join(map(one, stage)) or "nothing"


def cem(samples: int, rounds: int, elites: int) -> CEM:
    """Return a CEM whose rounds all have the same size, because every size is compiled separately."""
    return CEM(samples=samples, rounds=rounds, elites=elites, decay=1.0)


def points() -> tuple[Point, ...]:
    """Return the points to measure: the presets and variations around them, each once."""
    families = _sampling, _gauss_newton, _exact, _replans, _feedback, _combinations, _validated, _mujoco
    variations = (point for family in families for point in family())
    return tuple(dict.fromkeys((*map(Point, PRESETS.values()), *variations)))


# Optimisers that several points share.
NEVER = 1000  # steps between replans, longer than a kick
ONCE, TWICE, FOUR, SIX = (GaussNewton(rounds=rounds) for rounds in (1, 2, 4, 6))
FEW = cem(16, 5, 8)


def _larp(*first: Optimizer, replan: Optimizer = ONCE, interval: int = 5, **fields: Any) -> Point:
    return Point(Preset(first, (replan,), interval, **fields))


def _sampling() -> Iterator[Point]:
    for samples, rounds, elites in ((32, 4, 8), (32, 16, 8), (64, 8, 12), (64, 32, 12)):
        replan = cem(max(2 * elites, samples // 2), max(1, rounds // 3), elites)
        yield _larp(cem(samples, rounds, elites), replan=replan)
    yield _larp(MPPI(samples=64, rounds=16), replan=MPPI(samples=32, rounds=5))


def _gauss_newton() -> Iterator[Point]:
    """Yield points of other rounds and directions, and step of the differences."""
    for rounds, directions in ((1, 24), (2, 24), (4, 24), (9, 24), (24, 24), (9, 16)):
        replan = GaussNewton(rounds=1, directions=directions)
        yield _larp(GaussNewton(rounds=rounds, directions=directions), replan=replan)
    yield _larp(GaussNewton(rounds=9, step=0.1), replan=GaussNewton(rounds=1, step=0.1))


def _exact() -> Iterator[Point]:
    """Yield points with derivatives of the model: throughout, in the first plan, and where that did not converge."""
    once = GaussNewton(rounds=1, jacobian="forward")
    yield _larp(GaussNewton(rounds=6, jacobian="forward"), replan=once)
    for rounds in (4, 8):
        yield _larp(GaussNewton(rounds=rounds, jacobian="forward"), interval=4, feedback=True)
    for name in ("fast", "balanced"):
        preset = PRESETS[name]
        astray = Fallback(FIRST_TOLERANCE, (GaussNewton(rounds=4, jacobian="forward"),))
        yield Point(replace(preset, first=(preset.first[0], astray)))


def _replans() -> Iterator[Point]:
    """Yield points of other steps between replans, and of other optimisers of replans."""
    for interval in (1, 3, 8, 12):
        yield _larp(SIX, interval=interval)
    for replan in (TWICE, FEW):
        yield _larp(SIX, replan=replan)


def _feedback() -> Iterator[Point]:
    """Yield points with feedback, of other steps between replans, and of other first plans."""
    for interval in (1, 4, 8, NEVER):
        yield _larp(SIX, interval=interval, feedback=True)
    for first in (TWICE, FOUR):
        yield _larp(first, interval=4, feedback=True)


def _combinations() -> Iterator[Point]:
    """Yield points of Gauss-Newton after sampling, and of reverse gradients."""
    yield _larp(cem(32, 8, 8), SIX)
    yield _larp(Gradient(steps=16, elites=8), replan=Gradient(steps=2, elites=8))


def _validated() -> Iterator[Point]:
    """Yield points whose plans are validated in the ground truth."""
    for verify, tolerance in (((2, 1), 0.004), ((8, 1), 0.004), ((8, 3), 0.01)):
        yield _larp(SIX, verify=verify, tolerance=tolerance)
    yield _larp(SIX, verify=(8, 3), candidates=2)
    yield _larp(SIX, verify=(8, 3), interval=12)
    replan = cem(32, 2, 12)
    yield _larp(cem(64, 8, 12), replan=replan, verify=(2, 2), correct=cem(128, 2, 16), candidates=8, tolerance=0.0)


def _mujoco() -> Iterator[Point]:
    """Yield points whose model is MuJoCo."""
    for substeps in (5, 20):
        for first in (TWICE, SIX):
            yield Point(Preset((first,), (ONCE,), interval=5), "mujoco", substeps)
    yield Point(Preset((cem(64, 8, 12),), (FEW,), interval=5), "mujoco", 5)


def measure(kick: Kick, point: Point, weights: Path | None, targets: int, seed: int) -> report.Row:
    """Measure kicks to the first `targets` random targets of a seed, without the standing phase after them."""
    session = Session(kick, point.dynamics, weights, point.substeps)
    planners = session.planners(point.preset)
    random, kicks = np.random.default_rng(seed), []
    for index in range(targets):
        target, shift = random_kick(random)
        steps = kick.reference.strike + BEYOND + FLIGHT
        execution = session.execute(planners, target, seed + index, kick.start(shift), steps, recovers=False)
        plans = [plan.info for plan in plans_of(execution)]
        figures = summary_of(kick, execution, target)
        spent = sum(info.seconds for info in plans) + figures["feedback_seconds"]
        kicks.append(figures | {"planning_seconds": spent, "first_cost": plans[0].cost})
    jax.clear_caches()  # the next point compiles other programs, and each occupies memory
    errors = np.array([kick_figures["truth_error_m"] for kick_figures in kicks])
    return {
        "point": point.name,
        "family": point.family,
        "mean_truth_error_m": float(errors.mean()),
        "standard_error_m": float(errors.std(ddof=1) / np.sqrt(len(errors))) if len(errors) > 1 else None,
        "median_truth_error_m": float(np.median(errors)),
        "first_cost": float(np.mean([kick_figures["first_cost"] for kick_figures in kicks])),
        "planning_seconds": float(np.mean([kick_figures["planning_seconds"] for kick_figures in kicks])),
        "plan_seconds": float(np.mean([kick_figures["plan_seconds"] for kick_figures in kicks])),
        "replan_ms": float(np.median([kick_figures["replan_ms"]["p50"] for kick_figures in kicks])),
        "compile_seconds": float(sum(kick_figures["compile_seconds"] for kick_figures in kicks)),
        "truth_rollouts": float(np.mean([kick_figures["truth_rollouts"] for kick_figures in kicks])),
        "truth_errors_m": errors.tolist(),
    }


def front(rows: Sequence[report.Row]) -> list[report.Row]:
    """Return the Pareto front of mean error and planning time, the quickest row first."""
    best, best_rows = np.inf, []
    for row in sorted(rows, key=lambda row: (row["planning_seconds"], row["mean_truth_error_m"])):
        if row["mean_truth_error_m"] < best:
            best = row["mean_truth_error_m"]
            best_rows.append(row)
    return best_rows


def beaten(row: report.Row, rows: Sequence[report.Row]) -> list[report.Row]:
    """Return the rows that are better than this one by more than `BETTER` in both mean error and planning time."""
    figures = ("planning_seconds", "mean_truth_error_m")
    return [other for other in rows if all(other[figure] < (1.0 - BETTER) * row[figure] for figure in figures)]


def picture(rows: Sequence[report.Row], presets: dict[str, str], targets: int) -> Figure:
    """Plot every point, the Pareto front, and the presets by name."""
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
    """Return a table with one row per point, the quickest first; presets and points on the front are marked."""
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
    weights: Path | None = None,
    publish: bool = False,
) -> None:
    """Measure error and planning time of many ways to plan, and where the presets stand among them.

    Args:
        targets: kicks a point; the same for all.
        seed: of targets, ball spots and planner.
        json: where the figures go; the picture goes beside them.
        weights: manifest of weights that correct larp's physics; none by default.
        publish: put the table into RESULTS.md and the picture into docs/.
    """
    if targets < 1:
        raise InputError(f"targets is {targets}, but must be at least 1")
    report.ready(json, publish, weights)
    prepare_jax()
    kick = Kick.standard()
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

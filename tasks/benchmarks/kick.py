"""Misses of planned kicks to random targets, executed in MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from larp_model.anatomy import Detail
from larp_model.engines.mujoco import FINE_SUBSTEPS
from larp_model.errors import InputError
from tasks.benchmarks import report
from tasks.command import prepare_jax, run
from tasks.episodes.people import random_people
from tasks.kick import USUAL, Kick
from tasks.models import DynamicsName
from tasks.presets import PresetName, preset_of
from tasks.run import replayed, summary_of
from tasks.session import Planners, Session
from tasks.targets import random_kick, random_roll
from tasks.task import HEIGHT

WITHIN = (0.1, 0.25, 0.5)


@dataclass(frozen=True)
class KickSettings:
    """Settings of a run that its figures depend on; see the arguments of `main`."""

    targets: int
    seed: int
    preset: PresetName
    dynamics: DynamicsName
    weights: Path | None
    reference: Path | None
    height: float
    bodies: Literal["usual", "varied"]
    body: Detail
    self_contact: bool
    rolling: float
    budget: float | None
    substeps: int

    def check(self) -> None:
        """Raise InputError if a setting is invalid, or two of them contradict each other."""
        if self.targets < 1:
            raise InputError(f"targets is {self.targets}, but must be at least 1")
        preset_of(self.preset)
        if self.bodies == "varied" and (self.height != HEIGHT or self.budget is not None):
            raise InputError("bodies is 'varied', but height and budget are those of one body")
        if not (np.isfinite(self.rolling) and self.rolling >= 0.0):
            raise InputError(f"rolling is {self.rolling}, but must be a finite speed of at least 0 m/s")

    @property
    def variant(self) -> dict[str, str]:
        """Return the options that differ from the usual, with their values as text."""
        options = {
            "reference": self.reference.stem if self.reference else "",
            "height": f"{self.height:g}" if self.height != HEIGHT else "",
            "bodies": self.bodies if self.bodies != "usual" else "",
            "body": self.body if self.body != "lean" else "",
            "self_contact": "on" if self.self_contact else "",
            "rolling": f"{self.rolling:g}" if self.rolling else "",
            "budget": f"{self.budget:g}" if self.budget is not None else "",
            "substeps": f"{self.substeps}" if self.substeps != FINE_SUBSTEPS else "",
        }
        return {option: value for option, value in options.items() if value}

    @property
    def name(self) -> str:
        """Return the name of the run's JSON and of its part of RESULTS.md."""
        variant = (f"{option}_{value}" for option, value in self.variant.items())
        return "_".join(["kick", self.preset, self.dynamics, *variant])

    @property
    def title(self) -> str:
        """Return the title of the picture and of the table."""
        variant = (f"{option} {value}" for option, value in self.variant.items())
        return ", ".join([f"Kick: {self.preset}", self.dynamics, *variant])

    @property
    def command(self) -> str:
        """Return the command that repeats the run."""
        flags = {
            "reference": f"--reference {self.reference.name if self.reference else ''}",
            "self_contact": "--self-contact",
        }
        variant = (flags.get(option, f"--{option} {value}") for option, value in self.variant.items())
        planned = f"--targets {self.targets} --seed {self.seed} --preset {self.preset} --dynamics {self.dynamics}"
        return " ".join([f"python -m tasks.benchmarks.kick {planned}", *variant])

    def task(self) -> Kick:
        """Return the kick of a human of the usual sizes, or of this height."""
        return Kick.standard(
            self.reference, self.height, body=self.body, self_contact=self.self_contact, substeps=self.substeps
        )


def figures_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a set of kicks."""
    truth = np.array([row["truth_error_m"] for row in rows])
    limit = np.array([row["limit_error_m"] for row in rows])
    halved = np.array([row["halved_error_m"] for row in rows])
    replan_medians = np.array([row["replan_ms"]["p50"] for row in rows])
    replan_p99 = np.array([row["replan_ms"]["p99"] for row in rows])
    return {
        "mean_truth_error_m": float(truth.mean()),
        "median_truth_error_m": float(np.median(truth)),
        "p90_truth_error_m": float(np.quantile(truth, 0.9)),
        "mean_limit_error_m": float(limit.mean()),
        "median_limit_error_m": float(np.median(limit)),
        "p95_limit_error_m": float(np.quantile(limit, 0.95)),
        "mean_halved_error_m": float(halved.mean()),
        "median_halved_error_m": float(np.median(halved)),
        "p95_halved_error_m": float(np.quantile(halved, 0.95)),
        "success": {str(reach): float((truth <= reach).mean()) for reach in WITHIN},
        "mean_model_error_m": float(np.mean([row["model_error_m"] for row in rows])),
        "mean_gap_m": float(np.mean([abs(row["truth_error_m"] - row["model_error_m"]) for row in rows])),
        "mean_reference_deviation_m": float(np.mean([row["reference_deviation_m"] for row in rows])),
        "touched": int(sum(row["touched"] for row in rows)),
        "falls": int(sum(row["fell"] for row in rows)),
        "mean_plan_seconds": float(np.mean([row["plan_seconds"] for row in rows])),
        "replan_ms": {"p50": float(np.median(replan_medians)), "p99": float(replan_p99.max())},
        "mean_feedback_seconds": float(np.mean([row["feedback_seconds"] for row in rows])),
        "compile_seconds": float(sum(row["compile_seconds"] for row in rows)),
        "truth_rollouts": int(sum(row["truth_rollouts"] for row in rows)),
    }


def picture(rows: list[dict[str, Any]], title: str) -> Figure:
    """Plot the targets coloured by miss, and the misses in MuJoCo against those that the model expected."""
    figure = Figure(figsize=(12, 5), layout="constrained")
    figure.suptitle(title)
    above, gap = figure.subplots(1, 2)
    targets = np.array([row["target"] for row in rows])
    truth = 100 * np.array([row["truth_error_m"] for row in rows])
    model = 100 * np.array([row["model_error_m"] for row in rows])
    points = above.scatter(targets[:, 0], targets[:, 1], c=truth, s=60 + 120 * targets[:, 2], cmap="viridis")
    figure.colorbar(points, ax=above, label="missed by, in MuJoCo [cm]")
    above.scatter(0.0, 0.0, marker="+", c="black", s=80)
    above.set(
        xlabel="forwards [m]", ylabel="to the left [m]", title="targets from above, larger: higher", aspect="equal"
    )
    largest = max(truth.max(), model.max()) * 1.05
    gap.plot([0, largest], [0, largest], color="0.7", linewidth=1)
    gap.scatter(model, truth, color="#0072b2")
    gap.set(
        xlabel="miss the model expected [cm]", ylabel="miss in MuJoCo [cm]", title="model and truth", aspect="equal"
    )
    return figure


def main(
    targets: int = 16,
    seed: int = 0,
    preset: PresetName = "balanced",
    dynamics: DynamicsName = "larp",
    json: Path | None = None,
    weights: Path | None = None,
    reference: Path | None = None,
    height: float = HEIGHT,
    bodies: Literal["usual", "varied"] = "usual",
    body: Detail = "lean",
    self_contact: bool = False,
    rolling: float = 0.0,
    budget: float | None = None,
    substeps: int = FINE_SUBSTEPS,
    publish: bool = False,
) -> None:
    """Plan and execute kicks to random targets.

    Args:
        targets: how many kicks.
        seed: of targets, ball spots and planner.
        preset: fast, balanced or accurate.
        dynamics: the planner's model: larp or mujoco.
        json: where the figures go; the picture goes beside them.
        weights: manifest of weights that correct larp's physics; none by default.
        reference: a captured kick (BVH) instead of the embedded one.
        height: of the human [m].
        bodies: varied: every kick is another human's, of any size.
        body: lean: 13 links; full: 26, with a spine, hands and toes.
        self_contact: let one leg touch the other.
        rolling: greatest speed [m/s] of a ball that comes from ahead or from the kicking side; 0: it rests.
        budget: seconds for the first plan, and a fifth of them for each replan; the preset is scaled to fit.
        substeps: engine steps of the ground truth in a step of 10 ms, where plans are validated and executed.
        publish: put the table into RESULTS.md.
    """
    settings = KickSettings(
        targets, seed, preset, dynamics, weights, reference, height, bodies, body, self_contact, rolling, budget,
        substeps,
    )  # fmt: skip
    settings.check()
    json = json or Path(f"runs/benchmarks/{settings.name}.json")
    report.ready(json, publish, weights)
    prepare_jax()
    rows = report.collect(json, settings.command, jobs_of(settings))
    figures = figures_of(rows)
    content = {"command": settings.command, "hardware": report.hardware(), **figures, "rows": rows}
    report.write_json(json, content)
    report.write_picture(json.with_suffix(".png"), picture(rows, settings.title))
    table = table_of(figures, settings)
    report.show(table)
    if publish:
        report.publish(settings.name, f"{settings.title}, {targets} targets", settings.command, table)


def jobs_of(settings: KickSettings) -> dict[str, Callable[[], report.Row]]:
    """Return the jobs that plan and execute one kick each, by name; the targets are drawn at once."""
    usual = settings.task()
    people = random_people(np.random.default_rng((settings.seed, 1)), usual.scene, settings.targets)
    shared = Planned.of(usual, settings) if settings.bodies == "usual" else None
    random = np.random.default_rng(settings.seed)

    def one(index: int, target: np.ndarray, shift: np.ndarray, roll: np.ndarray) -> report.Row:
        if shared is not None:
            return kick_row(shared, settings, index, target, shift, roll)
        scene = usual.scene.sized(people[index])
        own = Planned.of(Kick.of(scene, settings.reference, substeps=settings.substeps), settings)
        return kick_row(own, settings, index, target, shift, roll)

    jobs: dict[str, Callable[[], report.Row]] = {}
    for index in range(settings.targets):
        target, shift = random_kick(random)
        roll = random_roll(random, settings.rolling) if settings.rolling else np.zeros(2)
        jobs[f"kick {index}"] = partial(one, index, target, shift, roll)
    return jobs


class Planned(NamedTuple):
    """Session of a kick with its planners."""

    session: Session
    planners: Planners

    @classmethod
    def of(cls, kick: Kick, settings: KickSettings) -> Planned:
        """Return a session with the planners of the preset, scaled to the budget if there is one."""
        session, preset = Session(kick, settings.dynamics, settings.weights), preset_of(settings.preset)
        fitting = preset if settings.budget is None else session.within(preset, settings.budget, USUAL)
        return cls(session, session.planners(fitting))


def kick_row(
    planned: Planned, settings: KickSettings, index: int, target: np.ndarray, shift: np.ndarray, roll: np.ndarray
) -> report.Row:
    """Return the row of a kick: its summary, and the miss at twice the engine steps.

    target: (3,) [m]. shift: of the ball (2,) [m]. roll: its velocity (2,) [m/s].
    """
    session, kick, seed = planned.session, planned.session.task, settings.seed + index
    execution = session.execute(planned.planners, target, seed, kick.start(shift, roll))
    return summary_of(kick, execution, target) | {
        "halved_error_m": replayed(kick, execution, target, 2 * settings.substeps),
        "preset": settings.preset,
        "dynamics": settings.dynamics,
        "weights": session.models.weights,
        "seed": seed,
        "ball_shift": shift.tolist(),
        "ball_velocity": roll.tolist(),
    }


def table_of(figures: dict[str, Any], settings: KickSettings) -> Table:
    """Return a table with one line per figure of `figures_of`."""

    def three(figure: str) -> str:
        return ", ".join(f"{figures[f'{which}_{figure}']:.3f} m" for which in ("mean", "median", "p95"))

    table = Table("measure", "value", title=settings.title)
    for measure, value in (
        ("mean truth error", f"{figures['mean_truth_error_m']:.3f} m"),
        ("median, 90th percentile", f"{figures['median_truth_error_m']:.3f} m, {figures['p90_truth_error_m']:.3f} m"),
        *(
            (f"replayed at {steps} engine steps: mean, median, 95th percentile", three(f"{which}_error_m"))
            for steps, which in ((FINE_SUBSTEPS, "limit"), (2 * settings.substeps, "halved"))
        ),
        *((f"within {reach} m", f"{100 * figures['success'][str(reach)]:.0f} %") for reach in WITHIN),
        ("mean model error", f"{figures['mean_model_error_m']:.3f} m"),
        ("mean gap between truth and model", f"{figures['mean_gap_m']:.3f} m"),
        ("mean distance from the reference", f"{figures['mean_reference_deviation_m']:.3f} m"),
        ("ball touched", f"{figures['touched']} of {settings.targets}"),
        ("fell within 2 s", f"{figures['falls']} of {settings.targets}"),
        ("first plan", f"{figures['mean_plan_seconds']:.2f} s"),
        ("feedback, once", f"{figures['mean_feedback_seconds']:.2f} s"),
        ("replan, p50 and p99", f"{figures['replan_ms']['p50']:.0f} ms, {figures['replan_ms']['p99']:.0f} ms"),
        ("compilation, where the cache did not have it", f"{figures['compile_seconds']:.0f} s"),
        ("truth rollouts asked for by the planner", str(figures["truth_rollouts"])),
    ):
        table.add_row(measure, value)
    return table


if __name__ == "__main__":
    run(main)

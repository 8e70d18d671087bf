"""Misses of planned kicks to random targets, executed in MuJoCo."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any, Literal

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
from tasks.run import replayed, summarize
from tasks.sensing import noisy
from tasks.session import Planners, Session
from tasks.targets import random_kick, random_roll
from tasks.task import HEIGHT

WITHIN = (0.1, 0.25, 0.5)


def summarise(rows: list[dict[str, Any]]) -> dict[str, Any]:
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
    noise: bool = False,
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
        noise: show the planner the state with sensing noise.
        budget: seconds for the first plan, and a fifth of them for each replan; the preset is scaled to fit.
        substeps: engine steps of the truth in each of the 10 ms, where plans are tried and executed.
        publish: put the table into RESULTS.md.
    """
    if targets < 1:
        raise InputError(f"targets is {targets}, but must be at least 1")
    chosen = preset_of(preset)
    if bodies == "varied" and (height != HEIGHT or budget is not None):
        raise InputError("bodies is 'varied', but height and budget are those of one body")
    if not (np.isfinite(rolling) and rolling >= 0.0):
        raise InputError(f"rolling is {rolling}, but must be a finite speed of at least 0 m/s")
    variant = {
        "reference": reference.stem if reference else "",
        "height": f"{height:g}" if height != HEIGHT else "",
        "bodies": bodies if bodies != "usual" else "",
        "body": body if body != "lean" else "",
        "self_contact": "on" if self_contact else "",
        "rolling": f"{rolling:g}" if rolling else "",
        "noise": "on" if noise else "",
        "budget": f"{budget:g}" if budget is not None else "",
        "substeps": f"{substeps}" if substeps != FINE_SUBSTEPS else "",
    }
    options = {option: value for option, value in variant.items() if value}
    name = "_".join(["kick", preset, dynamics, *(f"{option}_{value}" for option, value in options.items())])
    json = json or Path(f"runs/benchmarks/{name}.json")
    report.ready(json, publish, weights)
    prepare_jax()

    def planned(kick: Kick) -> tuple[Session, Planners]:
        session = Session(kick, dynamics, weights)
        fitting = chosen if budget is None else session.within(chosen, budget, USUAL)
        return session, session.planners(fitting)

    usual = Kick.standard(reference, height, body=body, self_contact=self_contact, substeps=substeps)
    people = random_people(np.random.default_rng((seed, 1)), usual.scene, targets)
    always = planned(usual) if bodies == "usual" else None
    random = np.random.default_rng(seed)

    def one(index: int, target: np.ndarray, shift: np.ndarray, roll: np.ndarray) -> report.Row:
        session, planners = always or planned(Kick.of(usual.scene.sized(people[index]), reference, substeps=substeps))
        kick = session.task
        sense = noisy(kick.scene, np.random.default_rng((seed, index))) if noise else lambda state: state
        execution = session.execute(planners, target, seed + index, kick.start(shift, roll), sense=sense)
        return summarize(kick, execution, target) | {
            "halved_error_m": replayed(kick, execution, target, 2 * substeps),
            "preset": preset,
            "dynamics": dynamics,
            "weights": session.models.weights,
            "seed": seed + index,
            "ball_shift": shift.tolist(),
            "ball_velocity": roll.tolist(),
        }

    jobs = {}
    for index in range(targets):
        target, shift = random_kick(random)
        roll = random_roll(random, rolling) if rolling else np.zeros(2)
        jobs[f"kick {index}"] = partial(one, index, target, shift, roll)
    command = (
        f"python -m tasks.benchmarks.kick --targets {targets} --seed {seed} --preset {preset} --dynamics {dynamics}"
    )
    flags = {
        "reference": f"--reference {reference.name if reference else ''}",
        "self_contact": "--self-contact",
        "noise": "--noise",
    }
    command = " ".join([command, *(flags.get(option, f"--{option} {value}") for option, value in options.items())])
    rows = report.collect(json, command, jobs)
    figures = summarise(rows)
    title = ", ".join([f"Kick: {preset}", dynamics, *(f"{option} {value}" for option, value in options.items())])
    report.write_json(json, {"command": command, "hardware": report.hardware(), **figures, "rows": rows})
    report.write_picture(json.with_suffix(".png"), picture(rows, title))

    def three(figure: str) -> str:
        return ", ".join(f"{figures[f'{which}_{figure}']:.3f} m" for which in ("mean", "median", "p95"))

    table = Table("measure", "value", title=title)
    for measure, value in (
        ("mean truth error", f"{figures['mean_truth_error_m']:.3f} m"),
        ("median, 90th percentile", f"{figures['median_truth_error_m']:.3f} m, {figures['p90_truth_error_m']:.3f} m"),
        *(
            (f"replayed at {steps} engine steps: mean, median, 95th percentile", three(f"{which}_error_m"))
            for steps, which in ((FINE_SUBSTEPS, "limit"), (2 * substeps, "halved"))
        ),
        *((f"within {reach} m", f"{100 * figures['success'][str(reach)]:.0f} %") for reach in WITHIN),
        ("mean model error", f"{figures['mean_model_error_m']:.3f} m"),
        ("mean gap between truth and model", f"{figures['mean_gap_m']:.3f} m"),
        ("mean distance from the reference", f"{figures['mean_reference_deviation_m']:.3f} m"),
        ("ball touched", f"{figures['touched']} of {targets}"),
        ("fell within 2 s", f"{figures['falls']} of {targets}"),
        ("first plan", f"{figures['mean_plan_seconds']:.2f} s"),
        ("replan, p50 and p99", f"{figures['replan_ms']['p50']:.0f} ms, {figures['replan_ms']['p99']:.0f} ms"),
        ("compilation, where the cache did not have it", f"{figures['compile_seconds']:.0f} s"),
        ("truth rollouts asked for by the planner", str(figures["truth_rollouts"])),
    ):
        table.add_row(measure, value)
    report.show(table)
    if publish:
        report.publish(name, f"{title}, {targets} targets", command, table)


if __name__ == "__main__":
    run(main)

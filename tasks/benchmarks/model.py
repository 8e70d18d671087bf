"""Error of the learned simulator against the truth, by horizon, and of the ball's launch."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from larp_model import evaluation
from larp_model import weights as stored
from larp_model.simulator import Simulator
from larp_model.truth import episodes as truth_episodes
from tasks.benchmarks import report
from tasks.kick import WEIGHTS, remember_compilations, run
from tasks.scenarios import Scenario, scenario

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")


def picture(windows: dict[str, dict[str, float]], chosen: Scenario, title: str) -> Figure:
    """Error over horizon, ours and the paper's."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    steps, paper = [int(n) for n in windows], dict(chosen.paper)
    for body, colour in zip(chosen.scene.bodies, COLOURS, strict=False):
        name = body.name
        errors = np.array([windows[str(n)][name] for n in steps], float)  # None becomes NaN: not drawn
        axes.plot(steps, 1e3 * errors, "o-", color=colour, label=name)
        if name in paper:
            axes.plot(steps, 1e3 * np.array(paper[name]), "s--", color=colour, alpha=0.5, label=f"{name}, paper")
    axes.set(xlabel="window [steps of 10 ms]", ylabel="mean position error [mm]", title=title)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def weights_of(name: str, weights: Path | None) -> Path:
    """The manifest of a scene's weights: the one asked for, or the shipped one."""
    manifest = weights or stored.SHIPPED / f"{name}.json"
    if weights is None and not manifest.is_file():
        raise ValueError(
            f"weights of {name} are not shipped: train them with python -m tasks.train --scene {name}, and name their "
            "manifest with --weights"
        )
    return manifest


def main(
    scene: str = WEIGHTS,
    sequences: int = 256,
    seed: int = 1,
    json: Path | None = None,
    weights: Path | None = None,
    states: Path | None = None,
    publish: bool = False,
) -> None:
    """Compare rollouts of the learned simulator with truth episodes from unseen initial states.

    Args:
        scene: what is simulated.
        sequences: truth episodes.
        seed: of the episodes.
        json: where the figures go; the picture goes beside them.
        weights: manifest of the weights; the shipped ones by default.
        states: truth episodes (.npz) to evaluate on instead.
        publish: put the table into RESULTS.md.
    """
    chosen = scenario(scene)
    if sequences < 1:
        raise ValueError(f"sequences is {sequences}, but must be at least 1")
    manifest = weights_of(scene, weights)
    json = json or Path(f"runs/benchmarks/model_{scene}.json")
    report.ready(json, publish)
    remember_compilations()
    model, learned, _ = stored.load(manifest, chosen.scene)
    episodes = chosen.draw(sequences, seed)[0] if states is None else truth_episodes.load(states, chosen.scene)
    found = evaluation.evaluate(Simulator(model, learned), episodes, chosen.windows)
    source = f"--states {states.name}" if states else f"--sequences {sequences} --seed {seed}"
    command = f"python -m tasks.benchmarks.model --scene {scene} {source}"
    report.write_json(json, {"command": command, "hardware": report.hardware(), **found})
    title = f"{scene}: {len(episodes.states)} sequences"
    report.write_picture(json.with_suffix(".png"), picture(found["windows"], chosen, title))
    table = table_of(found, chosen)
    report.show(table)
    if publish:
        report.publish(f"model_{scene}", f"Model: {scene}", command, table)


def said(value: float | None, how: str, unit: str) -> str:
    """A mean with its unit, or that there is none."""
    return "all diverged" if value is None else f"{value:{how}} {unit}"


def table_of(found: dict[str, Any], chosen: Scenario) -> Table:
    """What `evaluation.evaluate` found, as rows."""
    table, paper = (
        Table("measure", *(f"{n} steps" for n in chosen.windows), title=f"Model: {chosen.name}"),
        chosen.paper,
    )
    for body in chosen.scene.bodies:
        errors = (said(found["windows"][str(n)][body.name], ".4f", "m") for n in chosen.windows)
        table.add_row(f"{body.name}, position error", *errors)
        if body.name in dict(paper):
            table.add_row(f"{body.name}, the paper", *(f"{value:.3f} m" for value in dict(paper)[body.name]))
    beside = [""] * (len(chosen.windows) - 1)
    for name, turned in found["rotation_rad"].items():
        table.add_row(f"{name}, rotation error", *beside, said(turned, ".3f", "rad"))
    table.add_row("joint displacement", *beside, said(found["displacement_m"], ".5f", "m"))
    table.add_row("diverged", *beside, f"{found['diverged']} of {found['sequences']}")
    for before, launch in found["launch"].items():
        if not launch["count"]:
            continue
        for measure, unit in (("relative_error", ""), ("angle_deg", " deg")):
            cells = (f"{name} {value:.3g}{unit}" for name, value in launch[measure].items())
            table.add_row(f"launch from {before} steps before contact, {measure}, {launch['count']} times", *cells)
    return table


if __name__ == "__main__":
    run(main)

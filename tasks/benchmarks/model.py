"""Error of the learned simulator against the truth, by horizon, and of the ball's launch."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from larp_model import evaluation
from larp_model import weights as stored
from larp_model.simulator import Simulator
from larp_model.truth import episodes as truth_episodes
from tasks.benchmarks import report
from tasks.data import WINDOWS, random_episodes
from tasks.kick import WEIGHTS, prepare, remember_compilations, run

# Mean position error of the paper's table 2 [m], human kicking a ball.
PAPER = {"human": (0.010, 0.031, 0.048), "ball": (0.006, 0.033, 0.061)}
SCENES = ("human_ball",)


def picture(windows: dict[str, dict[str, float]], title: str) -> Figure:
    """Error over horizon, ours and the paper's."""
    figure = Figure(figsize=(7, 4.5), layout="constrained")
    axes = figure.subplots()
    steps = [int(n) for n in windows]
    for body, colour in (("human", "#0072b2"), ("ball", "#d55e00")):
        axes.plot(steps, [1e3 * windows[str(n)][body] for n in steps], "o-", color=colour, label=body)
        axes.plot(WINDOWS, 1e3 * np.array(PAPER[body]), "s--", color=colour, alpha=0.5, label=f"{body}, paper")
    axes.set(xlabel="window [steps of 10 ms]", ylabel="mean position error [mm]", title=title)
    axes.set_ylim(bottom=0.0)
    axes.grid(alpha=0.3)
    axes.legend()
    return figure


def main(
    scene: str = "human_ball",
    sequences: int = 256,
    seed: int = 1,
    json: Path | None = None,
    weights: Path = stored.SHIPPED / f"{WEIGHTS}.json",
    states: Path | None = None,
    publish: bool = False,
) -> None:
    """Compare rollouts of the learned simulator with truth episodes from unseen initial states.

    Args:
        scene: what is simulated.
        sequences: truth episodes.
        seed: of the episodes.
        json: where the figures go; the picture goes beside them.
        weights: manifest of the weights.
        states: truth episodes (.npz) to evaluate on instead.
        publish: put the table into RESULTS.md.
    """
    if scene not in SCENES:
        raise ValueError(f"scene is {scene!r}, but must be one of {', '.join(SCENES)}")
    if sequences < 1:
        raise ValueError(f"sequences is {sequences}, but must be at least 1")
    json = json or Path(f"runs/benchmarks/model_{scene}.json")
    report.ready(json, publish)
    remember_compilations()
    kick = prepare()
    config, learned, _ = stored.load(weights, kick.scene)
    if states is None:
        episodes, _ = random_episodes(kick.scene, kick.reference, sequences, seed)
    else:
        episodes = truth_episodes.load(states, kick.scene)
    found = evaluation.evaluate(Simulator(kick.scene, config, learned), episodes, WINDOWS)
    source = f"--states {states.name}" if states else f"--sequences {sequences} --seed {seed}"
    command = f"python -m tasks.benchmarks.model --scene {scene} {source}"
    report.write_json(json, {"command": command, "hardware": report.hardware(), "config": config.name, **found})
    title = f"{scene}: {len(episodes.states)} sequences"
    report.write_picture(json.with_suffix(".png"), picture(found["windows"], title))
    table = Table("measure", *(f"{n} steps" for n in WINDOWS), title=f"Model: {scene}")
    for body, paper in PAPER.items():
        table.add_row(f"{body}, position error", *(f"{found['windows'][str(n)][body]:.4f} m" for n in WINDOWS))
        table.add_row(f"{body}, the paper", *(f"{value:.3f} m" for value in paper))
    table.add_row("human, rotation error", "", "", f"{found['rotation_rad']['human']:.3f} rad")
    table.add_row("joint displacement", "", "", f"{1e3 * found['displacement_m']:.2f} mm")
    table.add_row("diverged", "", "", f"{found['diverged']} of {found['sequences']}")
    for before, launch in found["launch"].items():
        if not launch["count"]:
            continue
        for measure, unit in (("relative_error", ""), ("angle_deg", " deg")):
            cells = (f"{name} {value:.3g}{unit}" for name, value in launch[measure].items())
            table.add_row(f"launch from {before} steps before contact, {measure}, {launch['count']} balls", *cells)
    report.show(table)
    if publish:
        report.publish(f"model_{scene}", f"Model: {scene}", command, table)


if __name__ == "__main__":
    run(main)

"""Errors of the learned simulator against the ground truth, by horizon, and of the ball's launch."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from larp_model import evaluation
from larp_model.designs import DesignName
from larp_model.engines import episodes as truth_episodes
from larp_model.engines.bullet import BulletTruth
from larp_model.engines.episodes import Episodes
from larp_model.engines.mujoco import FINE_SUBSTEPS, Truth
from larp_model.errors import InputError
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from tasks.benchmarks import report
from tasks.command import prepare_jax, run
from tasks.scenarios import Scenario, around, scenario, trained_at

# Batch sizes at which a step is timed, and steps of each timed rollout.
BATCHES, TIMED = (1, 64, 512), 40
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")


@dataclass(frozen=True)
class ModelSettings:
    """Settings of a run that its figures depend on; see the arguments of `main`."""

    scene: str
    sequences: int
    seed: int
    weights: Path | None
    states: Path | None
    reference: Path | None
    bodies: Literal["usual", "varied"]
    beside: DesignName | None
    bullet: bool
    substeps: int

    @property
    def labels(self) -> list[str]:
        """Return what distinguishes the run, in a few words each."""
        files = [path.stem for path in (self.weights, self.reference) if path]
        return [self.scene, *files, *(["bodies varied"] if self.bodies == "varied" else [])]

    @property
    def name(self) -> str:
        """Return the name of the run's JSON and of its part of RESULTS.md."""
        return "_".join(["model", *self.labels]).replace(" ", "_")

    @property
    def other_weights(self) -> Path:
        """Return the manifest of the weights that are compared with, of the design `beside`."""
        return trained_at(self.scene, self.beside) / "weights" / f"{self.scene}.json"

    @property
    def command(self) -> str:
        """Return the command that repeats the run."""
        drawn = f"--sequences {self.sequences} --seed {self.seed}"
        options = [
            f"--weights {self.weights}" if self.weights else "",
            f"--states {self.states.name}" if self.states else drawn,
            f"--substeps {self.substeps}" if self.substeps != FINE_SUBSTEPS and self.states is None else "",
            f"--reference {self.reference.name}" if self.reference else "",
            "--bodies varied" if self.bodies == "varied" else "",
            f"--beside {self.beside}" if self.beside else "",
            "--bullet" if self.bullet else "",
        ]
        return " ".join([f"python -m tasks.benchmarks.model --scene {self.scene}", *filter(None, options)])


def picture(windows: dict[str, dict[str, float]], chosen: Scenario, title: str) -> Figure:
    """Plot the position error over the horizon, ours and the paper's."""
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


def main(
    scene: str = "human_ball",
    sequences: int = 256,
    seed: int = 1,
    json: Path | None = None,
    weights: Path | None = None,
    states: Path | None = None,
    reference: Path | None = None,
    bodies: Literal["usual", "varied"] = "usual",
    beside: DesignName | None = None,
    bullet: bool = False,
    substeps: int = FINE_SUBSTEPS,
    publish: bool = False,
) -> None:
    """Compare rollouts of the simulator with ground-truth episodes from unseen initial states.

    The ground truth is MuJoCo at the engine steps at which plans are executed: at those that networks are trained on,
    its own launches are off by as much as the simulator's.

    Args:
        scene: what is simulated.
        sequences: ground-truth episodes.
        seed: of the episodes.
        json: where the figures go; the picture goes beside them.
        weights: manifest of weights that correct physics; none by default.
        states: ground-truth episodes (.npz) to evaluate on instead.
        reference: a captured kick (BVH) to draw the episodes around.
        bodies: varied draws another human for every episode.
        beside: weights of this design, from where `tasks.train --design` leaves them, on the same episodes.
        bullet: also how far Bullet is from the ground truth.
        substeps: of the ground truth, engine steps in a step of the scene.
        publish: put the table into RESULTS.md.
    """
    chosen = around(scenario(scene), reference, bodies == "varied")
    settings = ModelSettings(scene, sequences, seed, weights, states, reference, bodies, beside, bullet, substeps)
    for argument, value in (("sequences", sequences), ("substeps", substeps)):
        if value < 1:
            raise InputError(f"{argument} is {value}, but must be at least 1")
    json = json or Path(f"runs/benchmarks/{settings.name}.json")
    report.ready(json, publish, weights)
    prepare_jax()
    if beside and not settings.other_weights.is_file():
        raise InputError(
            f"beside is {beside}, but {settings.other_weights} is not there: "
            f"`python -m tasks.train --scene {scene} --design {beside}`"
        )
    episodes = episodes_of(settings, chosen)
    results = results_of(settings, chosen, episodes)
    report.write_json(json, {"command": settings.command, "hardware": report.hardware(), **results})
    title = f"{', '.join(settings.labels)}: {len(episodes.states)} sequences"
    report.write_picture(json.with_suffix(".png"), picture(results["windows"], chosen, title))
    tables = [table_of(results, chosen), *launch_tables(results["launch"])]
    for table in tables:
        report.show(table)
    if publish:
        report.publish(settings.name, f"Model: {', '.join(settings.labels)}", settings.command, *tables)


def episodes_of(settings: ModelSettings, chosen: Scenario) -> Episodes:
    """Return the ground-truth episodes to evaluate on: those of a file, or new ones of the scenario."""
    if settings.states is not None:
        return truth_episodes.load(settings.states, chosen.scene)
    drawn, _ = chosen.draw(settings.sequences, settings.seed)
    truth = Truth(chosen.scene, min(len(drawn.states), 64), settings.substeps)
    starts, *inputs = drawn
    episodes, _ = truth_episodes.record(truth, starts[:, 0], *inputs)
    return episodes


def results_of(settings: ModelSettings, chosen: Scenario, episodes: Episodes) -> dict[str, Any]:
    """Return the errors of the weights and, where they are compared with, of another design's and of Bullet."""
    results = errors_of(settings.weights, chosen, episodes)
    if settings.beside:
        other = errors_of(settings.other_weights, chosen, episodes)
        results["beside"] = {"design": settings.beside, **other}
    if settings.bullet:
        results["bullet"] = bullet_errors(chosen.scene, episodes, chosen.windows)
    return results


def errors_of(manifest: Path | None, chosen: Scenario, episodes: Episodes) -> dict[str, Any]:
    """Return errors of weights, or of physics alone without a manifest, and the time of a step per batch size.

    See `evaluation.evaluate`.
    """
    scene = chosen.scene
    simulator = Simulator.of_physics(scene) if manifest is None else Simulator.load(manifest, scene)
    errors = evaluation.evaluate(simulator, episodes, chosen.windows)
    return errors | {"us_per_step": {str(size): step_time(simulator, episodes, size) for size in BATCHES}}


def bullet_errors(scene: Scene, episodes: Episodes, windows: Sequence[int]) -> dict[str, dict[str, float | None]]:
    """Return Bullet's position errors against the ground truth over the first n steps; see `evaluation.evaluate`.

    Needs the extra `bullet`. Two engines that agree on the equations differ in contact compliance and friction: a
    model of one of them need not be more accurate than that difference.
    """
    longest, parts = max(windows), []
    for row in range(len(episodes.states)):
        own = slice(row, row + 1)
        world = BulletTruth(scene.sized(episodes.morphology[row]))
        inputs = episodes.controls[own, :longest], episodes.torques[own, :longest]
        parts.append(world.rollout(episodes.states[own, 0], *inputs)[0])
        world.close()
    distance, is_finite = evaluation.distances(np.concatenate(parts), episodes, longest)
    return evaluation.by_window(scene, distance[is_finite], windows)


def step_time(simulator: Simulator, episodes: Episodes, size: int, runs: int = 5) -> float:
    """Return the median time of a step per scene [us], in a batch of `size` over the first steps of episodes."""
    rows = np.arange(size) % len(episodes.states)
    inputs = episodes.states[rows, 0], episodes.controls[rows, :TIMED], episodes.torques[rows, :TIMED]
    state, controls, torques, sizes = (jnp.asarray(array) for array in (*inputs, episodes.morphology[rows]))
    roll = jax.jit(simulator.rollout)
    seconds = []
    for _ in range(runs + 1):  # the first compiles
        begin = time.perf_counter()
        roll(state, controls, torques=torques, morphology=sizes).block_until_ready()
        seconds.append(time.perf_counter() - begin)
    return 1e6 * float(np.median(seconds[1:])) / (size * controls.shape[1])


def with_unit(value: float | None, form: str, unit: str) -> str:
    """Return a mean with its unit as text, or "all diverged" for None."""
    return "all diverged" if value is None else f"{value:{form}} {unit}"


def table_of(results: dict[str, Any], chosen: Scenario) -> Table:
    """Return a table of the errors that `judged` returns, beside the paper's and, if present, others'."""
    table, paper = (
        Table("measure", *(f"{n} steps" for n in chosen.windows), title=f"Model: {chosen.name}"),
        chosen.paper,
    )
    for body in chosen.scene.bodies:
        errors = (with_unit(results["windows"][str(n)][body.name], ".4f", "m") for n in chosen.windows)
        table.add_row(f"{body.name}, position error", *errors)
        if body.name in dict(paper):
            table.add_row(f"{body.name}, the paper", *(f"{value:.3f} m" for value in dict(paper)[body.name]))
        if "beside" in results:
            other = results["beside"]
            errors = (with_unit(other["windows"][str(n)][body.name], ".4f", "m") for n in chosen.windows)
            table.add_row(f"{body.name}, the {other['design']} design trained here", *errors)
        if "bullet" in results:
            errors = (with_unit(results["bullet"][str(n)][body.name], ".4f", "m") for n in chosen.windows)
            table.add_row(f"{body.name}, Bullet", *errors)
    beside = [""] * (len(chosen.windows) - 1)
    for name, turned in results["rotation_rad"].items():
        table.add_row(f"{name}, rotation error", *beside, with_unit(turned, ".3f", "rad"))
    table.add_row("joint displacement", *beside, with_unit(results["displacement_m"], ".5f", "m"))
    table.add_row("diverged", *beside, f"{results['diverged']} of {results['sequences']}")
    for whose in (results, *([results["beside"]] if "beside" in results else [])):
        name = f", the {whose['design']} design" if whose is not results else ""
        cells = (f"{value:.3g} us, {size} side by side" for size, value in whose["us_per_step"].items())
        table.add_row(f"a step of a scene{name}", *cells)
    return table


def launch_tables(launches: dict[str, Any]) -> Iterator[Table]:
    """Yield a table of launch errors, all and by kind, per number of steps before contact; see `Launches.summary`."""
    for before, launch in launches.items():
        if not launch["count"]:
            continue
        quantiles = "median / 75 % / 90 %"
        table = Table(
            "launches", "count", f"velocity, {quantiles} [%]", f"direction, {quantiles} [degrees]",
            title=f"Launch, from the true state {before} steps before first contact",
        )  # fmt: skip
        for kind, figures in {"all": launch, **launch["kinds"]}.items():
            errors = (100.0 * value for value in figures["relative_error"].values())
            angles = figures["angle_deg"].values()
            cells = (" / ".join(f"{value:.1f}" for value in values) for values in (errors, angles))
            table.add_row(kind, str(figures["count"]), *cells)
        yield table


if __name__ == "__main__":
    run(main)

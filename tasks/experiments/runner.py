"""Runner of experiments: trains and judges each run of a list, goes on where it was cut off, and compares them."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from larp_model import evaluation, training
from larp_model.engines.episodes import Episodes
from larp_model.errors import InputError
from larp_model.files import require_writable
from larp_model.names import require_known
from larp_model.simulator import Simulator
from tasks.benchmarks import report
from tasks.command import prepare_jax
from tasks.episodes.chains import thrown_episodes
from tasks.experiments import speed
from tasks.experiments.changes import CHANGES, DESIGNS
from tasks.experiments.lists import EXPERIMENTS, Experiment, Trial
from tasks.scenarios import scenario
from tasks.train import EVALUATION_SEED, claim, stored_episodes

# Seed of all training data, and episodes by which runs are judged.
DATA_SEED, JUDGED = 100, 256
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")

Key = tuple[str, str, str, int]
"""Scene, design, change and sequences: those of several seeds have them in common."""


class BudgetSpentError(Exception):
    """Raised where the minutes of a call are over before all runs are done."""


def main(
    name: Annotated[str, tyro.conf.Positional],
    scenes: tuple[str, ...] = (),
    changes: tuple[str, ...] = (),
    seeds: int | None = None,
    updates: int | None = None,
    minutes: float = 170.0,
    batch: str = speed.BATCHES,
    folder: Path = Path("runs/experiments"),
    publish: bool = False,
) -> None:
    """Train and judge the runs of an experiment; the same command goes on where it was cut off.

    Args:
        name: ablations, data, supertrack or speed.
        scenes: only runs in these.
        changes: only runs with these changes; "none" is the design as it is.
        seeds: only so many of each run.
        updates: of every run, instead of the experiment's own.
        minutes: after which no further run is begun.
        batch: of speed, simulations side by side, with commas between them.
        folder: where runs keep their data, checkpoints and logs for TensorBoard.
        publish: put the table into RESULTS.md.
    """
    require_known("experiment", name, (*EXPERIMENTS, "speed"))
    if name == "speed":
        return speed.measure_speed(batch, folder, publish)
    experiment = chosen_runs(name, scenes, changes, seeds, updates)
    if not minutes > 0.0:
        raise InputError(f"minutes is {minutes:g}, but must be above 0")
    path = folder / f"{name}.json"
    report.ready(path, publish)
    require_writable(folder, "folder")
    prepare_jax()
    words = {"scenes": " ".join(scenes), "changes": " ".join(f"'{change}'" for change in changes), "seeds": seeds,
             "updates": updates}  # fmt: skip
    options = "".join(f" --{option} {value}" for option, value in words.items() if value)
    command = f"python -m tasks.experiments {name}{options}"
    deadline = time.monotonic() + 60.0 * minutes
    with only_one_in(folder / name):
        jobs = {run.name: TrialRunner(experiment, run, folder, name, deadline) for run in experiment.runs}
        try:
            rows = report.collect(path, command, jobs)
        except BudgetSpentError:
            Console(stderr=True).print(f"{minutes:g} minutes are over: the same command goes on")
            return
        report.write_json(path, {"command": command, "hardware": report.hardware(), "rows": rows})
        report.write_picture(path.with_suffix(".png"), picture(experiment, rows))
        table = table_of(experiment, rows)
        report.show(table)
        if publish:
            report.publish(f"experiment_{name}", experiment.title, command, table)


def chosen_runs(
    name: str, scenes: Sequence[str] = (), changes: Sequence[str] = (), seeds: int | None = None,
    updates: int | None = None,
) -> Experiment:  # fmt: skip
    """Return an experiment with some of its runs; see the arguments of `main`."""
    require_known("experiment", name, EXPERIMENTS)
    experiment = EXPERIMENTS[name]
    for scene in scenes:
        require_known("scenes", scene, sorted({run.scene for run in experiment.runs}))
    for change in changes:
        require_known("changes", change, [*dict.fromkeys(run.change for run in experiment.runs)])
    for argument, value in (("seeds", seeds), ("updates", updates)):
        if value is not None and value < 1:
            raise InputError(f"{argument} is {value}, but must be at least 1")
    runs = [
        run._replace(updates=updates or run.updates)
        for run in experiment.runs
        if (not scenes or run.scene in scenes)
        and (not changes or run.change in changes)
        and (seeds is None or run.seed < seeds)
    ]
    if not runs:
        raise InputError(f"changes is {', '.join(changes)}, but {name} has no run with it in {', '.join(scenes)}")
    return experiment._replace(runs=tuple(runs))


@contextmanager
def only_one_in(folder: Path) -> Iterator[None]:
    """Hold a folder for this process; raises InputError if another one holds it."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(
                f"folder is {str(folder)!r}, but another run is in it: take another one, or wait"
            ) from None
        yield


@dataclass(frozen=True)
class TrialRunner:
    """Runner of one trial of an experiment; see `main`. deadline: of the monotonic clock [s]."""

    experiment: Experiment
    trial: Trial
    folder: Path
    name: str
    deadline: float

    def __call__(self) -> report.Row:
        """Return the run's figures; raise BudgetSpentError if the deadline is past."""
        if time.monotonic() > self.deadline:
            raise BudgetSpentError
        trial, chosen, design = self.trial, scenario(self.trial.scene), DESIGNS[self.trial.design]
        change, folder = CHANGES[trial.change], self.folder / self.name / self.trial.name
        model = change.model(design.model(chosen.scene))
        recipe = replace(change.recipe(design.recipe), updates=trial.updates, seed=trial.seed)
        folder.mkdir(parents=True, exist_ok=True)
        claim(folder, {**trial._asdict(), "made by": repr((model, recipe))})
        episodes = self.episodes(trial.sequences, DATA_SEED, 200)
        weights, log = training.train(model, recipe, [(episodes, 1.0)], folder, quiet=True)
        judged = self.episodes(JUDGED, EVALUATION_SEED, self.experiment.steps)
        scores = evaluation.evaluate(Simulator.of(model, weights), judged, self.experiment.windows)
        scores.pop("launch")
        return {
            **trial._asdict(),
            "seconds": log["seconds"],
            "dropped": log["dropped"],
            **scores,
            "sequences": trial.sequences,
            "judged": scores["sequences"],
        }

    def episodes(self, count: int, seed: int, steps: int) -> Episodes:
        """Return ground-truth episodes of the run's scene, which are drawn once for all runs."""
        chosen = scenario(self.trial.scene)
        folder = self.folder / "data"
        folder.mkdir(exist_ok=True)
        path = folder / f"{self.trial.scene}_{count}_{steps}_seed_{seed}.npz"
        return stored_episodes(
            path,
            chosen.scene,
            lambda: thrown_episodes(chosen.scene, count, seed, steps, varied=True),
            Console(stderr=True),
        )


def by_key(rows: Sequence[report.Row]) -> dict[Key, list[report.Row]]:
    """Return the rows of several seeds by what they have in common."""
    groups: dict[Key, list[report.Row]] = {}
    for row in rows:
        groups.setdefault((row["scene"], row["design"], row["change"], row["sequences"]), []).append(row)
    return groups


def errors_at(rows: Sequence[report.Row], window: int) -> np.ndarray:
    """Return the mean position error [m] of all bodies in a window of each row, NaN where all predictions diverged."""
    means = [[np.nan if error is None else error for error in row["windows"][str(window)].values()] for row in rows]
    errors: np.ndarray = np.array(means, float).mean(axis=1)
    return errors


def with_spread(values: np.ndarray | Sequence[float | None], digits: int = 3) -> str:
    """Return mean and standard deviation of values as text."""
    known = np.array([np.nan if value is None else value for value in values], float)
    if not np.isfinite(known).all():
        return "diverged"
    return f"{known.mean():.{digits}f} ± {known.std():.{digits}f}" if len(known) > 1 else f"{known.mean():.{digits}f}"


def label_of(key: Key, groups: Collection[Key]) -> str:
    """Return design and change of runs as text, and how many sequences they have where these differ."""
    _, design, change, sequences = key
    many = len({other[-1] for other in groups}) > 1
    return ", ".join([design, *([] if change == "none" else [change]), *([f"{sequences} sequences"] if many else [])])


def table_of(experiment: Experiment, rows: Sequence[report.Row]) -> Table:
    """Return a table of all runs, mean and standard deviation over the seeds, beside what the paper says."""
    groups = by_key(rows)
    windows = (f"{window} steps [m]" for window in experiment.windows)
    title = f"{experiment.title}: mean ± standard deviation of {len({row['seed'] for row in rows})} seeds"
    table = Table("run", *windows, "joints apart [m]", "diverged", "training", "the paper", title=title)
    for key, group in groups.items():
        diverged = 100.0 * sum(row["diverged"] for row in group) / sum(row["judged"] for row in group)
        table.add_row(
            f"{key[0]}, {label_of(key, groups)}",
            *(with_spread(errors_at(group, window)) for window in experiment.windows),
            with_spread([row["displacement_m"] for row in group], 4), f"{diverged:.0f} %",
            f"{np.mean([row['seconds'] for row in group]):.0f} s", experiment.paper.get(key[:3], ""),
        )  # fmt: skip
    return table


def picture(experiment: Experiment, rows: Sequence[report.Row]) -> Figure:
    """Plot the error of all runs of each scene in the longest window, a bar from the least to the largest seed."""
    groups, window = by_key(rows), experiment.windows[-1]
    scenes = [*dict.fromkeys(scene for scene, *_ in groups)]
    heights = [sum(scene == key[0] for key in groups) for scene in scenes]
    figure = Figure(figsize=(8, 1.2 + 0.32 * sum(heights) + 0.6 * len(scenes)), layout="constrained")
    axes = figure.subplots(len(scenes), 1, squeeze=False, height_ratios=heights, sharex=True)[:, 0]
    designs = [*dict.fromkeys(design for _, design, *_ in groups)]
    for scene, axis in zip(scenes, axes, strict=True):
        own = {key: errors_at(group, window) for key, group in groups.items() if key[0] == scene}
        for place, ((_, design, *_), errors) in enumerate(own.items()):
            if len(known := errors[np.isfinite(errors)]):
                colour = COLOURS[designs.index(design)]
                axis.plot([known.min(), known.max()], [place, place], color=colour, linewidth=3, alpha=0.5)
                axis.plot(known.mean(), place, "o", color=colour)
        axis.set_yticks(range(len(own)), [label_of(key, groups) for key in own])
        axis.invert_yaxis()
        axis.set(title=scene, xscale="log")
        axis.grid(alpha=0.3, axis="x")
    axes[-1].set_xlabel(f"mean position error over {window} steps [m]")
    return figure

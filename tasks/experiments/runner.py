"""Runner of experiments: trains and judges each run of a list, goes on where it was cut off, and compares them."""

from __future__ import annotations

import fcntl
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from larp_model import evaluation, training
from larp_model.engines.episodes import Episodes
from larp_model.errors import InputError
from larp_model.files import require_writable
from larp_model.names import require_known
from larp_model.networks import Weights
from larp_model.simulator import Simulator
from tasks.benchmarks import report
from tasks.command import prepare_jax
from tasks.experiments import speed
from tasks.experiments.changes import CHANGES, DESIGNS
from tasks.experiments.lists import EXPERIMENTS, Experiment, Trial
from tasks.experiments.tables import picture, tables_of, windows_of
from tasks.experiments.tracked import tracked
from tasks.scenarios import scenario
from tasks.train import EVALUATION_SEED, claim, stored_episodes

# Seed of all training data, and episodes by which runs are judged.
DATA_SEED, JUDGED = 100, 256


class BudgetSpentError(Exception):
    """Raised where the minutes of a call are over before all runs are done."""


def main(
    name: Annotated[str, tyro.conf.Positional],
    scenes: tuple[str, ...] = (),
    changes: tuple[str, ...] = (),
    seeds: int | None = None,
    updates: int | None = None,
    minutes: float = 170.0,
    batch: str | None = None,
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
        batch: of speed alone, simulations side by side, with commas between them; 1 to 32768 by default.
        folder: where runs keep their data, checkpoints and logs for TensorBoard.
        publish: put the table into RESULTS.md.
    """
    require_known("experiment", name, (*EXPERIMENTS, "speed"))
    words = {"scenes": " ".join(scenes), "changes": " ".join(f"'{change}'" for change in changes), "seeds": seeds,
             "updates": updates}  # fmt: skip
    for option, value in (words if name == "speed" else {"batch": batch}).items():
        if value:
            raise InputError(f"{option} is {value}, but {name} has no {option}: leave it out")
    if name == "speed":
        return speed.measure_speed(batch or speed.BATCHES, folder, publish)
    experiment = chosen_runs(name, scenes, changes, seeds, updates)
    if not minutes > 0.0:
        raise InputError(f"minutes is {minutes:g}, but must be above 0")
    path = folder / f"{name}.json"
    report.ready(path, publish)
    require_writable(folder, "folder")
    prepare_jax()
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
        tables = tables_of(experiment, rows)
        for table in tables:
            report.show(table)
        if publish:
            report.publish(f"experiment_{name}", experiment.title, command, *tables)


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
        run._replace(updates=updates) if updates and run.updates else run
        for run in experiment.runs
        if (not scenes or run.scene in scenes)
        and (not changes or run.change in changes)
        and (seeds is None or run.seed < seeds)
    ]
    if not runs:
        raise InputError(f"changes is {', '.join(changes)}, but {name} has no run with it in {', '.join(scenes)}")
    return experiment._replace(runs=tuple(dict.fromkeys(runs)))


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
        weights, log = Weights({}, {}, {}), {"seconds": 0.0, "dropped": 0}
        if trial.updates:
            recipe = replace(change.recipe(design.recipe), updates=trial.updates, seed=trial.seed)
            folder.mkdir(parents=True, exist_ok=True)
            claim(folder, {**trial._asdict(), "made by": repr((model, recipe))})
            episodes = self.episodes(trial.sequences, DATA_SEED)
            weights, log = training.train(model, recipe, [(episodes, 1.0)], folder, quiet=True)
        scores = self.scores(Simulator.of(model, weights))
        totals = {"seconds": log["seconds"], "dropped": log["dropped"], "judged": scores.pop("sequences")}
        return {**trial._asdict(), **totals, **scores}

    def scores(self, simulator: Simulator) -> report.Row:
        """Return the errors of a simulator; see `evaluation.evaluate` and `tracked.tracked`."""
        experiment, windows = self.experiment, windows_of(self.experiment, self.trial.scene)
        if experiment.tracked and simulator.scene.motors:
            return tracked(simulator, windows)
        judged = self.episodes(JUDGED, EVALUATION_SEED, max(windows) if experiment.windows else None)
        scores = evaluation.evaluate(simulator, judged, windows)
        scores.pop("launch")
        return scores

    def episodes(self, count: int, seed: int, steps: int | None = None) -> Episodes:
        """Return ground-truth episodes of the run's scene, which are drawn once for all runs.

        steps: as many as the scene's episodes usually have by default.
        """
        chosen = scenario(self.trial.scene)
        folder = self.folder / "data"
        folder.mkdir(exist_ok=True)
        path = folder / f"{self.trial.scene}_{count}{f'_{steps}_steps' if steps else ''}_seed_{seed}.npz"
        options = {"steps": steps} if steps else {}
        return stored_episodes(path, chosen.scene, partial(chosen.draw, count, seed, **options), Console(stderr=True))

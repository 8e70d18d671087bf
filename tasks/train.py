"""Training of the weights of a scene: ground-truth episodes, training, evaluation.

Every stage leaves a file in the run's folder and is skipped where that file exists; training itself goes on from its
last checkpoint. So the same command resumes a run that was interrupted.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import tyro
from rich.console import Console

from larp_model import designs, evaluation, training
from larp_model import weights as stored
from larp_model.designs import DesignName, SizeName
from larp_model.engines import episodes as truth_episodes
from larp_model.engines.episodes import Episodes
from larp_model.engines.mujoco import SUBSTEPS
from larp_model.errors import InputError
from larp_model.files import require_writable, write_whole
from larp_model.learned.model import Model
from larp_model.names import require_file
from larp_model.networks import Weights
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from tasks.command import prepare_jax, run
from tasks.curve import curve_picture
from tasks.scenarios import Scenario, scenario, trained_at

EVALUATION_SEED = 1


class TrainingStage(NamedTuple):
    """Stage of the training: its name and recipe."""

    name: str
    recipe: training.Recipe


# Corrections of physics are learned from single steps.
OVER_PHYSICS = training.Recipe(20000, 1024, ((1, 1.0),), learning_rate=1e-3, contact_share=0.0)
# Algorithm 1 of the paper, with its losses; in small batches, which give the most updates on two cores. Where the
# unroll grows by more at once, networks that work for a few steps diverge within more.
GROWING = ((2, 0.1), (3, 0.05), (4, 0.05), (6, 0.1), (8, 0.1), (11, 0.1), (14, 0.1), (17, 0.1), (20, 0.3))
ALGORITHM_1 = training.Recipe(batch=64, curriculum=GROWING, learning_rate=3e-4, emphasis=())
STAGES: dict[DesignName, tuple[TrainingStage, ...]] = {
    "residual": (TrainingStage("steps", OVER_PHYSICS),),
    "paper": (TrainingStage("rollouts", ALGORITHM_1),),
}


def stored_episodes(path: Path, scene: Scene, make: Callable[[], tuple[Episodes, int]], console: Console) -> Episodes:
    """Return the episodes of a file; where the file does not exist, they are made and stored first."""
    if not path.exists():
        begin = time.perf_counter()
        episodes, dropped = make()
        truth_episodes.save(path, scene, episodes)
        seconds = time.perf_counter() - begin
        console.print(f"{path.name}: {len(episodes.states)} episodes, {dropped} dropped, {seconds:.0f} s")
    return truth_episodes.load(path, scene)


def claim(folder: Path, settings: dict[str, Any]) -> None:
    """Write a run's settings to its folder; raise InputError if it has a run of others, whose stages would be reused.

    settings: values that JSON can hold, by the names of arguments.
    """
    path = folder / "settings.json"
    settings = json.loads(json.dumps(settings))
    if path.is_file():
        try:
            begun_with = dict(json.loads(path.read_text()))
        except ValueError:
            raise InputError(f"folder is {str(folder)!r}, but its settings.json is damaged: take another one") from None
        for name, value in settings.items():
            if begun_with.get(name) != value:
                raise InputError(
                    f"{name} is {value!r}, but the run in {folder} was begun with {begun_with.get(name)!r}: "
                    "take another --folder, or delete that one"
                )
    elif (folder / "random.npz").exists():
        raise InputError(f"folder is {str(folder)!r}, but holds a run of unknown settings: take another one")
    write_whole(path, (json.dumps(settings, indent=1) + "\n").encode())


def main(
    scene: str = "any_human",
    design: DesignName = "residual",
    size: SizeName | None = None,
    folder: Path | None = None,
    out: Path | None = None,
    episodes: int = 10000,
    effort: float = 1.0,
    seed: int = 100,
    start: Annotated[Path | None, tyro.conf.arg(name="from")] = None,
) -> None:
    """Train networks of a scene.

    Args:
        scene: what is simulated; any_human is a human of any size in any motion, with a ball. Or FILE.py:NAME, a Scene
            or a Scenario of your own.
        design: residual: physics that networks correct; paper: the paper's networks.
        size: of residual networks; small by default.
        folder: where the run keeps its stages and checkpoints; runs/train/SCENE by default, SCENE_DESIGN_SIZE where
            they are given. A run goes on only with the settings that it was begun with.
        out: where the weights and their manifest go; a folder of the run's by default.
        episodes: random ground-truth episodes.
        effort: multiplies the updates of every stage.
        seed: of the data and the training; the benchmarks use seeds below 100.
        start: manifest of weights of the same model to go on from.
    """
    chosen = scenario(scene)
    folder = folder or trained_at(chosen.name, None if design == "residual" else design, size)
    require_writable(folder, "folder")
    if start:
        require_file("from", start)
    stages, model = STAGES[design], designs.design(chosen.scene, design, size)
    settings = {
        "scene": chosen.name,
        "design": design,
        "size": size,
        "episodes": episodes,
        "effort": effort,
        "seed": seed,
        "from": start and hashlib.sha256(start.read_bytes()).hexdigest()[:12],
        "recipe of the scene": hashlib.sha256(repr((model, stages)).encode()).hexdigest()[:12],
    }
    claim(folder, settings)
    prepare_jax()
    training_run = TrainingRun(chosen, model, stages, folder, effort, seed, Console())
    training_run.run(episodes, start, out)


@dataclass(frozen=True, eq=False)
class TrainingRun:
    """Training of a scenario's model, stage after stage, in a folder; see the arguments of `main`."""

    scenario: Scenario
    model: Model
    stages: tuple[TrainingStage, ...]
    folder: Path
    effort: float
    seed: int
    console: Console

    def run(self, episodes: int, start: Path | None, out: Path | None) -> None:
        """Train on random episodes, from weights to start with if there are some; evaluate and write the weights."""
        path = self.folder / "random.npz"
        draw = partial(self.scenario.draw, episodes, self.seed)
        random = stored_episodes(path, self.scenario.scene, draw, self.console)
        begin = TrainedWeights(None, [], random.morphology)
        if start:
            begin = self.started(start, random.morphology)
        trained = self.trained(begin, random)
        assert trained.weights is not None
        held_out, _ = self.scenario.draw(256, EVALUATION_SEED)
        simulator = Simulator.of(self.model, trained.weights)
        scores = evaluation.evaluate(simulator, held_out, self.scenario.windows)
        written = self.save(out or self.folder / "weights", trained, self.recipe(trained, scores))
        self.console.print_json(json.dumps(scores))
        self.console.print(f"weights: {written}")

    def started(self, start: Path, sizes: np.ndarray) -> TrainedWeights:
        """Return the weights of a manifest to go on from; sizes: (N, L, 3) of the episodes, see `TrainedWeights`."""
        model, weights, content = stored.load(start, self.scenario.scene)
        if model != self.model:
            raise InputError(f"from is {str(start)!r}, but holds weights of another model")
        sizes = np.concatenate([sizes, stored.extremes(content, self.scenario.scene)])
        return TrainedWeights(weights, content["recipe"]["rounds"], sizes)

    def trained(self, begin: TrainedWeights, random: Episodes) -> TrainedWeights:
        """Return the weights after all stages; a stage whose weights are in the folder is loaded."""
        trained = begin
        for number, stage in enumerate(self.stages):
            manifest = self.folder / stage.name / f"{self.scenario.name}.json"
            if manifest.exists():
                _, weights, content = stored.load(manifest, self.scenario.scene)
                trained = trained._replace(weights=weights, rounds=content["recipe"]["rounds"])
            else:
                trained = self.stage(number, trained, random)
        return trained

    def stage(self, number: int, begin: TrainedWeights, random: Episodes) -> TrainedWeights:
        """Train one stage and return its weights, which are also written to the folder."""
        stage = self.stages[number]
        folder = self.folder / stage.name
        updates = max(1, round(self.effort * stage.recipe.updates))
        recipe = replace(stage.recipe, updates=updates, seed=self.seed + number)
        weights, log = training.train(self.model, recipe, [(random, 1.0)], folder, begin.weights)
        pictured = [self.folder / past.name for past in self.stages[: number + 1]]
        curve_picture(pictured, self.folder / "training.png")
        entry = {
            "stage": stage.name,
            "recipe": asdict(recipe),
            "episodes": len(random.states),
            "steps": random.steps,
            "seconds": log["seconds"],
            "dropped": log["dropped"],
            "stopped_early": log["stopped_early"],
            "last": log["history"][-1] if log["history"] else None,
        }
        trained = begin._replace(weights=weights, rounds=[*begin.rounds, entry])
        self.save(folder, trained, {"rounds": trained.rounds})
        self.console.print(f"{stage.name}: {log['seconds']:.0f} s, {log['dropped']} batches dropped")
        return trained

    def recipe(self, trained: TrainedWeights, scores: dict[str, Any]) -> dict[str, Any]:
        """Return the manifest's entry of how the weights were made, with their scores on held-out episodes."""
        hardware = f"{platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__} on {jax.default_backend()}"
        return {
            "rounds": trained.rounds,
            "truth": {"engine": "mujoco", "substeps": SUBSTEPS, "dt": self.scenario.scene.dt},
            "hardware": hardware,
            "scores": {"seed": EVALUATION_SEED, **scores},
        }

    def save(self, folder: Path, trained: TrainedWeights, recipe: dict[str, Any]) -> Path:
        """Write the weights and their manifest; return its path."""
        assert trained.weights is not None
        return stored.save(folder, self.scenario.name, self.model, trained.weights, recipe, trained.sizes)


class TrainedWeights(NamedTuple):
    """Weights, None before the first stage, with the manifest's entries of all rounds of training before.

    sizes: morphologies (N, L, 3) that the training has covered.
    """

    weights: Weights | None
    rounds: list[dict[str, Any]]
    sizes: np.ndarray


def cli() -> None:
    """Run the command `larp-train`."""
    run(main)


if __name__ == "__main__":
    cli()

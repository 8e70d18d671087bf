"""From nothing to the shipped weights: truth episodes, training, the planner's own candidates, evaluation.

Every stage leaves a file in the run's folder and is skipped where that file is there; training itself goes on from
its last checkpoint. So the same command takes up a run that was cut off.
"""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console

from larp_model import evaluation, networks, training
from larp_model import weights as stored
from larp_model.losses import LossWeights
from larp_model.simulator import Simulator, Weights
from larp_model.truth import episodes as truth_episodes
from larp_model.truth.episodes import Episodes
from larp_model.truth.mujoco import SUBSTEPS, Truth
from tasks.data import WINDOWS, random_episodes, random_task
from tasks.kick import WEIGHTS, Kick, dynamics_of, planners_of, prepare, remember_compilations, run

EVALUATION_SEED = 1


def planned_episodes(kick: Kick, weights: Path, tasks: int, elites: int, seed: int) -> tuple[Episodes, int]:
    """What the planner tries: of each of its plans on the way to `tasks` kicks some elites, executed in the truth.

    Returns the episodes, of `HORIZON` steps, and how many diverged.
    """
    random = np.random.default_rng(seed)
    model, _ = dynamics_of(kick.scene, "larp", weights)
    first, again, every = planners_of(kick, "balanced", model)
    states, controls = [], []
    for index in range(tasks):
        target, shift = random_task(random)
        execution = kick.run((first, again), every, target, seed + index, shift, steps=kick.reference.strike + 10)
        for replan in execution.replans:
            window = kick.window(target)(replan.step).controls
            count = elites if replan.step else 2 * elites
            for knots in np.asarray(replan.plan.elites[:count]):
                states.append(execution.states[replan.step])
                controls.append(first.controls(replan.plan._replace(elites=knots[None]), window))
    return truth_episodes.record(Truth(kick.scene, 128), np.stack(states), np.stack(controls))


def stage(path: Path, kick: Kick, make: Any, console: Console) -> Episodes:
    """The episodes of a file, made and stored first where it is not there."""
    if not path.exists():
        begin = time.perf_counter()
        episodes, dropped = make()
        truth_episodes.save(path, kick.scene, episodes)
        console.print(f"{path.name}: {len(episodes)} episodes, {dropped} diverged, {time.perf_counter() - begin:.0f} s")
    return truth_episodes.load(path, kick.scene)


def main(
    folder: Path = Path("runs/train"),
    out: Path = Path("runs/train/weights"),
    episodes: int = 12000,
    updates: tuple[int, ...] = (9000, 5000, 5000),
    tasks: int = 40,
    seed: int = 100,
) -> None:
    """Train the kick's learned simulator.

    Args:
        folder: where the run keeps its stages and checkpoints.
        out: where the weights and their manifest go.
        episodes: random truth episodes around the reference.
        updates: of the first training and of each round after the planner's candidates were added.
        tasks: kicks planned for the candidates of each round.
        seed: of the data and the training; the benchmarks use seeds below 100.
    """
    console = Console()
    remember_compilations()
    kick = prepare()
    scene, config = kick.scene, networks.COMPACT
    learned: Weights | None = None
    rounds: list[dict[str, Any]] = []
    random = stage(folder / "random.npz", kick, lambda: random_episodes(scene, kick.reference, episodes, seed), console)
    planned: list[Episodes] = []
    for number, count in enumerate(updates):
        name = f"round{number}"
        if number:
            before = folder / f"round{number - 1}" / f"{WEIGHTS}.json"
            planned.append(
                stage(
                    folder / f"planned{number}.npz", kick,
                    lambda n=number, w=before: planned_episodes(kick, w, tasks, 8, seed + 1000 * n), console,
                )
            )  # fmt: skip
        sources = [(random, 0.5 if planned else 1.0)] + [(part, 0.5 / len(planned)) for part in planned]
        recipe = training.Recipe(
            updates=count,
            learning_rate=1e-3 if number == 0 else 4e-4,
            loss=LossWeights(velocity=1e-3),
            seed=seed + number,
            curriculum=training.Recipe.curriculum if number == 0 else ((20, 1.0),),
        )
        manifest = folder / name / f"{WEIGHTS}.json"
        if manifest.exists():
            _, learned, content = stored.load(manifest, scene)
            rounds = content["recipe"]["rounds"]
            continue
        learned, log = training.train(scene, config, recipe, sources, folder / name / "checkpoints", learned)
        rounds = [
            *rounds,
            {
                "recipe": dataclasses.asdict(recipe),
                "sources": [{"episodes": len(source), "share": share} for source, share in sources],
                "seconds": log["seconds"],
                "dropped": log["dropped"],
                "stopped_early": log["stopped_early"],
                "sequences_per_second": log["history"][-1]["sequences_per_second"] if log["history"] else None,
            },
        ]
        stored.save(folder / name, WEIGHTS, scene, config, learned, {"rounds": rounds})
        console.print(f"{name}: {log['seconds']:.0f} s, {log['dropped']} batches dropped")
    assert learned is not None
    held_out, _ = random_episodes(scene, kick.reference, 256, EVALUATION_SEED)
    scores = evaluation.evaluate(Simulator(scene, config, learned), held_out, WINDOWS)
    recipe_of = {
        "rounds": rounds,
        "truth": {"engine": "mujoco", "substeps": SUBSTEPS, "dt": scene.dt},
        "hardware": f"{platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__} on {jax.default_backend()}",
        "scores": {"seed": EVALUATION_SEED, **scores},
    }
    console.print_json(json.dumps(scores))
    console.print(f"weights: {stored.save(out, WEIGHTS, scene, config, learned, recipe_of)}")


if __name__ == "__main__":
    run(main)

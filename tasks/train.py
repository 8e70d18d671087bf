"""From nothing to the weights of a scene: truth episodes, training, the planner's own candidates, evaluation.

Every stage leaves a file in the run's folder and is skipped where that file is there; training itself goes on from
its last checkpoint. So the same command takes up a run that was cut off.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
import tyro
from rich.console import Console

from larp_model import designs, evaluation, training
from larp_model import weights as stored
from larp_model.designs import DesignName, SizeName
from larp_model.errors import InputError
from larp_model.files import require_writable, write_whole
from larp_model.losses import LossWeights
from larp_model.names import require_file
from larp_model.networks import Weights
from larp_model.parts.part import Model, assemble
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from larp_model.truth import episodes as truth_episodes
from larp_model.truth.episodes import Episodes
from larp_model.truth.mujoco import SUBSTEPS, Truth
from mpc import CEM
from tasks.command import prepare_jax, run
from tasks.curve import curve_picture
from tasks.data import contact_episodes, random_task
from tasks.kick import Kick
from tasks.models import WEIGHTS, Models, learned_models
from tasks.presets import Preset
from tasks.scenarios import Scenario, scenario, trained_at

EVALUATION_SEED = 1
# Short episodes of impacts for each long one.
CONTACTS = 3
# How the planner searches for the candidates that it is trained on: by sampling, for a step by gradients tries few.
CANDIDATES = Preset((CEM(256, 10, 24, 1.0),), (CEM(128, 3, 24, 1.0),), every=4)
# Errors of a velocity count linearly: the median launch matters, not the worst.
LOSS = LossWeights(velocity=1e-2, far=0.05, fast=0.1, arm=0.14)


class TrainingStage(NamedTuple):
    """A part of the training: what it is called, which episodes it adds first, if any, and how it trains."""

    name: str
    adds: Literal["", "planned", "contacts"]
    recipe: training.Recipe


# Single steps around contacts teach impacts, at a twentieth of a rollout's price; rollouts teach the human to stay
# true. Rollouts would blur the impacts: a late foot makes any launch look wrong.
HUMAN, IMPACT, RESPONSE = ("dynamics/human",), ("dynamics/ball", "contact"), ("response",)
STEPS = training.Recipe(6000, 512, ((1, 1.0),), learning_rate=1e-3, before_contact=2, after_contact=3, loss=LOSS)
ROLLOUTS = training.Recipe(8000, 256, ((4, 0.1), (8, 0.2), (20, 0.7)), learning_rate=5e-4, loss=LOSS, only=HUMAN)
AGAIN = replace(ROLLOUTS, updates=3000, curriculum=((20, 1.0),), learning_rate=2e-4)
# Where the foot is when it meets the ball is decided by the last few steps before.
SWING = replace(AGAIN, updates=8000, curriculum=((5, 1.0),), learning_rate=4e-4, contact_share=0.8, before_contact=12)
IMPACTS = replace(
    STEPS, updates=12000, contact_share=0.9, before_contact=1, after_contact=2, only=IMPACT, loss=LOSS._replace(arm=0.0)
)
# Within a step of an impact a foot that is 2 mm off is off by 0.2 m/s: places and turns count as the speeds they are.
# The contact's own networks would pay for that with the ball's velocity, and are not trained with it.
PRECISE = LOSS._replace(position=100.0, rotation=16.0, far=1e-3)
RESPONSES = replace(IMPACTS, updates=8000, only=RESPONSE, loss=PRECISE)
# Over mechanics single steps suffice, where small errors count too.
OVER_MECHANICS = replace(
    STEPS, updates=10000, contact_share=0.4, before_contact=5, loss=LOSS._replace(far=0.005, fast=0.02)
)
GENERAL = (TrainingStage("steps", "", OVER_MECHANICS),)
# A struck ball is its launch, and nothing blurs that; what else is struck is a body like others, whose response counts
# like the push.
STRIKING_BALLS = (*GENERAL, TrainingStage("impacts", "", IMPACTS))
STRIKING = (*GENERAL, TrainingStage("impacts", "", replace(IMPACTS, only=("contact", "response"), loss=LOSS)))
# Algorithm 1 of the paper, with its losses; in small batches, which are the most updates that two cores give. Where the
# unroll grows by more at once, what worked for a few steps runs away within more.
GROWING = ((2, 0.1), (3, 0.05), (4, 0.05), (6, 0.1), (8, 0.1), (11, 0.1), (14, 0.1), (17, 0.1), (20, 0.3))
ALGORITHM_1 = training.Recipe(batch=64, curriculum=GROWING, learning_rate=3e-4, emphasis=())
PAPER = (TrainingStage("rollouts", "", ALGORITHM_1),)
KICK = (
    TrainingStage("steps", "", STEPS),
    TrainingStage("rollouts", "", ROLLOUTS),
    TrainingStage("planned1", "planned", AGAIN),
    TrainingStage("impacts1", "contacts", IMPACTS),
    TrainingStage("planned2", "planned", SWING),
    TrainingStage("impacts2", "contacts", replace(IMPACTS, updates=14000)),
    TrainingStage("responses", "", RESPONSES),
)


def stages_of(chosen: Scenario) -> tuple[TrainingStage, ...]:
    """How the weights of a scene are trained over mechanics."""
    scene = chosen.scene
    if not chosen.strikes:
        return GENERAL
    balls = any(scene.body(pair.second).is_ball for pair in scene.pairs)
    return STRIKING_BALLS if balls else STRIKING


def planned_episodes(kick: Kick, models: Models, tasks: int, elites: int, seed: int) -> tuple[Episodes, int]:
    """What the planner tries: of each of its plans on the way to `tasks` kicks some elites, executed in the truth.

    Returns the episodes, of the plans' horizon, and how many diverged.
    """
    random = np.random.default_rng(seed)
    planners = kick.planners_of(CANDIDATES, models)
    states, controls = [], []
    for index in range(tasks):
        target, shift = random_task(random)
        execution = kick.run(planners, target, seed + index, kick.start(shift), steps=kick.reference.strike + 10)
        for replan in kick.plans(execution):
            window = kick.window(target)(replan.step).controls
            count = elites if replan.step else 2 * elites
            for knots in np.asarray(replan.plan.elites[:count]):
                states.append(execution.states[replan.step])
                controls.append(planners.first.controls(replan.plan._replace(elites=knots[None]), window))
    return truth_episodes.record(Truth(kick.scene, 128), np.stack(states), np.stack(controls))


def on_policy_contacts(
    scene: Scene, random: Episodes, planned: Episodes, count: int, seed: int
) -> tuple[Episodes, int]:
    """Contacts of random episodes and of the planner's candidates, disturbed: `count` of each.

    Returns the episodes and how many diverged.
    """
    made, dropped = zip(
        *(contact_episodes(scene, source, count, seed + number) for number, source in enumerate((random, planned))),
        strict=True,
    )
    return truth_episodes.join(made), sum(dropped)


def stored_episodes(path: Path, scene: Scene, make: Callable[[], tuple[Episodes, int]], console: Console) -> Episodes:
    """The episodes of a file, made and stored first where it is not there."""
    if not path.exists():
        begin = time.perf_counter()
        episodes, dropped = make()
        truth_episodes.save(path, scene, episodes)
        seconds = time.perf_counter() - begin
        console.print(f"{path.name}: {len(episodes.states)} episodes, {dropped} dropped, {seconds:.0f} s")
    return truth_episodes.load(path, scene)


def model_of(chosen: Scenario, design: DesignName, size: SizeName | None) -> Model:
    """The untrained model of a scene."""
    if design == "hybrid":
        return designs.hybrid(chosen.scene, designs.SIZES[size or "small"])
    if size:
        raise InputError(f"size is {size!r}, but only the hybrid design comes in sizes, not {design!r}")
    return designs.DESIGNS[design](chosen.scene)


def claim(folder: Path, settings: dict[str, Any]) -> None:
    """Mark a run's folder by its settings; refuse one that was begun with others, whose stages would be kept.

    settings: what JSON holds, by the names of arguments.
    """
    path = folder / "settings.json"
    settings = json.loads(json.dumps(settings))
    if path.is_file():
        try:
            begun = dict(json.loads(path.read_text()))
        except ValueError:
            raise InputError(f"folder is {str(folder)!r}, but its settings.json is damaged: take another one") from None
        for name, value in settings.items():
            if begun.get(name) != value:
                raise InputError(
                    f"{name} is {value!r}, but the run in {folder} was begun with {begun.get(name)!r}: "
                    "take another --folder, or delete that one"
                )
    elif (folder / "random.npz").exists():
        raise InputError(f"folder is {str(folder)!r}, but holds a run of unknown settings: take another one")
    write_whole(path, (json.dumps(settings, indent=1) + "\n").encode())


def main(
    scene: str = WEIGHTS,
    design: DesignName | None = None,
    size: SizeName | None = None,
    folder: Path | None = None,
    out: Path | None = None,
    episodes: int = 10000,
    tasks: int = 30,
    effort: float = 1.0,
    seed: int = 100,
    start: Annotated[Path | None, tyro.conf.arg(name="from")] = None,
) -> None:
    """Train the learned simulator of a scene.

    Args:
        scene: what is simulated; human_ball is the kick's. Or FILE.py:NAME, a Scene or a Scenario of your own.
        design: which parts it is made of; compact for the kick and hybrid for all else by default.
        size: of the hybrid's networks; small by default.
        folder: where the run keeps its stages and checkpoints; runs/train/SCENE by default, SCENE_DESIGN_SIZE where
            they are given. A run goes on only with the settings that it was begun with.
        out: where the weights and their manifest go; a folder of the run's by default.
        episodes: random truth episodes.
        tasks: kicks planned for the candidates of each stage that adds some.
        effort: multiplies the updates of every stage.
        seed: of the data and the training; the benchmarks use seeds below 100.
        start: manifest of weights to go on from: stages that they have been through are left out.
    """
    if start and size:
        raise InputError(f"size is {size!r}, but the networks of weights to go on from keep their own: leave it out")
    console, chosen = Console(), scenario(scene)
    folder = folder or trained_at(chosen.name, design, size)
    require_writable(folder, "folder")
    if start:
        require_file("from", start)
    design = design or ("compact" if chosen.name == WEIGHTS else "hybrid")
    kick = Kick.standard() if (chosen.name, design) == (WEIGHTS, "compact") else None
    stages = PAPER if design == "paper" else KICK if kick else stages_of(chosen)
    model = model_of(chosen, design, size)
    settings = {
        "scene": chosen.name,
        "design": design,
        "size": size,
        "episodes": episodes,
        "tasks": tasks,
        "effort": effort,
        "seed": seed,
        "from": start and hashlib.sha256(start.read_bytes()).hexdigest()[:12],
        "recipe of the scene": hashlib.sha256(repr((model, stages)).encode()).hexdigest()[:12],
    }
    claim(folder, settings)
    prepare_jax()
    random = stored_episodes(folder / "random.npz", chosen.scene, lambda: chosen.draw(episodes, seed), console)
    sources = {"random": random}

    def add(name: str, make: Callable[[], tuple[Episodes, int]]) -> None:
        sources[name] = stored_episodes(folder / f"{name}.npz", chosen.scene, make, console)

    learned: Weights | None = None
    sizes = random.morphology
    rounds: list[dict[str, Any]] = []
    if start:
        given, learned, content = stored.load(start, chosen.scene, partly=True)
        # What they were trained over stays: networks that correct other mechanics would be wrong.
        model = assemble(chosen.scene, (*model.parts, *given.parts))
        rounds = content["recipe"]["rounds"]
        sizes = np.concatenate([sizes, stored.extremes(content, chosen.scene)])
    done = {each["stage"] for each in rounds}
    if chosen.strikes and any(stage.name not in done for stage in stages):
        add("contacts", partial(contact_episodes, chosen.scene, random, CONTACTS * episodes, seed + 1))
    manifest = Path()

    def save(into: Path, recipe: dict[str, Any]) -> Path:
        assert learned is not None
        return stored.save(into, chosen.name, model, learned, recipe, sizes)

    for number, stage in enumerate(stages):
        if stage.name in done:
            continue
        later = seed + 1000 * number
        if stage.adds and kick is not None and learned is not None:
            models = learned_models(chosen.scene, model, learned, stage.name)
            last = [*sources.values()][-1]
            makers = {
                "planned": partial(planned_episodes, kick, models, tasks, 8, later),
                "contacts": partial(on_policy_contacts, chosen.scene, random, last, 2 * episodes, later),
            }
            add(stage.name, makers[stage.adds])
        manifest = folder / stage.name / f"{chosen.name}.json"
        if manifest.exists():
            _, learned, content = stored.load(manifest, chosen.scene)
            rounds = content["recipe"]["rounds"]
            continue
        longest = max(steps for steps, _ in stage.recipe.curriculum)
        used = [(each, 1.0) for each in sources.values() if each.steps >= longest]
        updates = max(1, round(effort * stage.recipe.updates))
        recipe = replace(stage.recipe, updates=updates, seed=seed + number)
        learned, log = training.train(model, recipe, used, folder / stage.name, learned)
        curve_picture([folder / each.name for each in stages[: number + 1]], folder / "training.png")
        rounds = [
            *rounds,
            {
                "stage": stage.name,
                "recipe": asdict(recipe),
                "sources": [{"episodes": len(source.states), "steps": source.steps} for source, _ in used],
                "seconds": log["seconds"],
                "dropped": log["dropped"],
                "stopped_early": log["stopped_early"],
                "last": log["history"][-1] if log["history"] else None,
            },
        ]
        save(folder / stage.name, {"rounds": rounds})
        console.print(f"{stage.name}: {log['seconds']:.0f} s, {log['dropped']} batches dropped")
    assert learned is not None
    held_out, _ = chosen.draw(256, EVALUATION_SEED)
    scores = evaluation.evaluate(Simulator(model, learned), held_out, chosen.windows)
    recipe_of = {
        "rounds": rounds,
        "truth": {"engine": "mujoco", "substeps": SUBSTEPS, "dt": chosen.scene.dt},
        "hardware": f"{platform.machine()}, {os.cpu_count()} cores, jax {jax.__version__} on {jax.default_backend()}",
        "scores": {"seed": EVALUATION_SEED, **scores},
    }
    written = save(out or folder / "weights", recipe_of)
    console.print_json(json.dumps(scores))
    console.print(f"weights: {written}")


def cli() -> None:
    """The command `larp-train`."""
    run(main)


if __name__ == "__main__":
    cli()

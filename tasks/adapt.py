"""Ten minutes for yours: the shipped weights, fitted to a motion and a body of the user's own.

Truth around that motion and body and of what the planner tries there, training on from the weights, and a check on
episodes that neither saw, before and after. What is written is the better of both.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from larp_model import evaluation, training
from larp_model import weights as stored
from larp_model.anatomy import Detail
from larp_model.bodies import human_and_ball
from larp_model.files import require_writable
from larp_model.networks import Weights
from larp_model.parts.part import Model
from larp_model.simulator import Simulator
from larp_model.truth import episodes as truth_episodes
from larp_model.truth.episodes import Episodes
from larp_model.weights import Trained
from tasks.data import WINDOWS, random_episodes
from tasks.kick import HEIGHT, learned_models, prepare, remember_compilations, run
from tasks.scenarios import ANY_HUMAN, FULL_HUMAN
from tasks.train import IMPACTS, OVER_MECHANICS, on_policy_contacts, planned_episodes

# Episodes that weights are checked on, those drawn at a time, and shares of the time: random truth, and what the
# planner tries; of what is then left, the swing before the impact.
HELD_OUT, DRAWN, TRUTH, PLANS, SWING = 64, 256, 0.15, 0.2, 0.55
# Of each plan so many candidates, and more kicks than are planned in any time.
ELITES, KICKS = 8, 100
# The check at the end [s], and the least that is worth beginning [min].
CHECKING, LEAST = 20.0, 2.0
# Learning rate of what has learned already, and more updates than fit into any time.
RATE, MOST = 3e-4, 1_000_000


class Checked(NamedTuple):
    """Weights on episodes that they were not trained on: errors [m] of the human over `WINDOWS`, and of the launch.

    launch: median relative error from the true state at first contact; NaN where nothing was struck.
    """

    human: tuple[float, ...]
    launch: float

    def better_than(self, other: Checked) -> bool:
        """Whether errors are smaller on the whole: by the mean of their logarithms."""
        pairs = [*zip(self.human, other.human, strict=True), (self.launch, other.launch)]
        steps = [math.log(max(mine, 1e-6) / max(its, 1e-6)) for mine, its in pairs if mine + its == mine + its]
        return sum(steps) < 0.0


def check(model: Model, weights: Weights, episodes: Episodes) -> Checked:
    """What weights are worth; infinite where all predictions diverge."""
    found = evaluation.evaluate(Simulator(model, weights), episodes, WINDOWS)
    human = tuple(math.inf if (error := found["windows"][str(n)]["human"]) is None else error for n in WINDOWS)
    return Checked(human, found["launch"]["0"].get("relative_error", {}).get("median", math.nan))


def trained_on(
    model: Model,
    learned: Weights,
    long: list[Episodes],
    short: Episodes,
    folder: Path,
    seconds: tuple[float, float],
    seed: int,
) -> Weights:
    """Weights trained on for so many seconds: the human's swing on long episodes, then impacts on short too."""
    human = (f"dynamics/{model.scene.bodies[0].kind}",)
    swing = replace(OVER_MECHANICS, learning_rate=RATE, updates=MOST, seed=seed, only=human)
    impact = replace(IMPACTS, learning_rate=RATE, updates=MOST, seed=seed + 1)
    for name, recipe, sources, limit in (
        ("swing", swing, long, seconds[0]),
        ("impact", impact, [*long, short], seconds[1]),
    ):
        learned, _ = training.train(
            model, recipe, [(each, 1.0) for each in sources], folder / name, learned, seconds=limit
        )
    return learned


def main(
    reference: Path | None = None,
    names: Path | None = None,
    height: float = HEIGHT,
    mass: float | None = None,
    body: Detail = "lean",
    minutes: float = 10.0,
    weights: Path | None = None,
    out: Path = Path("runs/adapt"),
    seed: int = 0,
) -> None:
    """Fit the weights of the learned simulator to a motion and a body.

    Args:
        reference: a captured kick (BVH, or npz of joint angles); the embedded one by default.
        names: JSON object of what the BVH file calls our joints: {"Hips": "pelvis", ...}; known skeletons need none.
        height: of the human [m].
        mass: of the human [kg]; as heavy as its height squared by default.
        body: lean: 13 links; full: 26, with a spine, hands and toes.
        minutes: that it may take.
        weights: manifest of the weights to go on from; those shipped for any human by default.
        out: folder for the new weights and their manifest.
        seed: of the truth and the training.
    """
    begin = time.perf_counter()
    if not (math.isfinite(minutes) and minutes >= LEAST):
        raise ValueError(f"minutes is {minutes:g}, but must be at least {LEAST:g}: nothing is learned in less")
    if reference is not None and not reference.is_file():
        raise ValueError(f"reference is {str(reference)!r}, but no such file exists")
    require_writable(out, "out")
    remember_compilations()
    console, whole = Console(), 60.0 * minutes

    def tell(what: str) -> None:
        left = max(0.0, whole - (time.perf_counter() - begin)) / 60.0
        console.print(f"{what}; {left:.1f} min left")

    known_by = weights or stored.SHIPPED / f"{ANY_HUMAN if body == 'lean' else FULL_HUMAN}.json"
    model, start, content = stored.load(known_by, human_and_ball(detail=body))
    kick = prepare(reference, height, mass=mass, names=names, detail=body)
    scene, known = kick.scene, stored.trained_sizes(content)
    model = model.on(scene)
    for difference in (each for body in scene.bodies for each in stored.beyond(body, known[body.kind])):
        console.print(f"beyond what the weights know: {difference}")
        break
    held_out, _ = random_episodes(scene, kick.reference, HELD_OUT, 1_000_000 + seed)
    before = check(model, start, held_out)
    tell(f"{HELD_OUT} episodes to check on; {described(before)}")
    drawing = time.perf_counter()
    parts: list[Episodes] = []
    while not parts or (time.perf_counter() - drawing < TRUTH * whole and len(parts) * DRAWN < MOST):
        parts.append(random_episodes(scene, kick.reference, DRAWN, seed + len(parts))[0])
    long = truth_episodes.join(parts)
    tried, _ = planned_episodes(kick, learned_models(scene, model, start, "start"), KICKS, ELITES, seed, PLANS * whole)
    short, _ = on_policy_contacts(scene, long, tried, len(long.states), seed)
    tell(f"{len(long.states)} random episodes, {len(tried.states)} of plans, {len(short.states)} of impacts")
    left = whole - (time.perf_counter() - begin) - CHECKING
    with tempfile.TemporaryDirectory() as folder:
        learned = trained_on(
            model, start, [long, tried], short, Path(folder), (SWING * left, (1.0 - SWING) * left), seed
        )
    after = check(model, learned, held_out)
    tell(f"trained; {described(after)}")
    better = after.better_than(before)
    if not better:
        console.print("what was learned is no better on the whole: the weights stay as they were")
    recipe = {
        "adapted from": content["sha256"],
        "reference": None if reference is None else reference.name,
        "height": height,
        "mass": mass,
        "kept": "after" if better else "before",
        "before": before._asdict(),
        "after": after._asdict(),
        "recipe": content["recipe"],
    }
    sizes = np.stack(
        [np.concatenate([getattr(known[body.kind], end) for body in scene.bodies]) for end in Trained._fields]
    )
    written = stored.save(
        out, "adapted", model, learned if better else start, recipe, np.concatenate([sizes, scene.morphology[None]])
    )
    console.print(f"weights: {written}; {time.perf_counter() - begin:.0f} s in all")


def described(found: Checked) -> str:
    """In a few words."""
    human = " / ".join(f"{1000.0 * error:.1f}" for error in found.human)
    return f"human {human} mm over {' / '.join(map(str, WINDOWS))} steps, launch {100.0 * found.launch:.0f} %"


if __name__ == "__main__":
    run(main)

"""Ten minutes for yours: the shipped weights, fitted to a motion and a body of the user's own.

Truth around that motion and body and of what the planner tries there, training on from the weights, and a check on
episodes that neither saw, before and after. What is written is the better of both.
"""

from __future__ import annotations

import math
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from larp_model import evaluation, training
from larp_model import weights as stored
from larp_model.anatomy import Detail
from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from larp_model.files import require_writable
from larp_model.names import require_file
from larp_model.networks import Weights
from larp_model.parts.part import Model
from larp_model.simulator import Simulator
from larp_model.truth import episodes as truth_episodes
from larp_model.truth.episodes import Episodes
from tasks.command import prepare_jax, run
from tasks.data import STEPS, WINDOWS, contact_episodes, random_episodes
from tasks.kick import Kick
from tasks.scenarios import ANY_HUMAN
from tasks.task import HEIGHT
from tasks.train import IMPACTS, OVER_MECHANICS
from tasks.tried import tried_episodes

# Episodes that weights are checked on, and those drawn at a time.
HELD_OUT, DRAWN = 64, 256
# Shares of the time: random truth, random truth of the strike alone, and what the planner tries; of what is then left,
# the swing before the impact.
TRUTH, STRIKES, PLANS, SWING = 0.08, 0.1, 0.2, 0.4
# Steps of episodes of the strike alone, and of those from just before a recorded contact. Different strikes are what
# impacts are learned from: from a few thousand, each disturbed, weights learn those few.
STRIKE, IMPACT = 14, 6
# Of each plan so many of what it tried, and more kicks than are planned in any time.
TRIED, KICKS = 128, 1000
# The check at the end [s], and the least that is worth beginning [min].
CHECKING, LEAST = 20.0, 2.0
# Learning rate of a swing that has been learned already, and more updates than fit into any time.
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
    swings: Sequence[Episodes],
    impacts: Sequence[Episodes],
    folder: Path,
    seconds: tuple[float, float],
    seed: int,
) -> Weights:
    """Weights trained on for so many seconds: the human's swing, then impacts; every episode counts alike."""
    human = (f"dynamics/{model.scene.bodies[0].kind}",)
    swing = replace(OVER_MECHANICS, learning_rate=RATE, updates=MOST, seed=seed, only=human)
    impact = replace(IMPACTS, updates=MOST, seed=seed + 1)
    for name, recipe, sources, limit in (
        ("swing", swing, swings, seconds[0]),
        ("impact", impact, impacts, seconds[1]),
    ):
        shares = [(each, float(len(each.states))) for each in sources]
        learned, _ = training.train(model, recipe, shares, folder / name, learned, seconds=limit)
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
        raise InputError(f"minutes is {minutes:g}, but must be at least {LEAST:g}: nothing is learned in less")
    if reference is not None:
        require_file("reference", reference)
    require_writable(out, "out")
    prepare_jax()
    console, whole = Console(), 60.0 * minutes

    def tell(what: str) -> None:
        left = max(0.0, whole - (time.perf_counter() - begin)) / 60.0
        console.print(f"{what}; {left:.1f} min left")

    known_by = weights or stored.SHIPPED / f"{ANY_HUMAN[body]}.json"
    model, start, content = stored.load(known_by, human_and_ball(detail=body))
    kick = Kick.standard(reference, height, mass=mass, names=names, body=body)
    scene, known = kick.scene, stored.trained_sizes(content)
    model = model.on(scene)
    for difference in (each for body in scene.bodies for each in stored.beyond(body, known[body.kind])):
        console.print(f"beyond what the weights know: {difference}")
        break
    held_out, _ = random_episodes(scene, kick.reference, HELD_OUT, 1_000_000 + seed)
    before = check(model, start, held_out)
    tell(f"{HELD_OUT} episodes to check on; {described(before)}")

    def drawn(steps: int, share: float, first: int) -> Episodes:
        """Random truth of so many steps, for a share of the time."""
        began, parts = time.perf_counter(), list[Episodes]()
        while not parts or (time.perf_counter() - began < share * whole and len(parts) * DRAWN < MOST):
            parts.append(random_episodes(scene, kick.reference, DRAWN, first + len(parts), steps)[0])
        return truth_episodes.join(parts)

    long, strikes = drawn(STEPS, TRUTH, seed), drawn(STRIKE, STRIKES, 2_000_000 + seed)
    tried = tried_episodes(kick, KICKS, TRIED, seed, PLANS * whole)
    impacts = [
        contact_episodes(scene, source, round(share * len(strikes.states)), seed + number, IMPACT)[0]
        for number, (source, share) in enumerate(((strikes, 0.5), (long, 0.25), (tried, 1.0)))
    ]
    counts = [sum(len(each.states) for each in kind) for kind in ((long,), (tried,), (strikes, *impacts))]
    tell("{} random episodes, {} of plans, {} of strikes".format(*counts))
    left = whole - (time.perf_counter() - begin) - CHECKING
    with tempfile.TemporaryDirectory() as folder:
        learned = trained_on(
            model, start, (long, tried), (strikes, *impacts), Path(folder), (SWING * left, (1.0 - SWING) * left), seed
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
    sizes = np.concatenate([stored.extremes(content, scene), scene.morphology[None]])
    written = stored.save(out, "adapted", model, learned if better else start, recipe, sizes)
    console.print(f"weights: {written}; {time.perf_counter() - begin:.0f} s in all")


def described(found: Checked) -> str:
    """In a few words."""
    human = " / ".join(f"{1000.0 * error:.1f}" for error in found.human)
    return f"human {human} mm over {' / '.join(map(str, WINDOWS))} steps, launch {100.0 * found.launch:.0f} %"


def cli() -> None:
    """The command `larp-adapt`."""
    run(main)


if __name__ == "__main__":
    cli()

"""Training, in about ten minutes, of a network that corrects physics for a motion and a body of the user's own.

The network is trained on ground-truth episodes around that motion and body and on rollouts of the planner's candidates
there. Physics alone and the trained network are checked on the same held-out episodes; the better one is written.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from rich.console import Console

from larp_model import designs, evaluation, training
from larp_model import weights as stored
from larp_model.anatomy import Detail
from larp_model.designs import SizeName
from larp_model.engines import episodes as truth_episodes
from larp_model.engines.episodes import Episodes
from larp_model.errors import InputError
from larp_model.files import require_writable
from larp_model.learned.model import Model
from larp_model.learned.residual import ResidualModel
from larp_model.names import require_file
from larp_model.networks import Weights
from larp_model.simulator import Simulator
from tasks.command import prepare_jax, run
from tasks.episodes.around_kick import random_episodes
from tasks.episodes.candidates import tried_episodes
from tasks.kick import Kick
from tasks.scenarios import WINDOWS
from tasks.task import HEIGHT
from tasks.train import OVER_PHYSICS

# Episodes that weights are checked on, and those drawn at a time.
HELD_OUT, DRAWN = 64, 256
# Shares of the time: random episodes, and rollouts of the planner's candidates.
TRUTH, PLANS = 0.15, 0.2
# Rollouts taken from each plan, and more kicks than are planned in any time.
ROLLOUTS_PER_PLAN, KICKS = 128, 1000
# The check at the end [s], and the least that is worth beginning [min].
CHECKING, LEAST = 20.0, 2.0
# More updates than fit into any time.
MOST = 1_000_000


class Checked(NamedTuple):
    """Errors of weights on held-out episodes: of the human over `WINDOWS` [m], and of the launch.

    launch: median relative error from the true state at first contact; NaN where nothing was struck.
    """

    human: tuple[float, ...]
    launch: float

    def better_than(self, other: Checked) -> bool:
        """Return whether errors are smaller on the whole: by the mean of their logarithms."""
        pairs = [*zip(self.human, other.human, strict=True), (self.launch, other.launch)]
        steps = [math.log(max(own, 1e-6) / max(its, 1e-6)) for own, its in pairs if not math.isnan(own + its)]
        return sum(steps) < 0.0


def check(model: Model, weights: Weights, episodes: Episodes) -> Checked:
    """Return the errors of weights on episodes; the human's are infinite where all predictions diverge."""
    errors = evaluation.evaluate(Simulator.of(model, weights), episodes, WINDOWS)
    human = tuple(math.inf if (error := errors["windows"][str(n)]["human"]) is None else error for n in WINDOWS)
    return Checked(human, errors["launch"]["0"].get("relative_error", {}).get("median", math.nan))


def main(
    reference: Path | None = None,
    names: Path | None = None,
    height: float = HEIGHT,
    mass: float | None = None,
    body: Detail = "lean",
    minutes: float = 10.0,
    size: SizeName = "small",
    out: Path = Path("runs/adapt"),
    seed: int = 0,
) -> None:
    """Fit a network that corrects physics to a motion and a body.

    Args:
        reference: a captured kick (BVH, or npz of joint angles); the embedded one by default.
        names: JSON object of what the BVH file calls our joints: {"Hips": "pelvis", ...}; known skeletons need none.
        height: of the human [m].
        mass: of the human [kg]; as heavy as its height squared by default.
        body: lean: 13 links; full: 26, with a spine, hands and toes.
        minutes: that it may take.
        size: of the network.
        out: folder for the weights and their manifest.
        seed: of the truth and the training.
    """
    begin = time.perf_counter()
    if not (math.isfinite(minutes) and minutes >= LEAST):
        raise InputError(f"minutes is {minutes:g}, but must be at least {LEAST:g}: nothing is learned in less")
    if reference is not None:
        require_file("reference", reference)
    require_writable(out, "out")
    prepare_jax()
    console, budget_seconds = Console(), 60.0 * minutes

    def tell(message: str) -> None:
        left = max(0.0, budget_seconds - (time.perf_counter() - begin)) / 60.0
        console.print(f"{message}; {left:.1f} min left")

    kick = Kick.standard(reference, height, mass=mass, names=names, body=body)
    scene = kick.scene
    physics, no_weights = ResidualModel(scene), Weights({}, {}, {})
    held_out, _ = random_episodes(scene, kick.reference, HELD_OUT, 1_000_000 + seed)
    before = check(physics, no_weights, held_out)
    tell(f"{HELD_OUT} episodes to check on; {described(before)}")
    drawing_began, parts = time.perf_counter(), list[Episodes]()
    while not parts or (time.perf_counter() - drawing_began < TRUTH * budget_seconds and len(parts) * DRAWN < MOST):
        parts.append(random_episodes(scene, kick.reference, DRAWN, seed + len(parts))[0])
    random, of_plans = (
        truth_episodes.join(parts),
        tried_episodes(kick, KICKS, ROLLOUTS_PER_PLAN, seed, PLANS * budget_seconds),
    )
    tell(f"{len(random.states)} random episodes, {len(of_plans.states)} of plans")
    model = designs.design(scene, "residual", size)
    recipe = replace(OVER_PHYSICS, updates=MOST, seed=seed)
    left = budget_seconds - (time.perf_counter() - begin) - CHECKING
    with tempfile.TemporaryDirectory() as folder:
        sources = [(drawn, float(len(drawn.states))) for drawn in (random, of_plans)]
        learned, _ = training.train(model, recipe, sources, Path(folder), seconds=left)
    after = check(model, learned, held_out)
    tell(f"trained; {described(after)}")
    better = after.better_than(before)
    if not better:
        console.print("what was learned is no better on the whole: what is written is physics alone")
    content = {
        "reference": None if reference is None else reference.name,
        "height": height,
        "mass": mass,
        "kept": "after" if better else "before",
        "before": before._asdict(),
        "after": after._asdict(),
    }
    written = stored.save(out, "adapted", *((model, learned) if better else (physics, no_weights)), content)
    console.print(f"weights: {written}; {time.perf_counter() - begin:.0f} s in all")


def described(errors: Checked) -> str:
    """Return the errors in a few words: of the human [mm], of the launch [%]."""
    human = " / ".join(f"{1000.0 * error:.1f}" for error in errors.human)
    return f"human {human} mm over {' / '.join(map(str, WINDOWS))} steps, launch {100.0 * errors.launch:.0f} %"


def cli() -> None:
    """Run the command `larp-adapt`."""
    run(main)


if __name__ == "__main__":
    cli()

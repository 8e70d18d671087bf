"""Training, in about ten minutes, of a network that corrects physics for a motion and a body of the user's own.

The network is trained on ground-truth episodes around that motion and body and on rollouts of the planner's candidates
there. Physics alone and the trained network are checked on the same held-out episodes; the better one is written.
"""

from __future__ import annotations

import math
import tempfile
import time
from dataclasses import dataclass, replace
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
from tasks.episodes.candidates import candidate_episodes
from tasks.kick import Kick
from tasks.scenarios import WINDOWS
from tasks.task import HEIGHT
from tasks.train import OVER_PHYSICS

# Episodes that weights are checked on, and those drawn at a time.
HELD_OUT, DRAWN = 64, 256
# Shares of the time: random episodes, and rollouts of the planner's candidates.
RANDOM_SHARE, CANDIDATE_SHARE = 0.15, 0.2
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
        seed: of the episodes and the training.
    """
    begin = time.perf_counter()
    if not (math.isfinite(minutes) and minutes >= LEAST):
        raise InputError(f"minutes is {minutes:g}, but must be at least {LEAST:g}: nothing is learned in less")
    if reference is not None:
        require_file("reference", reference)
    require_writable(out, "out")
    prepare_jax()
    clock = Clock(begin, 60.0 * minutes, Console())
    kick = Kick.standard(reference, height, mass=mass, names=names, body=body)
    scene = kick.scene
    physics, no_weights = ResidualModel(scene), Weights({}, {}, {})
    held_out, _ = random_episodes(scene, kick.reference, HELD_OUT, 1_000_000 + seed)
    before = check(physics, no_weights, held_out)
    clock.tell(f"{HELD_OUT} episodes to check on; {described(before)}")
    model = designs.design(scene, "residual", size)
    learned = trained(kick, model, seed, clock)
    after = check(model, learned, held_out)
    clock.tell(f"trained; {described(after)}")
    better = after.better_than(before)
    if not better:
        clock.console.print("what was learned is no better on the whole: what is written is physics alone")
    content = {
        "reference": None if reference is None else reference.name,
        "height": height,
        "mass": mass,
        "kept": "after" if better else "before",
        "before": before._asdict(),
        "after": after._asdict(),
    }
    written = stored.save(out, "adapted", *((model, learned) if better else (physics, no_weights)), content)
    clock.console.print(f"weights: {written}; {time.perf_counter() - begin:.0f} s in all")


@dataclass(frozen=True)
class Clock:
    """Time budget [s] from a beginning on, on the scale of `time.perf_counter`, and the console that shows it."""

    begin: float
    budget: float
    console: Console

    @property
    def left(self) -> float:
        """Return the time that is left [s]; negative beyond the budget."""
        return self.budget - (time.perf_counter() - self.begin)

    def tell(self, message: str) -> None:
        """Print a message with the time that is left."""
        self.console.print(f"{message}; {max(0.0, self.left) / 60.0:.1f} min left")


def trained(kick: Kick, model: Model, seed: int, clock: Clock) -> Weights:
    """Return weights trained, as long as there is time, on random episodes around a kick and on plans' candidates."""
    begin, parts = time.perf_counter(), list[Episodes]()
    while not parts or (time.perf_counter() - begin < RANDOM_SHARE * clock.budget and len(parts) * DRAWN < MOST):
        parts.append(random_episodes(kick.scene, kick.reference, DRAWN, seed + len(parts))[0])
    random = truth_episodes.join(parts)
    candidates = candidate_episodes(kick, KICKS, ROLLOUTS_PER_PLAN, seed, CANDIDATE_SHARE * clock.budget)
    clock.tell(f"{len(random.states)} random episodes, {len(candidates.states)} of plans")
    recipe = replace(OVER_PHYSICS, updates=MOST, seed=seed)
    sources = [(episodes, float(len(episodes.states))) for episodes in (random, candidates)]
    with tempfile.TemporaryDirectory() as folder:
        weights, _ = training.train(model, recipe, sources, Path(folder), seconds=clock.left - CHECKING)
    return weights


def described(errors: Checked) -> str:
    """Return the errors in a few words: of the human [mm], of the launch [%]."""
    human = " / ".join(f"{1000.0 * error:.1f}" for error in errors.human)
    return f"human {human} mm over {' / '.join(map(str, WINDOWS))} steps, launch {100.0 * errors.launch:.0f} %"


def cli() -> None:
    """Run the command `larp-adapt`."""
    run(main)


if __name__ == "__main__":
    cli()

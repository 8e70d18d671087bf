"""Task of kicking a ball to a target.

    minimise over theta   w_t |x_b(t*) - p|                     the ball's path passes the target p
                        + ...                                   near the reference: see `task`

t* is the moment at which the ball is nearest to p, between steps too.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, get_args

import numpy as np

from larp_model import state as packed
from larp_model.anatomy import Detail
from larp_model.files import require_writable
from larp_model.names import require_file
from mpc import nearest_on_path
from tasks.command import Teller, prepare_jax, run
from tasks.models import DynamicsName
from tasks.presets import PRESETS, Preset, PresetName, changed, preset_of
from tasks.run import Run
from tasks.session import Session
from tasks.task import HEIGHT, Task, check_target

# A typical target (3,) [m]: straight ahead.
USUAL = np.array([4.0, 0.0, 0.5])


class Kick(Task):
    """Task of kicking the ball so that it passes a target (3,) [m]."""

    name = "kick"

    def check(self, goal: np.ndarray | tuple[float, float, float]) -> np.ndarray:
        """See `Task`."""
        return check_target(goal)

    def miss(self, states: Any, times: Any, goal: Any) -> Any:
        """See `Task`."""
        nearest, _ = nearest_on_path(states[:, self.ball, packed.POSITION], goal)
        return nearest - goal

    def marker(self, goal: np.ndarray) -> np.ndarray:
        """See `Task`."""
        return goal


def main(
    target: tuple[float, float, float] = (4.0, 0.0, 0.5),
    preset: PresetName = "balanced",
    change: tuple[str, ...] = (),
    dynamics: DynamicsName = "larp",
    reference: Path | None = None,
    names: Path | None = None,
    weights: Path | None = None,
    height: float = HEIGHT,
    mass: float | None = None,
    body: Detail = "lean",
    self_contact: bool = False,
    seed: int = 0,
    out: Path = Path("runs/kick"),
    view: bool = False,
    host: str = "127.0.0.1",
    port: int = 8080,
    allow_host: tuple[str, ...] = (),
    video: Path | None = None,
    quiet: bool = False,
    json: bool = False,
) -> None:
    """Plan a kick, execute it in MuJoCo, show how far the ball passed from its target.

    Args:
        target: where the ball's centre should pass [m]: forwards, to the left, up.
        preset: how much a plan may cost.
        change: fields of the preset to change: interval=2 replan.0.rounds=3 "verify=(4, 2)".
        dynamics: the planner's model: larp or mujoco.
        reference: a captured kick (BVH, npz of joint angles, or joints in space: TRC, C3D, npz) instead of the embedded
            one.
        names: JSON object of what the file calls our joints, {"Hips": "pelvis", ...}, which known skeletons do not
            need; and of its conventions, {"up": "z", "unit": "inches", "rest": "T-pose"}, where they are not found.
        weights: manifest of weights that correct larp's physics; none by default.
        height: of the human [m].
        mass: of the human [kg]; as heavy as its height squared by default.
        body: lean: 13 links; full: 26, with a spine, hands and toes.
        self_contact: let one leg touch the other, below the knee; else they pass through each other.
        seed: of the planner's random numbers.
        out: folder for summary.json, kick.npz, kick.png and kick.html.
        view: show the kick live in the browser; there, set what you like and kick again.
        host: of the page; others can use it where they reach the host.
        port: of the page.
        allow_host: names of hosts by which a proxy before the page is reached, such as hub.example.org.
        video: a film of the kick to write: FILE.mp4 or FILE.gif.
        quiet: print nothing.
        json: print the summary as JSON, and all other output on stderr.
    """
    goal = check_target(target)
    human = HumanOptions(reference, names, height, mass, body, self_contact)
    plans = PlanOptions(" ".join((preset, *change)), changed(preset_of(preset), change), dynamics, weights, seed)
    outputs = Outputs(out, video, Teller(quiet, json))
    outputs.check()
    address = PageAddress(host, port, allow_host) if view else None
    prepare_jax()
    with outputs.tell.part("setting up"):
        session = Session(human.task(), dynamics, weights)
        session.planners(plans.preset)
    if read := session.task.reference.read:
        outputs.tell(f"{reference} is read with {read}")
    if address is None:
        run_once(session, goal, plans, outputs)
    else:
        serve(session, goal, human, plans, outputs, address)


@dataclass(frozen=True)
class HumanOptions:
    """Options of the human and its reference; see the arguments of `main`. A reference must be a file."""

    reference: Path | None
    names: Path | None
    height: float
    mass: float | None
    body: Detail
    self_contact: bool

    def __post_init__(self) -> None:
        if self.reference is not None:
            require_file("reference", self.reference)

    def task(self) -> Kick:
        """Return the kick of this human near its reference."""
        return Kick.standard(self.reference, self.height, self.mass, self.body, self.self_contact, self.names)

    def embedded_task(self) -> Kick:
        """Return the kick of this human near the embedded reference."""
        return Kick.standard(None, self.height, self.mass, self.body, self.self_contact)


@dataclass(frozen=True)
class PlanOptions:
    """Options of the planner; see the arguments of `main`. label: the preset's name with its changes."""

    label: str
    preset: Preset
    dynamics: DynamicsName
    weights: Path | None
    seed: int


@dataclass(frozen=True)
class PageAddress:
    """Address of the page; see the arguments of `main`. Raises InputError if it cannot be opened."""

    host: str
    port: int
    allow_host: tuple[str, ...]

    def __post_init__(self) -> None:
        from viewer import require_address

        require_address(self.host, self.port, self.allow_host)


@dataclass(frozen=True)
class Outputs:
    """Folder and film to write, and the printer of progress and result; see the arguments of `main`."""

    folder: Path
    video: Path | None
    tell: Teller

    def check(self) -> None:
        """Raise InputError if a file cannot be written."""
        require_writable(self.folder, "out")
        if self.video is not None:
            from viewer import check_film

            check_film(self.video)
            require_writable(self.video.parent, "video")

    def write(self, kick: Run) -> None:
        """Write the files of a run, and print its result."""
        with self.tell.part("writing"):
            kick.save(self.folder)
        self.tell.result(kick.table, kick.summary)
        if self.video is not None:
            from viewer import write_film

            with self.tell.part(f"filming {self.video}"):
                write_film(kick.recording, self.video)
        self.tell(f"{self.folder}/: summary.json, kick.npz, kick.png, kick.html")


def run_once(session: Session, goal: np.ndarray, plans: PlanOptions, outputs: Outputs) -> None:
    """Plan and execute one kick, print how long the parts took, and write the run."""
    begin = time.perf_counter()
    outputs.tell("planning and executing; what is new is compiled first")
    kick = session.run(goal, plans.preset, plans.seed)
    kick.summary["preset"] = plans.label
    infos = [info for plan in kick.execution.plans for info in (plan.info, plan.feedback) if info is not None]
    compiling, planning = (sum(getattr(info, name) for info in infos) for name in ("compile_seconds", "seconds"))
    executing = time.perf_counter() - begin - compiling - planning
    outputs.tell(f"compiling {compiling:.1f} s, planning {planning:.1f} s, executing {executing:.1f} s")
    outputs.write(kick)


def serve(
    session: Session, goal: np.ndarray, human: HumanOptions, plans: PlanOptions, outputs: Outputs, address: PageAddress
) -> None:
    """Show the page, on which the user chooses and kicks, until Ctrl-C; the first kick begins at once."""
    from tasks.live import Live
    from tasks.live_choices import Choices, weights_for
    from viewer import LivePage

    reference = human.reference
    tasks: dict[str, Callable[[], Task]] = {"embedded" if reference is None else reference.name: lambda: session.task}
    if reference is not None:
        tasks["embedded"] = human.embedded_task
    models = (plans.dynamics, *(other for other in get_args(DynamicsName) if other != plans.dynamics))
    choices = Choices(tasks, {plans.label: plans.preset} | PRESETS, models, weights_for(plans.weights))
    with LivePage(address.host, address.port, choices.offer(session.task), address.allow_host) as page:
        outputs.tell(f"watch it at {page.address} (Ctrl-C ends)")
        live = Live(page, choices, goal, outputs.folder / "kept", plans.seed, outputs.write)
        live.serve("kick")


def cli() -> None:
    """Run the command `larp-kick`."""
    run(main)


if __name__ == "__main__":
    cli()

"""Task of kicking a ball to a target.

    minimise over theta   w_t |x_b(t*) - p|                     the ball's path passes the target p
                        + w_f min_t |x_f(t) - x_b(t)|^2         the foot reaches the ball
                        + ...                                   and the body stays near the reference: see `task`

t* is the moment at which the ball is nearest to p, between steps too.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, get_args

import numpy as np

from larp_model import state as packed
from larp_model.anatomy import Detail
from larp_model.engines.mujoco import FINE_SUBSTEPS, Truth
from larp_model.errors import InputError
from larp_model.files import require_writable
from larp_model.names import require_file
from mpc import CostTerm, l2, quadratic
from mpc.loop import Execution
from tasks import residuals
from tasks.command import Teller, prepare_jax, run
from tasks.gap import contact_step, gap, told
from tasks.live import Choices, Live, weights_for
from tasks.models import DynamicsName
from tasks.presets import PRESETS, PresetName, changed, preset_of
from tasks.task import AFTER_CONTACT, HEIGHT, REACHABLE, Run, Task, checked_target
from viewer import LivePage, Wishes, check_film, nearest_approach, require_address, write_film

Pair = np.ndarray | tuple[float, float]
# A typical target (3,) [m]: straight ahead.
USUAL = np.array([4.0, 0.0, 0.5])


class Kick(Task):
    """Task of kicking the ball so that it passes a target (3,) [m]."""

    name = "kick"

    @property
    def goals(self) -> tuple[CostTerm, ...]:
        """See `Task`."""
        target = partial(residuals.miss, ball=self.ball)
        find_ball = partial(residuals.apart, link=self.foot, other=self.ball)
        return CostTerm("target", target, l2(0.05), 10.0), CostTerm("find_ball", find_ball, quadratic, 5.0)

    def asked(self, goal: np.ndarray | tuple[float, float, float]) -> np.ndarray:
        """See `Task`."""
        return checked_target(goal)

    def place(self, goal: np.ndarray) -> np.ndarray:
        """See `Task`."""
        return goal

    def over(self, start: np.ndarray, steps: int) -> Callable[[int, np.ndarray], bool]:
        """See `Task`; the task is over when the ball has been touched."""
        return self.touched(start, steps)

    def start(self, ball_offset: Pair = (0.0, 0.0), ball_velocity: Pair = (0.0, 0.0)) -> np.ndarray:
        """Return the state (L, 13) before the kick, the ball moved by an offset (2,) [m] along the ground.

        ball_velocity: (2,) [m/s] of a ball that rolls so that it passes that place when the reference strikes.
        """
        for name, value in (("ball_offset", ball_offset), ("ball_velocity", ball_velocity)):
            if np.shape(value) != (2,) or not np.isfinite(value).all():
                raise InputError(f"{name} is {value}, but must be two finite numbers")
        state = self.reference.states[0].copy()
        ball = state[self.ball]
        ball[:2] += ball_offset
        radius = self.scene.links[self.ball].radius
        ball[7:9] = ball_velocity
        ball[10:12] = -ball_velocity[1] / radius, ball_velocity[0] / radius
        way = self.untouched(state, self.reference.strike)[-1]
        ball[:2] -= way[:2] - ball[:2]
        return state

    def report(self, execution: Execution, goal: np.ndarray) -> dict[str, Any]:
        """See `Task`; the README explains each entry."""
        states = np.stack(execution.states)
        free = self.untouched(states[0], len(states) - 1)[:, packed.VELOCITY]
        contact = contact_step(states, free)
        begin, end = after_contact(contact, len(states))
        last = self.plans(execution)[-1]
        truth_error = miss(states[begin:end, self.ball, packed.POSITION], goal)
        model_error = miss(last.info.states[:, self.ball, packed.POSITION], goal)
        return {
            "target": [float(x) for x in goal],
            "truth_error_m": truth_error,
            "limit_error_m": truth_error if self.substeps == FINE_SUBSTEPS else self.replayed(execution, goal),
            "model_error_m": model_error,
            "ball_speed_m_s": float(np.linalg.norm(states[begin:end, self.ball, packed.VELOCITY], axis=-1).max()),
            "touched": contact is not None,
            "reachable": model_error <= REACHABLE,
            "gap": gap(self.scene, states, np.concatenate([last.state[None], last.info.states]), last.step, free),
            **self.figures(execution, begin, end),
        }

    def title(self, goal: np.ndarray) -> str:
        """See `Task`."""
        return "Kick to ({:.2f}, {:.2f}, {:.2f}) m".format(*goal)

    def facts(self, summary: dict[str, Any]) -> dict[str, str]:
        """See `Task`."""
        found = {
            "the model expected": f"{100 * summary['model_error_m']:.1f} cm",
            "ball speed": f"{summary['ball_speed_m_s']:.1f} m/s",
            "distance from the reference": f"{100 * summary['reference_deviation_m']:.1f} cm",
            "planned with": f"{summary['dynamics']}, {summary['preset']}",
            **told(summary["gap"]),
        }
        if summary["fell"]:
            found["fell"] = "yes"
        if not summary["reachable"]:
            found["reachable"] = "no: this plan comes nearest"
        return found

    def replayed(self, execution: Execution, target: np.ndarray, substeps: int = FINE_SUBSTEPS) -> float:
        """Return the miss [m] of the executed controls, replayed from the start in the ground truth.

        substeps: engine steps in a step of the replay.
        """
        start, controls = execution.states[0], np.stack(execution.controls)
        after, _ = Truth(self.scene, 1, substeps, threads=1).rollout(start[None], controls[None])
        states = np.concatenate([start[None], after[0]])
        free = self.untouched(start, len(controls))[:, packed.VELOCITY]
        begin, end = after_contact(contact_step(states, free), len(states))
        return miss(states[begin:end, self.ball, packed.POSITION], target)


def after_contact(contact: int | None, count: int) -> tuple[int, int]:
    """Return the range of `count` states in which the miss is measured: from first contact, if any, to 2 s after it."""
    return (0, count) if contact is None else (max(contact - 1, 0), min(contact + AFTER_CONTACT + 1, count))


def miss(path: np.ndarray, target: np.ndarray) -> float:
    """Return the smallest distance [m] of the ball's path (T, 3) from the target (3,)."""
    return nearest_approach(path, target).distance


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
        change: fields of the preset to change: every=2 again.0.rounds=3 "verify=(4, 2)".
        dynamics: the planner's model: larp or mujoco.
        reference: a captured kick (BVH, or npz of joint angles) instead of the embedded one.
        names: JSON object of what the BVH file calls our joints: {"Hips": "pelvis", ...}; known skeletons need none.
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
        json: print the summary as JSON, and on stderr what else is told.
    """
    goal = checked_target(target)
    if reference is not None:
        require_file("reference", reference)
    chosen = changed(preset_of(preset), change)
    require_writable(out, "out")
    if video is not None:
        check_film(video)
        require_writable(video.parent, "video")
    if view:
        require_address(host, port, allow_host)
    prepare_jax()
    tell = Teller(quiet, json)
    with tell.part("setting up"):
        kick = Kick.standard(reference, height, mass, body, self_contact, names)
        kick.planners(chosen, dynamics, weights)
    called = " ".join((preset, *change))

    def finished(kicked: Run) -> None:
        with tell.part("writing"):
            kicked.save(out)
        tell.result(kicked.table, kicked.summary)
        if video is not None:
            with tell.part(f"filming {video}"):
                write_film(kicked.recording, video)
        tell(f"{out}/: summary.json, kick.npz, kick.png, kick.html")

    if not view:
        begin = time.perf_counter()
        tell("planning and executing; what is new is compiled first")
        kicked = kick.to(goal, chosen, dynamics, weights, seed)
        kicked.summary["preset"] = called
        replans = [replan.info for replan in kicked.execution.replans]
        compiling, planning = (sum(getattr(info, name) for info in replans) for name in ("compile_seconds", "seconds"))
        executing = time.perf_counter() - begin - compiling - planning
        tell(f"compiling {compiling:.1f} s, planning {planning:.1f} s, executing {executing:.1f} s")
        finished(kicked)
        return
    tasks: dict[str, Callable[[], Task]] = {"embedded" if reference is None else reference.name: lambda: kick}
    if reference is not None:
        tasks["embedded"] = lambda: Kick.standard(None, height, mass, body, self_contact)
    models = (dynamics, *(each for each in get_args(DynamicsName) if each != dynamics))
    choices = Choices(tasks, {called: chosen} | PRESETS, models, weights_for(weights))
    with LivePage(host, port, choices.offer(kick), allow_host) as page:
        tell(f"watch it at {page.address} (Ctrl-C ends)")
        Live(page, choices, goal, out / "kept", seed, wished, finished).serve("kick")


def wished(task: Task, wishes: Wishes) -> np.ndarray:
    """Return the state (L, 13) in which a kick begins, with the ball's place and velocity set on the page."""
    assert isinstance(task, Kick)
    return task.start(np.array(wishes.spot), np.array(wishes.roll))


def cli() -> None:
    """Run the command `larp-kick`."""
    run(main)


if __name__ == "__main__":
    cli()

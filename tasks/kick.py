"""Kick a ball to a target.

    minimise over theta   w_t |x_b(t*) - p|                     the ball's path passes the target p
                        + w_r mean_t |x_i(t) - x_i^ref(t)|^2    links stay near the reference, root-aligned
                        + w_e mean_t |Q(t) - Q^ref(t)|^2        joint targets stay near the reference's
                        + w_u mean_t max(0, h - z_pelvis(t))^2  the pelvis stays up
                        + w_f min_t |x_f(t) - x_b(t)|^2         the foot finds the ball
    subject to            S_{t+1} = dynamics(S_t, Q_t),  Q = Q^ref + spline(theta)

t* is the moment at which the ball is nearest to p, between steps too. The dynamics are LARP or MuJoCo; the plan is
executed in MuJoCo.
"""

from __future__ import annotations

import io
import json
import os
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import Array
from rich.console import Console
from rich.table import Table

from larp_model import state as packed
from larp_model import weights as stored
from larp_model.anatomy import Detail
from larp_model.bodies import detail_of, human_and_ball, standing_height
from larp_model.files import require_writable, write_whole
from larp_model.networks import Weights
from larp_model.parts.part import Model
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from larp_model.truth.mujoco import FINE_SUBSTEPS, SUBSTEPS, Truth
from mpc import (
    Continued,
    CostTerm,
    Dynamics,
    MujocoDynamics,
    Optimizer,
    Planner,
    Verified,
    l2,
    nearest_on_path,
    quadratic,
)
from mpc.loop import Execution, Phase, Replan, Window, execute
from tasks import residuals
from tasks.data import stray
from tasks.gap import contact_step, gap, told
from tasks.motions import references
from tasks.motions.bvh import names_in
from tasks.motions.references import Reference
from tasks.presets import Preset, preset_of, usable
from tasks.scenarios import ANY_HUMAN
from tasks.standing import Standing
from viewer import LivePage, Recording, kick_picture, nearest_approach, write_html

# Steps that a plan looks beyond the reference's strike with the whole scene, and then with the ball alone.
BEYOND, FLIGHT = 15, 120
# Steps for which a plan is carried on once the ball has been touched: for as long as it may be pushed.
LINGER = 6
# A plan looks at least so many steps ahead, even when the strike is overdue.
SHORTEST = 15
# Spread of a first plan, as a share of how far the training data strays from the reference.
SEARCH = 0.5
KNOTS = 9
AFTER_CONTACT = 200
STAND_EVERY = 4
REACHABLE = 0.25
WEIGHTS = "human_ball"
# Of the human whom the shipped weights know [m, kg].
HEIGHT, MASS = 1.75, 70.0
# Candidates that MuJoCo rolls out side by side: few, for a small budget's sake.
ROWS = 8

Pair = np.ndarray | tuple[float, float]
DynamicsName = Literal["larp", "mujoco"]


class Models(NamedTuple):
    """The planners' models of the scene and of the human alone, and which weights they have."""

    whole: Dynamics
    human: Dynamics
    learned: bool
    weights: str


class Planners(NamedTuple):
    """Planners of the first kick plan, of later ones, every `every` steps, and of what follows the kick."""

    first: Planner
    again: Planner
    every: int
    stand: Planner


class Kick:
    """The kick task on one scene and reference: terms, windows, planners, execution and its report."""

    def __init__(self, scene: Scene, reference: Reference, substeps: int = FINE_SUBSTEPS) -> None:
        """scene: its first body is the human, its last the ball. substeps: engine steps of the truth in a step."""
        self.scene, self.reference, self.substeps = scene, reference, substeps
        self.human = scene.rows(scene.bodies[0].name)
        self.ball = len(scene.links) - 1
        self.foot = scene.index(scene.bodies[0].name, "right_foot")
        self.horizon = reference.strike + BEYOND
        self.standing = standing_height(scene.bodies[0])
        bounds = np.array([(motor.lower, motor.upper) for motor in scene.motors])
        self.lower, self.upper = bounds[:, 0], bounds[:, 1]

    @property
    def terms(self) -> tuple[CostTerm, ...]:
        """The named costs of a candidate."""

        def target(states: Array, controls: Array, context: Any) -> Array:
            nearest, _ = nearest_on_path(states[:, self.ball, packed.POSITION], context["target"])
            return nearest - context["target"]

        def find_ball(states: Array, controls: Array, context: Any) -> Array:
            apart = (
                states[: len(controls), self.foot, packed.POSITION]
                - states[: len(controls), self.ball, packed.POSITION]
            )
            return apart[jnp.argmin(jnp.sum(apart**2, axis=-1))]

        return (
            CostTerm("target", target, l2(0.05), 10.0),
            CostTerm("reference", partial(residuals.pose, human=self.human), quadratic, 20.0),
            CostTerm("effort", residuals.effort, quadratic, 0.5),
            CostTerm("upright", residuals.upright, quadratic, 20.0),
            CostTerm("find_ball", find_ball, quadratic, 5.0),
        )

    def window(self, target: np.ndarray) -> Callable[[int], Window]:
        """The reference's window from any step on, with the target (3,) [m], as the residuals' context."""

        def at(step: int) -> Window:
            states, controls = self.reference.window(step, self.horizon)
            links = states[:, self.human, packed.POSITION]
            ahead = np.arange(step + 1, step + 1 + self.horizon)
            context = {
                "target": np.asarray(target, float),
                "reference": links - links[:, :1],
                "counted": (ahead <= self.reference.strike + 5).astype(float),
                "height": np.float64(0.85 * self.standing),
                "controls": controls,
            }
            return Window(controls, context, int(np.clip(self.horizon - step, SHORTEST, self.horizon)))

        return at

    def planner(self, dynamics: Dynamics, optimizers: tuple[Optimizer, ...]) -> Planner:
        """A planner of this task; what cannot do without gradients is left out where the dynamics have none."""
        return Planner(
            dynamics,
            self.terms,
            self.horizon,
            KNOTS,
            self.scene.dt,
            SEARCH * stray(self.scene),
            usable(dynamics, optimizers),
            self.lower,
            self.upper,
        )

    def start(self, ball_offset: Pair = (0.0, 0.0), ball_velocity: Pair = (0.0, 0.0)) -> np.ndarray:
        """The state (L, 13) before the kick, the ball moved by an offset (2,) [m] along the ground.

        ball_velocity: (2,) [m/s], with which it rolls so that it passes that place when the reference strikes.
        """
        state = self.reference.states[0].copy()
        ball = state[self.ball]
        ball[:2] += ball_offset
        radius = self.scene.links[self.ball].radius
        ball[7:9] = ball_velocity
        ball[10:12] = -ball_velocity[1] / radius, ball_velocity[0] / radius
        way = self.untouched(state, self.reference.strike)[-1]
        ball[:2] -= way[:2] - ball[:2]
        return state

    def untouched(self, state: np.ndarray, steps: int) -> np.ndarray:
        """The ball's states (steps + 1, 13) from a state (L, 13) on, if nothing but the ground touched it."""
        truth = Truth(self.scene.only(self.scene.bodies[-1].name), 1, self.substeps, threads=1)
        alone = state[None, self.ball :]
        after, _ = truth.rollout(alone, np.zeros((1, steps, 0, 3)))
        return np.concatenate([alone[0], after[0][:, 0]])

    def run(
        self,
        planners: Planners,
        target: np.ndarray,
        seed: int,
        state: np.ndarray | None = None,
        steps: int | None = None,
        observe: Callable[[Execution], None] = lambda execution: None,
        sense: Callable[[np.ndarray], np.ndarray] = lambda state: state,
        stands: bool = True,
    ) -> Execution:
        """Plan and execute one kick in the truth from a state of `start`, for `steps` or until 2 s after contact.

        stands: whether plans go on after the kick, to keep the human up.
        """
        state = self.start() if state is None else state
        steps = self.reference.strike + 20 + AFTER_CONTACT if steps is None else steps
        free = self.untouched(state, steps)

        def touched(step: int, current: np.ndarray) -> bool:
            apart = current[self.ball] - free[step]
            return bool(np.linalg.norm(apart[packed.VELOCITY]) >= 0.5 or abs(apart[packed.POSITION]).max() >= 0.03)

        first, again, every, stand = planners
        phases = [Phase(first, again, every, self.window(target), touched, LINGER)]
        if stands:
            standing = Standing(self.scene, self.reference)
            phases.append(Phase(stand, stand, STAND_EVERY, standing.window, links=self.human))
        return execute(
            Truth(self.scene, 1, self.substeps, threads=1),
            state,
            phases,
            steps,
            key=jax.random.key(seed),
            dt=self.scene.dt,
            observe=observe,
            sense=sense,
        )

    @staticmethod
    def plans(execution: Execution) -> list[Replan]:
        """The plans of the kick itself."""
        return [replan for replan in execution.replans if replan.phase == 0]

    def predicted(self, execution: Execution) -> np.ndarray:
        """What the last plan of the kick expected (T', L, 13), from the state it saw on."""
        last = self.plans(execution)[-1]
        return np.concatenate([last.state[None], last.info.states])

    def report(self, execution: Execution, target: np.ndarray) -> dict[str, Any]:
        """What `summary.json` says of the kick itself; see the README for each entry."""
        states = np.stack(execution.states)
        free = self.untouched(states[0], len(states) - 1)[:, packed.VELOCITY]
        contact = contact_step(states, free)
        begin, end = after_contact(contact, len(states))
        plans = self.plans(execution)
        last = plans[-1]
        links = states[: begin + 1, self.human, packed.POSITION]
        wanted = self.reference.states[: begin + 1, self.human, packed.POSITION]
        apart = np.linalg.norm((links - links[:, :1]) - (wanted - wanted[:, :1]), axis=-1)
        truth_error = miss(states[begin:end, self.ball, packed.POSITION], target)
        model_error = miss(last.info.states[:, self.ball, packed.POSITION], target)
        seconds = [replan.info.seconds for replan in plans]
        again = 1e3 * np.array(seconds[1:] or seconds)
        return {
            "target": [float(x) for x in target],
            "truth_error_m": truth_error,
            "limit_error_m": truth_error if self.substeps == FINE_SUBSTEPS else self.replayed(execution, target),
            "model_error_m": model_error,
            "reference_deviation_m": float(apart.mean()),
            "ball_speed_m_s": float(np.linalg.norm(states[begin:end, self.ball, packed.VELOCITY], axis=-1).max()),
            "touched": contact is not None,
            "fell": bool((states[:end, 0, 2] < 0.5 * self.standing).any()),
            "reachable": model_error <= REACHABLE,
            "plan_seconds": float(seconds[0]),
            "replan_ms": {"p50": float(np.quantile(again, 0.5)), "p99": float(np.quantile(again, 0.99))},
            "compile_seconds": float(sum(replan.info.compile_seconds for replan in execution.replans)),
            "candidates_lost": sum(r.info.candidates - r.info.finite for r in execution.replans),
            "truth_rollouts": sum(replan.info.verified for replan in plans),
            "gap": gap(self.scene, states, self.predicted(execution), last.step, free),
        }

    def replayed(self, execution: Execution, target: np.ndarray, substeps: int = FINE_SUBSTEPS) -> float:
        """The miss [m] of the executed controls, replayed from the start in the truth at another step."""
        start, controls = execution.states[0], np.stack(execution.controls)
        after, _ = Truth(self.scene, 1, substeps, threads=1).rollout(start[None], controls[None])
        states = np.concatenate([start[None], after[0]])
        free = self.untouched(start, len(controls))[:, packed.VELOCITY]
        begin, end = after_contact(contact_step(states, free), len(states))
        return miss(states[begin:end, self.ball, packed.POSITION], target)


def after_contact(contact: int | None, count: int) -> tuple[int, int]:
    """Which of `count` states count for the miss: from first contact, if any, to 2 s after it."""
    return (0, count) if contact is None else (max(contact - 1, 0), min(contact + AFTER_CONTACT + 1, count))


def miss(path: np.ndarray, target: np.ndarray) -> float:
    """Smallest distance [m] of the ball's path (T, 3) from the target (3,)."""
    return nearest_approach(path, target).distance


def shipped(scene: Scene, reference: Path | None) -> Path:
    """The manifest of the shipped weights for a kick: of the embedded one, or of any human in any motion."""
    embedded = reference is None and scene == human_and_ball()
    return stored.SHIPPED / f"{WEIGHTS if embedded else ANY_HUMAN[detail_of(scene.bodies[0])]}.json"


def models_of(scene: Scene, name: DynamicsName, weights: Path, substeps: int = SUBSTEPS, rows: int = ROWS) -> Models:
    """The planners' models; that of the scene goes on with the ball alone once no link can reach it any more.

    After the kick the human moves as it must: the shipped weights of the embedded kick leave it to those of any human.
    substeps: engine steps in a step of MuJoCo. rows: candidates that it rolls out side by side.
    """
    if name == "mujoco":
        return _continued(scene, [MujocoDynamics(Truth(part, rows, substeps)) for part in _parts(scene)], "none")
    if name != "larp":
        raise ValueError(f"dynamics is {name!r}, but must be 'larp' or 'mujoco'")
    model, learned, manifest = stored.load(weights, scene)
    found = learned_models(scene, model, learned, manifest["sha256"][:12])
    if weights != stored.SHIPPED / f"{WEIGHTS}.json":
        return found
    any_human, motion, _ = stored.load(stored.SHIPPED / f"{ANY_HUMAN['lean']}.json", _parts(scene)[2])
    return found._replace(human=Simulator(any_human, motion))


def learned_models(scene: Scene, model: Model, weights: Weights, name: str) -> Models:
    """The planners' models by learned parts; see `models_of`. name: of the weights."""
    return _continued(scene, [Simulator(model.on(part), weights) for part in _parts(scene)], name)


def _parts(scene: Scene) -> tuple[Scene, Scene, Scene]:
    """Human and ball, the ball, and the human."""
    human, ball = scene.bodies[0].name, scene.bodies[-1].name
    return scene.only(human, ball), scene.only(ball), scene.only(human)


def _continued(scene: Scene, models: Sequence[Dynamics], weights: str) -> Models:
    whole, ball, human = models
    rest = slice(scene.rows(scene.bodies[0].name).stop, None)
    return Models(Continued(whole, ball, rest, FLIGHT), human, weights != "none", weights)


def planners_of(kick: Kick, preset: Preset, models: Models) -> Planners:
    """The preset's planners; where MuJoCo is the model there is nothing to try in the truth."""
    first: tuple[Optimizer, ...] = preset.first
    again: tuple[Optimizer, ...] = preset.again
    if any(preset.verify) and models.learned:
        rows = max(2, preset.candidates)  # the plan carried on is tried beside the first proposal
        truth = models_of(kick.scene, "mujoco", Path(), substeps=kick.substeps, rows=rows).whole
        enough = (("target", preset.enough),)
        first, again = (
            (*proposing, Verified(truth, preset.correct, rounds, preset.candidates, enough)) if rounds else proposing
            for proposing, rounds in zip((first, again), preset.verify, strict=True)
        )
    planner = kick.planner(models.whole, first)
    return Planners(
        planner,
        planner.using(usable(models.whole, again)),
        preset.every,
        Standing(kick.scene, kick.reference).planner(models.human, preset.stand),
    )


def checked_target(target: tuple[float, ...]) -> np.ndarray:
    """The target (3,) [m]; refuses what is not three finite numbers."""
    if len(target) != 3 or not np.isfinite(target).all():
        raise ValueError(f"target is {target}, but must be three finite numbers, in metres")
    return np.asarray(target, float)


def remember_compilations() -> None:
    """Keep compiled planners in the user's cache folder, so that the second run starts at once."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(base / "larp-mpc"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.5)


def recording_of(kick: Kick, execution: Execution, target: np.ndarray, summary: dict[str, Any]) -> Recording:
    """The kick for the viewer: the truth, the last plan's prediction, the reference."""
    last = kick.plans(execution)[-1]
    states = np.stack(execution.states)
    predicted = kick.predicted(execution)
    shown = {
        "the model expected": f"{100 * summary['model_error_m']:.1f} cm",
        "ball speed": f"{summary['ball_speed_m_s']:.1f} m/s",
        "dynamics": f"{summary['dynamics']}, {summary['preset']}",
        **told(summary["gap"]),
    }
    title = "Kick to ({:.2f}, {:.2f}, {:.2f}) m".format(*target)
    reference = kick.reference.states[: len(states)]
    return Recording(kick.scene, states, target, predicted, last.step, reference, title, shown)


def write(folder: Path, kick: Kick, execution: Execution, target: np.ndarray, summary: dict[str, Any]) -> None:
    """`kick.npz`, `kick.png`, `kick.html` and, last, `summary.json`; each whole or not at all."""
    recording = recording_of(kick, execution, target, summary)
    plans = kick.plans(execution)
    last = plans[-1]
    buffer = io.BytesIO()
    np.savez_compressed(
        buffer,
        states=recording.states.astype(np.float32),
        joint_targets=np.stack(execution.controls).astype(np.float32),
        plan_knots=np.asarray(last.plan.knots),
        plan_step=last.step,
        predicted_states=last.info.states,
    )
    write_whole(folder / "kick.npz", buffer.getvalue())
    costs = {name: [replan.info.terms[name] for replan in plans] for name in last.info.terms}
    kick_picture(recording, costs, folder / "kick.png")
    write_html(recording, folder / "kick.html")
    write_whole(folder / "summary.json", (json.dumps(summary, indent=2) + "\n").encode())


def table(summary: dict[str, Any]) -> Table:
    """The result for a person."""
    rows = Table("", "", title="Kick", show_header=False)
    x, y, z = summary["target"]
    rows.add_row("target", f"({x:.2f}, {y:.2f}, {z:.2f}) m")
    rows.add_row("missed by, in MuJoCo", f"{100 * summary['truth_error_m']:.1f} cm")
    rows.add_row("missed by, as the model expected", f"{100 * summary['model_error_m']:.1f} cm")
    rows.add_row("distance from the reference", f"{100 * summary['reference_deviation_m']:.1f} cm")
    rows.add_row("ball speed", f"{summary['ball_speed_m_s']:.1f} m/s")
    rows.add_row("fell", "yes" if summary["fell"] else "no")
    rows.add_row("first plan, each replan", f"{summary['plan_seconds']:.2f} s, {summary['replan_ms']['p50']:.0f} ms")
    rows.add_row("compilation", f"{summary['compile_seconds']:.1f} s")
    if not summary["reachable"]:
        rows.add_row("reachable", "no: this plan comes nearest")
    return rows


def prepare(
    body_reference: Path | None = None,
    height: float = HEIGHT,
    substeps: int = FINE_SUBSTEPS,
    mass: float | None = None,
    names: Path | None = None,
    detail: Detail = "lean",
    self_contact: bool = False,
) -> Kick:
    """The kick's scene with its reference: the embedded one, or a captured one from a BVH or an npz file.

    height: of the human [m]. substeps: engine steps of the truth in a step. mass: of the human [kg]; as heavy as its
    height squared by default. names: JSON file of what a BVH file calls our joints; see `bvh.load`. detail,
    self_contact: see `bodies.human_and_ball`.
    """
    heavy = MASS * (height / HEIGHT) ** 2 if mass is None else mass
    scene = human_and_ball(height=height, mass=heavy, detail=detail, self_contact=self_contact)
    return kick_of(scene, body_reference, substeps, names)


def kick_of(
    scene: Scene, body_reference: Path | None, substeps: int = FINE_SUBSTEPS, names: Path | None = None
) -> Kick:
    """The kick of a scene's human, as `prepare` makes it."""
    if body_reference is None:
        if names is not None:
            raise ValueError(f"names is {str(names)!r}, but there is no reference whose joints they could be")
        return Kick(scene, references.embedded(scene), substeps)
    called = None if names is None else names_in(names)
    return Kick(scene, references.captured(body_reference, scene, names=called), substeps)


def main(
    target: tuple[float, float, float] = (4.0, 0.0, 0.5),
    preset: str = "balanced",
    dynamics: str = "larp",
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
    port: int = 8080,
) -> None:
    """Plan a kick, execute it in MuJoCo, show how far the ball passed from its target.

    Args:
        target: where the ball's centre should pass [m]: forwards, to the left, up.
        preset: fast, balanced or accurate.
        dynamics: the planner's model: larp (learned) or mujoco.
        reference: a captured kick (BVH, or npz of joint angles) instead of the embedded one.
        names: JSON object of what the BVH file calls our joints: {"Hips": "pelvis", ...}; known skeletons need none.
        weights: manifest of the weights of the learned model; those shipped for the kick by default.
        height: of the human [m].
        mass: of the human [kg]; as heavy as its height squared by default.
        body: lean: 13 links; full: 26, with a spine, hands and toes.
        self_contact: let one leg touch the other, below the knee; else they pass through each other.
        seed: of the planner's random numbers.
        out: folder for summary.json, kick.npz, kick.png and kick.html.
        view: show the kick live in the browser, on 127.0.0.1.
        port: of the page.
    """
    goal = checked_target(target)
    if reference is not None and not reference.is_file():
        raise ValueError(f"reference is {str(reference)!r}, but no such file exists")
    chosen = preset_of(preset)
    require_writable(out, "out")
    remember_compilations()
    kick = prepare(reference, height, mass=mass, names=names, detail=body, self_contact=self_contact)
    models = models_of(kick.scene, dynamics, weights or shipped(kick.scene, reference))  # type: ignore[arg-type]
    planners = planners_of(kick, chosen, models)
    page = LivePage(port=port) if view else None
    if page:
        Console().print(f"Watch it at {page.address} (Ctrl-C ends)")
        page.begin(kick.scene, goal)

    def observe(execution: Execution) -> None:
        if page:
            last, step = kick.plans(execution)[-1], len(execution.states) - 1
            news = last.info.states[1:] if last.step == step - 1 else None
            page.update(execution.states[-1], news, step * kick.scene.dt)

    execution = kick.run(planners, goal, seed, observe=observe)
    summary = kick.report(execution, goal) | {
        "preset": preset,
        "dynamics": dynamics,
        "weights": models.weights,
        "seed": seed,
    }
    write(out, kick, execution, goal, summary)
    Console().print(table(summary))
    Console().print(f"{out}/: summary.json, kick.npz, kick.png, kick.html")
    if page:
        page.finish(recording_of(kick, execution, goal, summary))
        page.wait()


def run(task: Callable[..., None], arguments: list[str] | None = None) -> None:
    """A task's command line: wrong values end it with one line and exit code 2."""
    try:
        tyro.cli(task, args=arguments)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


if __name__ == "__main__":
    run(main)

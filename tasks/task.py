"""Tasks of a human and a ball near a reference motion, and the results of their runs.

    minimise over theta   sum_g w_g n_g(r_g(S, Q, goal))          the task's own goals for the ball
                        + w_r mean_t |x_i(t) - x_i^ref(t)|^2      links stay near the reference, root-aligned
                        + w_e mean_t |Q(t) - Q^ref(t)|^2          joint targets stay near the reference's
                        + w_u mean_t max(0, h - z_pelvis(t))^2    the pelvis stays up
    subject to            S_{t+1} = dynamics(S_t, Q_t),  Q = Q^ref + spline(theta)

The dynamics are LARP or MuJoCo; the plan is executed in MuJoCo. A task of your own defines its goals, when it is over,
and its report: see `kick.py`, and `examples/`.
"""

from __future__ import annotations

import io
import json
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self

import jax
import numpy as np
from jax.typing import ArrayLike
from rich.table import Table

from larp_model import state as packed
from larp_model.anatomy import Detail
from larp_model.bodies import human_and_ball, standing_height
from larp_model.engines.mujoco import FINE_SUBSTEPS, Truth
from larp_model.errors import InputError
from larp_model.files import require_writable, write_whole
from larp_model.scene import Scene
from mpc import CostTerm, Dynamics, Optimizer, Planner, Verified, quadratic
from mpc.loop import Execution, Phase, Replan, Window, World, execute
from tasks import residuals
from tasks.data import stray
from tasks.models import FLIGHT, NO_WEIGHTS, DynamicsName, Models, models_of
from tasks.motions import references
from tasks.motions.bvh import names_in
from tasks.motions.references import Reference
from tasks.motions.skeleton import Motion
from tasks.presets import Preset, PresetName, Seconds, preset_of, usable, within
from tasks.standing import Standing
from viewer import LivePage, Recording, framed, kick_picture, write_html

# Steps that a plan looks beyond the reference's strike with the whole scene.
BEYOND = 15
# Steps for which a plan is carried on once the task is over: for as long as the ball may be pushed.
LINGER = 6
# A plan looks at least so many steps ahead, even when the strike is overdue.
SHORTEST = 15
# Spread of a first plan, as a share of the training data's deviation from the reference.
SEARCH = 0.5
KNOTS = 9
# Steps for which an execution goes on after the strike.
AFTER_CONTACT = 200
# Steps between the plans that keep the human up, until so many after the strike, and from then on.
CATCH_EVERY, CATCH, STAND_EVERY = 4, 70, 12
REACHABLE = 0.25
# Of the usual human [m, kg].
HEIGHT, MASS = 1.75, 70.0


class Planners(NamedTuple):
    """Planners of the first plan, of later ones, every `every` steps, and of the standing that follows."""

    first: Planner
    again: Planner
    every: int
    stand: Planner


class Task(ABC):
    """Scene, reference and goals, with planning, execution and report; subclasses define only what is abstract here."""

    name: str

    def __init__(self, scene: Scene, reference: Reference, substeps: int = FINE_SUBSTEPS) -> None:
        """Set up the task of a scene near a reference.

        scene: its first body is the human, its last the ball. substeps: engine steps of the ground truth in a step.
        """
        self.scene, self.reference, self.substeps = scene, reference, substeps
        self.human = scene.rows(scene.bodies[0].name)
        self.ball = len(scene.links) - 1
        self.foot = scene.index(scene.bodies[0].name, "right_foot")
        self.horizon = reference.strike + BEYOND
        self.standing = standing_height(scene.bodies[0])
        bounds = np.array([(motor.lower, motor.upper) for motor in scene.motors])
        self.lower, self.upper = bounds[:, 0], bounds[:, 1]
        self._planners: dict[tuple[str | Preset, str | int, Path | None], tuple[Planners, str]] = {}
        self._models: dict[tuple[str | int, Path | None], Models] = {}
        self._bases: dict[int, tuple[Models, Planner, Planner]] = {}  # by the model, with which they are kept

    def __getstate__(self) -> dict[str, Any]:
        """Return the state to copy or pickle; copies, and other processes, make their own models and planners."""
        return self.__dict__ | {"_planners": {}, "_models": {}, "_bases": {}}

    @classmethod
    def standard(
        cls,
        reference: str | Path | Motion | Reference | None = None,
        height: float = HEIGHT,
        mass: float | None = None,
        body: Detail = "lean",
        self_contact: bool = False,
        names: str | Path | None = None,
        substeps: int = FINE_SUBSTEPS,
    ) -> Self:
        """Return the task of a human and a football near the embedded reference, or near one of your own.

        reference: a captured kick (BVH, or npz), a motion in memory (`angles.motion`), or a finished `Reference`.
        height [m] and mass [kg] of the human; as heavy as its height squared by default. body, self_contact: see
        `bodies.human_and_ball`. names: JSON file of a BVH file's names of our joints; see `bvh.load`. substeps: engine
        steps of the ground truth in a step.
        """
        heavy = MASS * (height / HEIGHT) ** 2 if mass is None else mass
        scene = human_and_ball(height=height, mass=heavy, detail=body, self_contact=self_contact)
        return cls.of(scene, reference, names, substeps)

    @classmethod
    def of(
        cls,
        scene: Scene,
        reference: str | Path | Motion | Reference | None = None,
        names: str | Path | None = None,
        substeps: int = FINE_SUBSTEPS,
    ) -> Self:
        """Return the task of a scene's human; see `standard`."""
        if names is not None and not isinstance(reference, str | Path):
            raise InputError(f"names is {str(names)!r}, but there is no file whose joints they could be")
        if reference is None:
            return cls(scene, references.embedded(scene), substeps)
        if isinstance(reference, Reference):
            return cls(scene, reference, substeps)
        called = None if names is None else names_in(Path(names))
        return cls(scene, references.captured(reference, scene, names=called), substeps)

    @property
    @abstractmethod
    def goals(self) -> tuple[CostTerm, ...]:
        """Return the cost terms that are this task's own.

        Their context holds `goal`, as `asked` gives it, and `times` (H',), those of the states [s from the start]. One
        of them is called `target`, a distance [m]: by it presets judge whether a plan is good enough.
        """

    @abstractmethod
    def asked(self, goal: Any) -> Any:
        """Return a goal as a pytree of arrays; raises InputError for one that makes no sense."""

    @abstractmethod
    def place(self, goal: Any) -> np.ndarray:
        """Return the place at which a goal is drawn (3,) [m]."""

    @abstractmethod
    def over(self, start: np.ndarray, steps: int) -> Callable[[int, np.ndarray], bool]:
        """Return a predicate of step and state (L, 13), within `steps` of a start (L, 13): whether the task is over."""

    @abstractmethod
    def report(self, execution: Execution, goal: Any) -> dict[str, Any]:
        """Return a run's entries of `summary.json`: `figures`, and at least `truth_error_m` and `model_error_m`."""

    @abstractmethod
    def title(self, goal: Any) -> str:
        """Return the title of a run in a few words."""

    @abstractmethod
    def facts(self, summary: dict[str, Any]) -> dict[str, str]:
        """Return the summary for display: labels, and values with their units."""

    def start(self) -> np.ndarray:
        """Return the state (L, 13) in which the reference begins."""
        return self.reference.states[0].copy()

    @property
    def terms(self) -> tuple[CostTerm, ...]:
        """Return the named cost terms of a candidate."""
        return (
            *self.goals,
            CostTerm("reference", partial(residuals.pose, human=self.human), quadratic, 20.0),
            CostTerm("effort", residuals.effort, quadratic, 0.5),
            CostTerm("upright", residuals.upright, quadratic, 20.0),
        )

    def window(self, goal: Any) -> Callable[[int], Window]:
        """Return a function that gives a step's window of the reference, with the goal in the residuals' context."""

        def at(step: int) -> Window:
            states, controls = self.reference.window(step, self.horizon)
            links = states[:, self.human, packed.POSITION]
            ahead = np.arange(step + 1, step + 1 + self.horizon)
            steps = int(np.clip(self.horizon - step, SHORTEST, self.horizon))
            # What lies beyond the steps that are computed repeats the last, until the ball flies on alone.
            seen = np.minimum(np.arange(1, self.horizon + 1), steps)
            times = self.scene.dt * (step + np.concatenate([seen, steps + np.arange(1, FLIGHT + 1)]))
            context = {
                "goal": self.asked(goal),
                "times": times,
                "reference": links - links[:, :1],
                "counted": (ahead <= self.reference.strike + 5).astype(float),
                "height": np.float64(0.85 * self.standing),
                "controls": controls,
            }
            return Window(controls, context, steps)

        return at

    def planner(self, dynamics: Dynamics, optimizers: tuple[Optimizer, ...]) -> Planner:
        """Return a planner of this task; optimisers that need gradients are left out where the dynamics have none."""
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

    def planners_of(self, preset: Preset, models: Models) -> Planners:
        """Return a preset's planners; where MuJoCo is the model, plans are not verified in the ground truth.

        All presets of the same models share compiled functions.
        """
        first: tuple[Optimizer, ...] = preset.first
        again: tuple[Optimizer, ...] = preset.again
        if any(preset.verify) and not models.exact:
            rows = max(2, preset.candidates)  # the plan carried on is tried beside the first proposal
            truth = models_of(self.scene, "mujoco", substeps=self.substeps, rows=rows).whole
            enough = (("target", preset.enough),)
            first, again = (
                (*proposing, Verified(truth, preset.correct, rounds, preset.candidates, enough))
                if rounds
                else proposing
                for proposing, rounds in zip((first, again), preset.verify, strict=True)
            )
        if (known := id(models.whole)) not in self._bases:
            standing = Standing(self.scene, self.reference).planner(models.human, preset.stand)
            self._bases[known] = models, self.planner(models.whole, first), standing
        _, planner, standing = self._bases[known]
        return Planners(
            planner.using(usable(models.whole, first)),
            planner.using(usable(models.whole, again)),
            preset.every,
            standing.using(usable(models.human, preset.stand)),
        )

    def planners(
        self,
        preset: PresetName | Preset = "balanced",
        dynamics: DynamicsName | Dynamics = "larp",
        weights: str | Path | None = None,
    ) -> tuple[Planners, str]:
        """Return a preset's planners, made once, and the name of their weights; see `to`."""
        manifest = None if weights is None else Path(weights)
        key = (preset, dynamics if isinstance(dynamics, str) else id(dynamics), manifest)
        if key not in self._planners:
            chosen = preset_of(preset) if isinstance(preset, str) else preset
            models = self.models(dynamics, manifest)
            self._planners[key] = self.planners_of(chosen, models), models.weights
        return self._planners[key]

    def models(self, dynamics: DynamicsName | Dynamics = "larp", weights: str | Path | None = None) -> Models:
        """Return the models to plan with, made once; see `to`."""
        manifest = None if weights is None else Path(weights)
        key = (dynamics if isinstance(dynamics, str) else id(dynamics), manifest)
        if key not in self._models:
            if isinstance(dynamics, str):
                self._models[key] = models_of(self.scene, dynamics, manifest)
            else:
                ours = models_of(self.scene, "larp", manifest)
                self._models[key] = ours._replace(whole=dynamics, weights=NO_WEIGHTS)
        return self._models[key]

    def within(self, preset: Preset, budget: float, models: Models, goal: Any) -> Preset:
        """Return the preset scaled to a budget of a plan [s]; see `presets.within`. goal: any typical one."""
        return within(preset, budget, partial(self.seconds, models, goal))

    def seconds(self, models: Models, goal: Any, preset: Preset) -> Seconds:
        """Return the times that the preset's plans take for a goal, with full horizons."""
        planners, usual = self.planners_of(preset, models), self.window(goal)
        took = []
        for planner, window, links in (
            (planners.first, usual, slice(None)),
            (planners.again, usual, slice(None)),
            (planners.stand, Standing(self.scene, self.reference).window, self.human),
        ):
            plan, wanted, state = planner.init(jax.random.key(0)), window(0), self.start()[links]
            runs = [planner.step(plan, state, wanted.controls, wanted.context, steps=wanted.steps) for _ in range(2)]
            took.append(min(info.seconds for _, info in runs))
        return Seconds(*took)

    def to(
        self,
        goal: Any,
        preset: PresetName | Preset = "balanced",
        dynamics: DynamicsName | Dynamics = "larp",
        weights: str | Path | None = None,
        seed: int = 0,
        state: ArrayLike | None = None,
        observe: Callable[[Execution], None] = lambda execution: None,
        world: World | None = None,
    ) -> Run:
        """Plan for a goal and execute in MuJoCo, or in a world of your own.

        goal: of a kick, the target (3,) [m]. preset: its name, or one of your own. dynamics: the planner's model, by
        name or your own of the whole scene; the plans that keep the human up afterwards use ours. weights: manifest of
        the model's; none by default. seed: of the planner's random numbers. state: (L, 13) to begin in; see `start`.
        observe: called after every step. Later runs with the same preset, dynamics and weights compile nothing again.
        """
        goal = self.asked(goal)
        planners, known_by = self.planners(preset, dynamics, weights)
        execution = self.run(planners, goal, seed, state, observe=observe, world=world)
        named = (each if isinstance(each, str) else type(each).__name__ for each in (preset, dynamics))
        said = dict(zip(("preset", "dynamics"), named, strict=True)) | {"weights": known_by, "seed": seed}
        return Run(self, execution, goal, self.report(execution, goal) | said)

    def run(
        self,
        planners: Planners,
        goal: Any,
        seed: int,
        state: ArrayLike | None = None,
        steps: int | None = None,
        observe: Callable[[Execution], None] = lambda execution: None,
        sense: Callable[[np.ndarray], np.ndarray] = lambda state: state,
        stands: bool = True,
        world: World | None = None,
        window: Callable[[int], Window] | None = None,
    ) -> Execution:
        """Plan and execute in the ground truth, from a state (`start` by default), for `steps`.

        steps: by default until 20 + `AFTER_CONTACT` steps after the reference's strike. stands: whether plans go on
        after the task is over, to keep the human up. world: to execute in instead. window: gives the targets and
        context from a step on, if they are not always the goal's.
        """
        state = self.start() if state is None else self.checked_state(state)
        steps = self.reference.strike + 20 + AFTER_CONTACT if steps is None else steps
        first, again, every, stand = planners
        phases = [Phase(first, again, every, window or self.window(goal), self.over(state, steps), LINGER)]
        if stands:
            standing = Standing(self.scene, self.reference)
            caught = self.reference.strike + CATCH
            phases += [
                Phase(stand, stand, CATCH_EVERY, standing.window, lambda step, state: step >= caught, links=self.human),
                Phase(stand, stand, STAND_EVERY, standing.window, links=self.human),
            ]
        return execute(
            world or Truth(self.scene, 1, self.substeps, threads=1),
            state,
            phases,
            steps,
            key=jax.random.key(seed),
            dt=self.scene.dt,
            observe=observe,
            sense=sense,
        )

    def checked_state(self, state: ArrayLike) -> np.ndarray:
        """Return a state (L, 13) of this task's scene as an array; raises InputError for anything else."""
        needed = (len(self.scene.links), packed.SIZE)
        try:
            array = np.asarray(state, float)
        except (TypeError, ValueError):
            raise InputError(f"state is of type {type(state).__name__}, but needs numbers of shape {needed}") from None
        if array.shape != needed:
            raise InputError(f"state has shape {array.shape}, but needs {needed}")
        if not np.isfinite(array).all():
            raise InputError("state has numbers that are not finite, but needs all of them finite")
        return array

    def touched(self, start: np.ndarray, steps: int) -> Callable[[int, np.ndarray], bool]:
        """Return a predicate of step and state (L, 13): whether the ball has left its untouched path from `start`."""
        free = self.untouched(start, steps)

        def at(step: int, current: np.ndarray) -> bool:
            apart = current[self.ball] - free[step]
            return bool(np.linalg.norm(apart[packed.VELOCITY]) >= 0.5 or abs(apart[packed.POSITION]).max() >= 0.03)

        return at

    def untouched(self, state: np.ndarray, steps: int) -> np.ndarray:
        """Return the ball's states (steps + 1, 13) from a state (L, 13) on, if nothing but the ground touched it."""
        truth = Truth(self.scene.only(self.scene.bodies[-1].name), 1, self.substeps, threads=1)
        alone = state[None, self.ball :]
        after, _ = truth.rollout(alone, np.zeros((1, steps, 0, 3)))
        return np.concatenate([alone[0], after[0][:, 0]])

    @staticmethod
    def plans(execution: Execution) -> list[Replan]:
        """Return the plans of the task itself, without those of standing."""
        return [replan for replan in execution.replans if replan.phase == 0]

    def figures(self, execution: Execution, until: int, end: int) -> dict[str, Any]:
        """Return the figures of every report: deviation from the reference, fall, times, and counts of rollouts.

        until: the last row that counts for the deviation. end: the row before which a fall counts.
        """
        states, plans = np.stack(execution.states), self.plans(execution)
        links = states[: until + 1, self.human, packed.POSITION]
        wanted = self.reference.states[: until + 1, self.human, packed.POSITION]
        apart = np.linalg.norm((links - links[:, :1]) - (wanted - wanted[:, :1]), axis=-1)
        seconds = [replan.info.seconds for replan in plans]
        again = 1e3 * np.array(seconds[1:] or seconds)
        return {
            "reference_deviation_m": float(apart.mean()),
            "fell": bool((states[:end, 0, 2] < 0.5 * self.standing).any()),
            "plan_seconds": float(seconds[0]),
            "replan_ms": {"p50": float(np.quantile(again, 0.5)), "p99": float(np.quantile(again, 0.99))},
            "compile_seconds": float(sum(replan.info.compile_seconds for replan in execution.replans)),
            "candidates_lost": sum(r.info.candidates - r.info.finite for r in execution.replans),
            "truth_rollouts": sum(replan.info.verified for replan in plans),
        }


@dataclass(frozen=True, eq=False)
class Run:
    """Result of a task that was planned and executed in the ground truth.

    summary: the content of `summary.json`; see the README for each entry.
    """

    task: Task
    execution: Execution
    goal: Any
    summary: dict[str, Any]

    @property
    def states(self) -> np.ndarray:
        """Return the executed states (T + 1, L, 13)."""
        return np.stack(self.execution.states)

    @property
    def joint_targets(self) -> np.ndarray:
        """Return the executed joint targets of the motors (T, J, 3) [rad]."""
        return np.stack(self.execution.controls)

    @property
    def predicted(self) -> np.ndarray:
        """Return the states (T', L, 13) that the last plan predicted, from the state that it saw on."""
        last = self.task.plans(self.execution)[-1]
        return np.concatenate([last.state[None], last.info.states])

    @property
    def truth_error_m(self) -> float:
        """Return by how much the target was missed, in the ground truth [m]."""
        return float(self.summary["truth_error_m"])

    @property
    def model_error_m(self) -> float:
        """Return by how much the last plan expected to miss the target [m]."""
        return float(self.summary["model_error_m"])

    @property
    def costs(self) -> dict[str, list[float]]:
        """Return each term's share of the cost, plan by plan."""
        plans = self.task.plans(self.execution)
        return {term: [replan.info.terms[term] for replan in plans] for term in plans[-1].info.terms}

    @property
    def recording(self) -> Recording:
        """Return the recording for the viewer: ground truth, the last plan's prediction, reference."""
        states, begun = self.states, self.task.plans(self.execution)[-1].step
        reference = self.task.reference.states[: len(states)]
        task, goal = self.task, self.goal
        told = task.title(goal), task.facts(self.summary)
        return Recording(task.scene, states, task.place(goal), self.predicted, begun, reference, *told)

    @property
    def table(self) -> Table:
        """Return the result as a table for display."""
        said, again = self.summary, self.summary["replan_ms"]["p50"]
        facts = {
            "missed by, in MuJoCo": f"{100 * self.truth_error_m:.1f} cm",
            **self.task.facts(said),
            "first plan, each replan": f"{said['plan_seconds']:.2f} s, {again:.0f} ms",
        }
        rows = Table("", "", title=self.task.title(self.goal), show_header=False)
        for what, value in facts.items():
            rows.add_row(what, value)
        return rows

    def save(self, folder: str | Path) -> Path:
        """Write `NAME.npz`, `.png`, `.html` and, last, `summary.json`, each whole or not at all; returns the folder.

        NAME is the task's; the npz holds states, joint_targets, plan_knots, plan_step and predicted_states.
        """
        folder, name, recording = Path(folder), self.task.name, self.recording
        require_writable(folder, "folder")
        plans = self.task.plans(self.execution)
        buffer = io.BytesIO()
        np.savez_compressed(
            buffer,
            states=recording.states.astype(np.float32),
            joint_targets=self.joint_targets.astype(np.float32),
            plan_knots=np.asarray(plans[-1].plan.knots),
            plan_step=plans[-1].step,
            predicted_states=plans[-1].info.states,
        )
        write_whole(folder / f"{name}.npz", buffer.getvalue())
        kick_picture(recording, self.costs, folder / f"{name}.png")
        write_html(recording, folder / f"{name}.html")
        write_whole(folder / "summary.json", (json.dumps(self.summary, indent=2) + "\n").encode())
        return folder

    def _repr_html_(self) -> str:
        """Return the replay as HTML, which a notebook shows for the run."""
        return framed(self.recording)

    def show(self, host: str = "127.0.0.1", port: int = 0) -> LivePage:
        """Open a page that plays the run, at its `address`, until it is closed; port 0 takes a free one."""
        page = LivePage(host, port)
        page.finish(self.recording)
        return page


def checked_target(target: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Return the target (3,) [m] as an array; raises InputError for anything but three finite numbers."""
    if np.shape(target) != (3,) or not np.isfinite(target).all():
        raise InputError(f"target is {target}, but must be three finite numbers, in metres")
    return np.asarray(target, float)

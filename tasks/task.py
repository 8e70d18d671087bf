"""Tasks of a human and a ball near a reference motion.

    minimise over theta   w_t n(r(S, goal))                       the ball meets the goal: the task's own residual
                        + w_f min_t |x_f(t) - x_b(t)|^2           the foot reaches the ball
                        + w_r mean_t |x_i(t) - x_i^ref(t)|^2      links stay near the reference, root-aligned
                        + w_e mean_t |Q(t) - Q^ref(t)|^2          joint targets stay near the reference's
                        + w_u mean_t max(0, h - z_pelvis(t))^2    the pelvis stays up
                        + ...                                     costs that the task adds
    subject to            S_{t+1} = dynamics(S_t, Q_t),  Q = Q^ref + spline(theta)

A task states scene, reference, goal and costs. `session.Session` plans it through LARP or MuJoCo and executes the plan
in MuJoCo; `run.Run` keeps and shows the result.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np
from jax.typing import ArrayLike

from larp_model import state as packed
from larp_model.anatomy import Detail
from larp_model.bodies import human_and_ball, standing_height
from larp_model.engines.mujoco import FINE_SUBSTEPS
from larp_model.errors import InputError
from larp_model.scene import Scene
from mpc import CostTerm, Dynamics, Optimizer, Planner, Window, l2, quadratic
from tasks import residuals, strike
from tasks.exploration import exploration_std
from tasks.models import FLIGHT
from tasks.motions import references
from tasks.motions.joint_names import names_in
from tasks.motions.references import Reference
from tasks.motions.skeleton import Motion
from tasks.pose.joint_motion import source_of
from tasks.presets import usable
from tasks.residuals import Context

# Steps that a plan looks beyond the reference's strike with the whole scene.
BEYOND = 15
# A plan looks at least so many steps ahead, even when the strike is overdue.
SHORTEST = 15
# Spread of a first plan, as a share of the training data's deviation from the reference.
SEARCH = 0.5
KNOTS = 9
# Of the usual human [m, kg].
HEIGHT, MASS = 1.75, 70.0
Pair = np.ndarray | tuple[float, float]


class Task(ABC):
    """Scene, reference and goal of a motion that strikes the ball.

    A task of one's own defines `check`, `miss` and `marker`; it may add `costs` and `metrics`, and replace `is_done`
    and `title`. See `tasks.kick` and `examples/pass_to_runner.py`.
    """

    name: str

    def __init__(self, scene: Scene, reference: Reference, substeps: int = FINE_SUBSTEPS) -> None:
        """Set up the task of a scene near a reference.

        scene: its first body is the human, its last the ball. substeps: engine steps of the ground truth in a step.
        """
        self.scene, self.reference, self.substeps = scene, reference, substeps
        self.human = scene.rows(scene.human.name)
        self.ball = len(scene.links) - 1
        self.foot = scene.index(scene.human.name, "right_foot")
        self.horizon = reference.strike + BEYOND
        self.standing_height = standing_height(scene.human)

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
        joint_names = None if names is None else names_in(Path(names))
        source = source_of(reference, joint_names)
        return cls(scene, references.captured(source, scene, names=joint_names), substeps)

    @abstractmethod
    def check(self, goal: Any) -> Any:
        """Return a goal as a pytree of arrays; raises InputError for an invalid one."""

    @abstractmethod
    def miss(self, states: Any, times: Any, goal: Any) -> Any:
        """Return the vector (3,) [m] by which a trajectory misses the goal where it is nearest.

        states: (T, L, 13) at times (T,) [s] from the start; arrays of JAX while planning, of NumPy when measured.
        """

    @abstractmethod
    def marker(self, goal: Any) -> np.ndarray:
        """Return the position (3,) [m] at which a goal is drawn."""

    @property
    def costs(self) -> tuple[CostTerm, ...]:
        """Return further cost terms; their context is a `residuals.Context`."""
        return ()

    def metrics(self, states: np.ndarray, goal: Any) -> dict[str, float]:
        """Return further figures, by name, of the executed states (T, L, 13) in which the miss is measured.

        They are the entry `metrics` of `summary.json`, and displayed under their names.
        """
        return {}

    def is_done(self, step: int, state: np.ndarray, free: np.ndarray) -> bool:
        """Return whether the task is over in a state (L, 13) of a step, here that the ball has been struck, not grazed.

        free: (13,), the untouched ball's state in that step.
        """
        least = strike.STRUCK if step >= self.reference.strike else strike.GRAZED
        return bool(strike.is_struck(state[self.ball], free, least))

    def title(self, goal: Any) -> str:
        """Return the title of a run in a few words."""
        return f"{self.name.capitalize()} to ({{:.2f}}, {{:.2f}}, {{:.2f}}) m".format(*self.marker(goal))

    @property
    def terms(self) -> tuple[CostTerm, ...]:
        """Return the named cost terms of a candidate; by the length of `target` presets judge convergence."""
        find_ball = partial(residuals.apart, link=self.foot, other=self.ball)
        return (
            CostTerm("target", self._target, l2(0.05), 10.0),
            CostTerm("find_ball", find_ball, quadratic, 5.0),
            *self.costs,
            CostTerm("reference", partial(residuals.pose, human=self.human), quadratic, 20.0),
            CostTerm("effort", residuals.effort, quadratic, 0.5),
            CostTerm("upright", residuals.upright, quadratic, 20.0),
        )

    def _target(self, states: Any, controls: Any, context: Context) -> Any:
        return self.miss(states, context.times, context.goal)

    def missed(self, states: np.ndarray, begin: int, goal: Any) -> float:
        """Return the distance [m] by which states (T, L, 13), the first of them in step `begin`, miss the goal."""
        states = np.concatenate([states, states[-1:]])  # of one state, there still is a path
        times = self.scene.dt * (begin + np.arange(len(states)))
        return float(np.linalg.norm(self.miss(states, times, goal)))

    def start(self, ball_offset: Pair = (0.0, 0.0), ball_velocity: Pair = (0.0, 0.0)) -> np.ndarray:
        """Return the initial state (L, 13), the ball moved by an offset (2,) [m] along the ground.

        ball_velocity: (2,) [m/s] of a ball that rolls so that it passes that place when the reference strikes.
        """
        for name, value in (("ball_offset", ball_offset), ("ball_velocity", ball_velocity)):
            if np.shape(value) != (2,) or not np.isfinite(value).all():
                raise InputError(f"{name} is {value}, but must be two finite numbers")
        state: np.ndarray = self.reference.states[0].copy()
        ball = state[self.ball]
        ball[:2] += ball_offset
        radius = self.scene.links[self.ball].radius
        ball[7:9] = ball_velocity
        ball[10:12] = -ball_velocity[1] / radius, ball_velocity[0] / radius
        at_strike = self.untouched(state, self.reference.strike)[-1]
        ball[:2] -= at_strike[:2] - ball[:2]
        return state

    def untouched(self, state: np.ndarray, steps: int) -> np.ndarray:
        """Return states (steps + 1, 13) of the untouched ball from a state (L, 13) on."""
        return strike.untouched(self.scene, state, steps, self.substeps)

    def window(self, goal: Any) -> Callable[[int], Window]:
        """Return a function that gives the planner's window from a step on."""
        goal = self.check(goal)

        def at(step: int) -> Window:
            states, controls = self.reference.window(step, self.horizon)
            links = states[:, self.human, packed.POSITION]
            ahead = np.arange(step + 1, step + 1 + self.horizon)
            steps = int(np.clip(self.horizon - step, SHORTEST, self.horizon))
            # States beyond the steps that are computed repeat the last, until the ball flies on alone.
            computed = np.minimum(np.arange(1, self.horizon + 1), steps)
            context = Context(
                goal=goal,
                times=self.scene.dt * (step + np.concatenate([computed, steps + np.arange(1, FLIGHT + 1)])),
                reference=links - links[:, :1],
                reference_share=(ahead <= self.reference.strike + 5).astype(float),
                pelvis_height=np.float64(0.85 * self.standing_height),
                controls=controls,
            )
            return Window(step * self.scene.dt, controls, context, steps)

        return at

    def planner(self, dynamics: Dynamics, optimizers: tuple[Optimizer, ...]) -> Planner:
        """Return a planner of this task; optimisers that need gradients are left out where the dynamics have none."""
        return Planner(
            dynamics,
            self.terms,
            self.horizon,
            KNOTS,
            self.scene.dt,
            SEARCH * exploration_std(self.scene),
            usable(dynamics, optimizers),
            *self.scene.limits,
        )

    def check_state(self, state: ArrayLike) -> np.ndarray:
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


def check_target(target: np.ndarray | tuple[float, ...]) -> np.ndarray:
    """Return the target (3,) [m] as an array; raises InputError for anything but three finite numbers."""
    if np.shape(target) != (3,) or not np.isfinite(target).all():
        raise InputError(f"target is {target}, but must be three finite numbers, in metres")
    return np.asarray(target, float)

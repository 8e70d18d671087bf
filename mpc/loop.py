"""The closed loop in a world: plan, execute, shift. It records and draws nothing."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from mpc.planner import Plan, PlanInfo, Planner


class World(Protocol):
    """The world that a plan is executed in, step by step; `larp_model.engines.mujoco.Truth` of batch 1 is one."""

    def reset(self, states: np.ndarray) -> None:
        """Put the world into states (1, L, 13)."""

    def step(self, control: np.ndarray) -> np.ndarray:
        """Return states (1, L, 13) after one step under joint targets (1, J, 3) [rad]; NaN where it diverged."""


class DivergenceError(RuntimeError):
    """Raised where the world's state is no longer finite, and executing on would mean nothing."""


class Window(NamedTuple):
    """The task's input for the next H steps: reference controls (H, J, 3) [rad] and the residuals' context.

    steps: so many of the H suffice; all by default. weights: of cost terms by name, instead of their own.
    """

    controls: np.ndarray
    context: Any
    steps: int | None = None
    weights: Mapping[str, float] | None = None


def never(step: int, state: np.ndarray) -> bool:
    """Return False: nothing ends the phase."""
    return False


class Phase(NamedTuple):
    """A part of an execution with its planners and windows.

    first: the planner of its first plan; again: of all later ones, every `every` steps. Both share horizon and knots.
    window: the window that begins in a step. over: whether the phase ends in a step with a state (L, 13); its plan is
    carried on for `linger` steps, then the next phase begins or, after the last, planning ends. A phase whose first
    planner is the one before's `again` goes on with its plan. links: those that the planners' dynamics know.
    """

    first: Planner
    again: Planner
    every: int
    window: Callable[[int], Window]
    over: Callable[[int, np.ndarray], bool] = never
    linger: int = 0
    links: slice = slice(None)


class Replan(NamedTuple):
    """One planning step: its step and phase, the state (L, 13) that it began from, the plan and its `PlanInfo`."""

    step: int
    phase: int
    state: np.ndarray
    plan: Plan
    info: PlanInfo


@dataclass
class Execution:
    """A record of an execution: states (T + 1, L, 13), joint targets (T, J, 3) [rad], and every plan on the way."""

    states: list[np.ndarray]
    controls: list[np.ndarray] = field(default_factory=list)
    replans: list[Replan] = field(default_factory=list)


class Begun(NamedTuple):
    """The part of an interrupted execution that is needed to go on with it.

    states (T + 1, L, 13) and controls (T, J, 3) [rad] so far; the last plan, the step and the phase it was made in.
    """

    states: np.ndarray
    controls: np.ndarray
    plan: Plan
    step: int
    phase: int

    @staticmethod
    def of(execution: Execution) -> Begun:
        """Return the part of an execution so far."""
        last = execution.replans[-1]
        return Begun(np.stack(execution.states), np.stack(execution.controls), last.plan, last.step, last.phase)


def execute(
    world: World,
    state: np.ndarray,
    phases: Sequence[Phase],
    steps: int,
    key: jax.Array,
    dt: float,
    observe: Callable[[Execution], None] = lambda execution: None,
    sense: Callable[[np.ndarray], np.ndarray] = lambda state: state,
    begun: Begun | None = None,
) -> Execution:
    """Plan in the true state, from state (L, 13) on, execute and plan again, one phase after the other.

    After the last phase its plan is carried out, and after the plan's end the task's reference. `observe` is called
    after every step. sense: what the planners are shown of a true state (L, 13); all of it by default. begun: to go
    on with, from the state it has reached; the plans found are then those from there on. Raises
    `DivergenceError` as soon as the world diverges.
    """
    execution = Execution([np.asarray(state)])
    index, plan, planned_at, targets = 0, None, 0, np.zeros(0)
    ends: int | None = None
    if begun is not None:
        execution = Execution([*begun.states], [*begun.controls])
        plan, planned_at, index = begun.plan, begun.step, begun.phase
        targets = np.asarray(phases[index].again.controls(plan, phases[index].window(planned_at).controls))
    world.reset(execution.states[-1][None])
    for step in range(len(execution.controls), steps):
        current = sense(execution.states[-1])
        while index < len(phases):
            if ends is None and phases[index].over(step, current):
                ends = step + phases[index].linger
            if ends is None or step < ends:
                break
            if phases[index + 1 :] and phases[index + 1].first is not phases[index].again:
                plan = None
            index, ends = index + 1, None
        phase = phases[min(index, len(phases) - 1)]
        if index < len(phases) and (plan is None or (ends is None and step - planned_at >= phase.every)):
            planner = phase.first if plan is None else phase.again
            before = planner.init(jax.random.fold_in(key, index), step * dt) if plan is None else plan
            wanted = phase.window(step)
            seen = current[phase.links]
            plan, info = planner.step(
                before, seen, wanted.controls, wanted.context, wanted.weights, now=step * dt, steps=wanted.steps
            )
            targets, planned_at = np.asarray(planner.controls(plan, wanted.controls)), step
            execution.replans.append(Replan(step, index, current, plan, info))
        ahead = step - planned_at
        control = targets[ahead] if ahead < len(targets) else phase.window(step).controls[0]
        execution.controls.append(control)
        after = world.step(control[None])[0]
        if not np.isfinite(after).all():
            cause = "" if np.isfinite(control).all() else ": the joint targets are not finite"
            raise DivergenceError(f"the world diverged in step {step}{cause}")
        execution.states.append(after)
        observe(execution)
    return execution

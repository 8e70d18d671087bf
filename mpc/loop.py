"""The closed loop in a world: plan, execute, shift. It records and draws nothing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import jax
import numpy as np

from mpc.feedback import Feedback, FeedbackInfo
from mpc.planner import Plan, PlanInfo, Planner, Window


class World(Protocol):
    """The world that a plan is executed in, step by step; `larp_model.engines.mujoco.Truth` of batch 1 is one."""

    def reset(self, states: np.ndarray) -> None:
        """Put the world into states (1, L, 13)."""

    def step(self, control: np.ndarray) -> np.ndarray:
        """Return states (1, L, 13) after one step under joint targets (1, J, 3) [rad]; NaN where it diverged."""


class DivergenceError(RuntimeError):
    """Raised where the world's state is no longer finite, and executing on would mean nothing."""


def never(step: int, state: np.ndarray) -> bool:
    """Return False: nothing ends the phase."""
    return False


class Phase(NamedTuple):
    """Part of an execution with its own planners.

    first: the planner of the first plan; replan: of all later ones, every `interval` steps. Both share horizon and
    knots. window: returns the window that begins at a step. is_done: returns whether the phase ends at a step in a
    state (L, 13); its plan is then executed for `hold_steps` more before the next phase begins. After the last phase
    nothing is planned any more. A phase whose first planner is the `replan` of the phase before continues with its
    plan. links: those that the planners' dynamics have. feedback: whether the joint targets of plans answer deviations
    from what they predict, with gains computed once, around the first plan: see `mpc.feedback`.
    """

    first: Planner
    replan: Planner
    interval: int
    window: Callable[[int], Window]
    is_done: Callable[[int, np.ndarray], bool] = never
    hold_steps: int = 0
    links: slice = slice(None)
    feedback: bool = False


class PlanRecord(NamedTuple):
    """A plan with its step and phase, the state (L, 13) that it began from, and its figures.

    feedback: those of the feedback that was computed around it, if any.
    """

    step: int
    phase: int
    state: np.ndarray
    plan: Plan
    info: PlanInfo
    feedback: FeedbackInfo | None = None


@dataclass
class Execution:
    """Record of an execution: states (T + 1, L, 13), joint targets (T, J, 3) [rad], and every plan on the way."""

    states: list[np.ndarray]
    controls: list[np.ndarray] = field(default_factory=list)
    plans: list[PlanRecord] = field(default_factory=list)


class Checkpoint(NamedTuple):
    """Part of an interrupted execution that is needed to continue it.

    states (T + 1, L, 13) and controls (T, J, 3) [rad] so far; the last plan, the step and the phase it was made in.
    """

    states: np.ndarray
    controls: np.ndarray
    plan: Plan
    step: int
    phase: int

    @staticmethod
    def of(execution: Execution) -> Checkpoint:
        """Return the checkpoint of an execution so far."""
        last = execution.plans[-1]
        return Checkpoint(np.stack(execution.states), np.stack(execution.controls), last.plan, last.step, last.phase)


@dataclass
class ActivePlan:
    """A plan that is being executed: joint targets (H, J, 3) [rad] from a step on, and feedback around it, if any.

    sums: see `feedback.Feedback`.
    """

    plan: Plan
    step: int
    controls: np.ndarray
    feedback: Feedback | None = None
    sums: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def target(self, step: int, state: np.ndarray) -> np.ndarray | None:
        """Return the joint targets (J, 3) [rad] of a step in a state (L, 13), or None after the plan's end."""
        number = step - self.step
        if number >= len(self.controls):
            return None
        if self.feedback is None:
            control: np.ndarray = self.controls[number]
            return control
        self.sums, control = self.feedback.step(self.sums, number, state)
        return control


def next_plan(
    phase: Phase, index: int, step: int, state: np.ndarray, last: ActivePlan | None, key: jax.Array
) -> tuple[ActivePlan, PlanRecord]:
    """Return a plan that a phase, the `index`-th, makes in a state (L, 13) of a step, after its last one, if any."""
    planner, window = phase.first if last is None else phase.replan, phase.window(step)
    warm_start = planner.init(jax.random.fold_in(key, index), window.time) if last is None else last.plan
    plan, info = planner.step(warm_start, state, window)
    active = ActivePlan(plan, step, np.asarray(planner.controls(plan, window.reference)))
    feedback_info = None
    if phase.feedback:
        if last is None or last.feedback is None:
            active.feedback, feedback_info = planner.feedback(plan, info, state, window)
        else:
            predicted = planner.predicted(info, state, window)
            active.feedback = last.feedback.around(active.controls, predicted, step - last.step)
        active.sums = active.feedback.init()
    return active, PlanRecord(step, index, state, plan, info, feedback_info)


def execute(
    world: World,
    state: np.ndarray,
    phases: Sequence[Phase],
    steps: int,
    key: jax.Array,
    observe: Callable[[Execution], None] = lambda execution: None,
    sense: Callable[[np.ndarray], np.ndarray] = lambda state: state,
    checkpoint: Checkpoint | None = None,
) -> Execution:
    """Plan, execute and replan for `steps`, from a state (L, 13) on, one phase after the other.

    After the last phase its plan is executed and, after the plan's end, the task's reference. observe: called after
    every step. sense: returns the state that the planners get in a true state (L, 13); the same by default.
    checkpoint: to continue from, without feedback until the next plan; the plans in the result are then those from
    there on. Raises `DivergenceError` as soon as the world diverges.
    """
    execution, phase_index = Execution([np.asarray(state)]), 0
    active: ActivePlan | None = None
    end_step: int | None = None
    if checkpoint is not None:
        execution = Execution([*checkpoint.states], [*checkpoint.controls])
        phase_index, planner = checkpoint.phase, phases[checkpoint.phase].replan
        targets = planner.controls(checkpoint.plan, phases[phase_index].window(checkpoint.step).reference)
        active = ActivePlan(checkpoint.plan, checkpoint.step, np.asarray(targets))
    world.reset(execution.states[-1][None])
    for step in range(len(execution.controls), steps):
        sensed = sense(execution.states[-1])
        while phase_index < len(phases):
            if end_step is None and phases[phase_index].is_done(step, sensed):
                end_step = step + phases[phase_index].hold_steps
            if end_step is None or step < end_step:
                break
            if phases[phase_index + 1 :] and phases[phase_index + 1].first is not phases[phase_index].replan:
                active = None
            phase_index, end_step = phase_index + 1, None
        phase = phases[min(phase_index, len(phases) - 1)]
        planning, seen = phase_index < len(phases), sensed[phase.links]
        if planning and (active is None or (end_step is None and step - active.step >= phase.interval)):
            active, record = next_plan(phase, phase_index, step, seen, active, key)
            execution.plans.append(record._replace(state=sensed))
        target = None if active is None else active.target(step, seen)
        control = np.asarray(phase.window(step).reference)[0] if target is None else target
        execution.controls.append(control)
        next_state = world.step(control[None])[0]
        if not np.isfinite(next_state).all():
            cause = "" if np.isfinite(control).all() else ": the joint targets are not finite"
            raise DivergenceError(f"the world diverged in step {step}{cause}")
        execution.states.append(next_state)
        observe(execution)
    return execution

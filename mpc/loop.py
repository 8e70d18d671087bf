"""The closed loop in a world: plan, execute, shift. It records and draws nothing.

A world waits for each plan, or goes on meanwhile (`realtime`): a plan then begins in the step in which it is expected,
from the state that the planner's model predicts for it, and the plans before are executed until then.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple, Protocol

import jax
import numpy as np

from larp_model import state as packed
from larp_model.errors import InputError
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


class DeadlineError(InputError):
    """Raised where plans are expected to take longer than their horizon, and none would be in time."""


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
    """A plan with the step that it begins in, its phase, the state (L, 13) that it began from, and its figures.

    feedback: figures of the feedback that was computed around it, if any. requested: the step in which it was asked
    for, from where `state` was predicted. seconds: from then until it was finished, compilation left out. received: the
    step from which it was executed. error: largest distance [m] of a link from that prediction in step `step`; NaN
    where it was received later.
    """

    step: int
    phase: int
    state: np.ndarray
    plan: Plan
    info: PlanInfo
    feedback: FeedbackInfo | None = None
    requested: int = 0
    seconds: float = 0.0
    received: int = 0
    error: float = math.nan


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
    """A plan to execute: joint targets (H, J, 3) [rad] from a step on, for `links`, and feedback around it, if any.

    sums: see `feedback.Feedback`.
    """

    plan: Plan
    step: int
    controls: np.ndarray
    links: slice
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
        self.sums, control = self.feedback.step(self.sums, number, state[self.links])
        return control


PlanResult = tuple[ActivePlan, PlanRecord]


class Latency(Protocol):
    """Time that plans take while the world goes on. It makes one plan at a time."""

    @property
    def lead(self) -> int:
        """Return the steps after which a plan that is requested now is expected."""

    def submit(self, step: int, job: Callable[[], PlanResult]) -> None:
        """Begin to make a plan that is requested in a step."""

    def result(self, step: int) -> PlanResult | None:
        """Return the plan once it is finished, once, else None. Raises the errors of making it."""

    def close(self) -> None:
        """End what still runs."""


class NoLatency:
    """The world waits for each plan."""

    lead = 0

    def submit(self, step: int, job: Callable[[], PlanResult]) -> None:
        """See `Latency`."""
        self._result = job()

    def result(self, step: int) -> PlanResult | None:
        """See `Latency`."""
        return self._result

    def close(self) -> None:
        """See `Latency`."""


def next_plan(
    phase: Phase, index: int, step: int, state: np.ndarray, last: ActivePlan | None, key: jax.Array
) -> PlanResult:
    """Return a plan that a phase, the `index`-th, makes in a state (L, 13) of a step, after its last one, if any."""
    planner, window = phase.first if last is None else phase.replan, phase.window(step)
    warm_start = planner.init(jax.random.fold_in(key, index), window.time) if last is None else last.plan
    seen = state[phase.links]
    plan, info = planner.step(warm_start, seen, window)
    active = ActivePlan(plan, step, np.asarray(planner.controls(plan, window.reference)), phase.links)
    feedback_info = None
    if phase.feedback:
        if last is None or last.feedback is None:
            active.feedback, feedback_info = planner.feedback(plan, info, seen, window)
        else:
            predicted = planner.predicted(info, seen, window)
            active.feedback = last.feedback.around(active.controls, predicted, step - last.step)
        active.sums = active.feedback.init()
    return active, PlanRecord(step, index, state, plan, info, feedback_info)


def target_of(plan: ActivePlan | None, phase: Phase, step: int, state: np.ndarray) -> np.ndarray:
    """Return the joint targets (J, 3) [rad] of a step in a state (L, 13): a plan's, or after its end the reference."""
    if plan is not None and (target := plan.target(step, state)) is not None:
        return target
    reference: np.ndarray = np.asarray(phase.window(step).reference)[0]
    return reference


def predicted_state(
    planner: Planner, phase: Phase, plans: Sequence[ActivePlan], step: int, lead: int, state: np.ndarray
) -> np.ndarray:
    """Return the state (L, 13) that a planner of a phase predicts `lead` steps on, from a state in a step.

    plans: that are executed until then, each from its own step on; their feedback goes on with the prediction. Where
    the model diverges, its last finite state is returned.
    """
    active, upcoming = None, deque(plans)
    for number in range(step, step + lead):
        while upcoming and upcoming[0].step <= number:
            active = upcoming.popleft()
        control = target_of(active, phase, number, state)
        following = state.copy()
        following[phase.links] = planner.advance(state[phase.links], control)
        if not np.isfinite(following).all():
            break
        state = following
    return state


Sense = Callable[[int, np.ndarray, np.ndarray | None], np.ndarray]
"""(step, true state (L, 13), joint targets (J, 3) [rad] of the step before, if any) -> state that the planners get."""


@dataclass
class _Loop:
    """The state of an execution between its steps.

    phase: the number of the current one; end_step: in which it ends, if that is known. last: the phase's last plan,
    that the next one continues. active: the plan that is executed. upcoming: plans that begin in later steps.
    """

    phases: Sequence[Phase]
    key: jax.Array
    latency: Latency
    phase: int = 0
    end_step: int | None = None
    last: ActivePlan | None = None
    active: ActivePlan | None = None
    upcoming: deque[PlanResult] = field(default_factory=deque)
    in_flight: bool = False
    first_valid: int = 0  # plans of earlier phases are outdated

    def enter_phase(self, step: int, state: np.ndarray) -> None:
        """Go on to the phase that a step belongs to."""
        while self.phase < len(self.phases):
            current = self.phases[self.phase]
            if self.end_step is None and current.is_done(step, state):
                self.end_step = step + current.hold_steps
            if self.end_step is None or step < self.end_step:
                break
            following = self.phases[self.phase + 1 : self.phase + 2]
            if following and following[0].first is not current.replan:
                self.last, self.first_valid = None, self.phase + 1
                self.upcoming.clear()
            self.phase, self.end_step = self.phase + 1, None

    def update(self, step: int, state: np.ndarray) -> list[PlanRecord]:
        """Return the records of plans that begin to be executed in a step, and request the next one."""
        before = self.receive(step, state)
        self.request(step, state)
        return [record for record in (before, self.receive(step, state)) if record is not None]

    def request(self, step: int, state: np.ndarray) -> None:
        """Request the next plan in a step, if it is due."""
        if self.phase >= len(self.phases) or self.in_flight:
            return
        phase, index, last = self.phases[self.phase], self.phase, self.last
        # Nothing is executed yet, and the world waits for the first plan.
        latency: Latency = NoLatency() if self.active is None else self.latency
        lead = min(latency.lead, phase.replan.horizon - 1)
        due = last is None or (self.end_step is None and step + lead - last.step >= phase.interval)
        if not due:
            return
        active = [] if self.active is None else [self.active]
        plans = [replace(plan) for plan in (*active, *(plan for plan, _ in self.upcoming))]

        def job() -> PlanResult:
            planner, begin = phase.first if last is None else phase.replan, time.perf_counter()
            compiled_before = planner.compile_seconds
            start = predicted_state(planner, phase, plans, step, lead, state)
            plan, record = next_plan(phase, index, step + lead, start, last, self.key)
            seconds = time.perf_counter() - begin - (planner.compile_seconds - compiled_before)
            return plan, record._replace(requested=step, seconds=seconds)

        latency.submit(step, job)
        self.in_flight = True
        if latency is not self.latency:
            self.expect(latency.result(step))

    def expect(self, result: PlanResult | None) -> None:
        """Take a plan that was in flight, None: it is not finished; that of a phase that is over is dropped."""
        if result is None:
            return
        self.in_flight = False
        if result[1].phase >= self.first_valid:
            self.upcoming.append(result)
            self.last = result[0]

    def receive(self, step: int, state: np.ndarray) -> PlanRecord | None:
        """Return the record of the plan that begins to be executed in a step, if there is one."""
        if self.in_flight:
            self.expect(self.latency.result(step))
        if not self.upcoming or self.upcoming[0][1].step > step:
            return None
        self.active, record = self.upcoming.popleft()
        record = record._replace(received=step)
        if step > record.step:
            return record
        links = self.phases[record.phase].links
        return record._replace(error=_largest_distance(state[links], record.state[links]))

    def target(self, step: int, state: np.ndarray) -> np.ndarray:
        """Return the joint targets (J, 3) [rad] of a step in a state (L, 13)."""
        return target_of(self.active, self.phases[min(self.phase, len(self.phases) - 1)], step, state)


def _largest_distance(state: np.ndarray, other: np.ndarray) -> float:
    """Return the largest distance [m] of a link's centre in two states (L, 13)."""
    return float(np.linalg.norm(state[:, packed.POSITION] - other[:, packed.POSITION], axis=1).max())


def execute(
    world: World,
    state: np.ndarray,
    phases: Sequence[Phase],
    steps: int,
    key: jax.Array,
    observe: Callable[[Execution], None] = lambda execution: None,
    sense: Sense | None = None,
    checkpoint: Checkpoint | None = None,
    latency: Latency | None = None,
) -> Execution:
    """Plan, execute and replan for `steps`, from a state (L, 13) on, one phase after the other.

    After the last phase its plan is executed and, after the plan's end, the task's reference. observe: called after
    every step. sense: returns the state that the planners get; the true one by default.
    checkpoint: to continue from, without feedback until the next plan; the plans in the result are then those from
    there on. latency: of all plans but the first, for which the world waits; none by default. Raises `DivergenceError`
    as soon as the world diverges, and `DeadlineError` where plans are expected to take longer than their horizon.
    """
    latency = NoLatency() if latency is None else latency
    if phases and latency.lead >= (horizon := min(phase.replan.horizon for phase in phases)):
        message = f"latency: plans take {latency.lead} steps, needs fewer than the planners' horizon, {horizon}"
        raise DeadlineError(message)
    execution, loop = Execution([np.asarray(state)]), _Loop(phases, key, latency)
    if checkpoint is not None:
        execution = Execution([*checkpoint.states], [*checkpoint.controls])
        loop.phase, phase = checkpoint.phase, phases[checkpoint.phase]
        targets = phase.replan.controls(checkpoint.plan, phase.window(checkpoint.step).reference)
        loop.last = ActivePlan(checkpoint.plan, checkpoint.step, np.asarray(targets), phase.links)
        loop.active = loop.last
    world.reset(execution.states[-1][None])
    try:
        for step in range(len(execution.controls), steps):
            sensed = execution.states[-1]
            if sense is not None:
                sensed = sense(step, sensed, execution.controls[-1] if execution.controls else None)
            loop.enter_phase(step, sensed)
            execution.plans += loop.update(step, sensed)
            execution.controls.append(loop.target(step, sensed))
            execution.states.append(_stepped(world, step, execution.controls[-1]))
            observe(execution)
    finally:
        latency.close()
    return execution


def _stepped(world: World, step: int, control: np.ndarray) -> np.ndarray:
    """Return the world's state (L, 13) after a step under joint targets (J, 3) [rad]."""
    state: np.ndarray = world.step(control[None])[0]
    if not np.isfinite(state).all():
        cause = "" if np.isfinite(control).all() else ": the joint targets are not finite"
        raise DivergenceError(f"the world diverged in step {step}{cause}")
    return state

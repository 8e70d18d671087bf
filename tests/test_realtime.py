"""Promises of plans that take time: where they begin, what acts until then, and what comes too late."""

import threading
import time
from dataclasses import dataclass, field
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model.errors import InputError
from mpc import CostTerm, GaussNewton, Planner, Window
from mpc.loop import Execution, Phase, execute
from mpc.realtime import PacedWorld, PlanningThread, SimulatedLatency

HORIZON, DT = 8, 0.01
STATE = np.tile(np.eye(1, 13, 3), (2, 1))
TARGET = np.array([0.5, -0.2, 0.1])


@dataclass(frozen=True)
class Slider:
    """Every link moves by `pace` times the control in each step."""

    pace: float = 1.0
    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        way = jnp.cumsum(self.pace * controls[:, :, 0], axis=1)
        states = jnp.repeat(state[:, None], controls.shape[1], axis=1)
        return states.at[..., :3].add(way[:, :, None])


@dataclass
class SliderWorld:
    """The ground truth of `Slider`; in a step of this number something fails."""

    failing_step: int = 10**6
    failure: type[BaseException] = KeyboardInterrupt
    states: np.ndarray = field(default_factory=lambda: STATE[None])
    controls: list[np.ndarray] = field(default_factory=list)

    def reset(self, states: np.ndarray) -> None:
        self.states = np.array(states)

    def step(self, control: np.ndarray) -> np.ndarray:
        if len(self.controls) == self.failing_step:
            raise self.failure
        self.controls.append(control[0])
        self.states = self.states.copy()
        self.states[..., :3] += control
        return self.states


def planner_of(pace: float = 1.0) -> Planner:
    terms = (CostTerm("miss", lambda states, controls, target: states[-1, 0, :3] - target),)
    return Planner(Slider(pace), terms, HORIZON, 3, DT, np.full((1, 3), 0.1), GaussNewton(2, 9))


def window(step: int) -> Window:
    return Window(step * DT, np.zeros((HORIZON, 1, 3)), TARGET)


def executed(latency: object, steps: int = 20, interval: int = 4, planner: Planner | None = None) -> Execution:
    planner = planner or planner_of()
    phase = Phase(planner, planner, interval, window)
    return execute(SliderWorld(), STATE, (phase,), steps, jax.random.key(0), latency=latency)  # type: ignore[arg-type]


def begins(execution: Execution) -> list[tuple[int, int, int]]:
    return [(plan.requested, plan.step, plan.received) for plan in execution.plans]


def test_a_plan_without_delay_begins_in_the_step_in_which_it_is_requested() -> None:
    waiting, instant = executed(None), executed(SimulatedLatency(DT, 0.0))
    assert begins(waiting) == begins(instant) == [(step, step, step) for step in range(0, 20, 4)]
    np.testing.assert_array_equal(waiting.states, instant.states)


def test_a_plan_begins_when_it_is_expected_and_the_one_before_acts_until_then() -> None:
    planner = planner_of()
    execution = executed(SimulatedLatency(DT, 0.03), planner=planner)
    assert begins(execution)[:4] == [(0, 0, 0), (1, 4, 4), (5, 8, 8), (9, 12, 12)]
    for plan, after in pairwise(execution.plans):
        controls = planner.controls(plan.plan, np.zeros((HORIZON, 1, 3)))
        np.testing.assert_array_equal(execution.controls[plan.step : after.step], controls[: after.step - plan.step])


def test_a_plan_starts_from_the_state_that_the_model_predicts_for_its_beginning() -> None:
    exact, wrong = (executed(SimulatedLatency(DT, 0.03), planner=planner_of(pace)) for pace in (1.0, 0.8))
    for plan in exact.plans:
        np.testing.assert_allclose(plan.state, exact.states[plan.step], atol=1e-6)
    assert max(plan.error for plan in exact.plans) < 1e-6
    for plan in wrong.plans[1:]:
        moved = wrong.states[plan.step] - wrong.states[plan.requested]
        assert plan.error == pytest.approx(0.2 * np.linalg.norm(moved[0, :3]), rel=1e-4)


def test_where_the_model_diverges_a_plan_starts_from_its_last_finite_state() -> None:
    @dataclass(frozen=True)
    class Fragile(Slider):
        """Lost once a link has moved by so much."""

        def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
            states = super().rollout(state, controls, steps)
            return jnp.where(state[:, None, :1, :1] > 0.1, jnp.nan, states)

    terms = (CostTerm("miss", lambda states, controls, target: states[-1, 0, :3] - target),)
    planner = Planner(Fragile(), terms, HORIZON, 3, DT, np.full((1, 3), 0.1), GaussNewton(2, 9))
    execution = executed(SimulatedLatency(DT, 0.03), planner=planner)
    assert begins(execution)[:2] == [(0, 0, 0), (1, 4, 4)]
    assert all(np.isfinite(plan.state).all() for plan in execution.plans)
    assert execution.states[4][0, 0] > 0.1 >= execution.plans[1].state[0, 0] - float(execution.controls[0][0, 0])


def test_a_late_plan_is_joined_where_it_would_be_by_then_and_the_next_is_expected_later() -> None:
    planner = planner_of()
    latency = SimulatedLatency(DT, [0.01, 0.04])
    latency._random = Drawn([0.01, 0.04, 0.01])  # type: ignore[assignment]
    latency._leads._recent.clear()
    latency._leads.add(1)
    execution = executed(latency, planner=planner)
    # Requested 1 step ahead, the third takes 4; then plans are requested 4 steps ahead, and wait for their beginning.
    assert begins(execution)[:4] == [(0, 0, 0), (3, 4, 4), (7, 8, 11), (11, 15, 15)]
    late = execution.plans[2]
    controls = planner.controls(late.plan, np.zeros((HORIZON, 1, 3)))
    np.testing.assert_array_equal(execution.controls[11:15], controls[3:7])
    assert np.isnan(late.error)


def test_while_a_finished_plan_waits_for_its_beginning_the_next_is_made() -> None:
    latency = SimulatedLatency(DT, 0.01)
    latency._leads.add(3)  # so many steps are expected to pass, where all plans take 1
    execution = executed(latency, 12, interval=1)
    assert begins(execution)[:5] == [(0, 0, 0), (1, 4, 4), (2, 5, 5), (3, 6, 6), (4, 7, 7)]
    for plan in execution.plans:
        np.testing.assert_allclose(plan.state, execution.states[plan.step], atol=1e-6)


@dataclass
class Drawn:
    """Delays, one after the other."""

    delays: list[float]

    def choice(self, _: np.ndarray) -> float:
        return self.delays.pop(0) if self.delays else 0.01


def test_a_plan_of_a_phase_that_is_over_is_dropped() -> None:
    one, other = planner_of(), planner_of()
    phases = (Phase(one, one, 2, window, lambda step, state: step == 5), Phase(other, other, 3, window))
    execution = execute(SliderWorld(), STATE, phases, 20, jax.random.key(0), latency=SimulatedLatency(DT, 0.03))
    assert [(plan.requested, plan.phase) for plan in execution.plans][:3] == [(0, 0), (1, 0), (7, 1)]
    assert all(plan.received == plan.step for plan in execution.plans)


def test_drawn_delays_are_repeated_with_their_seed() -> None:
    # So rare a delay is not expected.
    runs = [executed(SimulatedLatency(DT, [0.0] * 100 + [0.05], seed), 150, interval=1) for seed in (1, 1, 2)]
    assert begins(runs[0]) == begins(runs[1]) != begins(runs[2])


def test_a_thread_plans_while_the_world_keeps_to_the_clock() -> None:
    planner = planner_of()
    planner.compile(STATE, window(0))
    planner.advance(STATE, np.zeros((1, 3)))
    world, steps = PacedWorld(SliderWorld(), DT), 60
    phase = Phase(planner, planner, 4, window)
    begin = time.monotonic()
    execution = execute(world, STATE, (phase,), steps, jax.random.key(0), latency=PlanningThread(DT, expected=0.02))
    assert time.monotonic() - begin >= steps * DT
    received = [plan.received for plan in execution.plans]
    assert len(received) > 3 and received == sorted(set(received))
    assert all(plan.requested < plan.received for plan in execution.plans[1:])
    assert np.linalg.norm(execution.states[-1][0, :3] - TARGET) < 0.1


def planning_threads() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name.startswith("planning")]


@pytest.mark.parametrize("failure", [KeyboardInterrupt, ValueError])
def test_the_thread_ends_with_the_world(failure: type[BaseException]) -> None:
    planner = planner_of()
    phase = Phase(planner, planner, 4, window)
    with pytest.raises(failure):
        execute(SliderWorld(6, failure), STATE, (phase,), 20, jax.random.key(0), latency=PlanningThread(DT, 0.01))
    assert not planning_threads()


def test_an_error_of_planning_ends_the_execution() -> None:
    planner = planner_of()

    def failing(step: int) -> Window:
        return window(step)._replace(weights={"unknown": 1.0} if step else None)

    phase = Phase(planner, planner, 2, failing)
    with pytest.raises(InputError, match=r"window.weights: got 'unknown'"):
        execute(PacedWorld(SliderWorld(), DT), STATE, (phase,), 500, jax.random.key(0), latency=PlanningThread(DT, 0.0))
    assert not planning_threads()


def test_plans_that_are_expected_to_take_longer_than_their_horizon_are_refused() -> None:
    with pytest.raises(InputError, match=r"latency: plans take 9 steps, needs fewer than the planners' horizon, 8"):
        executed(SimulatedLatency(DT, 0.09))


def test_a_plan_that_is_there_after_its_end_is_counted_and_the_next_is_made() -> None:
    latency = SimulatedLatency(DT, [0.01])
    latency._random = Drawn([0.12])  # type: ignore[assignment]
    execution = executed(latency, 40)
    late, after = execution.plans[1:3]
    assert late.received == late.requested + 12 > late.step + HORIZON
    np.testing.assert_array_equal(execution.controls[HORIZON : late.received], 0.0)  # the reference
    assert after.requested == late.received and after.step == after.received == after.requested + HORIZON - 1


@pytest.mark.parametrize("delays", [-0.01, np.nan, [], [0.01, np.inf]])
def test_delays_that_mean_nothing_are_refused(delays: object) -> None:
    with pytest.raises(InputError, match=r"delays: got"):
        SimulatedLatency(DT, delays)  # type: ignore[arg-type]


def test_times_that_mean_nothing_are_refused() -> None:
    with pytest.raises(InputError, match=r"dt: got 0"):
        PlanningThread(0.0, 0.01)
    with pytest.raises(InputError, match=r"expected: got -1"):
        PlanningThread(DT, -1.0)


def test_a_world_that_is_too_slow_for_the_clock_counts_its_overruns() -> None:
    @dataclass
    class Slow(SliderWorld):
        def step(self, control: np.ndarray) -> np.ndarray:
            time.sleep(2.0 * DT if len(self.controls) % 2 else 0.0)
            return super().step(control)

    world = PacedWorld(Slow(), DT)
    world.reset(STATE[None])
    begin = time.monotonic()
    for _ in range(6):
        world.step(np.zeros((1, 1, 3)))
    assert world.overruns >= 3
    assert time.monotonic() - begin >= 3 * (DT + 2.0 * DT)

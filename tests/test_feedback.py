"""Promises of feedback around a plan: gains of least cost, slopes of model and costs, a closed loop that uses them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import DT, HORIZON, LEG, REFERENCE, STATE, TARGET, PointMass, planner_of

from larp_model.errors import InputError
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from mpc import Continued, CostTerm, GaussNewton, Planner, Window
from mpc.dynamics import linearizable
from mpc.feedback import LARGEST_CHANGE, Feedback, LinearQuadratic, quadratic_costs, riccati
from mpc.loop import Phase, execute

COUNT, INPUTS, SUMS = 4, 2, 3


@dataclass(frozen=True)
class Unstable:
    """A point whose place grows by a tenth a step, and moves with the velocity 100 u; its coordinates are its place."""

    differentiable = True
    growth: float = 1.1

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        def advance(place: jax.Array, control: jax.Array) -> tuple[jax.Array, jax.Array]:
            after = self.growth * place + 100 * DT * control[:, :1]
            return after, after

        _, places = jax.lax.scan(advance, state[:, :, :3], jnp.moveaxis(controls, 1, 0))
        return jnp.repeat(state[:, None], controls.shape[1], 1).at[..., :3].set(jnp.moveaxis(places, 0, 1))

    def linearize(self, states: jax.Array, controls: jax.Array) -> tuple[jax.Array, jax.Array]:
        unit = jnp.broadcast_to(jnp.eye(3), (len(states), 3, 3))
        return self.growth * unit, 100 * DT * unit

    def difference(self, states: jax.Array, references: jax.Array) -> jax.Array:
        return (states - references)[..., 0, :3]

    def basis(self, states: jax.Array) -> jax.Array:
        return jnp.broadcast_to(jnp.eye(13, 3), (*states.shape, 3))

    def moved(self, states: jax.Array, coordinates: jax.Array) -> jax.Array:
        return states.at[..., 0, :3].add(coordinates)


@dataclass
class Pushed:
    """The world of `Unstable`, whose point is pushed in one step."""

    push: np.ndarray
    at: int
    state: np.ndarray = field(default_factory=STATE.copy)
    steps: int = 0

    def reset(self, states: np.ndarray) -> None:
        self.state, self.steps = states[0].copy(), 0

    def step(self, control: np.ndarray) -> np.ndarray:
        after = Unstable().rollout(jnp.asarray(self.state[None]), jnp.asarray(control[None]))
        self.state = np.array(after[0, 0])
        self.state[0, :3] += self.push * (self.steps == self.at)
        self.steps += 1
        return self.state[None]


def random_problem(horizon: int) -> LinearQuadratic:
    random = np.random.default_rng(0)
    factors = random.standard_normal((horizon, COUNT + INPUTS, COUNT + INPUTS))
    return LinearQuadratic(
        0.5 * random.standard_normal((horizon, COUNT, COUNT)),
        random.standard_normal((horizon, COUNT, INPUTS)),
        factors @ np.swapaxes(factors, 1, 2),
        random.standard_normal((horizon, SUMS, COUNT)),
        random.standard_normal((horizon, SUMS, INPUTS)),
        random.uniform(0.5, 2.0, SUMS),
    )


def cost_of(problem: LinearQuadratic, deviation: Any, sums: Any, changes: Any) -> Any:
    """The cost that the module states, of changes (H, m) from a deviation (n,) and sums (r,) on."""
    cost = 0.0
    for step, change in enumerate(changes):
        deviation = problem.by_state[step] @ deviation + problem.by_control[step] @ change
        sums = sums + problem.sum_by_state[step] @ deviation + problem.sum_by_control[step] @ change
        both = jnp.concatenate([deviation, change])
        cost += 0.5 * both @ problem.step_curvature[step] @ both
    return cost + 0.5 * jnp.sum(problem.sum_curvature * sums**2)


def test_no_changes_of_the_controls_cost_less_than_those_of_the_gains() -> None:
    with jax.enable_x64(True):
        problem, random = random_problem(5), np.random.default_rng(1)
        deviation, sums = random.standard_normal(COUNT), random.standard_normal(SUMS)
        gains = riccati(problem, damping=0.0)
        changes, place, total = [], deviation, sums
        for step, gain in enumerate(gains):
            changes.append(gain @ np.concatenate([place, total]))
            place = problem.by_state[step] @ place + problem.by_control[step] @ changes[-1]
            total = total + problem.sum_by_state[step] @ place + problem.sum_by_control[step] @ changes[-1]
        slope = jax.grad(lambda changes: cost_of(problem, deviation, sums, changes))(jnp.stack(changes))
        size = cost_of(problem, deviation, sums, jnp.zeros((5, INPUTS)))
        assert float(jnp.abs(slope).max()) < 1e-4 * float(size)


def test_damping_makes_gains_smaller() -> None:
    sizes = [np.abs(riccati(random_problem(5), damping)).max() for damping in (0.0, 1.0, 100.0)]
    assert sizes[0] > sizes[1] > sizes[2] > 0.0


def test_the_quadratic_predicts_what_changes_of_start_and_controls_cost() -> None:
    """A swinging leg has costs of each step, and one of its last state and its mean control."""
    with jax.enable_x64(True):
        simulator, random, steps = Simulator.of_physics(Scene((LEG,))), np.random.default_rng(0), 4
        start = jnp.asarray(leg_state())
        controls = jnp.asarray(0.3 * random.standard_normal((steps, 1, 3)))

        def residuals_of(states: jax.Array, controls: jax.Array) -> dict[str, jax.Array]:
            by_step = jnp.concatenate([states[:, 1, :3], controls[:, 0] * states[:, 1, 7:10]], axis=1)
            return {"steps": by_step, "sums": states[-1, 0, 7:10] + jnp.mean(controls[:, 0], axis=0)}

        def rolled_out(start: jax.Array, controls: jax.Array) -> dict[str, jax.Array]:
            return residuals_of(simulator.rollout(start[None], controls[None])[0], controls)

        states = jnp.concatenate([start[None], simulator.rollout(start[None], controls[None])[0]])
        ones = jax.tree.map(jnp.ones_like, residuals_of(states[1:], controls))
        problem = LinearQuadratic(
            *simulator.linearize(states[:-1], controls),
            *quadratic_costs(simulator, residuals_of, ones, states[1:], controls),
        )
        size = 1e-5
        deviation = size * random.standard_normal(problem.by_state.shape[1])
        changes = size * random.standard_normal((steps, 3))
        moved_start = start + simulator.basis(start[None])[0] @ deviation
        moved = rolled_out(moved_start, controls + changes[:, None])
        differences = jax.tree.map(jnp.subtract, moved, rolled_out(start, controls))
        expected = 0.5 * sum(float(jnp.sum(leaf**2)) for leaf in jax.tree.leaves(differences))
        sums = np.zeros(3)
        assert float(cost_of(problem, deviation, sums, changes)) == pytest.approx(expected, rel=1e-3)


def leg_state() -> np.ndarray:
    """A state (2, 13) of the leg, straight, at rest, in the air."""
    state = np.zeros((2, 13))
    state[:, 3], state[:, 2] = 1.0, (2.0, 1.6)
    return state


def closed_loop(feedback: bool, push: float, interval: int = 100) -> tuple[float, Any]:
    planner = planner_of(Unstable(), GaussNewton(rounds=6, directions=12))
    phase = Phase(planner, planner, interval, window, feedback=feedback)
    world = Pushed(push * np.array([1.0, -0.5, 0.2]), 3)
    execution = execute(world, STATE, (phase,), HORIZON, jax.random.key(0))
    return float(np.linalg.norm(execution.states[-1][0, :3] - TARGET)), execution


def window(step: int) -> Window:
    return Window(step * DT, REFERENCE, TARGET, steps=HORIZON - step)


def test_feedback_brings_a_pushed_body_back_to_its_plan() -> None:
    (undisturbed, _), (alone, _), (followed, execution) = (
        closed_loop(*arguments) for arguments in ((False, 0.0), (False, 0.1), (True, 0.1))
    )
    assert undisturbed < 0.01 and alone > 0.1
    assert followed < 0.5 * alone
    assert len(execution.plans) == 1 and execution.plans[0].feedback.gain > 0.0


def test_where_all_goes_as_planned_feedback_changes_nothing() -> None:
    _, without = closed_loop(False, 0.0)
    _, with_feedback = closed_loop(True, 0.0)
    np.testing.assert_allclose(with_feedback.controls, without.controls, atol=1e-5)


def test_gains_are_computed_once_and_serve_replans_for_the_same_moments() -> None:
    _, execution = closed_loop(True, 0.1, interval=5)
    assert [plan.feedback is not None for plan in execution.plans] == [True, False, False]
    gains = np.arange(HORIZON, dtype=float)[:, None, None] * np.ones((1, 3, 3))
    first = feedback_of(gains)
    later = first.around(first.controls + 1.0, first.states[:8] + 1.0, 5)
    np.testing.assert_array_equal(later.gains, gains[5:])
    assert len(later.states) == 8 and (later.controls == first.controls + 1.0).all()


def feedback_of(gains: np.ndarray, limit: float = 10.0) -> Feedback:
    states, none = np.repeat(STATE[None], HORIZON + 1, axis=0), np.zeros((HORIZON, 0, 3))
    bounds = np.full((1, 3), -limit, np.float32), np.full((1, 3), limit, np.float32)
    return Feedback(Unstable(), np.zeros((HORIZON, 1, 3), np.float32), states, gains, none, none, *bounds)


def test_no_joint_target_is_changed_by_more_than_the_largest_change_or_beyond_its_bounds() -> None:
    gains = np.repeat(1e3 * np.eye(3)[None], HORIZON, axis=0)
    far = STATE.copy()
    far[0, :3] = 1.0, -1.0, 0.0
    for limit in (10.0, 0.05):
        feedback = feedback_of(gains, limit)
        _, target = feedback.step(feedback.init(), 0, far)
        largest = np.float32(min(LARGEST_CHANGE, limit))
        np.testing.assert_array_equal(target, [[largest, -largest, 0.0]])


def test_beyond_the_states_that_are_finite_the_plan_is_followed_without_feedback() -> None:
    gains = np.repeat(np.eye(3)[None], HORIZON, axis=0)
    feedback = feedback_of(gains)
    states = feedback.states.copy()
    states[4:] = np.nan
    cut = feedback.around(feedback.controls, states, 0)
    far = STATE + 0.1
    changed = [bool(np.any(cut.step(cut.init(), number, far)[1])) for number in range(6)]
    assert changed == [True, True, True, False, False, False]


def test_feedback_is_not_taken_from_derivatives_that_are_not_finite() -> None:
    terms = (CostTerm("miss", lambda states, controls, target: jnp.sqrt(states[0, 0, :3] - 1e6) + target),)
    planner = Planner(Unstable(), terms, HORIZON, 4, DT, np.full((1, 3), 0.1), GaussNewton(rounds=1))
    plan = planner.init(jax.random.key(0))
    _, info = planner.step(plan, STATE, window(0))
    feedback, figures = planner.feedback(plan, info, STATE, window(0))
    assert figures.gain == 0.0
    _, target = feedback.step(feedback.init(), 0, STATE + 1.0)
    np.testing.assert_array_equal(target, feedback.controls[0])


def test_dynamics_without_derivatives_of_steps_are_refused_by_name() -> None:
    planner = planner_of(PointMass(), GaussNewton(rounds=1))
    plan = planner.init(jax.random.key(0))
    plan, info = planner.step(plan, STATE, Window(0.0, REFERENCE, TARGET))
    with pytest.raises(InputError, match="dynamics: got PointMass, needs `linearize`"):
        planner.feedback(plan, info, STATE, Window(0.0, REFERENCE, TARGET))


def test_only_dynamics_whose_steps_have_derivatives_count_as_linearizable() -> None:
    tail = PointMass()
    assert linearizable(Unstable()) and linearizable(Continued(Unstable(), tail, slice(0, 1), 2))
    assert not linearizable(PointMass()) and not linearizable(Continued(tail, Unstable(), slice(0, 1), 2))
    assert linearizable(Simulator.of_physics(Scene((LEG,))))

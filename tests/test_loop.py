"""Promises of the closed loop: phases, what the planners are shown, and candidates tried in truer dynamics."""

from dataclasses import dataclass, field
from itertools import pairwise

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model.errors import InputError
from mpc import CEM, CostTerm, GaussNewton, Plan, Planner, Verified, Window
from mpc.loop import Checkpoint, Phase, execute

HORIZON, DT = 6, 0.01


@dataclass(frozen=True)
class Mover:
    """Every link moves with the velocity `pace` times the control."""

    pace: float = 100.0
    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        way = jnp.cumsum(self.pace * DT * controls[:, :, 0], axis=1)
        states = jnp.repeat(state[:, None], controls.shape[1], axis=1)
        return states.at[..., :3].add(way[:, :, None])


@dataclass
class MoverWorld:
    """The ground truth of `Mover`, one step at a time; it records its joint targets."""

    states: np.ndarray = field(default_factory=lambda: np.zeros((1, 2, 13)))
    given: list[np.ndarray] = field(default_factory=list)

    def reset(self, states: np.ndarray) -> None:
        self.states = np.array(states)

    def step(self, control: np.ndarray) -> np.ndarray:
        self.given.append(control[0])
        self.states = self.states.copy()
        self.states[..., :3] += control
        return self.states


TERMS = (CostTerm("miss", lambda states, controls, target: states[-1, 0, :3] - target),)
SEARCH = CEM(samples=24, rounds=3, elites=6)
START = np.tile(np.eye(1, 13, 3), (2, 1))
TARGET = np.array([0.5, -0.2, 0.1])


def _planner(dynamics: Mover | None = None, optimizers: object = SEARCH) -> Planner:
    return Planner(dynamics or Mover(), TERMS, HORIZON, 3, DT, np.full((1, 3), 0.1), optimizers)  # type: ignore[arg-type]


def _window(step: int) -> Window:
    return Window(step * DT, np.zeros((HORIZON, 1, 3)), TARGET)


def test_each_phase_plans_with_its_own_planners_for_its_own_links_until_it_is_over() -> None:
    one, other = _planner(), _planner()
    phases = (
        Phase(one, one, 2, _window, lambda step, state: step == 5),
        Phase(other, other, 3, _window, lambda step, state: step == 12, links=slice(0, 1)),
    )
    world = MoverWorld()
    execution = execute(world, START, phases, 20, jax.random.key(0))
    assert [(plan.step, plan.phase) for plan in execution.plans] == [
        (0, 0), (2, 0), (4, 0), (5, 1), (8, 1), (11, 1),
    ]  # fmt: skip
    assert [plan.info.states.shape[1] for plan in execution.plans] == [2, 2, 2, 1, 1, 1]
    assert len(execution.states) == 21 and len(world.given) == 20
    # The last plan is carried out, and then the reference.
    assert np.abs(world.given[11:16]).max() > 0.0
    np.testing.assert_array_equal(world.given[11 + HORIZON :], np.zeros((20 - 11 - HORIZON, 1, 3)))


def test_weights_of_a_window_replace_those_of_the_terms() -> None:
    planner, costs = _planner(), []
    for weight in (1.0, 10.0):

        def window(step: int) -> Window:
            return _window(step)._replace(weights={"miss": weight})  # noqa: B023

        (plan,) = execute(MoverWorld(), START, (Phase(planner, planner, 9, window),), 1, jax.random.key(0)).plans
        costs.append(plan.info.cost)
    assert costs[1] == pytest.approx(10.0 * costs[0], rel=1e-4)


def test_a_phase_that_holds_executes_its_plan_further_before_the_next_begins() -> None:
    one, other = _planner(), _planner()
    phases = (
        Phase(one, one, 2, _window, lambda step, state: step == 5, hold_steps=3),
        Phase(other, other, 3, _window),
    )
    world = MoverWorld()
    execution = execute(world, START, phases, 12, jax.random.key(0))
    assert [(plan.step, plan.phase) for plan in execution.plans] == [(0, 0), (2, 0), (4, 0), (8, 1), (11, 1)]
    last = execution.plans[2].plan
    np.testing.assert_array_equal(world.given[4:8], one.controls(last, np.zeros((HORIZON, 1, 3)))[:4])


def test_a_phase_with_the_planner_of_the_one_before_goes_on_with_its_plan() -> None:
    one = _planner()
    ends = [lambda step, state: step == 6, lambda step, state: False]
    phases = [Phase(one, one, every, _window, over) for every, over in zip((2, 5), ends, strict=True)]
    execution = execute(MoverWorld(), START, phases, 20, jax.random.key(0))
    assert [(plan.step, plan.phase) for plan in execution.plans] == [
        (0, 0), (2, 0), (4, 0), (9, 1), (14, 1), (19, 1),
    ]  # fmt: skip
    alone = execute(MoverWorld(), START, phases[:1], 6, jax.random.key(0))
    np.testing.assert_array_equal(execution.states[:7], alone.states)


@pytest.mark.parametrize("cut", [1, 4, 7, 11])
def test_an_execution_that_was_cut_off_goes_on_as_if_it_had_not_been(cut: int) -> None:
    one, other = _planner(), _planner()
    phases = (Phase(one, one, 2, _window, lambda step, state: step == 5), Phase(other, other, 3, _window))
    whole = execute(MoverWorld(), START, phases, 14, jax.random.key(0))
    part = execute(MoverWorld(), START, phases, cut, jax.random.key(0))
    rest = execute(MoverWorld(), START, phases, 14, jax.random.key(0), checkpoint=Checkpoint.of(part))
    np.testing.assert_array_equal(rest.states, whole.states)
    np.testing.assert_array_equal(rest.controls, whole.controls)
    assert [each.step for each in (*part.plans, *rest.plans)] == [each.step for each in whole.plans]


def test_planners_see_what_is_sensed_and_the_truth_goes_on_from_the_truth() -> None:
    planner = _planner()
    shift = np.zeros((2, 13))
    shift[:, 0] = 0.25
    execution = execute(
        MoverWorld(),
        START,
        (Phase(planner, planner, 3, _window),),
        6,
        jax.random.key(0),
        sense=lambda step, state, control: state + shift,
    )
    for plan in execution.plans:
        np.testing.assert_allclose(plan.state, execution.states[plan.step] + shift)
    # The planner believes itself nearer to the target than it is, and so ends up short of it.
    assert execution.states[-1][0, 0] < 0.45 * TARGET[0] + 0.1


def test_truer_dynamics_decide_and_their_rollouts_are_counted() -> None:
    model, truth = Mover(85.0), Mover(100.0)
    missed, verified = [], []
    for optimizers in ((SEARCH,), (SEARCH, Verified(truth, SEARCH, rounds=3, candidates=4))):
        planner = _planner(model, optimizers)
        plan, info = planner.step(planner.init(jax.random.key(1)), START, _window(0))
        missed.append(_missed(planner, plan, truth))
        verified.append(info.verified)
    assert verified == [0, 12]
    assert missed[1] < 0.25 * missed[0]


def test_each_trial_in_truer_dynamics_corrects_the_aim() -> None:
    model, truth = Mover(85.0), Mover(100.0)
    missed: list[float] = []
    search = CEM(samples=24, rounds=8, elites=6)  # enough of it, so that what is left is the model's error
    for rounds in (1, 2):
        planner = _planner(model, (search, Verified(truth, search, rounds, candidates=4)))
        plan, _ = planner.step(planner.init(jax.random.key(1)), START, _window(0))
        missed.append(_missed(planner, plan, truth))
    assert missed[1] < 0.4 * missed[0]


def test_the_last_plan_is_tried_again_in_the_truer_dynamics() -> None:
    model, truth = Mover(20.0), Mover(100.0)
    planner = _planner(model, (SEARCH, Verified(truth, SEARCH, rounds=1, candidates=4)))
    plan, info = planner.step(planner.init(jax.random.key(1)), START, _window(0))
    costs = [float(info.elite_costs[0])]
    for _ in range(4):
        plan, info = planner.step(plan, START, _window(0))
        costs.append(float(info.elite_costs[0]))
    assert all(after <= before + 1e-6 for before, after in pairwise(costs))


def test_where_no_trial_is_finite_the_last_plan_stays() -> None:
    planner = _planner(Mover(60.0), (SEARCH, Verified(Mover(np.nan), SEARCH, rounds=2, candidates=4)))
    plan, info = planner.step(planner.init(jax.random.key(1)), START, _window(0))
    np.testing.assert_array_equal(plan.knots, 0.0)
    assert info.finite < info.candidates


def test_what_is_verified_comes_last() -> None:
    with pytest.raises(InputError, match="optimizers: got Verified before another"):
        _planner(Mover(), (Verified(Mover(50.0), SEARCH), SEARCH))


def test_the_plan_carried_on_is_tried_even_where_it_is_a_late_elite() -> None:
    asked = []

    class Asked(Mover):
        def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
            jax.debug.callback(lambda each: asked.append(np.asarray(each)), controls)
            return super().rollout(state, controls, steps=steps)

    late = CEM(samples=24, rounds=1, elites=12, keep=0.9)
    planner = _planner(Mover(85.0), (late, Verified(Asked(100.0), late, rounds=1, candidates=2)))
    planner.step(planner.init(jax.random.key(1)), START, _window(0))
    assert any((each == 0.0).all(axis=(1, 2, 3)).any() for each in asked)


def test_a_step_by_the_truths_residual_and_the_models_slope_needs_few_trials() -> None:
    model, truth = Mover(85.0), Mover(100.0)
    step = GaussNewton(rounds=1, directions=12, damping=1e-6)
    verified = Verified(truth, step, rounds=10, candidates=1, tolerance=(("miss", 1e-3),))
    planner = _planner(model, (step, verified))
    plan, info = planner.step(planner.init(jax.random.key(1)), START, _window(0))
    assert _missed(planner, plan, truth) <= 1e-3
    assert info.verified <= 6  # the plan carried on, and at most five of its own

    # What is enough needs no more than that plan and the one proposed.
    _, info = planner.step(plan, START, _window(0))
    assert info.verified <= 2


def test_where_the_model_makes_steps_too_long_they_are_halved_until_they_help() -> None:
    model, truth = Mover(30.0), Mover(100.0)
    step = GaussNewton(rounds=1, directions=12, damping=1e-6)
    missed: list[float] = []
    for rounds in (1, 20):  # each cycle of overshooting and halving leaves two thirds of the miss
        planner = _planner(model, (step, Verified(truth, step, rounds, candidates=1)))
        plan, _ = planner.step(planner.init(jax.random.key(1)), START, _window(0))
        missed.append(_missed(planner, plan, truth))
    assert missed[1] < 0.05 * missed[0]


@pytest.mark.parametrize(("name", "value"), [("rounds", 0), ("candidates", 0)])
def test_too_few_trials_are_refused_by_name(name: str, value: int) -> None:
    with pytest.raises(InputError, match=name):
        Verified(Mover(), SEARCH, **{name: value})  # type: ignore[arg-type]


def test_a_length_that_is_never_reached_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="tolerance"):
        Verified(Mover(), SEARCH, tolerance=(("miss", np.nan),))


def _missed(planner: Planner, plan: Plan, truth: Mover) -> float:
    """Return the distance [m] from the target at which the plan ends in the ground truth."""
    controls = planner.controls(plan, np.zeros((HORIZON, 1, 3)))
    end = truth.rollout(jnp.asarray(START)[None], controls[None])[0, -1, 0, :3]
    return float(np.linalg.norm(end - TARGET))

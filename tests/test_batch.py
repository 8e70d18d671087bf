"""Laws of plans that are made side by side: they are the plans that are made alone."""

from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
import pytest
from small_problems import HORIZON, SAMPLING, STATE, TARGET, WINDOW, Broken, Engine, PointMass, Wall, planner_of

from larp_model.errors import InputError
from mpc import CEM, Fallback, GaussNewton, Gradient, MujocoDynamics, Plan, Planner, Verified

pytestmark = pytest.mark.usefixtures("quick_compilation")
COUNT = 5
STATES = STATE + 0.05 * np.arange(COUNT)[:, None, None] * (np.arange(13) < 3)
# The last target is behind the wall.
WINDOWS = [WINDOW._replace(context=TARGET * scale) for scale in (0.2, 0.3, -0.2, 0.4, 3.0)]
STEPS = GaussNewton(rounds=3, directions=16)
OPTIMIZERS: dict[str, Any] = {
    "sampling": SAMPLING,
    "steps": STEPS,
    "gradient": Gradient(steps=4, learning_rate=0.2, elites=4),
    "forward": GaussNewton(rounds=2, directions=12, jacobian="forward"),
    "fallback": (STEPS, Fallback((("miss", 0.01),), (CEM(samples=24, rounds=2, elites=6), STEPS))),
    "verified": (STEPS, Verified(MujocoDynamics(Engine()), STEPS, 2, 3)),
}


def first_plans(planner: Planner) -> list[Plan]:
    return [planner.init(jax.random.key(number)) for number in range(COUNT)]


@pytest.mark.parametrize("dynamics", [PointMass(), Wall(), Broken()])
@pytest.mark.parametrize("optimizers", OPTIMIZERS.values(), ids=OPTIMIZERS)
def test_plans_made_side_by_side_are_those_made_alone(dynamics: Any, optimizers: Any) -> None:
    planner = planner_of(dynamics, optimizers)
    plans = first_plans(planner)
    for now in (0.0, 0.03):  # from a warm start too
        windows = [window._replace(time=now) for window in WINDOWS]
        together = planner.step_batch(plans, STATES, windows)
        for before, (plan, info), state, window in zip(plans, together, STATES, windows, strict=True):
            alone, alone_info = planner.step(before, state, window)
            np.testing.assert_allclose(plan.elites, alone.elites, atol=1e-4)
            np.testing.assert_array_equal(plan.key, alone.key)
            np.testing.assert_allclose(info.cost, alone_info.cost, rtol=1e-3, atol=1e-6)
            np.testing.assert_allclose(info.states, alone_info.states, atol=1e-3)
            assert (info.candidates, info.verified) == (alone_info.candidates, alone_info.verified)
        plans = [plan for plan, _ in together]


def test_plans_made_side_by_side_fill_the_batches_of_one_program_of_rollouts() -> None:
    calls = list[int]()

    @dataclass(frozen=True)
    class Counted(PointMass):
        side_by_side: int = 16

        def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
            jax.debug.callback(lambda: calls.append(len(state)))
            return super().rollout(state, controls, steps)

    planner = planner_of(Counted(), GaussNewton(rounds=3, directions=12))
    plans = first_plans(planner)
    for plan, state, window in zip(plans, STATES, WINDOWS, strict=True):
        planner.step(plan, state, window)
    jax.effects_barrier()
    alone = len(calls)
    planner.step_batch(plans, STATES, WINDOWS)
    jax.effects_barrier()
    assert len(calls) - alone < alone
    assert set(calls) == {16}


def test_a_plan_that_cannot_be_made_ends_the_batch_with_its_error() -> None:
    planner = planner_of(optimizers=STEPS)
    states = STATES.copy()
    states[3] = np.nan
    with pytest.raises(InputError, match=r"state: got numbers that are not finite"):
        planner.step_batch(first_plans(planner), states, WINDOWS)

    @dataclass(frozen=True)
    class Refusing(PointMass):
        def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
            raise InputError("rollout: got none, needs one")

    with pytest.raises(InputError, match=r"rollout: got none"):
        planner_of(Refusing(), STEPS).step_batch(first_plans(planner), STATES, WINDOWS)


def test_batches_that_do_not_fit_together_are_refused_in_one_line_and_empty_ones_are_empty() -> None:
    planner = planner_of(optimizers=STEPS)
    plans = first_plans(planner)
    with pytest.raises(InputError, match=r"^states: got 5 plans, states of shape \(4, 1, 13\), 5 windows, needs P pl"):
        planner.step_batch(plans, STATES[:4], WINDOWS)
    uneven = [window._replace(steps=HORIZON - (number == 2)) for number, window in enumerate(WINDOWS)]
    with pytest.raises(InputError, match=r"^windows: got steps \[11, 12\], needs equally many"):
        planner.step_batch(plans, STATES, uneven)
    assert planner.step_batch([], STATES[:0], []) == []

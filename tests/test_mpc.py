"""Laws of the planner's parts, and one contract that every planner keeps on every small problem."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_problems import (
    DT,
    HORIZON,
    KNOTS,
    REFERENCE,
    SAMPLING,
    STATE,
    TARGET,
    TERMS,
    WINDOW,
    Broken,
    Drift,
    Engine,
    PointMass,
    Wall,
    miss,
    planner_of,
)

from larp_model.errors import InputError
from mpc import (
    CEM,
    MPPI,
    Continued,
    CostTerm,
    Fallback,
    GaussNewton,
    Gradient,
    MujocoDynamics,
    Planner,
    Window,
    absolute,
    evaluate,
    interpolate,
    l2,
    quadratic,
    shift,
)
from mpc.cost import curvatures
from mpc.search import Search, merged

pytestmark = pytest.mark.usefixtures("quick_compilation")
KINDS = ("linear", "cubic")
TIMES = jnp.linspace(0.0, 0.9, KNOTS)
PROBLEMS = {"point_mass": PointMass(), "wall": Wall(), "broken": Broken()}
OPTIMIZERS: dict[str, Any] = {
    "cem": SAMPLING,
    "gradient": Gradient(steps=6, learning_rate=0.2, elites=4),
    "cem_gradient": (CEM(samples=32, rounds=2, elites=6), Gradient(steps=4, elites=3)),
    "gradient_cem": (Gradient(steps=2, elites=3), CEM(samples=24, rounds=2, elites=5, decay=1.0)),
    "mppi": MPPI(samples=32, rounds=4, elites=4),
    "gauss_newton": GaussNewton(rounds=3, directions=6, jacobian="forward"),
    "differences": GaussNewton(rounds=3, directions=6, elites=2),
    "fallback": (
        GaussNewton(rounds=1, directions=3),
        Fallback((("miss", 1e-3),), (CEM(24, 2, 5), GaussNewton(rounds=1))),
    ),
    "small_rounds": (Gradient(steps=2, elites=9), CEM(samples=8, rounds=6, elites=4), GaussNewton(directions=3)),
}


@pytest.mark.parametrize("optimizers", OPTIMIZERS)
@pytest.mark.parametrize("problem", PROBLEMS)
def test_every_planner_keeps_the_contract(problem: str, optimizers: str) -> None:
    planner = planner_of(PROBLEMS[problem], OPTIMIZERS[optimizers])
    first = planner.init(jax.random.key(7))
    plan, info = planner.step(first, STATE, WINDOW)
    same_plan, same_info = planner.step(first, STATE, WINDOW)

    assert plan.knots.shape == (KNOTS, 1, 3) and info.states.shape == (HORIZON, 1, 13)
    assert jax.tree.map(jnp.shape, plan) == jax.tree.map(jnp.shape, first)
    assert np.isfinite(plan.elites).all() and np.isfinite(plan.spread).all()
    assert info.candidates == sum(len(costs) for costs in info.costs)
    assert info.finite == sum(np.isfinite(costs).sum() for costs in info.costs)
    assert info.compile_seconds > 0 and same_info.compile_seconds == 0 and same_info.seconds > 0
    assert (plan.knots == same_plan.knots).all() and info.cost == same_info.cost

    controls = np.asarray(planner.controls(plan, REFERENCE))
    assert controls.shape == REFERENCE.shape and np.abs(controls).max() <= 0.5
    if problem == "broken":
        assert info.finite == 0 and info.cost == np.inf
        assert (plan.elites == first.knots).all()
        return
    zero, _ = evaluate(TERMS, jnp.repeat(STATE[None], HORIZON, axis=0), jnp.asarray(REFERENCE), TARGET)
    assert info.cost < 0.7 * zero
    assert info.cost == pytest.approx(min(costs.min() for costs in info.costs), rel=1e-5)
    assert np.isfinite(info.states).all()
    assert problem == "wall" or info.finite == info.candidates
    assert sum(info.terms.values()) == pytest.approx(info.cost, rel=1e-5)
    expected = planner.dynamics.rollout(jnp.asarray(STATE)[None], jnp.asarray(controls)[None])[0]
    np.testing.assert_allclose(info.states, expected, atol=1e-5)

    onward, later = planner.step(plan, STATE, WINDOW)
    assert later.cost <= info.cost
    assert (onward.key != plan.key).all()


def test_target_weights_and_time_compile_nothing_again() -> None:
    planner = planner_of()
    plan = planner.init(jax.random.key(0), now=1.0)
    assert planner.compile(STATE, WINDOW) > 0
    plan, info = planner.step(plan, STATE, WINDOW._replace(time=1.0, weights={"effort": 0}))
    assert info.terms["effort"] == 0
    single = STATE.astype(np.float32)
    other, info = planner.step(plan, single, Window(1.02, REFERENCE + 0.01, -TARGET, weights={"miss": 2.5}))
    assert info.compile_seconds == 0 and float(other.start) == pytest.approx(1.02)
    assert planner.step(other, STATE, WINDOW._replace(time=7.0))[1].compile_seconds == 0


def test_locked_axis_never_moves() -> None:
    spread = [[0.1, 0.0, 0.1]]
    planner = planner_of(optimizers=OPTIMIZERS["cem_gradient"], spread=spread, interpolation="linear")
    plan, _ = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    assert (plan.elites[..., 1] == 0).all() and (plan.knots[..., 0] != 0).all()


def test_wrong_arguments_are_refused_by_name() -> None:
    planner = planner_of()
    plan = planner.init(jax.random.key(0), now=1.0)
    window = WINDOW._replace(time=1.0)
    other = Planner(PointMass(), TERMS, HORIZON, KNOTS + 1, DT, np.ones((1, 3)), CEM()).init(jax.random.key(0))
    for name, call in (
        ("state", (plan, STATE[0], window)),
        ("state", (plan, STATE * np.nan, window)),
        ("reference", (plan, STATE, window._replace(reference=REFERENCE[1:]))),
        ("window.time", (plan, STATE, window._replace(time=0.5))),
        ("window.time", (plan, STATE, window._replace(time=np.nan))),
        ("plan", (other, STATE, window)),
        ("window.weights", (plan, STATE, window._replace(weights={"mis": 1.0}))),
        ("weight of 'miss'", (plan, STATE, window._replace(weights={"miss": np.nan}))),
    ):
        with pytest.raises(InputError, match=name):
            planner.step(*call)
    wrong_planners: list[dict[str, Any]] = [
        {"spread": [0.1, 0.1, 0.1]},
        {"spread": [[0.1, np.nan, 0.1]]},
        {"lower": 0.6},
        {"upper": np.zeros((2, 3))},
        {"optimizers": ()},
        {"optimizers": Gradient(), "dynamics": MujocoDynamics(Engine())},
        {"optimizers": GaussNewton(jacobian="forward"), "dynamics": MujocoDynamics(Engine())},
        {"interpolation": "quintic"},
        {"reheat": -1.0},
    ]
    for wrong in wrong_planners:
        with pytest.raises(InputError, match=next(iter(wrong))):
            planner_of(**wrong)
    for name, value in {"horizon": 1, "knots": 13, "dt": 0.0, "terms": TERMS[:1] * 2}.items():
        arguments: dict[str, Any] = {"terms": TERMS, "horizon": HORIZON, "knots": KNOTS, "dt": DT}
        with pytest.raises(InputError, match=name):
            Planner(PointMass(), spread=np.ones((1, 3)), optimizers=CEM(), **{**arguments, name: value})
    optimizers: tuple[tuple[Any, str, Any], ...] = (
        (CEM, "samples", 47),
        (CEM, "rounds", 0),
        (CEM, "keep", 1.0),
        (CEM, "decay", np.inf),
        (Gradient, "steps", 0),
        (Gradient, "learning_rate", np.nan),
        (MPPI, "temperature", 0.0),
        (MPPI, "elites", 0),
        (GaussNewton, "directions", 0),
        (GaussNewton, "step", 0.0),
        (GaussNewton, "damping", np.nan),
        (GaussNewton, "jacobian", "reverse"),
    )
    for optimizer, name, number in optimizers:
        with pytest.raises(InputError, match=name):
            optimizer(**{name: number})
    with pytest.raises(InputError, match="weight"):
        CostTerm("miss", miss, weight=-1.0)
    with pytest.raises(InputError, match="width"):
        l2(0.0)
    with pytest.raises(InputError, match="steps"):
        Continued(PointMass(), PointMass(), slice(0, 1), 0)


# Dynamics


def test_engine_is_called_in_its_own_batches_and_loses_its_lost_rows() -> None:
    controls = 0.25 * jax.random.normal(jax.random.key(0), (12, HORIZON, 1, 3))
    state = jnp.broadcast_to(jnp.asarray(STATE), (12, 1, 13))
    states = jax.jit(MujocoDynamics(Engine()).rollout)(state, controls)
    lost = controls[:, 0, 0, 0] > 0.1
    assert lost.any() and np.isnan(states[lost]).all()
    np.testing.assert_allclose(states[~lost], PointMass().rollout(state, controls)[~lost], atol=1e-6)


@pytest.mark.parametrize("steps", [1, 7, HORIZON])
def test_an_engine_computes_only_the_steps_that_are_needed_and_repeats_the_last(steps: int) -> None:
    computed = []

    class Counting(Engine):
        def rollout(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            computed.append(controls.shape[1])
            return super().rollout(states, controls)

    controls = 0.02 * jax.random.normal(jax.random.key(0), (5, HORIZON, 1, 3))
    state = jnp.broadcast_to(jnp.asarray(STATE), (5, 1, 13))
    states = jax.jit(MujocoDynamics(Counting()).rollout)(state, controls, steps=steps)
    all_states = PointMass().rollout(state, controls)
    np.testing.assert_allclose(states[:, :steps], all_states[:, :steps], atol=1e-6)
    np.testing.assert_array_equal(states[:, steps:], jnp.repeat(states[:, steps - 1 : steps], HORIZON - steps, axis=1))
    assert computed == [steps]


def test_the_prediction_goes_on_from_the_last_step_that_is_computed() -> None:
    planner = planner_of(Continued(MujocoDynamics(Engine()), Drift(), slice(0, 1), 5))
    _, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW._replace(steps=4))
    assert len(info.states) == 4 + 5
    np.testing.assert_allclose(np.diff(info.states[3:, 0, :3], axis=0), 1.0, rtol=1e-5)


def test_a_plan_knows_the_errors_to_expect_of_its_computed_steps_where_the_dynamics_do() -> None:
    class Honest(PointMass):
        def expected_errors(self, states: np.ndarray) -> np.ndarray:
            return np.asarray(np.linalg.norm(np.diff(states[..., 0, :3], axis=-2), axis=-1))

    planner = planner_of(Continued(Honest(), Drift(), slice(0, 1), 5), CEM(samples=8, rounds=1, elites=2))
    _, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW._replace(steps=4))
    path = np.concatenate([STATE[:, :3], info.states[:4, 0, :3]])
    np.testing.assert_allclose(info.expected_errors, np.linalg.norm(np.diff(path, axis=0), axis=-1), rtol=1e-5)

    planner = planner_of(PointMass(), CEM(samples=8, rounds=1, elites=2))
    assert planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)[1].expected_errors.shape == (0,)


@pytest.mark.parametrize("steps", [0, HORIZON + 1])
def test_steps_that_are_not_in_the_horizon_are_refused(steps: int) -> None:
    planner = planner_of(MujocoDynamics(Engine()))
    with pytest.raises(InputError, match="steps"):
        planner.step(planner.init(jax.random.key(0)), STATE, WINDOW._replace(steps=steps))


def test_planner_runs_on_an_engine() -> None:
    planner = planner_of(MujocoDynamics(Engine()))
    _, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    assert info.cost < 0.5 * TARGET @ TARGET and 0 < info.finite < info.candidates


def test_continued_follows_its_links_and_freezes_the_others() -> None:
    state = jax.random.normal(jax.random.key(1), (3, 4, 13))
    controls = jax.random.normal(jax.random.key(2), (3, HORIZON, 1, 3))
    both = Continued(PointMass(), Drift(), slice(1, 3), 5)
    states, head = both.rollout(state, controls), PointMass().rollout(state, controls)
    assert states.shape == (3, HORIZON + 5, 4, 13) and not both.differentiable
    np.testing.assert_array_equal(states[:, :HORIZON], head)
    np.testing.assert_array_equal(states[:, -1, ::3], head[:, -1, ::3])
    np.testing.assert_allclose(states[:, -1, 1:3, :3], head[:, -1, 1:3, :3] + 5, rtol=1e-5)


# Splines


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=10)
@given(seed=st.integers(0, 1000))
def test_spline_laws(kind: Any, seed: int) -> None:
    first, second = jax.random.normal(jax.random.key(seed), (2, KNOTS, 2, 3))
    times = jnp.linspace(-0.1, 1.2, 29)
    values = interpolate(first, TIMES, times, kind)
    np.testing.assert_array_equal(interpolate(first, TIMES, TIMES, kind), first)
    np.testing.assert_array_equal(shift(first, TIMES, 0.0, kind), first)
    np.testing.assert_array_equal(values[times >= 0.9], jnp.broadcast_to(first[-1], (7, 2, 3)))
    constant = jnp.broadcast_to(first[0], first.shape)
    still = interpolate(constant, TIMES, times, kind)
    np.testing.assert_allclose(still, jnp.broadcast_to(first[0], still.shape), rtol=1e-5)
    both = interpolate(2 * first - second, TIMES, times, kind)
    np.testing.assert_allclose(both, 2 * values - interpolate(second, TIMES, times, kind), atol=1e-5)
    twice = shift(shift(first, TIMES, 0.3, kind), TIMES, 0.6, kind)
    np.testing.assert_allclose(twice, shift(first, TIMES, 0.9, kind), atol=1e-5)


@given(st.floats(0, 0.3), st.floats(0, 0.3))
def test_shifts_of_a_straight_line_add_up(first: float, second: float) -> None:
    line = TIMES[:, None] * jnp.array([1.0, -2.0])
    twice = shift(shift(line, TIMES, first, "linear"), TIMES, second, "linear")
    once = shift(line, TIMES, first + second, "linear")
    np.testing.assert_allclose(twice[0], once[0], atol=1e-5)  # the later knots come to the held end


# Costs


@pytest.mark.parametrize("norm", [quadratic, l2(0.1), absolute(0.1)])
def test_norms_vanish_at_zero_only_and_are_even(norm: Any) -> None:
    residual = jax.random.normal(jax.random.key(0), (5, 3))
    assert norm(residual).shape == (5,) and (norm(residual) > 0).all()
    np.testing.assert_allclose(norm(residual), norm(-residual))
    np.testing.assert_allclose(norm(jnp.zeros(3)), 0, atol=1e-7)
    np.testing.assert_allclose(jax.grad(norm)(jnp.zeros(3)), 0)


@given(st.floats(0, 10), st.floats(0, 10))
def test_cost_is_linear_in_its_weights(miss: float, effort: float) -> None:
    states = jnp.repeat(jnp.asarray(STATE)[None], HORIZON, axis=0)
    controls = jnp.ones((HORIZON, 1, 3))
    _, unit = evaluate(TERMS, states, controls, TARGET, {"miss": 1.0, "effort": 1.0})
    total, shares = evaluate(TERMS, states, controls, TARGET, {"miss": miss, "effort": effort})
    np.testing.assert_allclose(total, miss * unit["miss"] + effort * unit["effort"], rtol=1e-5)
    np.testing.assert_allclose(shares["miss"], miss * unit["miss"], rtol=1e-5)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_not_finite_costs_infinity(value: float) -> None:
    states = jnp.zeros((HORIZON, 1, 13))
    lost = CostTerm("lost", lambda states, controls, context: jnp.full(1, value), jnp.sum)
    assert evaluate((lost,), states, jnp.zeros((HORIZON, 1, 3)))[0] == np.inf
    states = states.at[3, 0, 7].set(value)
    assert evaluate(TERMS, states, jnp.zeros((HORIZON, 1, 3)), TARGET)[0] == np.inf


def test_residual_of_the_wrong_shape_is_named() -> None:
    flat = CostTerm("flat", lambda states, controls, context: states.sum())
    with pytest.raises(InputError, match="'flat'"):
        evaluate((flat,), jnp.zeros((HORIZON, 1, 13)), jnp.zeros((HORIZON, 1, 3)))


@pytest.mark.parametrize("norm", [quadratic, l2(0.1), absolute(0.1)])
@pytest.mark.parametrize("residual", [[0.3, -0.2, 0.05], [0.4, 0.0, 0.0], [0.0, 0.0, 0.0]])
def test_the_parabola_of_a_term_touches_its_cost_with_its_slope(norm: Any, residual: list[float]) -> None:
    term, at = CostTerm("term", miss, norm, 2.0), jnp.array(residual)
    curvature = curvatures((term,), {"term": at})["term"]
    slope = jax.grad(lambda r: 2.0 * jnp.mean(norm(r)))(at)
    assert curvature.shape == at.shape and (curvature >= 0).all()
    np.testing.assert_allclose(curvature * at, slope, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("norm", "expected"), [(quadratic, 2.0), (l2(0.1), 20.0), (absolute(0.1), 20.0)])
def test_where_a_residual_vanishes_its_parabola_is_as_steep_as_its_norm(norm: Any, expected: float) -> None:
    term = CostTerm("term", miss, norm, 2.0)
    np.testing.assert_allclose(curvatures((term,), {"term": jnp.zeros(3)})["term"], expected, rtol=1e-3)


def test_few_candidates_are_rolled_out_as_many_at_a_time_as_the_dynamics_say() -> None:
    sizes = set()

    @dataclass(frozen=True)
    class Wide(PointMass):
        side_by_side: int = 12

        def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
            sizes.add(len(controls))
            return super().rollout(state, controls, steps)

    for dynamics in (Wide(), Continued(Wide(), Drift(), slice(0, 1), 2)):
        planner = planner_of(dynamics, CEM(samples=15, rounds=1, elites=3))
        planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    assert sizes == {12}


def test_planners_of_one_problem_share_what_is_compiled() -> None:
    first = planner_of(optimizers=CEM(samples=16, rounds=2, elites=3, decay=1.0))
    plan, info = first.step(first.init(jax.random.key(0)), STATE, WINDOW)
    sharing = first.using((MPPI(samples=16, rounds=3, elites=3), GaussNewton(directions=16, elites=3)))
    assert first.using(MPPI(samples=2, rounds=1, elites=3)).compile(STATE, WINDOW) == 0  # few: one size
    _, second = sharing.step(plan, STATE, WINDOW)
    assert info.compile_seconds > 0 and second.compile_seconds == 0
    assert second.cost <= info.cost


def test_the_fan_around_a_plan_is_of_its_problem_always_the_same_and_compiles_nothing() -> None:
    planner = planner_of(optimizers=CEM(samples=16, rounds=1, elites=3))
    plan, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    costs, states = planner.fan(plan, STATE, WINDOW, count=12)
    assert costs.shape == (12,) and states.shape == (12, *info.states.shape)
    assert costs.min() >= 0.0 and np.isfinite(costs).all() and (costs != costs[0]).any()
    same_costs, _ = planner.fan(plan, STATE, WINDOW, count=12)
    np.testing.assert_array_equal(costs, same_costs)
    assert planner.step(plan, STATE, WINDOW)[1].compile_seconds == 0


def test_a_plan_goes_on_in_a_planner_that_keeps_more_elites_or_fewer() -> None:
    few, many = CEM(samples=16, rounds=1, elites=3), CEM(samples=32, rounds=1, elites=9)
    planner = planner_of(optimizers=few)
    plan, before = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    for optimizer in (many, few):
        plan, info = planner.using(optimizer).step(plan, STATE, WINDOW)
        assert len(plan.elites) == optimizer.elites and info.cost <= before.cost


@dataclass(frozen=True)
class Nudge:
    """Anyone's own optimiser: a step along each axis of the first knot."""

    differentiates = False
    terminal = False
    elites = 1

    def improve(self, search: Search, random: Any, problem: Any) -> Search:
        knots = np.repeat(search.elites[:1], 4, axis=0)
        knots[1:, 0, 0] += 0.1 * np.eye(3, dtype=np.float32)
        costs = problem.evaluate(knots).costs
        return merged(search, knots, costs)


def test_the_planner_takes_anyones_own_optimiser() -> None:
    planner = planner_of(optimizers=(Nudge(), CEM(samples=16, rounds=1, elites=4), Nudge()))
    _, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    assert info.candidates == 4 + 16 + 4
    assert info.cost == pytest.approx(min(costs.min() for costs in info.costs), rel=1e-5)

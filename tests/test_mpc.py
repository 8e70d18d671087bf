"""Laws of the planner's parts, and one contract that every planner keeps on every small problem."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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
    Verified,
    Window,
    absolute,
    evaluate,
    interpolate,
    l2,
    quadratic,
    shift,
)
from mpc.cost import curvatures
from mpc.gauss_newton import Linearization
from mpc.search import Evaluations, Search, coloured_noise, distinct, merged

HORIZON, KNOTS, DT = 12, 4, 0.01
KINDS = ("linear", "cubic")
TIMES = jnp.linspace(0.0, 0.9, KNOTS)


# Small problems: one link, one motor whose target is read as a velocity or an acceleration.


@dataclass(frozen=True)
class PointMass:
    """Moves with the velocity 100 u."""

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        return _moving(state, jnp.cumsum(controls[:, :, 0] * 100 * DT, axis=1))


@dataclass(frozen=True)
class Wall:
    """Moves with the acceleration 2000 u and is lost (NaN) once past x = 0.5."""

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        velocity = jnp.cumsum(controls[:, :, 0] * 2000 * DT, axis=1)
        states = _moving(state, jnp.cumsum(velocity * DT, axis=1))
        lost = jnp.cumsum(states[..., 0, 0] > 0.5, axis=1) > 0
        return jnp.where(lost[:, :, None, None], jnp.nan, states)


@dataclass(frozen=True)
class Broken:
    """Always diverges."""

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        return jnp.full((*controls.shape[:2], *state.shape[1:]), jnp.nan)


@dataclass(frozen=True)
class Drift:
    """Every link moves by 1 along each axis in a step; it has no motors."""

    differentiable = False

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        assert controls.shape[2] == 0
        return _moving(state, jnp.cumsum(jnp.ones((*controls.shape[:2], 3)), axis=1))


@dataclass(frozen=True)
class Engine:
    """A point mass outside JAX that loses every row whose first target is above 0.1."""

    batch: int = 5

    def rollout(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert len(states) == len(controls) == self.batch
        result = np.repeat(states[:, None], controls.shape[1], axis=1)
        result[..., :3] += np.cumsum(controls * 100 * DT, axis=1)
        return result, controls[:, 0, 0, 0] <= 0.1


def _moving(state: jax.Array, displacement: jax.Array) -> jax.Array:
    """States (N, H, L, 13): the first state with every link displaced (N, H, 3)."""
    states = jnp.repeat(state[:, None], displacement.shape[1], axis=1)
    return states.at[..., :3].add(displacement[:, :, None])


def _miss(states: jax.Array, controls: jax.Array, target: Any) -> jax.Array:
    """From the target at the end [m]; a lost link is, treacherously, right on it."""
    distance = states[-1, 0, :3] - target
    return jnp.where(jnp.abs(distance) < 1e6, distance, 0.0)


def _effort(states: jax.Array, controls: jax.Array, target: Any) -> jax.Array:
    return controls[:, 0]


TERMS = (CostTerm("miss", _miss), CostTerm("effort", _effort, quadratic, 1e-3))
STATE = np.eye(1, 13, 3)
REFERENCE = np.zeros((HORIZON, 1, 3))
TARGET = np.array([1.0, -0.5, 0.3])
WINDOW = Window(0.0, REFERENCE, TARGET)
PROBLEMS = {"point_mass": PointMass(), "wall": Wall(), "broken": Broken()}
OPTIMIZERS: dict[str, Any] = {
    "cem": CEM(samples=32, rounds=4, elites=6),
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


def _planner(dynamics: Any = None, optimizers: Any = OPTIMIZERS["cem"], **changes: Any) -> Planner:
    arguments = {"spread": np.full((1, 3), 0.1), "lower": -0.5, "upper": 0.5, **changes}
    return Planner(dynamics or PointMass(), TERMS, HORIZON, KNOTS, DT, optimizers=optimizers, **arguments)


@pytest.fixture(autouse=True, scope="module")
def quick_compilation() -> Iterator[None]:
    """These problems take longer to compile than to solve."""
    jax.config.update("jax_disable_most_optimizations", True)
    yield
    jax.config.update("jax_disable_most_optimizations", False)


@pytest.mark.parametrize("optimizers", OPTIMIZERS)
@pytest.mark.parametrize("problem", PROBLEMS)
def test_every_planner_keeps_the_contract(problem: str, optimizers: str) -> None:
    planner = _planner(PROBLEMS[problem], OPTIMIZERS[optimizers])
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
    planner = _planner()
    plan = planner.init(jax.random.key(0), now=1.0)
    assert planner.compile(STATE, WINDOW) > 0
    plan, info = planner.step(plan, STATE, WINDOW._replace(time=1.0, weights={"effort": 0}))
    assert info.terms["effort"] == 0
    single = STATE.astype(np.float32)
    other, info = planner.step(plan, single, Window(1.02, REFERENCE + 0.01, -TARGET, weights={"miss": 2.5}))
    assert info.compile_seconds == 0 and float(other.start) == pytest.approx(1.02)
    assert planner.step(other, STATE, WINDOW._replace(time=7.0))[1].compile_seconds == 0


class Hollows:
    """A problem of one angle x: r = 0.5 + |x| up to x = 1, x - 2 beyond; at 0 no slope tells of the zero at 2."""

    def __init__(self) -> None:
        self.evaluated = 0

    def evaluate(self, knots: np.ndarray) -> Evaluations:
        x = knots[:, :1, 0, 0]
        self.evaluated += len(x)
        residual = np.where(x < 1.0, 0.5 + np.abs(x), x - 2.0)
        return Evaluations(np.sum(residual**2, axis=1), {"miss": residual}, {"miss": np.full_like(residual, 2.0)})


def _at(x: float, elites: int) -> Search:
    knots = np.zeros((elites, 2, 1, 3), np.float32)
    knots[:, :, 0, 0] = x
    spread = np.tile(2.0 * np.eye(1, 3, dtype=np.float32), (2, 1, 1))
    return Search(knots[0], spread, knots, np.full(elites, np.inf, np.float32), spread[0])


def test_a_fallback_leaves_a_hollow_and_takes_one_candidate_where_the_search_has_converged() -> None:
    steps = GaussNewton(rounds=6, directions=4)
    fallback = Fallback((("miss", 0.1),), (CEM(24, 6, 6, decay=1.0), steps))
    stuck, problem = _at(0.0, fallback.elites), Hollows()
    alone = steps.improve(stuck, np.random.default_rng(0), problem)  # type: ignore[arg-type]
    assert problem.evaluate(alone.elites[:1]).costs[0] > 0.24
    freed = fallback.improve(alone, np.random.default_rng(0), problem)  # type: ignore[arg-type]
    assert problem.evaluate(freed.elites[:1]).costs[0] < 1e-4

    problem = Hollows()
    assert fallback.improve(freed, np.random.default_rng(0), problem) is freed  # type: ignore[arg-type]
    assert problem.evaluated == 1


def test_a_fallback_refuses_a_tolerance_of_no_cost_term() -> None:
    steps, problem = GaussNewton(), Hollows()
    fallback = Fallback((("speed", 0.1),), (steps,))
    with pytest.raises(InputError, match="tolerance: got 'speed', needs names of cost terms: miss"):
        fallback.improve(_at(0.0, 1), np.random.default_rng(0), problem)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="tolerance: got nan for 'miss', needs a finite number >= 0"):
        Fallback((("miss", np.nan),), (steps,))
    with pytest.raises(InputError, match="needs some of both"):
        Fallback((), (steps,))
    with pytest.raises(InputError, match="optimizers: got Verified, which must come last of all"):
        Fallback((("miss", 0.1),), (Verified(PointMass(), steps),))


def test_locked_axis_never_moves() -> None:
    spread = [[0.1, 0.0, 0.1]]
    planner = _planner(optimizers=OPTIMIZERS["cem_gradient"], spread=spread, interpolation="linear")
    plan, _ = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    assert (plan.elites[..., 1] == 0).all() and (plan.knots[..., 0] != 0).all()


def test_wrong_arguments_are_refused_by_name() -> None:
    planner = _planner()
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
            _planner(**wrong)
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
        CostTerm("miss", _miss, weight=-1.0)
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
    planner = _planner(Continued(MujocoDynamics(Engine()), Drift(), slice(0, 1), 5))
    _, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW._replace(steps=4))
    assert len(info.states) == 4 + 5
    np.testing.assert_allclose(np.diff(info.states[3:, 0, :3], axis=0), 1.0, rtol=1e-5)


@pytest.mark.parametrize("steps", [0, HORIZON + 1])
def test_steps_that_are_not_in_the_horizon_are_refused(steps: int) -> None:
    planner = _planner(MujocoDynamics(Engine()))
    with pytest.raises(InputError, match="steps"):
        planner.step(planner.init(jax.random.key(0)), STATE, WINDOW._replace(steps=steps))


def test_planner_runs_on_an_engine() -> None:
    planner = _planner(MujocoDynamics(Engine()))
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
    term, at = CostTerm("term", _miss, norm, 2.0), jnp.array(residual)
    curvature = curvatures((term,), {"term": at})["term"]
    slope = jax.grad(lambda r: 2.0 * jnp.mean(norm(r)))(at)
    assert curvature.shape == at.shape and (curvature >= 0).all()
    np.testing.assert_allclose(curvature * at, slope, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize(("norm", "expected"), [(quadratic, 2.0), (l2(0.1), 20.0), (absolute(0.1), 20.0)])
def test_where_a_residual_vanishes_its_parabola_is_as_steep_as_its_norm(norm: Any, expected: float) -> None:
    term = CostTerm("term", _miss, norm, 2.0)
    np.testing.assert_allclose(curvatures((term,), {"term": jnp.zeros(3)})["term"], expected, rtol=1e-3)


# Optimisers


@dataclass
class Ripples:
    """A bowl with ripples around 0.3; nothing below -1 is finite. Optimisers see it as a `Problem`."""

    counted: int = 0
    missing: int = 0

    def cost(self, knots: Any) -> jax.Array:
        cost = jnp.sum((knots - 0.3) ** 2 - 0.1 * jnp.cos(9 * knots), axis=(1, 2, 3))
        return jnp.where((knots < -1).any(axis=(1, 2, 3)), jnp.inf, cost)

    def evaluate(self, knots: np.ndarray) -> Evaluations:
        self.counted += 1
        return Evaluations(np.asarray(self.cost(knots)), {}, {})

    def gradients(self, knots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        slope = jax.grad(
            lambda candidates: jnp.sum(jnp.where(jnp.isfinite(self.cost(candidates)), self.cost(candidates), 0.0))
        )(knots)
        return self.evaluate(knots).costs, np.array(slope)

    def lost(self, count: int) -> None:
        self.missing += count


def _search(elites: int = 6) -> Search:
    spread = np.full((KNOTS, 1, 3), 0.5, np.float32)
    starts = 0.5 * np.asarray(jax.random.normal(jax.random.key(3), (elites, KNOTS, 1, 3)))
    return Search(np.zeros_like(spread), spread, starts, np.full(elites, np.inf), spread[0])


@pytest.mark.parametrize("learning_rate", [1e-3, 0.1, 100.0])
def test_gradient_steps_never_make_a_candidate_worse(learning_rate: float) -> None:
    search, gradient, problem = _search(), Gradient(steps=5, learning_rate=learning_rate, elites=4), Ripples()
    better = gradient.improve(search, np.random.default_rng(0), problem)  # type: ignore[arg-type]
    before = np.asarray(problem.cost(search.elites[:4]))
    assert problem.counted == 6
    np.testing.assert_allclose(problem.cost(better.elites[:4]), better.costs[:4], rtol=1e-6)
    assert (better.costs[:4] <= np.sort(before) + 1e-6).all()
    np.testing.assert_array_equal(better.elites[4:], search.elites[4:])


def test_gradient_that_is_not_finite_stops_only_its_own_candidate_and_is_counted() -> None:
    class Holed(Ripples):
        def gradients(self, knots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            costs, slope = super().gradients(knots)
            slope[0, 0, 0, 0] = np.nan
            return costs, slope

    search, problem = _search(2), Holed()
    better = Gradient(steps=3, elites=2).improve(search, np.random.default_rng(0), problem)  # type: ignore[arg-type]
    assert problem.missing == 3
    assert (better.elites == search.elites[0]).all(axis=(1, 2, 3)).any()
    assert not (better.elites == search.elites[1]).all(axis=(1, 2, 3)).any()


def _line(dynamics: Any = None, terms: Any = TERMS[:1], **settings: Any) -> tuple[Planner, Any, Any]:
    """A planner of one optimiser on residuals that are linear in the knots, its plan and what it found."""
    planner = Planner(
        dynamics or PointMass(), terms, HORIZON, KNOTS, DT, np.full((1, 3), 0.1), GaussNewton(**settings),
    )  # fmt: skip
    return planner, *planner.step(planner.init(jax.random.key(1)), STATE, WINDOW)


@pytest.mark.parametrize("jacobian", ["forward", "differences"])
def test_one_step_of_gauss_newton_solves_what_is_linear(jacobian: str) -> None:
    _, plan, info = _line(rounds=1, directions=12, jacobian=jacobian, damping=1e-3)
    assert info.cost < 1e-5 * TARGET @ TARGET
    assert np.abs(plan.knots).max() < 1.0


@pytest.mark.parametrize("rounds", [1, 3])
def test_rounds_of_differences_ask_for_one_rollout_each_and_one_at_first(rounds: int) -> None:
    class Bowl(Ripples):
        def evaluate(self, knots: np.ndarray) -> Evaluations:
            evaluations, flat = super().evaluate(knots), knots.reshape(len(knots), -1)
            return evaluations._replace(residuals={"miss": flat - 0.3}, curvatures={"miss": np.ones_like(flat)})

    problem, search = Bowl(), _search()
    start = search.elites[0]
    steps = GaussNewton(rounds=rounds, directions=3)
    better = steps.refine(start, search, np.random.default_rng(0), problem)  # type: ignore[arg-type]
    assert problem.counted == 1 + rounds and better.costs[0] < problem.cost(start[None])[0]


def test_few_candidates_are_rolled_out_as_many_at_a_time_as_the_dynamics_say() -> None:
    sizes = set()

    @dataclass(frozen=True)
    class Wide(PointMass):
        side_by_side: int = 12

        def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
            sizes.add(len(controls))
            return super().rollout(state, controls, steps)

    for dynamics in (Wide(), Continued(Wide(), Drift(), slice(0, 1), 2)):
        planner = _planner(dynamics, CEM(samples=15, rounds=1, elites=3))
        planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    assert sizes == {12}


def test_forward_derivatives_and_small_differences_give_the_same_step() -> None:
    plans = [_line(rounds=1, directions=12, jacobian=jacobian)[1] for jacobian in ("forward", "differences")]
    np.testing.assert_allclose(plans[0].knots, plans[1].knots, rtol=1e-3, atol=1e-4)


def test_where_nothing_depends_on_the_controls_the_plan_stays() -> None:
    still = CostTerm("still", lambda states, controls, target: target)
    for jacobian in ("forward", "differences"):
        _, plan, info = _line(terms=(still,), jacobian=jacobian)
        assert not plan.knots.any() and np.isfinite(info.cost)


def test_a_spread_of_zero_leaves_the_plan_where_it_is() -> None:
    planner = _planner(optimizers=GaussNewton(), spread=np.zeros((1, 3)))
    plan, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    assert not plan.knots.any() and np.isfinite(info.cost)


def test_a_residual_of_rank_one_is_met_along_its_one_direction() -> None:
    flat = CostTerm("flat", lambda states, controls, target: (states[-1, 0, 0] - target[0]) * jnp.ones(3))
    _, _, info = _line(terms=(flat,), directions=2)
    assert info.cost < 1e-4


@dataclass(frozen=True)
class Torn:
    """A point mass whose derivative is not a number."""

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        return PointMass().rollout(state, controls + jnp.sqrt(0.0 * controls))


def test_differences_take_nothing_from_candidates_that_are_lost() -> None:
    class Treacherous(Ripples):
        def evaluate(self, knots: np.ndarray) -> Evaluations:
            return Evaluations(np.array([0.5, np.inf], np.float32), {"miss": np.array([[0.9], [0.0]])}, {})

    here = Evaluations(np.array([0.6]), {"miss": np.array([[1.0]])}, {})
    directions, problem = np.ones((2, KNOTS, 1, 3), np.float32), Treacherous()
    linearization = Linearization(_search().mean, here, directions, problem.evaluate(directions))
    derivatives = GaussNewton(directions=2, step=0.1).derivatives(linearization, problem)  # type: ignore[arg-type]
    np.testing.assert_allclose(derivatives["miss"], [[-1.0], [0.0]])


@dataclass(frozen=True)
class Away:
    """A point mass that is lost where its targets stay below 10 mrad."""

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        lost = jnp.max(controls[:, :, 0, 0], axis=1) < 0.01
        return jnp.where(lost[:, None, None, None], jnp.nan, PointMass().rollout(state, controls))


def test_gauss_newton_looks_around_where_nothing_comes_back() -> None:
    planner = _planner(Away(), GaussNewton(rounds=4, directions=8))
    _, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    assert not np.isfinite(info.costs[0]).any()
    assert info.cost < 0.01


def test_mppi_weighs_huge_and_lost_costs_without_losing_its_mean() -> None:
    search, candidates = _search(), np.random.default_rng(0).normal(size=(4, KNOTS, 1, 3)).astype(np.float32)
    costs = np.array([1.0, 1e30, np.inf, np.nan], np.float32)
    np.testing.assert_allclose(MPPI().update(search, candidates, costs).mean, candidates[0], rtol=1e-5)


def test_of_copies_the_first_stays_in_its_place() -> None:
    a, b, c = np.arange(3, dtype=np.float32).reshape(3, 1, 1, 1)
    np.testing.assert_array_equal(distinct(np.stack([a, b, a, c, b, a])), [0, 1, 3])


def test_derivatives_that_are_not_finite_leave_the_plan_and_are_counted() -> None:
    _, plan, info = _line(Torn(), rounds=2, directions=5, jacobian="forward")
    assert not plan.knots.any() and np.isfinite(info.cost)
    assert info.candidates - info.finite >= 5


def test_planners_of_one_problem_share_what_is_compiled() -> None:
    first = _planner(optimizers=CEM(samples=16, rounds=2, elites=3, decay=1.0))
    plan, info = first.step(first.init(jax.random.key(0)), STATE, WINDOW)
    sharing = first.using((MPPI(samples=16, rounds=3, elites=3), GaussNewton(directions=16, elites=3)))
    assert first.using(MPPI(samples=2, rounds=1, elites=3)).compile(STATE, WINDOW) == 0  # few: one size
    _, second = sharing.step(plan, STATE, WINDOW)
    assert info.compile_seconds > 0 and second.compile_seconds == 0
    assert second.cost <= info.cost


def test_the_fan_around_a_plan_is_of_its_problem_always_the_same_and_compiles_nothing() -> None:
    planner = _planner(optimizers=CEM(samples=16, rounds=1, elites=3))
    plan, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    costs, states = planner.fan(plan, STATE, WINDOW, count=12)
    assert costs.shape == (12,) and states.shape == (12, *info.states.shape)
    assert costs.min() >= 0.0 and np.isfinite(costs).all() and (costs != costs[0]).any()
    same_costs, _ = planner.fan(plan, STATE, WINDOW, count=12)
    np.testing.assert_array_equal(costs, same_costs)
    assert planner.step(plan, STATE, WINDOW)[1].compile_seconds == 0


def test_a_plan_goes_on_in_a_planner_that_keeps_more_elites_or_fewer() -> None:
    few, many = CEM(samples=16, rounds=1, elites=3), CEM(samples=32, rounds=1, elites=9)
    planner = _planner(optimizers=few)
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
    planner = _planner(optimizers=(Nudge(), CEM(samples=16, rounds=1, elites=4), Nudge()))
    _, info = planner.step(planner.init(jax.random.key(0)), STATE, WINDOW)
    assert info.candidates == 4 + 16 + 4
    assert info.cost == pytest.approx(min(costs.min() for costs in info.costs), rel=1e-5)


def test_gradient_equals_finite_differences() -> None:
    times = DT * jnp.arange(HORIZON)

    @jax.jit
    def cost(knots: jax.Array) -> jax.Array:
        controls = interpolate(knots, jnp.linspace(0, times[-1], KNOTS), times)
        states = PointMass().rollout(jnp.asarray(STATE)[None], controls[None])[0]
        return evaluate(TERMS, states, controls, TARGET)[0]

    knots, direction = 0.1 * jax.random.normal(jax.random.key(0), (2, KNOTS, 1, 3))
    difference = (cost(knots + 0.1 * direction) - cost(knots - 0.1 * direction)) / 0.2
    np.testing.assert_allclose(jnp.sum(jax.grad(cost)(knots) * direction), difference, rtol=1e-3)
    np.testing.assert_allclose(jax.jvp(cost, (knots,), (direction,))[1], difference, rtol=1e-3)


def test_cem_update_ignores_what_is_not_finite() -> None:
    cem, search = CEM(samples=32, elites=6), _search()
    candidates = cem.sample(search, np.random.default_rng(0), 32, last=True)
    np.testing.assert_array_equal(candidates[: cem.kept], search.elites[: cem.kept])
    np.testing.assert_array_equal(candidates[cem.kept], search.mean)

    lost = np.full(32, np.inf)
    unchanged = cem.update(search, candidates, lost)
    for after, before in zip(unchanged[:3], search[:3], strict=True):
        np.testing.assert_array_equal(after, before)
    lost[9] = 1.0
    single = cem.update(search, candidates, lost)
    np.testing.assert_allclose(single.mean, 0.9 * candidates[9], rtol=1e-5)
    np.testing.assert_array_equal(single.elites[0], candidates[9])
    np.testing.assert_array_equal(single.spread, search.spread)
    alike = cem.update(search._replace(spread=0 * search.spread), 0 * candidates, np.zeros(32))
    np.testing.assert_allclose(alike.spread, cem.floor * search.scale[None].repeat(KNOTS, 0), rtol=1e-6)


def test_cem_population_shrinks_to_twice_the_elites() -> None:
    assert CEM(samples=256, rounds=12, elites=24).sizes == (256,) * 4 + (128,) * 3 + (64,) * 3 + (48,) * 2
    assert CEM(samples=64, rounds=3, decay=1.0).sizes == (64,) * 3


def test_noise_has_unit_variance_and_grows_smoother_with_its_exponent() -> None:
    noise = {e: coloured_noise(np.random.default_rng(0), (4000, 6, 1, 3), e) for e in (0.0, 2.0, 3.5)}
    neighbours = [np.mean(values[:, 1:] * values[:, :-1]) for values in noise.values()]
    np.testing.assert_allclose([values.std(axis=0) for values in noise.values()], 1, atol=0.05)
    assert abs(neighbours[0]) < 0.02 and neighbours[0] + 0.5 < neighbours[1] < neighbours[2]

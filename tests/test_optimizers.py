"""Laws of the optimisers: sampling, gradients, Gauss-Newton and its fallback."""

import math
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from small_problems import DT, HORIZON, KNOTS, STATE, TARGET, TERMS, WINDOW, PointMass, planner_of

from larp_model.errors import InputError
from mpc import (
    CEM,
    MPPI,
    CostTerm,
    Fallback,
    GaussNewton,
    Gradient,
    Planner,
    Verified,
    evaluate,
    interpolate,
)
from mpc.damping import next_damping
from mpc.gauss_newton import Linearization
from mpc.search import Evaluations, Search, coloured_noise, distinct

pytestmark = pytest.mark.usefixtures("quick_compilation")


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
        def summed(candidates: Any) -> jax.Array:
            cost = self.cost(candidates)
            return jnp.sum(jnp.where(jnp.isfinite(cost), cost, 0.0))

        slope = jax.grad(summed)(knots)
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


def test_damping_falls_where_the_quadratic_is_right_and_rises_where_it_is_wrong() -> None:
    assert next_damping(0.3, gain=1.0, predicted_gain=1.0) == pytest.approx(0.1)
    assert next_damping(0.3, gain=0.5, predicted_gain=1.0) == 0.3
    assert next_damping(0.3, gain=0.1, predicted_gain=1.0) == pytest.approx(0.9)
    assert next_damping(0.3, gain=0.0, predicted_gain=1.0) == next_damping(0.3, -5.0, 1.0) == pytest.approx(3.0)
    assert next_damping(0.3, gain=math.nan, predicted_gain=1.0) == pytest.approx(3.0)
    assert next_damping(1e-6, gain=1.0, predicted_gain=1.0) == 1e-6


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


def test_forward_derivatives_and_small_differences_give_the_same_step() -> None:
    plans = [_line(rounds=1, directions=12, jacobian=jacobian)[1] for jacobian in ("forward", "differences")]
    np.testing.assert_allclose(plans[0].knots, plans[1].knots, rtol=1e-3, atol=1e-4)


def test_where_nothing_depends_on_the_controls_the_plan_stays() -> None:
    still = CostTerm("still", lambda states, controls, target: target)
    for jacobian in ("forward", "differences"):
        _, plan, info = _line(terms=(still,), jacobian=jacobian)
        assert not plan.knots.any() and np.isfinite(info.cost)


def test_a_spread_of_zero_leaves_the_plan_where_it_is() -> None:
    planner = planner_of(optimizers=GaussNewton(), spread=np.zeros((1, 3)))
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
    planner = planner_of(Away(), GaussNewton(rounds=4, directions=8))
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
    np.testing.assert_array_equal(candidates[: cem.retained], search.elites[: cem.retained])
    np.testing.assert_array_equal(candidates[cem.retained], search.mean)

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

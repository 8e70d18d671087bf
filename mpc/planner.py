"""The planner: warm start, then CEM and gradient descent one after the other."""

import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from mpc.cem import CEM
from mpc.cost import CostTerm, evaluate, require_weight, residuals
from mpc.dynamics import Dynamics
from mpc.gradient import Gradient
from mpc.search import Score, Search, coloured_noise
from mpc.spline import Interpolation, interpolate, shift
from mpc.verified import Residuals, Verified


class Plan(NamedTuple):
    """What is carried from one planning step to the next."""

    elites: jax.Array  # (M, K, J, 3) rad, knots around the reference, best first
    spread: jax.Array  # (K, J, 3) rad, standard deviation of the search's distribution
    start: jax.Array  # () s, time of the first knot
    key: jax.Array  # of the next step's random numbers

    @property
    def knots(self) -> jax.Array:
        """The plan itself (K, J, 3) [rad]: the best candidate, never an average."""
        return self.elites[0]


Optimizer = CEM | Gradient | Verified


class PlanInfo(NamedTuple):
    """What a step found out; for looking, never carried."""

    cost: float  # of the plan; inf where no candidate was finite
    terms: dict[str, float]  # each term's weighted share of the cost
    states: np.ndarray  # (H', L, 13), what the dynamics predict for the plan
    costs: list[np.ndarray]  # (N,) of all candidates, an array a round or gradient step; inf: not finite
    elite_costs: np.ndarray  # (M,) of plan.elites; inf where not known
    finite: int  # candidates with a finite cost ...
    candidates: int  # ... of so many
    verified: int  # of them in other dynamics than the planner's own
    seconds: float  # from arguments to finished results, compilation left out
    compile_seconds: float  # 0 unless this step had to compile


class Planner:
    """Finds joint targets that minimise a cost over a horizon, through any dynamics.

        minimise over theta   sum_i w_i n_i(r_i(x_1..x_H', u_0..u_H-1, context))
        subject to            x_1..x_H' = dynamics(x_0, u_0..u_H-1)
                              u_h = clip(reference_h + spline(theta, h dt), lower, upper)

    theta are `knots` offsets from the reference, evenly spaced from the first control to the last, so that
    zero is the reference itself. The optimisers run in the order given, each on what the one before it found:
    `CEM` alone, `Gradient` alone (on random starts around the reference), or CEM and then Gradient on its
    elites. `Verified`, if any, comes last: the planner's own dynamics propose, truer ones decide.

    `spread` (J, 3) [rad] is the standard deviation of a first plan's candidates; 0 locks an axis. A later
    plan starts from the last one's spread, widened towards the first by the share `reheat`. `lower` and
    `upper` (J, 3) [rad] bound the targets. `dt` [s] is the control step. `step` is compiled once for each set
    of argument shapes: a moving target, weight or reference compiles nothing again.
    """

    def __init__(
        self,
        dynamics: Dynamics,
        terms: Sequence[CostTerm],
        horizon: int,
        knots: int,
        dt: float,
        spread: ArrayLike,
        optimizers: Optimizer | Sequence[Optimizer],
        lower: ArrayLike = -np.pi,
        upper: ArrayLike = np.pi,
        interpolation: Interpolation = "cubic",
        reheat: float = 0.5,
    ) -> None:
        self.dynamics = dynamics
        self.terms = tuple(terms)
        self.horizon = horizon
        self.optimizers = (optimizers,) if isinstance(optimizers, Optimizer) else tuple(optimizers)
        self.interpolation = interpolation
        self.reheat = reheat
        self.scale = np.asarray(spread, np.float32)
        if self.scale.ndim != 2 or self.scale.shape[1] != 3:
            raise ValueError(f"spread: got shape {self.scale.shape}, needs (J, 3)")
        self.lower = _broadcast("lower", lower, self.scale.shape)
        self.upper = _broadcast("upper", upper, self.scale.shape)
        if not 2 <= knots <= horizon:
            raise ValueError(f"knots: got {knots}, needs 2 to horizon ({horizon})")
        if not (np.isfinite(dt) and dt > 0):
            raise ValueError(f"dt: got {dt}, needs a finite number > 0")
        self._check()
        self.control_times = dt * np.arange(horizon, dtype=np.float32)
        self.knot_times = np.linspace(0, self.control_times[-1], knots, dtype=np.float32)
        self.elites = max(optimizer.elites for optimizer in self.optimizers)
        self._compiled: dict[Any, Any] = {}
        self._controls = jax.jit(self._controls_of)

    def init(self, key: jax.Array, now: float = 0.0) -> Plan:
        """The plan that follows the reference from `now` [s]; its other elites are drawn around it."""
        key, draw = jax.random.split(key)
        spread = jnp.broadcast_to(self.scale, (len(self.knot_times), *self.scale.shape))
        elites = coloured_noise(draw, (self.elites, *spread.shape), CEM.exponent) * spread
        return Plan(elites.at[0].set(0.0), spread, jnp.float32(now), key)

    def step(
        self,
        plan: Plan,
        state: ArrayLike,
        reference: ArrayLike,
        context: Any = None,
        weights: Mapping[str, float] | None = None,
        now: float = 0.0,
        steps: int | None = None,
    ) -> tuple[Plan, PlanInfo]:
        """Plans the window that starts `now` [s] in `state` (L, 13), warm-started by the last plan.

        `reference` (H, J, 3) [rad] are the controls to start from in this window; `context` any pytree of
        arrays that the residuals take; `weights` replace those of the terms they name. `steps` of the H suffice,
        if given: the dynamics compute no more of them under control. The plan never costs more, in the
        dynamics' eyes, than the last plan carried on. If no candidate is finite, that one returns at cost inf.
        """
        arguments = self._arguments(plan, state, reference, context, weights, now, steps)
        compiled, compile_seconds = self._compile(arguments)
        begin = time.perf_counter()
        plan, cost, terms, states, costs, elite_costs = jax.block_until_ready(compiled(*arguments))
        seconds = time.perf_counter() - begin
        costs = [np.asarray(each) for each in costs]
        return plan, PlanInfo(
            cost=float(cost),
            terms={name: float(value) for name, value in terms.items()},
            states=np.delete(
                np.asarray(states), np.s_[self.horizon if steps is None else steps : self.horizon], axis=0
            ),
            costs=costs,
            elite_costs=np.asarray(elite_costs),
            finite=sum(int(np.isfinite(each).sum()) for each in costs),
            candidates=sum(len(each) for each in costs),
            verified=sum(each.rollouts for each in self.optimizers if isinstance(each, Verified)),
            seconds=seconds,
            compile_seconds=compile_seconds,
        )

    def compile(
        self,
        state: ArrayLike,
        reference: ArrayLike,
        context: Any = None,
        weights: Mapping[str, float] | None = None,
        steps: int | None = None,
    ) -> float:
        """Compiles `step` ahead for arguments of these shapes; returns the seconds it took."""
        plan = self.init(jax.random.key(0))
        return self._compile(self._arguments(plan, state, reference, context, weights, 0.0, steps))[1]

    def controls(self, plan: Plan, reference: ArrayLike) -> jax.Array:
        """Joint targets (H, J, 3) [rad] of the plan, given the reference (H, J, 3) it was made around."""
        return self._controls(plan.knots, self._reference(reference))

    def _plan(
        self,
        plan: Plan,
        state: jax.Array,
        reference: jax.Array,
        context: Any,
        weights: dict[str, jax.Array],
        now: jax.Array,
        steps: jax.Array | None,
    ) -> tuple[Plan, jax.Array, dict[str, jax.Array], jax.Array, list[jax.Array], jax.Array]:
        """The whole step, traced once: shift, improve, look at the best."""

        def roll_out(dynamics: Dynamics, knots: jax.Array) -> tuple[jax.Array, jax.Array]:
            controls = jax.vmap(self._controls_of, (0, None))(knots, reference)
            start = jnp.broadcast_to(state, (len(knots), *state.shape))
            return dynamics.rollout(start, controls, *([] if steps is None else [steps])), controls

        def score(corrections: Residuals) -> Score:
            one = partial(evaluate, self.terms, context=context, weights=weights, corrections=corrections)
            return lambda knots: jax.vmap(one)(*roll_out(self.dynamics, knots))[0]

        def trial(dynamics: Dynamics | None, knots: jax.Array) -> tuple[jax.Array, Residuals]:
            states, controls = roll_out(dynamics or self.dynamics, knots)
            costs, _ = jax.vmap(partial(evaluate, self.terms, context=context, weights=weights))(states, controls)
            return costs, jax.vmap(partial(residuals, self.terms, context=context))(states, controls)

        key, draw = jax.random.split(plan.key)
        search = self._shifted(plan, now - plan.start)
        last, costs = search.elites[0], []
        for optimizer in self.optimizers:
            draw, phase = jax.random.split(draw)
            if isinstance(optimizer, Verified):
                search, tried = optimizer.improve(search, last, phase, trial, score)
            else:
                search, tried = optimizer.improve(search, phase, score({}))
            costs.extend(tried)
        elites = jnp.where(jnp.isfinite(search.costs)[:, None, None, None], search.elites, search.elites[0])
        states, controls = jax.tree.map(lambda leaf: leaf[0], roll_out(self.dynamics, elites[:1]))
        cost, shares = evaluate(self.terms, states, controls, context, weights)
        return Plan(elites, search.spread, now, key), cost, shares, states, costs, search.costs

    def _shifted(self, plan: Plan, elapsed: jax.Array) -> Search:
        """The last plan's search as it looks `elapsed` [s] later, its spread widened, its costs unknown."""

        times = jnp.asarray(self.knot_times)
        elites = jax.vmap(lambda knots: shift(knots, times, elapsed, self.interpolation))(plan.elites)
        spread = shift(plan.spread, times, elapsed, "linear")  # a cubic could swing below zero
        spread = spread + self.reheat * jnp.maximum(self.scale - spread, 0.0)
        return Search(elites[0], spread, elites, jnp.full(self.elites, jnp.inf), jnp.asarray(self.scale))

    def _controls_of(self, knots: jax.Array, reference: jax.Array) -> jax.Array:
        times = jnp.asarray(self.knot_times), jnp.asarray(self.control_times)
        return jnp.clip(reference + interpolate(knots, *times, self.interpolation), self.lower, self.upper)

    def _compile(self, arguments: tuple) -> tuple[Any, float]:
        """The compiled step for arguments of these shapes, and the seconds spent on it just now."""
        leaves, structure = jax.tree.flatten(arguments)
        signature = structure, tuple((leaf.shape, leaf.dtype) for leaf in leaves)
        begin = time.perf_counter()
        if signature in self._compiled:
            return self._compiled[signature], 0.0
        self._compiled[signature] = jax.jit(self._plan).lower(*arguments).compile()
        return self._compiled[signature], time.perf_counter() - begin

    def _arguments(
        self,
        plan: Plan,
        state: ArrayLike,
        reference: ArrayLike,
        context: Any,
        weights: Mapping[str, float] | None,
        now: float,
        steps: int | None,
    ) -> tuple:
        """The public arguments, checked, as JAX arrays of fixed shape and type."""
        state = np.asarray(state, np.float32)
        if state.ndim != 2 or state.shape[1] != 13 or not np.isfinite(state).all():
            raise ValueError(f"state: got shape {state.shape}, needs (L, 13), all finite")
        elites = (self.elites, len(self.knot_times), *self.scale.shape)
        if plan.elites.shape != elites:
            raise ValueError(f"plan: got elites {plan.elites.shape}, needs {elites}; it is another planner's")
        start = float(plan.start)  # of a clock in 32 bits, hence the tolerance
        if not start - 1e-4 * max(1.0, abs(start)) <= now < np.inf:
            raise ValueError(f"now: got {now} s, needs a time from plan.start, {start} s, on")
        if steps is not None and not 1 <= steps <= self.horizon:
            raise ValueError(f"steps: got {steps}, needs 1 to horizon ({self.horizon})")
        current = {term.name: float(term.weight) for term in self.terms}
        for name, weight in (weights or {}).items():
            if name not in current:
                raise ValueError(f"weights: got {name!r}, needs names of cost terms: {', '.join(current)}")
            require_weight(name, weight)
            current[name] = float(weight)
        arrays = state, self._reference(reference), context, current, float(now), steps
        return plan, *jax.tree.map(_array, arrays)

    def _reference(self, reference: ArrayLike) -> jax.Array:
        shape = (self.horizon, *self.scale.shape)
        if np.shape(reference) != shape:
            raise ValueError(f"reference: got shape {np.shape(reference)}, needs {shape}")
        return _array(reference)

    def _check(self) -> None:
        """Refuses what would fail later, or silently, by the name of the argument."""
        if not (np.isfinite(self.scale).all() and (self.scale >= 0).all()):
            raise ValueError(f"spread: got {self.scale.tolist()}, needs finite numbers >= 0")
        if not (self.lower <= self.upper).all():
            raise ValueError("lower: got values above upper, needs lower <= upper")
        if self.interpolation not in ("linear", "cubic"):
            raise ValueError(f"interpolation: got {self.interpolation!r}, needs 'linear' or 'cubic'")
        if not 0 <= self.reheat <= 1:
            raise ValueError(f"reheat: got {self.reheat}, needs a share in [0, 1]")
        names = [term.name for term in self.terms]
        if not names or len(set(names)) < len(names):
            raise ValueError(f"terms: got {names}, needs at least one, each with its own name")
        if not self.optimizers:
            raise ValueError("optimizers: got none, needs CEM, Gradient or both")
        if any(isinstance(each, Verified) for each in self.optimizers[:-1]):
            raise ValueError("optimizers: got Verified before another, needs it last")
        searching = [each.optimizer if isinstance(each, Verified) else each for each in self.optimizers]
        least = min((min(each.sizes) for each in searching if isinstance(each, CEM)), default=None)
        for each in searching:
            if isinstance(each, Gradient) and not self.dynamics.differentiable:
                model = type(self.dynamics).__name__
                raise ValueError(f"optimizers: got Gradient, needs differentiable dynamics, not {model}")
            if least is not None and each.elites > least:
                raise ValueError(f"optimizers: got {each.elites} elites, CEM's smallest round has {least}")


def _array(value: ArrayLike) -> jax.Array:
    """A JAX array of 32 bits whose type does not depend on whether a Python or a NumPy number came in."""
    array = np.asarray(value)
    return jnp.asarray(array, jnp.float32 if jnp.issubdtype(array.dtype, jnp.floating) else None)


def _broadcast(name: str, value: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(value, np.float32)
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise ValueError(f"{name}: got shape {array.shape}, needs {shape}") from None

"""The planner: a warm start, then its optimisers one after the other."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from larp_model.errors import InputError
from larp_model.runtime import one_blas_thread, prepare_compiler
from mpc.batch import SharedRollouts
from mpc.cost import CostTerm, require_weight
from mpc.dynamics import Dynamics, Linearizable, advanced, expected_errors, linearized, of_steps, program_of
from mpc.feedback import Feedback, FeedbackInfo, LinearQuadratic, finite_part, riccati
from mpc.problem import Equations, Inputs, PlannerProblem, Programs, Rollouts, filled_up
from mpc.search import COLOUR, Optimizer, Search, coloured_noise
from mpc.spline import Interpolation, shift


class Window(NamedTuple):
    """The H steps ahead that a plan is made for, as a task describes them.

    time: at which they begin [s]. reference: (H, J, 3) [rad], joint targets that the search starts from. context: any
    pytree of arrays, for the residuals. steps: the dynamics compute only so many of the H; all by default. weights: of
    cost terms by name, instead of their own.
    """

    time: float
    reference: np.ndarray | jax.Array
    context: Any = None
    steps: int | None = None
    weights: Mapping[str, float] | None = None


class Plan(NamedTuple):
    """The state of the planner from one planning step to the next."""

    elites: np.ndarray  # (M, K, J, 3) rad, knots around the reference, best first
    spread: np.ndarray  # (K, J, 3) rad, standard deviation of the search's distribution
    start: np.float32  # s, time of the first knot
    key: np.ndarray  # (W,) words of 32 bits, of the next step's random numbers

    @property
    def knots(self) -> np.ndarray:
        """Return the knots (K, J, 3) [rad] of the best candidate, never an average."""
        best: np.ndarray = self.elites[0]
        return best


class PlanInfo(NamedTuple):
    """Figures of one planning step; for display, never part of the next one."""

    cost: float  # of the plan; inf where no candidate was finite
    terms: dict[str, float]  # each term's weighted share of the cost
    states: np.ndarray  # (H', L, 13), what the dynamics predict for the plan
    costs: list[np.ndarray]  # (N,) of all candidates, an array a round; inf: not finite, or without a finite gradient
    elite_costs: np.ndarray  # (M,) of plan.elites; inf where not evaluated
    finite: int  # candidates with a finite cost ...
    candidates: int  # ... of so many
    verified: int  # of them in other dynamics than the planner's own
    expected_errors: np.ndarray  # (H,) m, of each step by the dynamics alone, mean over links; (0,) if not known
    seconds: float  # from arguments to finished results, compilation left out
    compile_seconds: float  # 0 unless this step had to compile


class Planner:
    """A planner of joint targets that minimise a cost over a horizon, through any dynamics.

        minimise over theta   sum_i w_i n_i(r_i(x_1..x_H', u_0..u_H-1, context))
        subject to            x_1..x_H' = dynamics(x_0, u_0..u_H-1)
                              u_h = clip(reference_h + spline(theta, h dt), lower, upper)

    theta are `knots` offsets from the reference, evenly spaced from the first control to the last, so that
    zero is the reference itself. The optimisers run in their order, each on the result of the one before it; the last
    one ranks the plan. The planner knows none of them: see `search.Optimizer`.

    `spread` (J, 3) [rad] is the standard deviation of a first plan's candidates; 0 locks an axis. A later
    plan starts from the last one's spread, widened towards the first by the share `reheat`. `lower` and
    `upper` (J, 3) [rad] bound the targets. `dt` [s] is the control step. What the model does is compiled once for each
    set of argument shapes and each number of candidates, and shared with the planners that `using` makes: a moving
    target, weight or reference compiles nothing again, and other processes compile nothing again either: see
    `runtime.prepare_compiler`.
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
        prepare_compiler()
        self.dynamics = dynamics
        self.terms = tuple(terms)
        self.horizon = horizon
        self.interpolation = interpolation
        self.reheat = reheat
        self.scale = np.asarray(spread, np.float32)
        if self.scale.ndim != 2 or self.scale.shape[1] != 3:
            raise InputError(f"spread: got shape {self.scale.shape}, needs (J, 3)")
        self.lower = _broadcast("lower", lower, self.scale.shape)
        self.upper = _broadcast("upper", upper, self.scale.shape)
        if not 2 <= knots <= horizon:
            raise InputError(f"knots: got {knots}, needs 2 to horizon ({horizon})")
        if not (np.isfinite(dt) and dt > 0):
            raise InputError(f"dt: got {dt}, needs a finite number > 0")
        self._check()
        self.control_times = dt * np.arange(horizon, dtype=np.float32)
        self.knot_times = np.linspace(0, self.control_times[-1], knots, dtype=np.float32)
        self._programs = Programs()
        self._equations = Equations(
            dynamics, self.terms, self.knot_times, self.control_times, interpolation, self.lower, self.upper
        )
        self._use(optimizers)

    def using(self, optimizers: Optimizer | Sequence[Optimizer]) -> Planner:
        """Return a planner of the same problem with other optimisers, which shares compiled programs."""
        other = copy.copy(self)
        other._use(optimizers)
        return other

    def _use(self, optimizers: Optimizer | Sequence[Optimizer]) -> None:
        self.optimizers: tuple[Optimizer, ...] = (
            tuple(optimizers) if isinstance(optimizers, Sequence) else (optimizers,)
        )
        if not self.optimizers:
            raise InputError("optimizers: got none, needs at least one")
        for optimizer in self.optimizers:
            if optimizer.differentiates and not self.dynamics.differentiable:
                names = type(optimizer).__name__, type(self.dynamics).__name__
                raise InputError("optimizers: got {}, needs differentiable dynamics, not {}".format(*names))
        for optimizer in self.optimizers[:-1]:
            if optimizer.terminal:
                raise InputError(f"optimizers: got {type(optimizer).__name__} before another, needs it last")
        self.elites = max(optimizer.elites for optimizer in self.optimizers)

    def init(self, key: jax.Array, now: float = 0.0) -> Plan:
        """Return the plan that follows the reference from `now` [s]; its other elites are drawn around it."""
        random = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        spread = np.broadcast_to(self.scale, (len(self.knot_times), *self.scale.shape))
        elites = coloured_noise(random, (self.elites, *spread.shape), COLOUR) * spread
        elites[0] = 0.0
        return Plan(elites, spread, np.float32(now), _entropy(random))

    def step(self, plan: Plan, state: ArrayLike, window: Window) -> tuple[Plan, PlanInfo]:
        """Plan a window that begins in `state` (L, 13), warm-started by the last plan.

        By the dynamics, the plan never costs more than the last plan shifted to the window's time. If no candidate is
        finite, that one is returned, at cost inf.
        """
        return self._step(plan, state, window, filled_up)

    def step_batch(
        self, plans: Sequence[Plan], states: ArrayLike, windows: Sequence[Window]
    ) -> list[tuple[Plan, PlanInfo]]:
        """Plan P windows that begin in states (P, L, 13), as `step` does each: results differ by rounding only.

        Their rollouts share batches, which fills a GPU; on a CPU they take as long as one by one. The windows compute
        equally many steps. The `seconds` of each plan are those of all.
        """
        states = np.asarray(states, np.float32)
        if not (states.ndim == 3 and len(plans) == len(states) == len(windows)):
            counts = f"{len(plans)} plans, states of shape {states.shape}, {len(windows)} windows"
            raise InputError(f"states: got {counts}, needs P plans, (P, L, 13), P windows")
        if len(steps := {window.steps for window in windows}) > 1:
            raise InputError(f"windows: got steps {sorted(steps, key=str)}, needs equally many in all windows")
        together = SharedRollouts()
        jobs = [
            partial(self._step, *arguments, together.roll_out) for arguments in zip(plans, states, windows, strict=True)
        ]
        with one_blas_thread():  # once for all: its state is the process's
            return together.make(jobs)

    def _step(self, plan: Plan, state: ArrayLike, window: Window, rollouts: Rollouts) -> tuple[Plan, PlanInfo]:
        self._check_warm_start(plan, window.time)
        inputs = self._inputs(state, window)
        begin, compiled_before = time.perf_counter(), self._programs.seconds
        random = np.random.default_rng(plan.key)
        search = self._warm_start(plan, window.time - float(plan.start), random)
        problem = PlannerProblem(self._equations, self._programs, inputs, search.elites[0], rollouts=rollouts)
        with one_blas_thread():
            for optimizer in self.optimizers:
                search = optimizer.improve(search, random, problem)
                if len(search.elites) != self.elites:
                    name = type(optimizer).__name__
                    raise InputError(f"optimizers: got {len(search.elites)} elites from {name}, needs {self.elites}")
        evaluated = np.isfinite(search.costs)[:, None, None, None]
        elites = np.where(evaluated, search.elites, search.elites[0])
        new_plan = Plan(elites, search.spread, np.float32(window.time), _entropy(random))
        states = problem.states_of(new_plan.knots)
        cost, terms = problem.plan_cost(new_plan.knots)
        compile_seconds = self._programs.seconds - compiled_before
        record, steps = problem.record, window.steps or self.horizon
        return new_plan, PlanInfo(
            cost=cost,
            terms=terms,
            states=np.delete(states, np.s_[steps : self.horizon], axis=0),
            costs=record.costs,
            elite_costs=search.costs,
            finite=sum(int(np.isfinite(costs).sum()) for costs in record.costs),
            candidates=sum(len(costs) for costs in record.costs),
            verified=record.verified,
            expected_errors=expected_errors(self.dynamics, np.concatenate([inputs.state[None], states[:steps]])),
            seconds=time.perf_counter() - begin - compile_seconds,
            compile_seconds=compile_seconds,
        )

    def compile(self, state: ArrayLike, window: Window) -> float:
        """Compile the programs of a first plan with arguments of these shapes, by making it; return the seconds."""
        _, info = self.step(self.init(jax.random.key(0), window.time), state, window)
        return info.compile_seconds

    @property
    def compile_seconds(self) -> float:
        """Return the seconds that compiling took so far, of all planners that share its programs."""
        return self._programs.seconds

    def fan(self, plan: Plan, state: ArrayLike, window: Window, count: int = 16) -> tuple[np.ndarray, np.ndarray]:
        """Return costs (N,) and states (N, H', L, 13) of candidates around a plan made in `state`, for display.

        Candidates are drawn with half the plan's spread, the same ones each time, and rolled out by programs of `step`.
        """
        noise = coloured_noise(np.random.default_rng(0), (count, *plan.knots.shape), COLOUR)
        inputs = self._inputs(state, window)
        problem = PlannerProblem(self._equations, self._programs, inputs, plan.knots)
        return problem.for_display(plan.knots + 0.5 * plan.spread * noise)

    def controls(self, plan: Plan, reference: ArrayLike) -> jax.Array:
        """Return joint targets (H, J, 3) [rad] of the plan, given the reference (H, J, 3) it was made around."""
        controls: jax.Array = _controls(self._equations, plan.knots, self._reference(reference))
        return controls

    def advance(self, state: ArrayLike, control: ArrayLike) -> np.ndarray:
        """Return the state (L, 13) after a step under joint targets (J, 3) [rad], from a state (L, 13) on."""
        function, arguments = program_of(advanced, self.dynamics)
        arrays = self._state(state)[None], np.asarray(control, np.float32)[None]
        following: np.ndarray = np.asarray(self._programs("advance", function, *arguments, *arrays))[0]
        return following

    def predicted(self, info: PlanInfo, state: ArrayLike, window: Window) -> np.ndarray:
        """Return the states (S + 1, L, 13) of a plan made in `state` for a window, from there on, under control."""
        return np.concatenate([np.asarray(state)[None], info.states[: window.steps or self.horizon]])

    def feedback(self, plan: Plan, info: PlanInfo, state: ArrayLike, window: Window) -> tuple[Feedback, FeedbackInfo]:
        """Return feedback around a plan that `step` made in `state` (L, 13) for a window.

        There is none from where the dynamics diverge, or where their derivatives are not finite.
        """
        steps = of_steps(self.dynamics)
        if not isinstance(steps, Linearizable):
            raise InputError(f"dynamics: got {type(self.dynamics).__name__}, needs `linearize` for feedback")
        inputs, states = self._inputs(state, window), self.predicted(info, state, window)
        begin, compiled_before = time.perf_counter(), self._programs.seconds
        rest = np.repeat(states[-1:], self.horizon + 1 - len(states), axis=0)
        all_states = np.concatenate([states, rest]).astype(np.float32)
        controls = np.asarray(self.controls(plan, window.reference))
        # Two programs, for the first compiles longest, and serves whatever the costs are.
        linear, dynamics = program_of(linearized, self.dynamics)
        costs, _ = program_of(self._equations.quadratic_costs, self.dynamics)
        count = np.int32(window.steps or self.horizon)
        problem = LinearQuadratic(
            *map(np.asarray, self._programs("linear", linear, *dynamics, all_states[:-1], controls, count)),
            *map(np.asarray, self._programs("quadratic costs", costs, *dynamics, inputs, all_states[1:], controls)),
        )
        states = finite_part(states)
        if all(np.isfinite(array).all() for array in problem):
            with one_blas_thread():
                gains = riccati(problem)
        else:
            gains, states = np.zeros((len(problem.by_control), 0, 0)), states[:1]
        feedback = Feedback(
            steps, controls, states, gains, problem.sum_by_state, problem.sum_by_control, self.lower, self.upper
        )
        compile_seconds = self._programs.seconds - compiled_before
        seconds = time.perf_counter() - begin - compile_seconds
        return feedback, FeedbackInfo(float(np.abs(gains).max(initial=0.0)), seconds, compile_seconds)

    def _shift(self, elites: jax.Array, spread: jax.Array, elapsed: jax.Array) -> tuple[jax.Array, jax.Array]:
        times = jnp.asarray(self.knot_times)
        elites = jax.vmap(lambda knots: shift(knots, times, elapsed, self.interpolation))(elites)
        return elites, shift(spread, times, elapsed, "linear")  # a cubic could swing below zero

    def _warm_start(self, plan: Plan, elapsed: float, random: np.random.Generator) -> Search:
        """Return the last plan's search shifted by `elapsed` [s], its spread widened, its costs unknown.

        Where the last plan has fewer elites, the others are drawn around its best.
        """
        elites = plan.elites[: self.elites]
        missing = self.elites - len(elites)
        if missing:
            samples = plan.spread * coloured_noise(random, (missing, *plan.knots.shape), COLOUR)
            elites = np.concatenate([elites, plan.knots + samples])
        elites, spread = map(np.asarray, self._programs("shift", self._shift, elites, plan.spread, np.float32(elapsed)))
        spread = spread + self.reheat * np.maximum(self.scale - spread, 0.0)
        return Search(elites[0], spread, elites, np.full(self.elites, np.inf, np.float32), self.scale)

    def _check_warm_start(self, plan: Plan, now: float) -> None:
        """Raise InputError for a plan of another problem, or of a later time than `now` [s]."""
        knots = (len(self.knot_times), *self.scale.shape)
        if plan.knots.shape != knots:
            raise InputError(f"plan: got knots {plan.knots.shape}, needs {knots}; it is another problem's")
        start = float(plan.start)  # of a clock in 32 bits, hence the tolerance
        if not start - 1e-4 * max(1.0, abs(start)) <= now < np.inf:
            raise InputError(f"window.time: got {now} s, needs a time from plan.start, {start} s, on")

    def _inputs(self, state: ArrayLike, window: Window) -> Inputs:
        """Return the public arguments, checked, as arrays of fixed shape and type."""
        if window.steps is not None and not 1 <= window.steps <= self.horizon:
            raise InputError(f"window.steps: got {window.steps}, needs 1 to horizon ({self.horizon})")
        weights = {term.name: float(term.weight) for term in self.terms}
        for name, weight in (window.weights or {}).items():
            if name not in weights:
                raise InputError(f"window.weights: got {name!r}, needs names of cost terms: {', '.join(weights)}")
            require_weight(name, weight)
            weights[name] = float(weight)
        arrays = jax.tree.map(_array, (window.context, weights, window.steps))
        return Inputs(self._state(state), self._reference(window.reference), *arrays)

    def _state(self, state: ArrayLike) -> np.ndarray:
        state = np.asarray(state, np.float32)
        if state.ndim != 2 or state.shape[1] != 13:
            raise InputError(f"state: got shape {state.shape}, needs (L, 13)")
        if not np.isfinite(state).all():
            raise InputError("state: got numbers that are not finite, needs all of them finite")
        return state

    def _reference(self, reference: ArrayLike) -> ArrayLike:
        shape = (self.horizon, *self.scale.shape)
        if np.shape(reference) != shape:
            raise InputError(f"reference: got shape {np.shape(reference)}, needs {shape}")
        return reference if isinstance(reference, jax.core.Tracer) else _array(reference)

    def _check(self) -> None:
        """Raise InputError, with the argument's name, for what would fail later or silently."""
        if not (np.isfinite(self.scale).all() and (self.scale >= 0).all()):
            raise InputError(f"spread: got {self.scale.tolist()}, needs finite numbers >= 0")
        if not (self.lower <= self.upper).all():
            raise InputError("lower: got values above upper, needs lower <= upper")
        if self.interpolation not in ("linear", "cubic"):
            raise InputError(f"interpolation: got {self.interpolation!r}, needs 'linear' or 'cubic'")
        if not 0 <= self.reheat <= 1:
            raise InputError(f"reheat: got {self.reheat}, needs a share in [0, 1]")
        names = [term.name for term in self.terms]
        if not names or len(set(names)) < len(names):
            raise InputError(f"terms: got {names}, needs at least one, each with its own name")


_controls = jax.jit(Equations.controls, static_argnums=0)


def _entropy(random: np.random.Generator) -> np.ndarray:
    return random.integers(2**32, size=4, dtype=np.uint32)


def _array(value: ArrayLike) -> np.ndarray:
    """Return an array of 32 bits, whether a Python or a NumPy number came in."""
    array = np.asarray(value)
    if jnp.issubdtype(array.dtype, jnp.floating):
        return array.astype(np.float32)
    return array.astype(np.int32) if jnp.issubdtype(array.dtype, jnp.integer) else array


def _broadcast(name: str, value: ArrayLike, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(value, np.float32)
    try:
        return np.broadcast_to(array, shape)
    except ValueError:
        raise InputError(f"{name}: got shape {array.shape}, needs {shape}") from None

"""The planner's problem: its equations, compiled, and the interface that optimisers of one plan see."""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from larp_model.runtime import no_garbage_collection
from mpc.cost import CostTerm, curvatures, evaluate, residuals, weighted_cost
from mpc.dynamics import Continued, Coordinated, Dynamics, continued, of_steps, program_of, side_by_side
from mpc.feedback import quadratic_costs
from mpc.search import Evaluations, Residuals
from mpc.spline import Interpolation, interpolate

# Every size is compiled apart, a kick's for 8 s and more. So on a CPU candidates are rolled out
# `side_by_side(dynamics)` at a time where there are so few of them.
FEW = 32


class Inputs(NamedTuple):
    """Inputs of one plan: NumPy arrays, and JAX arrays inside compiled programs."""

    state: Any  # (L, 13), where it starts
    reference: Any  # (H, J, 3) rad
    context: Any
    weights: dict[str, Any]
    steps: Any | None  # (), so many of the H are computed


class Rows(NamedTuple):
    """Candidates to roll out, each from its own start and around its own reference."""

    starts: Any  # (N, L, 13)
    references: Any  # (N, H, J, 3) rad
    knots: Any  # (N, K, J, 3) rad


def rows_of(inputs: Inputs, knots: Any) -> Rows:
    """Return the rows of knots (N, K, J, 3) of one plan, as arrays of NumPy, or of JAX where those are."""
    of = np if isinstance(knots, np.ndarray) else jnp
    starts, references = (of.broadcast_to(leaf, (len(knots), *leaf.shape)) for leaf in (inputs.state, inputs.reference))
    return Rows(starts, references, knots)


@dataclass(frozen=True, eq=False)
class Equations:
    """The planner's equations as pure functions of arrays; see `planner.Planner`, which states them.

    knot_times (K,), control_times (H,) [s]. lower, upper (J, 3) [rad].
    """

    dynamics: Dynamics
    terms: tuple[CostTerm, ...]
    knot_times: np.ndarray
    control_times: np.ndarray
    interpolation: Interpolation
    lower: np.ndarray
    upper: np.ndarray

    def controls(self, knots: jax.Array, reference: jax.Array) -> jax.Array:
        """Return joint targets (H, J, 3) [rad] of knots (K, J, 3) around a reference (H, J, 3)."""
        times = jnp.asarray(self.knot_times), jnp.asarray(self.control_times)
        return jnp.clip(reference + interpolate(knots, *times, self.interpolation), self.lower, self.upper)

    def roll_out(self, dynamics: Dynamics, rows: Rows, steps: jax.Array | None) -> tuple[jax.Array, jax.Array]:
        """Return states (N, H', L, 13) and controls (N, H, J, 3) of N rows; steps: see `Inputs`."""
        controls = jax.vmap(self.controls)(rows.knots, rows.references)
        return dynamics.rollout(rows.starts, controls, **({} if steps is None else {"steps": steps})), controls

    def weigh(
        self, inputs: Inputs, states: jax.Array, controls: jax.Array, corrections: Any
    ) -> tuple[jax.Array, Any, Any]:
        """Return costs, residuals plus corrections, and their curvatures, of N candidates."""

        def weigh_one(states: jax.Array, controls: jax.Array) -> tuple[jax.Array, Any, Any]:
            residual_values = residuals(self.terms, states, controls, inputs.context, corrections)
            cost, _ = weighted_cost(self.terms, residual_values, states, inputs.weights)
            return cost, residual_values, curvatures(self.terms, residual_values, inputs.weights)

        return jax.vmap(weigh_one)(states, controls)

    def gradients(
        self, dynamics: Dynamics, inputs: Inputs, knots: jax.Array, corrections: Any
    ) -> tuple[jax.Array, Any, jax.Array]:
        """Return gradients (N, K, J, 3) of the costs of knots (N, K, J, 3), the result of `weigh`, and the states."""

        def total_cost(knots: jax.Array) -> tuple[jax.Array, Any]:
            states, controls = self.roll_out(dynamics, rows_of(inputs, knots), inputs.steps)
            results = self.weigh(inputs, states, controls, corrections)
            return jnp.sum(results[0]), (results, states)

        gradient, (results, states) = jax.grad(total_cost, has_aux=True)(knots)
        return gradient, results, states

    def tangents(self, dynamics: Dynamics, inputs: Inputs, knots: jax.Array, directions: jax.Array) -> Any:
        """Return derivatives (D, ...) of the residuals at knots (K, J, 3) along directions (D, K, J, 3)."""

        def residuals_of(knots: jax.Array) -> Any:
            rollout = self.roll_out(dynamics, rows_of(inputs, knots[None]), inputs.steps)
            states, controls = (leaf[0] for leaf in rollout)
            return residuals(self.terms, states, controls, inputs.context)

        return jax.vmap(lambda direction: jax.jvp(residuals_of, (knots,), (direction,))[1])(directions)

    def quadratic_costs(
        self, dynamics: Coordinated | Continued, inputs: Inputs, states: jax.Array, controls: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
        """Return `feedback.quadratic_costs` around states (H, L, 13) after the steps, and controls (H, J, 3) [rad]."""

        def residuals_of(states: jax.Array, controls: jax.Array) -> dict[str, jax.Array]:
            return residuals(self.terms, continued(dynamics, states[None])[0], controls, inputs.context)

        curvature = curvatures(self.terms, residuals_of(states, controls), inputs.weights)
        steps = of_steps(dynamics)
        assert isinstance(steps, Coordinated)
        return quadratic_costs(steps, residuals_of, curvature, states, controls)

    def plan_cost(self, inputs: Inputs, knots: jax.Array, states: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Return the cost and each term's share of knots (K, J, 3) that led to states (H', L, 13)."""
        controls = self.controls(knots, inputs.reference)
        return evaluate(self.terms, states, controls, inputs.context, inputs.weights)


class Programs:
    """Compiled functions, by name and shapes of arguments, and the seconds that compiling took."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self._compiled: dict[Any, Any] = {}
        self._dynamics: list[Dynamics] = []

    def __getstate__(self) -> dict[str, Any]:
        """Return no compiled programs, which cannot be copied."""
        return self.__dict__ | {"_compiled": {}, "_dynamics": []}

    def number(self, dynamics: Dynamics) -> int:
        """Return the number of these dynamics among all those numbered so far; they need not be hashable."""
        for number, other in enumerate(self._dynamics):
            if other is dynamics:
                return number
        self._dynamics.append(dynamics)
        return len(self._dynamics) - 1

    def __call__(self, name: Any, function: Callable[..., Any], *arguments: Any) -> Any:
        """Return the function's finished result, compiled first where needed; `name` stands for the function."""
        leaves, structure = jax.tree.flatten(arguments)
        signature = (
            name,
            structure,
            tuple((np.shape(leaf), leaf.dtype, getattr(leaf, "sharding", None)) for leaf in leaves),
        )
        if signature not in self._compiled:
            begin = time.perf_counter()
            with no_garbage_collection():
                lowered = jax.jit(function).lower(*arguments)
            self._compiled[signature] = lowered.compile()
            self.seconds += time.perf_counter() - begin
        return jax.block_until_ready(self._compiled[signature](*arguments))


RollOut = Callable[[Rows], tuple[Any, Any]]
"""rows of one size -> states (N, H', L, 13), controls (N, H, J, 3)."""
Rollouts = Callable[[Hashable, RollOut, Rows, int], tuple[Any, Any]]
"""(what the rows share, their rollout, N rows, size >= N) -> its results for so many rows, the last one repeated."""


def filled_up(key: Hashable, roll_out: RollOut, rows: Rows, size: int) -> tuple[Any, Any]:
    """Return the `Rollouts` of one plan alone."""
    numbers = np.minimum(np.arange(size), len(rows.knots) - 1)
    return roll_out(Rows(*(leaf[numbers] for leaf in rows)))


@dataclass
class Record:
    """Record of the candidates that were evaluated while one plan was made."""

    costs: list[np.ndarray] = field(default_factory=list)
    verified: int = 0
    best: dict[bytes, np.ndarray] = field(default_factory=dict)  # states (H', L, 13) by the knots of a round's best


@dataclass(frozen=True)
class PlannerProblem:
    """The `search.Problem` of one plan."""

    equations: Equations
    run: Programs
    inputs: Inputs
    warm_start: np.ndarray
    corrections: Residuals = field(default_factory=dict)
    record: Record = field(default_factory=Record)
    rollouts: Rollouts = filled_up
    cache: dict[bytes, Evaluations] = field(default_factory=dict)
    """Results of the best candidate of each batch, by its knots."""

    def evaluate(self, knots: np.ndarray) -> Evaluations:
        """See `search.Problem`."""
        if len(knots) == 1 and (cached := self.cache.get(knots.tobytes())):
            return cached
        dynamics = self.equations.dynamics
        size = side_by_side(dynamics)
        few = len(knots) <= (max(FEW, size) if jax.default_backend() == "cpu" else size)
        return self._evaluate(dynamics, knots, size if few else len(knots))

    def gradients(self, knots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `search.Problem`."""
        function, arguments = program_of(self.equations.gradients, self.equations.dynamics)
        gradient, results, states = self.run("gradients", function, *arguments, self.inputs, knots, self.corrections)
        return self._add_to_record(knots, results, states).costs, np.asarray(gradient)

    def tangents(self, knots: np.ndarray, directions: np.ndarray) -> Residuals:
        """See `search.Problem`."""
        function, arguments = program_of(self.equations.tangents, self.equations.dynamics)
        derivatives = self.run("tangents", function, *arguments, self.inputs, knots, directions)
        return {name: np.asarray(values) for name, values in derivatives.items()}

    def lost(self, count: int) -> None:
        """See `search.Problem`."""
        if count:
            self.record.costs.append(np.full(count, np.inf, np.float32))

    def validate(self, dynamics: Dynamics, knots: np.ndarray) -> Evaluations:
        """See `search.Problem`."""
        self.record.verified += len(knots)
        uncorrected = replace(self, corrections={}, record=Record(self.record.costs), cache={})
        return uncorrected._evaluate(dynamics, knots, len(knots))

    def corrected(self, corrections: Residuals) -> PlannerProblem:
        """See `search.Problem`."""
        return replace(self, corrections={name: values[0] for name, values in corrections.items()}, cache={})

    def states_of(self, knots: np.ndarray) -> np.ndarray:
        """Return the states (H', L, 13) of knots (K, J, 3)."""
        if knots.tobytes() not in self.record.best:
            self.evaluate(knots[None])
        return self.record.best[knots.tobytes()]

    def for_display(self, knots: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return costs (N,) and states (N, H', L, 13) of knots (N, K, J, 3), for display: they are not recorded."""
        dynamics = self.equations.dynamics
        results, states = self._roll_out(dynamics, knots, side_by_side(dynamics))
        return np.asarray(results[0]), np.asarray(states)

    def plan_cost(self, knots: np.ndarray) -> tuple[float, dict[str, float]]:
        """Return the cost of knots (K, J, 3) and each term's share of it."""
        cost, terms = self.run("plan cost", self.equations.plan_cost, self.inputs, knots, self.states_of(knots))
        return float(cost), {name: float(value) for name, value in terms.items()}

    def _evaluate(self, dynamics: Dynamics, knots: np.ndarray, size: int) -> Evaluations:
        return self._add_to_record(knots, *self._roll_out(dynamics, knots, size))

    def _roll_out(self, dynamics: Dynamics, knots: np.ndarray, size: int) -> tuple[Any, Any]:
        """Return the result of `weigh` for knots, and their states: `size` at a time, the last ones filled up."""
        name, batches = ("roll out", self.run.number(dynamics)), list[tuple[Any, Any]]()
        function, arguments = program_of(self.equations.roll_out, dynamics)

        def roll_out(rows: Rows) -> tuple[Any, Any]:
            result: tuple[Any, Any] = self.run(name, function, *arguments, rows, self.inputs.steps)
            return result

        for begin in range(0, len(knots), size):
            rows = rows_of(self.inputs, knots[begin : begin + size])
            states, controls = self.rollouts((*name, size), roll_out, rows, size)
            results = self.run("weigh", self.equations.weigh, self.inputs, states, controls, self.corrections)
            batches.append((results, states))
        if len(knots) == size:
            return batches[0]
        results, states = jax.tree.map(lambda *parts: np.concatenate(parts)[: len(knots)], *batches)
        return results, states

    def _add_to_record(self, knots: np.ndarray, results: Any, states: jax.Array) -> Evaluations:
        evaluations = Evaluations(*jax.tree.map(np.asarray, results))
        self.record.costs.append(evaluations.costs)
        best = int(np.argmin(evaluations.costs))
        key = knots[best].tobytes()
        self.record.best[key], self.cache[key] = np.asarray(states)[best].copy(), evaluations.row(best)
        return evaluations

"""Feedback around a plan: joint targets that answer deviations of the state, by derivatives of model and costs.

Near the controls u_h of a plan and the states x_h that it predicts, deviations d_h of the states and changes v_h of the
controls obey, and cost, up to terms without a gain,

    d_h+1 = A_h d_h + B_h v_h,    s_h+1 = s_h + G_h d_h+1 + E_h v_h,
    sum_h |[d_h+1, v_h]|^2_W_h / 2 + |s_H|^2_C / 2

s are residuals that depend on states of several steps, such as the ball's miss of its target: their changes add up from
step to step. W_h has the curvatures of all residuals that depend on the state after one step and on its control. The
changes that cost least are linear in what has happened, v_h = K_h [d_h, s_h], by the Riccati recursion from the last
step to the first (W. Li and E. Todorov, "Iterative linear quadratic regulator design for nonlinear biological movement
systems", 2004). One plan's gains serve the plans that follow it as well.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mpc.dynamics import Coordinated, Linearizable

# No joint target is changed by more about an axis [rad]: beyond, derivatives do not hold.
LARGEST_CHANGE = 0.2
# Added to the curvature by the controls: in units of the mean that their own costs have, since larger gains do harm
# where contacts begin otherwise than predicted; and a share of the mean, so that controls without effect stay as they
# are.
DAMPING, RIDGE = 300.0, 1e-6

ResidualFunction = Callable[[jax.Array, jax.Array], dict[str, jax.Array]]
"""(states (H, L, 13) after H steps, controls (H, J, 3)) -> residuals by term, (R,) or (T, R)."""


class LinearQuadratic(NamedTuple):
    """The module's problem: n coordinates of the state, m of the controls, r residuals that add up.

    by_state (H, n, n), by_control (H, n, m): A and B. step_curvature (H, n + m, n + m): W. sum_by_state (H, r, n),
    sum_by_control (H, r, m): G and E. sum_curvature (r,): the diagonal of C.
    """

    by_state: Any
    by_control: Any
    step_curvature: Any
    sum_by_state: Any
    sum_by_control: Any
    sum_curvature: Any


class FeedbackInfo(NamedTuple):
    """Figures of one computation of feedback; for display. gain: the largest, 0 where derivatives are not finite."""

    gain: float
    seconds: float
    compile_seconds: float


@dataclass(frozen=True, eq=False)
class Feedback:
    """Joint targets of a plan that answer deviations of the state.

    controls (H, J, 3) [rad]: of the plan. states (S + 1, L, 13): as it predicts them, from its start on, S <= H. gains
    (H, m, n + r), sum_by_state (H, r, n) and sum_by_control (H, r, m): see the module. lower, upper (J, 3) [rad]:
    bounds of the joint targets.
    """

    dynamics: Linearizable
    controls: np.ndarray
    states: np.ndarray
    gains: np.ndarray
    sum_by_state: np.ndarray
    sum_by_control: np.ndarray
    lower: np.ndarray
    upper: np.ndarray

    def init(self) -> np.ndarray:
        """Return the sums s (r,) at the start of the plan."""
        return np.zeros(self.sum_by_state.shape[1])

    def step(self, sums: np.ndarray, number: int, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the sums s (r,) after a step of this number, and its joint targets (J, 3) [rad] in a state (L, 13).

        From step S on they are those of the plan.
        """
        control: np.ndarray = self.controls[number]
        if number >= len(self.states) - 1:
            return sums, control
        deviation = np.asarray(self.dynamics.difference(jnp.asarray(state, jnp.float32), self.states[number]))
        if number:
            sums = sums + self.sum_by_state[number - 1] @ deviation
        change = self.gains[number] @ np.concatenate([deviation, sums])
        change = np.clip(change, -LARGEST_CHANGE, LARGEST_CHANGE).reshape(control.shape)
        target = np.clip(control + change, self.lower, self.upper, dtype=control.dtype)
        return sums + self.sum_by_control[number] @ (target - control).ravel(), target

    def around(self, controls: np.ndarray, states: np.ndarray, elapsed: int) -> Feedback:
        """Return feedback around a plan made `elapsed` steps later, with the gains of this one for the same moments.

        controls, states: see the class. Beyond this plan's end there is no feedback.
        """
        gains, by_state, by_control = (
            array[elapsed:] for array in (self.gains, self.sum_by_state, self.sum_by_control)
        )
        within = finite_part(states[: len(gains) + 1] if self.gains.size else states[:1])
        return replace(
            self, controls=controls, states=within, gains=gains, sum_by_state=by_state, sum_by_control=by_control
        )


def finite_part(states: np.ndarray) -> np.ndarray:
    """Return the states (S + 1, L, 13) before the first that is not finite; the very first always."""
    finite = np.logical_and.accumulate(np.isfinite(states).all(axis=(1, 2)))
    return states[: max(1, int(finite.sum()))]


def quadratic_costs(
    dynamics: Coordinated,
    residuals_of: ResidualFunction,
    curvatures: dict[str, jax.Array],
    states: jax.Array,
    controls: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array, jax.Array]:
    """Return the module's W, G, E and diagonal of C around states (H, L, 13) after the steps, controls (H, J, 3) [rad].

    residuals_of: of a candidate; those of shape (H, R) depend, in each row, on the state after that step and on its
    control alone, as costs averaged over the steps do. curvatures: of the residuals, see `cost.curvatures`.
    """
    horizon, inputs = len(controls), controls[0].size
    basis = dynamics.basis(states)
    count = basis.shape[-1]
    names = {True: list[str](), False: list[str]()}
    for name, values in curvatures.items():
        names[values.ndim == 2 and len(values) == horizon].append(name)

    def by_step(values: dict[str, jax.Array]) -> jax.Array:
        """Return the values (H, R) of residuals that depend on one step each."""
        return jnp.concatenate([jnp.zeros((horizon, 0)), *(values[name] for name in names[True])], axis=1)

    def in_sums(values: dict[str, jax.Array]) -> jax.Array:
        """Return the values (r,) of all other residuals."""
        return jnp.concatenate([jnp.zeros(0), *(values[name].ravel() for name in names[False])])

    def step_slope(direction: jax.Array) -> jax.Array:
        """Return the derivative (H, R) along the same direction (n + m,) in all steps."""
        control_change = jnp.broadcast_to(direction[count:].reshape(controls.shape[1:]), controls.shape)
        changes = basis @ direction[:count], control_change
        slope: jax.Array = jax.jvp(lambda *steps: by_step(residuals_of(*steps)), (states, controls), changes)[1]
        return slope

    slopes = jax.vmap(step_slope, out_axes=-1)(jnp.eye(count + inputs))
    sum_slopes = jax.jacrev(lambda *steps: in_sums(residuals_of(*steps)), (0, 1))
    sum_by_states, sum_by_controls = sum_slopes(states, controls)
    return (
        jnp.einsum("hr,hri,hrj->hij", by_step(curvatures), slopes, slopes),
        jnp.einsum("rhlc,hlcn->hrn", sum_by_states, basis),
        jnp.moveaxis(sum_by_controls.reshape(-1, horizon, inputs), 0, 1),
        in_sums(curvatures),
    )


def riccati(problem: LinearQuadratic, damping: float = DAMPING) -> np.ndarray:
    """Return the gains K (H, m, n + r) of the module's problem, computed in 64 bits; damping: see `DAMPING`."""
    by_state, by_control, step_curvature, sum_by_state, sum_by_control, sum_curvature = (
        np.asarray(array, float) for array in problem
    )
    horizon, count, inputs = by_control.shape
    known, moving = count + len(sum_curvature), np.r_[:count, -inputs:0]
    gains = np.zeros((horizon, inputs, known))
    value = np.zeros((known, known))  # of what it costs from a step on: half of |[d, s]|^2 in this matrix
    value[count:, count:] = np.diag(sum_curvature)
    own = damping * np.trace(step_curvature[:, count:, count:], axis1=1, axis2=2) / max(inputs, 1)
    transition, curvature = np.eye(known + inputs), np.zeros((known + inputs, known + inputs))
    for step in reversed(range(horizon)):
        transition[:count, :count], transition[:count, known:] = by_state[step], by_control[step]
        transition[count:known, :count] = sum_by_state[step] @ by_state[step]
        transition[count:known, known:] = sum_by_state[step] @ by_control[step] + sum_by_control[step]
        curvature[:known, :known], curvature[known:] = value, 0.0
        curvature[:known, known:] = 0.0
        curvature[np.ix_(moving, moving)] += step_curvature[step]
        total = transition.T @ curvature @ transition
        by_inputs = total[known:, known:]
        added = own[step] + RIDGE * max(np.trace(by_inputs) / max(inputs, 1), np.finfo(np.float32).tiny)
        gains[step] = -np.linalg.solve(by_inputs + added * np.eye(inputs), total[known:, :known])
        value = total[:known, :known] + total[:known, known:] @ gains[step]
        value = 0.5 * (value + value.T)
    return gains

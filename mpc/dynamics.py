"""Models to plan with: anything that rolls a batch of states out under a batch of controls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol, TypeGuard, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from larp_model.errors import InputError

# Rollouts at a time where dynamics do not say how many.
SIDE_BY_SIDE = 8


class Dynamics(Protocol):
    """A model of the scene; LARP and MuJoCo both are one.

    It may say in an attribute `side_by_side` (an integer) how many rollouts at a time take least, each, on a CPU.
    """

    @property
    def differentiable(self) -> bool:
        """Return whether JAX can differentiate `rollout`."""

    def rollout(self, state: jax.Array, controls: jax.Array, *, steps: jax.Array | None = None) -> jax.Array:
        """Return states (N, H', L, 13) after steps 1 to H' >= H, from state (N, L, 13), controls (N, H, J, 3) [rad].

        Pure, traceable by JAX, and every row independent of the others. A row that diverged holds NaN. steps (): only
        so many of the H are computed; the rest of them repeat the last. A planner that needs all does not pass it.
        """


@runtime_checkable
class Coordinated(Dynamics, Protocol):
    """Dynamics whose states have n coordinates of small changes: positions first, and then their rates."""

    def difference(self, states: jax.Array, references: jax.Array) -> jax.Array:
        """Return the coordinates (H, n) of the deviations of states (H, L, 13) from references (H, L, 13)."""

    def moved(self, states: jax.Array, coordinates: jax.Array) -> jax.Array:
        """Return states (H, L, 13) moved by coordinates (H, n): the inverse of `difference`, near zero."""

    def basis(self, states: jax.Array) -> jax.Array:
        """Return derivatives (H, L, 13, n) of states (H, L, 13) by their coordinates."""


@runtime_checkable
class Linearizable(Coordinated, Protocol):
    """Dynamics whose steps have derivatives by these coordinates; `larp_model.Simulator` is one."""

    def linearize(self, states: jax.Array, controls: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return A (H, n, n) and B (H, n, 3 J): steps from states (H, L, 13), controls (H, J, 3) [rad] add A d + B v.

        d (n,): small deviations of states. v (3 J,): small changes of controls [rad].
        """


@runtime_checkable
class Calibrated(Dynamics, Protocol):
    """Dynamics that know the size of their errors; `larp_model.Simulator` is one."""

    def expected_errors(self, states: ArrayLike) -> np.ndarray:
        """Return errors (*, T) [m] to expect of single steps between states (*, T + 1, L, 13): links, in the mean."""


def side_by_side(dynamics: Dynamics) -> int:
    """Return how many candidates are rolled out at a time in small batches."""
    return int(getattr(dynamics, "side_by_side", SIDE_BY_SIDE))


class BatchedTruth(Protocol):
    """An engine outside JAX; `larp_model.engines.mujoco.Truth` is one."""

    @property
    def batch(self) -> int:
        """Return the number of rows N of every rollout: always exactly so many."""

    def rollout(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return states (N, H, L, 13) from (N, L, 13) under (N, H, J, 3) [rad], and (N,) False where diverged."""


@dataclass(frozen=True)
class MujocoDynamics:
    """MuJoCo as the planner's model, called back from the compiled planner.

    It has no gradient: the planner refuses gradient steps on it. Diverged rows come back as NaN. Rows are
    rolled out `truth.batch` at a time, the last time filled up; a few rows for each core waste least.
    """

    truth: BatchedTruth
    differentiable = False

    def rollout(self, state: jax.Array, controls: jax.Array, *, steps: jax.Array | None = None) -> jax.Array:
        """Return the states of `Dynamics.rollout`; H' = H."""
        shape = (*controls.shape[:2], *state.shape[1:])
        result = jax.ShapeDtypeStruct(shape, jnp.float32)
        count = controls.shape[1] if steps is None else steps
        states: jax.Array = jax.pure_callback(self._simulate, result, state, controls, count)
        return states

    def _simulate(self, state: jax.Array, controls: jax.Array, steps: jax.Array) -> np.ndarray:
        start, targets, size = np.asarray(state), np.asarray(controls), self.truth.batch
        count = int(steps)
        result = np.empty((*targets.shape[:2], *start.shape[1:]), np.float32)
        for begin in range(0, len(start), size):
            rows = np.minimum(np.arange(begin, begin + size), len(start) - 1)
            states, ok = self.truth.rollout(start[rows], targets[rows, :count])
            result[rows, :count] = np.where(ok[:, None, None, None], states, np.nan)
        result[:, count:] = result[:, count - 1 : count]
        return result


@jax.tree_util.register_pytree_node_class
@dataclass(frozen=True)
class Continued:
    """Dynamics of the whole scene for H steps under control, then of `links` alone for `steps` more.

    A flying ball is followed to its target at a fraction of the whole scene's cost. All other links stay
    frozen as step H left them. `tail` sees the states of `links` (N, links, 13) and controls (N, steps, 0,
    3).
    """

    dynamics: Dynamics
    tail: Dynamics
    links: slice
    steps: int

    def __post_init__(self) -> None:
        if self.steps < 1:
            raise InputError(f"steps: got {self.steps}, needs at least 1")

    @property
    def differentiable(self) -> bool:
        """Return whether both models are differentiable."""
        return self.dynamics.differentiable and self.tail.differentiable

    @property
    def side_by_side(self) -> int:
        """Return `side_by_side` of the whole scene's dynamics."""
        return side_by_side(self.dynamics)

    def rollout(self, state: jax.Array, controls: jax.Array, *, steps: jax.Array | None = None) -> jax.Array:
        """Return the states of `Dynamics.rollout`; H' = H + `self.steps`."""
        return self.continued(self.dynamics.rollout(state, controls, **({} if steps is None else {"steps": steps})))

    def continued(self, states: jax.Array) -> jax.Array:
        """Return the states (N, H', L, 13) of a rollout from those of its H steps under control, (N, H, L, 13)."""
        last = states[:, -1]
        tail_states = self.tail.rollout(last[:, self.links], jnp.zeros((len(states), self.steps, 0, 3)))
        frozen = jnp.repeat(last[:, None], self.steps, axis=1)
        return jnp.concatenate([states, frozen.at[:, :, self.links].set(tail_states)], axis=1)

    def tree_flatten(self) -> tuple[tuple[Dynamics, Dynamics], tuple[int, int, int]]:
        """Return the models, and the static fields that need a program of their own."""
        return (self.dynamics, self.tail), (self.links.start, self.links.stop, self.steps)

    @classmethod
    def tree_unflatten(cls, fields: tuple[int, int, int], models: tuple[Dynamics, Dynamics]) -> Continued:
        """Return the dynamics of flattened ones; inside JAX the models may be placeholders."""
        begin, end, steps = fields
        return cls(*models, slice(begin, end), steps)


def linearizable(dynamics: Dynamics) -> TypeGuard[Linearizable | Continued]:
    """Return whether the steps under control have derivatives, as feedback needs."""
    return isinstance(of_steps(dynamics), Linearizable)


def of_steps(dynamics: Dynamics) -> Dynamics:
    """Return the dynamics of the steps under control."""
    return dynamics.dynamics if isinstance(dynamics, Continued) else dynamics


def expected_errors(dynamics: Dynamics, states: np.ndarray) -> np.ndarray:
    """Return errors (T,) [m] to expect of steps between states (T + 1, L, 13); none (0,) where nobody knows them."""
    steps = of_steps(dynamics)
    return steps.expected_errors(states) if isinstance(steps, Calibrated) else np.zeros(0)


def advanced(dynamics: Dynamics, states: jax.Array, controls: jax.Array) -> jax.Array:
    """Return the states (N, L, 13) after one step under controls (N, J, 3) [rad]."""
    following: jax.Array = of_steps(dynamics).rollout(states, controls[:, None])[:, 0]
    return following


def linearized(
    dynamics: Dynamics, states: jax.Array, controls: jax.Array, count: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return A and B of `Linearizable.linearize`; from step number `count` () on, those of states that stay."""
    steps = of_steps(dynamics)
    assert isinstance(steps, Linearizable)
    by_state, by_control = steps.linearize(states, controls)
    computed = (jnp.arange(len(controls)) < count)[:, None, None]
    return jnp.where(computed, by_state, jnp.eye(by_state.shape[1])), jnp.where(computed, by_control, 0.0)


def continued(dynamics: Dynamics, states: jax.Array) -> jax.Array:
    """Return the states (N, H', L, 13) of a rollout from those of its H steps under control, (N, H, L, 13)."""
    return dynamics.continued(states) if isinstance(dynamics, Continued) else states


def program_of(function: Callable[..., Any], dynamics: Dynamics) -> tuple[Callable[..., Any], tuple[Dynamics, ...]]:
    """Return the function to compile of one whose first argument are dynamics, and its leading arguments.

    Dynamics that are a pytree of arrays are an argument: others of the same structure then need not be compiled again.
    """
    traced = all(isinstance(leaf, jax.Array | np.ndarray) for leaf in jax.tree.leaves(dynamics))
    return (function, (dynamics,)) if traced else (partial(function, dynamics), ())

"""LARP: a step of a scene by its model and weights, and rollouts of many steps.

After M. Andriluka et al., "Learned neural physics simulation for articulated 3D human pose reconstruction" (2024).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from larp_model import state as packed
from larp_model import weights as stored
from larp_model.bodies import usual
from larp_model.errors import InputError
from larp_model.expected_error import expected_errors
from larp_model.learned.model import Model
from larp_model.learned.residual import ResidualModel
from larp_model.linearization import Coordinates, linearized
from larp_model.networks import Weights
from larp_model.physics.kinematics import morphology_of
from larp_model.runtime import prepare_compiler, require_memory
from larp_model.scene import Scene
from larp_model.sharding import shared

# Of its result, a rollout holds so many at a time.
COPIES = 3
# Scenes are moved towards the origin by whole multiples of this [m]: near it, no number changes.
TILE = 16.0


def step(
    model: Model, weights: Weights, state: Array, control: Array, torque: Array | None = None,
    morphology: Array | None = None, stop_gradient: bool = False,
) -> Array:  # fmt: skip
    """Return states (B, L, 13) one time step of the scene after states (B, L, 13).

    control: joint targets (B, J, 3) [rad]. torque: external, (B, L, 3) [N m], world frame; none by default. morphology
    (B or 1, L, 3); the scene's by default. stop_gradient: as in the paper's training; never when planning.
    """
    torque = jnp.zeros((*state.shape[:-1], 3), state.dtype) if torque is None else torque
    sizes = morphology_of(model.scene)[None].astype(state.dtype) if morphology is None else morphology
    return model.step(weights, state, control, torque, sizes, stop_gradient)


@partial(jax.tree_util.register_dataclass, data_fields=["weights", "morphology"], meta_fields=["model", "scene"])
@dataclass(frozen=True, eq=False)
class Simulator:
    """A model of a scene, with its weights: pure, jit-able, batched, differentiable.

    A pytree, whose leaves are weights and sizes: scenes that differ in sizes of humans alone share what is compiled.
    """

    model: Model
    weights: Weights
    scene: Scene
    morphology: Array | np.ndarray
    """Sizes of the scene's links, (L, 3)."""

    differentiable = True

    @staticmethod
    def of(model: Model, weights: Weights) -> Simulator:
        """Return the simulator of a model; the scene's humans share the model of humans of usual size."""
        scene = model.scene
        shared = replace(scene, bodies=tuple(usual(body) for body in scene.bodies))
        return Simulator(model.on(shared), weights, scene, scene.morphology)

    @property
    def side_by_side(self) -> int:
        """Return the number of rollouts side by side at which one takes least time on a CPU."""
        return self.model.side_by_side

    @staticmethod
    def load(weights: str | Path, scene: Scene | None = None) -> Simulator:
        """Return the simulator of weights by their manifest.

        scene: that is to be simulated; what the weights were trained on by default. What is compiled is kept from one
        process to the next: see `runtime.prepare_compiler`.
        """
        prepare_compiler()
        return Simulator.of(*stored.load(Path(weights), scene)[:2])

    @staticmethod
    def of_physics(scene: Scene) -> Simulator:
        """Return the simulator of any scene by physics alone."""
        prepare_compiler()
        return Simulator.of(ResidualModel(scene), Weights({}, {}, {}))

    def step(
        self, state: ArrayLike, control: ArrayLike, torque: ArrayLike | None = None,
        morphology: ArrayLike | None = None,
    ) -> Array:  # fmt: skip
        """Return states (N, L, 13) after one `scene.dt` under controls (N, J, 3) [rad]; see `rollout` for the rest."""
        arguments = self._checked(state, control, torque, morphology, ())
        return arguments[0] if arguments[0].shape[0] == 0 else _step(self.model, self.weights, *arguments)

    def rollout(
        self, state: ArrayLike, controls: ArrayLike, torques: ArrayLike | None = None,
        morphology: ArrayLike | None = None, steps: ArrayLike | None = None,
    ) -> Array:  # fmt: skip
        """Return states (N, H, L, 13) after each of H steps from states (N, L, 13) under controls (N, H, J, 3) [rad].

        From where a trajectory diverges it holds NaN: see `state.healthy`.

        torques: external, (N, H, L, 3) [N m]. morphology (N or 1, L, 3); the scene's by default. steps (): so many of
        the H are computed, the rest repeat the last; all by default. All are taken in the state's precision, 32
        or 64 bits. Positions in 32 bits are 0.1 mm apart 1 km from the origin, and 1 mm apart at 10 km.
        """
        arguments = self._checked(state, controls, torques, morphology, np.shape(controls)[1:2])
        start, targets, *_ = arguments
        if start.shape[0] == 0:
            return jnp.zeros((0, targets.shape[1], *start.shape[1:]), start.dtype)
        if not isinstance(start, jax.core.Tracer):  # which may be for another machine
            row = targets.shape[1] * start.shape[1] * packed.SIZE * start.dtype.itemsize
            require_memory("state", start.shape[0], COPIES * row)
        states = _rollout(self.model, self.weights, *arguments, steps)
        diverged = jnp.cumsum(~packed.healthy(states), axis=1) > 0
        return jnp.where(diverged[..., None, None], jnp.nan, states)

    def linearize(self, states: ArrayLike, controls: ArrayLike) -> tuple[Array, Array]:
        """Return A (*, 2 V, 2 V) and B (*, 2 V, 3 J), derivatives of steps from states (*, L, 13).

        controls: (*, J, 3) [rad]. Near them the state after a step changes by A dx + B du, for changes dx of the state
        in the 2 V coordinates of `linearization`, and du of the controls [rad].
        """
        state, control = _array("states", states), _array("controls", controls)
        lead = state.shape[:-2]
        if control.shape[:-2] != lead:
            raise InputError(f"controls have shape {control.shape}, but need {(*lead, len(self.scene.motors), 3)}")
        flat_state, flat_control = (array.reshape(-1, *array.shape[-2:]) for array in (state, control))
        start, targets, _, sizes = self._checked(flat_state, flat_control, None, None, ())
        by_state, by_control = _linearized(self.model, self.weights, start, targets, sizes)
        return by_state.reshape(*lead, *by_state.shape[1:]), by_control.reshape(*lead, *by_control.shape[1:])

    def difference(self, states: ArrayLike, references: ArrayLike) -> Array:
        """Return the coordinates (*, 2 V) of states (*, L, 13) near references (*, L, 13): see `linearization`."""
        state, reference = jnp.broadcast_arrays(_array("states", states), _array("references", references))
        flat = (array.reshape(-1, *array.shape[-2:]) for array in (state, reference))
        coordinates: Array = _difference(self.scene, *flat).reshape(*state.shape[:-2], -1)
        return coordinates

    def moved(self, states: ArrayLike, coordinates: ArrayLike) -> Array:
        """Return states (*, L, 13) moved by coordinates (*, 2 V), with all joints closed: see `linearization`."""
        state, change = _array("states", states), _array("coordinates", coordinates)
        flat = state.reshape(-1, *state.shape[-2:]), change.reshape(-1, change.shape[-1])
        result: Array = _moved(self.scene, *flat, jnp.asarray(self.morphology, state.dtype)).reshape(state.shape)
        return result

    def basis(self, states: ArrayLike) -> Array:
        """Return changes (*, L, 13, 2 V) of states (*, L, 13) per unit of each coordinate: see `linearization`."""
        state = _array("states", states)
        flat = _basis(self.scene, state.reshape(-1, *state.shape[-2:]), jnp.asarray(self.morphology, state.dtype))
        changes: Array = flat.reshape(*state.shape, -1)
        return changes

    def expected_errors(self, states: ArrayLike) -> np.ndarray:
        """Return errors (*, T) [m] to expect of steps between states (*, T + 1, L, 13): see `expected_error`."""
        errors: np.ndarray = expected_errors(self.scene, np.asarray(states), np.asarray(self.morphology))
        return errors

    def _checked(
        self, state: ArrayLike, control: ArrayLike, torque: ArrayLike | None, morphology: ArrayLike | None,
        steps: tuple[int, ...],
    ) -> tuple[Array, Array, Array | None, Array]:  # fmt: skip
        """Return the public arguments as JAX arrays; raise InputError where one does not fit. steps: (H,) or none."""
        start, links, motors = _array("state", state), len(self.scene.links), len(self.scene.motors)
        if start.ndim != 3 or start.shape[1:] != (links, packed.SIZE):
            raise InputError(f"state has shape {start.shape}, but needs (N, {links}, {packed.SIZE})")
        if start.dtype not in (jnp.float32, jnp.float64):
            raise InputError(f"state has numbers of type {start.dtype}, but needs float32 or float64")
        count, arrays = start.shape[0], list[Array | None]()  # the count may be a symbol: see `jax.export`
        for name, value, rows in (("controls", control, motors), ("torques", torque, links)):
            arrays.append(None if value is None else _array(name, value, start.dtype))
            if arrays[-1] is not None and arrays[-1].shape != (count, *steps, rows, 3):
                expected = f"({count}, {'H, ' if steps else ''}{rows}, 3)"
                raise InputError(f"{name} have shape {arrays[-1].shape}, but need {expected}")
        sizes = _array("morphology", self.morphology[None] if morphology is None else morphology, start.dtype)
        if sizes.shape not in ((1, links, 3), (count, links, 3)):
            raise InputError(f"morphology has shape {sizes.shape}, but needs ({count} or 1, {links}, 3)")
        controls, torques = arrays
        assert controls is not None
        return start, controls, torques, sizes


def _array(name: str, value: ArrayLike, dtype: DTypeLike | None = None) -> Array:
    try:
        return jnp.asarray(value, dtype)
    except (TypeError, ValueError):
        raise InputError(f"{name} is of type {type(value).__name__}, but needs an array of numbers") from None


def near_origin(function: Callable[..., Array], model: Model, weights: Weights, state: Array, *arguments: Any) -> Array:
    """Return the states of `step` or `rollout`, computed with the first link of each scene within `TILE` of the origin.

    Numbers are precise there. Models that are not invariant compute where the scene is.
    """
    if not model.invariant:
        return function(model, weights, state, *arguments)
    tiles = TILE * jnp.round(state[:, 0, :2] / TILE)
    offset = jnp.zeros_like(state[:, 0]).at[:, :2].set(tiles)
    after = function(model, weights, state - offset[:, None], *arguments)
    return after + jnp.expand_dims(offset, range(1, after.ndim - 1))


def rollout(
    model: Model, weights: Weights, state: Array, controls: Array, torques: Array | None = None,
    morphology: Array | None = None, steps: Array | None = None, stop_gradient: bool = False,
) -> Array:  # fmt: skip
    """Return states (B, H, L, 13) after each of H steps; the arguments are those of `step`, with a time axis second.

    steps (): so many of the H are computed, the rest repeat the last; all by default.
    """

    def advance(current: Array, inputs: tuple[Array, Array | None]) -> Array:
        control, torque = inputs
        return step(model, weights, current, control, torque, morphology, stop_gradient)

    def next_state(current: Array, inputs: tuple[Array, tuple[Array, Array | None]]) -> tuple[Array, Array]:
        number, step_inputs = inputs
        if steps is None:
            after = advance(current, step_inputs)
        else:
            after = jax.lax.cond(number < steps, advance, lambda unchanged, _: unchanged, current, step_inputs)
        return after, after

    by_time = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), (controls, torques))
    _, states = jax.lax.scan(next_state, state, (jnp.arange(controls.shape[1]), by_time))
    return jnp.moveaxis(states, 0, 1)


# Compiled once for each shape where they are called by themselves; inlined where JAX traces their caller.
@partial(jax.jit, static_argnums=0, inline=True)
def _step(model: Model, weights: Weights, *arrays: Any) -> Array:
    return shared(partial(near_origin, step, model), *_by_row(weights, *arrays))


@partial(jax.jit, static_argnums=0, inline=True)
def _rollout(model: Model, weights: Weights, *arrays: Any) -> Array:
    return shared(partial(near_origin, rollout, model), *_by_row(weights, *arrays))


@partial(jax.jit, static_argnums=0, inline=True)
def _linearized(model: Model, weights: Weights, state: Array, control: Array, sizes: Array) -> tuple[Array, Array]:
    def one_step(state: Array, control: Array, sizes: Array) -> Array:
        return step(model, weights, state, control, morphology=sizes)

    return linearized(model.scene, one_step, state, control, jnp.broadcast_to(sizes, (len(state), *sizes.shape[1:])))


@partial(jax.jit, static_argnums=0, inline=True)
def _difference(scene: Scene, state: Array, reference: Array) -> Array:
    return Coordinates(scene).difference(*(jnp.moveaxis(array, 0, -1) for array in (state, reference))).T


@partial(jax.jit, static_argnums=0, inline=True)
def _moved(scene: Scene, state: Array, coordinates: Array, sizes: Array) -> Array:
    return jnp.moveaxis(Coordinates(scene).moved(jnp.moveaxis(state, 0, -1), sizes[..., None], coordinates.T), -1, 0)


@partial(jax.jit, static_argnums=0, inline=True)
def _basis(scene: Scene, state: Array, sizes: Array) -> Array:
    coordinates, last = Coordinates(scene), jnp.moveaxis(state, 0, -1)
    count, batch = 2 * coordinates.count, state.shape[0]

    def change(direction: Array) -> Array:
        return coordinates.change(last, sizes[..., None], jnp.broadcast_to(direction[:, None], (count, batch)))

    return jnp.moveaxis(jax.vmap(change)(jnp.eye(count, dtype=state.dtype)), (0, -1), (-1, 0))


def _by_row(
    weights: Weights, state: Array, control: Array, torque: Array | None, morphology: Array, *steps: Array | None
) -> tuple[int, tuple[Any, ...], tuple[bool, ...]]:
    """Return the other arguments of `sharding.shared` for a step or a rollout."""
    count = state.shape[0]
    arguments = (weights, state, control, torque, morphology, *steps)
    return count, arguments, (False, True, True, True, morphology.shape[0] == count, *(False for _ in steps))

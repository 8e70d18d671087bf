"""LARP: a step is what bodies do alone, where they meet, and what that does to them; a rollout repeats it.

M. Andriluka et al., "Learned neural physics simulation for articulated 3D human pose reconstruction" (2024), in the
parts of a `Model`.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike, DTypeLike

from larp_model import designs
from larp_model import state as packed
from larp_model import weights as stored
from larp_model.errors import InputError
from larp_model.kinematics import Kinematics, kinematics, morphology_of
from larp_model.mechanics import BodyMotion
from larp_model.meeting import Velocities
from larp_model.names import require_known
from larp_model.networks import Weights
from larp_model.parts.part import BodyPart, Hits, Model, PairPart
from larp_model.parts.residual import FreeBall, ResidualBody, SoftContact
from larp_model.physics.collision import ContactSettings
from larp_model.physics.step import step as physics_step
from larp_model.runtime import remember_compilations
from larp_model.scene import Body, Scene


def step(
    model: Model, weights: Weights, state: Array, control: Array, torque: Array | None = None,
    morphology: Array | None = None, stop_gradient: bool = False,
) -> Array:  # fmt: skip
    """Advance states (B, L, 13) by the scene's time step under joint targets (B, J, 3) [rad].

    torque: external, (B, L, 3) [N m], world frame. morphology (B or 1, L, 3); the scene's by default.
    stop_gradient: hold the contact's inputs fixed, as in the paper's training; never when planning.
    """
    scene = model.scene
    torque = jnp.zeros((*state.shape[:-1], 3), state.dtype) if torque is None else torque
    sizes = morphology_of(scene)[None].astype(state.dtype) if morphology is None else morphology
    if isinstance(model.bodies[0], ResidualBody | FreeBall):
        return _over_physics(model, weights, state, control, torque, sizes)
    bodies = cast(tuple[BodyPart, ...], model.bodies)
    seen = model.each(kinematics(scene, state, sizes))
    moving = [
        part.move(weights, own, control[:, scene.motor_rows(part.body.name)], torque[:, scene.rows(part.body.name)])
        for part, own in zip(bodies, seen, strict=True)
    ]
    free = [each.free for each in moving]
    hits = pooled(model, weights, *(jax.lax.stop_gradient((seen, free)) if stop_gradient else (seen, free)))
    after = [
        part.respond(weights, own, moved, hit) for part, own, moved, hit in zip(bodies, seen, moving, hits, strict=True)
    ]
    return jnp.concatenate(after, axis=1)


def _over_physics(model: Model, weights: Weights, state: Array, control: Array, torque: Array, sizes: Array) -> Array:
    """Return the states after a step of physics, in which networks correct how bodies move by themselves."""
    scene, parts = model.scene, {part.body.name: part for part in model.bodies}

    def correct(body: Body, before: Array, own: Array, motion: BodyMotion, dt: float) -> BodyMotion:
        part = parts[body.name]
        if not isinstance(part, ResidualBody) or part.size is None:
            return motion
        seen = kinematics(scene.only(body.name), *(jnp.moveaxis(each, -1, 0) for each in (before, own)))
        corrected = part.corrected(weights, seen, BodyMotion(*(jnp.moveaxis(each, -1, 0) for each in motion)), dt)
        return BodyMotion(*(jnp.moveaxis(each, 0, -1) for each in corrected))

    constants = {name: part.constants for name, part in parts.items() if isinstance(part, ResidualBody)}
    found = (part.settings for part in model.pairs if isinstance(part, SoftContact))
    settings = next(found, ContactSettings())
    return physics_step(scene, state, control, torque, sizes, constants, settings, correct)


def pooled(model: Model, weights: Weights, seen: list[Kinematics], free: list[Velocities]) -> list[Hits]:
    """Sum f_c over the contacts of every link, body by body (equation 1 of the paper)."""
    hits = [Hits.none(own) for own in seen]
    for pair in cast(tuple[PairPart, ...], model.pairs):
        both = model.of(pair)
        first, second = both
        met = pair.meet(weights, (seen[first], seen[second]), (free[first], free[second]))
        for index, found in zip(both, met, strict=True):
            hits[index] = hits[index].plus(found)
    return hits


@dataclass(frozen=True, eq=False)
class Simulator:
    """A scene with learned weights: pure, jit-able, batched, differentiable."""

    model: Model
    weights: Weights

    differentiable = True

    @property
    def side_by_side(self) -> int:
        """Return how many rollouts are cheapest side by side on a CPU: physics is made of many small loops."""
        return 32 if isinstance(self.model.bodies[0], ResidualBody | FreeBall) else 8

    @staticmethod
    def load(weights: str | Path, scene: Scene | None = None) -> Simulator:
        """The simulator of weights by their manifest, or of shipped ones by their name ("human_ball", "chains2", ...).

        scene: that is to be simulated; what the weights were trained on by default. What is compiled is kept from one
        process to the next: see `runtime.remember_compilations`.
        """
        remember_compilations()
        manifest = Path(weights)
        if manifest.name == str(weights) and not manifest.suffix:
            require_known("weights", str(weights), sorted(each.stem for each in stored.SHIPPED.glob("*.json")))
            manifest = stored.SHIPPED / f"{weights}.json"
        return Simulator(*stored.load(manifest, scene)[:2])

    @staticmethod
    def of_physics(scene: Scene) -> Simulator:
        """Return the simulator of any scene with nothing learned."""
        remember_compilations()
        return Simulator(designs.physical(scene), Weights({}, {}, {}))

    @property
    def scene(self) -> Scene:
        """What is simulated."""
        return self.model.scene

    def step(
        self, state: ArrayLike, control: ArrayLike, torque: ArrayLike | None = None,
        morphology: ArrayLike | None = None,
    ) -> Array:  # fmt: skip
        """States (N, L, 13) after one `scene.dt` under controls (N, J, 3) [rad]; see `rollout` for the rest."""
        given = self._checked(state, control, torque, morphology, ())
        return given[0] if given[0].shape[0] == 0 else _step(self.model, self.weights, *given)

    def rollout(
        self, state: ArrayLike, controls: ArrayLike, torques: ArrayLike | None = None,
        morphology: ArrayLike | None = None, steps: ArrayLike | None = None,
    ) -> Array:  # fmt: skip
        """States (N, H, L, 13) after each of H steps from states (N, L, 13) under controls (N, H, J, 3) [rad].

        From where a trajectory diverges it holds NaN: see `state.healthy`.

        torques: external, (N, H, L, 3) [N m]. morphology (N or 1, L, 3); the scene's by default. steps (): so many of
        the H are computed, the rest repeat the last; all by default. All are taken in the state's precision, 32
        or 64 bits. Positions in 32 bits are 0.1 mm apart 1 km from the origin: plan near it.
        """
        given = self._checked(state, controls, torques, morphology, np.shape(controls)[1:2])
        start, targets, *_ = given
        if start.shape[0] == 0:
            return jnp.zeros((0, targets.shape[1], *start.shape[1:]), start.dtype)
        states = _rollout(self.model, self.weights, *given, steps=steps)
        lost = jnp.cumsum(~packed.healthy(states), axis=1) > 0
        return jnp.where(lost[..., None, None], jnp.nan, states)

    def _checked(
        self, state: ArrayLike, control: ArrayLike, torque: ArrayLike | None, morphology: ArrayLike | None,
        steps: tuple[int, ...],
    ) -> tuple[Array, Array, Array | None, Array | None]:  # fmt: skip
        """The public arguments as JAX arrays, refused by name where they do not fit; steps: (H,) or none."""
        start, links, motors = _array("state", state), len(self.scene.links), len(self.scene.motors)
        if start.ndim != 3 or start.shape[1:] != (links, packed.SIZE):
            raise InputError(f"state has shape {start.shape}, but needs (N, {links}, {packed.SIZE})")
        if start.dtype not in (jnp.float32, jnp.float64):
            raise InputError(f"state has numbers of type {start.dtype}, but needs float32 or float64")
        count, given = start.shape[0], list[Array | None]()  # the count may be a symbol: see `jax.export`
        for name, value, rows in (("controls", control, motors), ("torques", torque, links)):
            given.append(None if value is None else _array(name, value, start.dtype))
            if given[-1] is not None and given[-1].shape != (count, *steps, rows, 3):
                wanted = f"({count}, {'H, ' if steps else ''}{rows}, 3)"
                raise InputError(f"{name} have shape {given[-1].shape}, but need {wanted}")
        sizes = None if morphology is None else _array("morphology", morphology, start.dtype)
        if sizes is not None and sizes.shape not in ((1, links, 3), (count, links, 3)):
            raise InputError(f"morphology has shape {sizes.shape}, but needs ({count} or 1, {links}, 3)")
        controls, torques = given
        assert controls is not None
        return start, controls, torques, sizes


def _array(name: str, value: ArrayLike, dtype: DTypeLike | None = None) -> Array:
    try:
        return jnp.asarray(value, dtype)
    except (TypeError, ValueError):
        raise InputError(f"{name} is of type {type(value).__name__}, but needs an array of numbers") from None


def rollout(
    model: Model, weights: Weights, state: Array, controls: Array, torques: Array | None = None,
    morphology: Array | None = None, steps: Array | None = None, stop_gradient: bool = False,
) -> Array:  # fmt: skip
    """States (B, H, L, 13) after each of H steps; the arguments are those of `step`, with a time axis second.

    steps (): so many of the H are computed, the rest repeat the last; all by default.
    """

    def advance(current: Array, inputs: tuple[Array, Array | None]) -> Array:
        control, torque = inputs
        return step(model, weights, current, control, torque, morphology, stop_gradient)

    def next_state(current: Array, inputs: tuple[Array, tuple[Array, Array | None]]) -> tuple[Array, Array]:
        number, given = inputs
        if steps is None:
            after = advance(current, given)
        else:
            after = jax.lax.cond(number < steps, advance, lambda held, _: held, current, given)
        return after, after

    by_time = jax.tree.map(lambda x: jnp.moveaxis(x, 1, 0), (controls, torques))
    _, states = jax.lax.scan(next_state, state, (jnp.arange(controls.shape[1]), by_time))
    return jnp.moveaxis(states, 0, 1)


# Compiled once for each shape, also where nothing around them is; in what JAX traces they leave no mark.
_step = jax.jit(step, static_argnums=0, inline=True)
_rollout = jax.jit(rollout, static_argnums=0, inline=True)

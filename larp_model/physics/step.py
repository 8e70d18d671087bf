"""A step of a whole scene by physics alone: bodies move on by themselves, and what touches is integrated finely.

Where links touch within a step, the scene's step is made of two halves, each with its contacts (`impact`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import state as packed
from larp_model.linalg import mv, rotated, rotation_matrices
from larp_model.physics.ball import ball_motion, flight
from larp_model.physics.collision import Candidates, ContactSettings, Links
from larp_model.physics.impact import integrate
from larp_model.physics.motion import Articulation, BodyMotion, Constants, articulated_motion, velocity_products
from larp_model.scene import Body, Scene

# Scenes in which links touch are worked on so many side by side: more do not fit into the caches of a core.
CHUNK = 32


class Given(NamedTuple):
    """States (L, 13, B) before a step, targets (J, 3, B) [rad], torques (L, 3, B) [N m], and sizes (L, 3, B)."""

    state: Array
    targets: Array
    torques: Array
    sizes: Array


BallMotion = Callable[[Body, Array, Array, Array, float, float], BodyMotion]
"""(body, states (1, 13, B), torques (1, 3, B), sizes (1, 3, B), gravity, dt [s]) -> motion (1, 3, B) each."""

Correction = Callable[[Body, Array, Array, BodyMotion, float], BodyMotion]
"""(body, states (n, 13, B), sizes (n, 3, B), motion (n, 3, B) each, dt [s]) -> motion, as a network knows better."""


def step(
    scene: Scene, state: Array, control: Array, torque: Array, morphology: Array,
    constants: Constants, settings: ContactSettings,
    correct: Correction = lambda body, state, sizes, motion, dt: motion,
) -> Array:  # fmt: skip
    """Return states (B, L, 13) one `scene.dt` after states (B, L, 13).

    control (B, J, 3) [rad], torque (B, L, 3) [N m], morphology (B or 1, L, 3). correct: see
    `Correction`.
    """
    before, targets, torques = (jnp.moveaxis(each, 0, -1) for each in (state, control, torque))
    sizes = jnp.broadcast_to(jnp.moveaxis(morphology, 0, -1), (len(scene.links), 3, state.shape[0]))
    given, candidates = Given(before, targets, torques, sizes), Candidates(scene)

    def free(given: Given, dt: float, of_ball: BallMotion) -> tuple[BodyMotion, dict[str, Articulation]]:
        motions, articulations = [], {}
        for body in scene.bodies:
            rows = scene.rows(body.name)
            state, torques, sizes = given.state[rows], given.torques[rows], given.sizes[rows]
            if body.is_ball:
                motion = of_ball(body, state, torques, sizes, scene.gravity, dt)
            else:
                aims = given.targets[scene.motor_rows(body.name)]
                motion, articulations[body.name] = articulated_motion(
                    body, state, aims, torques, sizes, scene.gravity, dt, constants
                )
            motions.append(correct(body, state, sizes, motion, dt))
        return BodyMotion(*(jnp.concatenate(each) for each in zip(*motions, strict=True))), articulations

    def half(given: Given, nothing: None) -> tuple[Given, None]:
        dt = 0.5 * scene.dt
        # Balls are integrated with all that touches them, the ground as well.
        motion, articulations = free(given, dt, flight)
        links = _links(scene, given, motion, articulations, dt)
        gained = integrate(scene, links, articulations, candidates.gaps(links, dt, settings), dt, settings)
        both = BodyMotion(*(own + more for own, more in zip(motion, gained, strict=True)))
        return given._replace(state=_after(given.state, both)), None

    motion, articulations = free(given, scene.dt, ball_motion)
    after = _after(before, motion)
    if scene.pairs:
        links = _links(scene, given, motion, articulations, scene.dt)
        gaps = candidates.gaps(links, scene.dt, settings)
        near = jnp.min(gaps, axis=0) < settings.margin
        after = _where(near, lambda given: jax.lax.scan(half, given, length=2)[0].state, given, after)
    return jnp.moveaxis(after, -1, 0)


def _where(near: Array, finely: Callable[[Given], Array], given: Given, otherwise: Array) -> Array:
    """Return states (L, 13, B) by `finely` where near (B,), chunk by chunk, and the other states elsewhere."""
    count = near.shape[0]
    # The count may be a symbol: see `jax.export`.
    size = min(CHUNK, count) if isinstance(count, int) else count
    if size == count:
        found = jax.lax.cond(jnp.any(near), finely, lambda given: given.state, given)
        return jnp.where(near, found, otherwise)
    order = jnp.argsort(~near)
    rows = order[np.minimum(np.arange(count + -count % size), count - 1)].reshape(-1, size)

    def chunk(nothing: None, rows: Array) -> tuple[None, Array]:
        own: Given = jax.tree.map(lambda each: each[..., rows], given)
        return None, jax.lax.cond(jnp.any(near[rows]), finely, lambda given: given.state, own)

    _, chunks = jax.lax.scan(chunk, None, rows)
    found = jnp.moveaxis(chunks, 0, -2).reshape(*otherwise.shape[:2], -1)[..., jnp.argsort(order)]
    return jnp.where(near, found, otherwise)


def _links(scene: Scene, given: Given, motion: BodyMotion, articulations: dict[str, Articulation], dt: float) -> Links:
    """Return all links of a scene whose bodies move so within `dt` [s]."""
    position, orientation, velocity, spin = (
        given.state[:, columns]
        for columns in (packed.POSITION, packed.ORIENTATION, packed.VELOCITY, packed.ANGULAR_VELOCITY)
    )
    axes = jnp.array([link.axis for link in scene.links], given.state.dtype)[..., None]
    half = 0.5 * given.sizes[:, :1] * mv(rotation_matrices(orientation), axes)
    acceleration, turning = (motion.velocity - velocity) / dt, (motion.spin - spin) / dt
    rates = []
    for body in scene.bodies:
        still = jnp.zeros_like(spin[scene.rows(body.name)])
        jerks = products = still, still
        if articulation := articulations.get(body.name):
            jerks = articulation.jerk, articulation.angular_jerk
            if body.joints:
                products = velocity_products(body, articulation.tied, spin[scene.rows(body.name)])
        rates.append((*jerks, *products))
    jerk, angular_jerk, uncounted, uncounted_turning = (jnp.concatenate(each) for each in zip(*rates, strict=True))
    return Links(
        position, half, velocity, spin, acceleration, turning, jerk, angular_jerk, uncounted, uncounted_turning,
        given.sizes,
    )  # fmt: skip


def _after(before: Array, motion: BodyMotion) -> Array:
    """Return states (L, 13, B) after a motion."""
    position, orientation = before[:, packed.POSITION], before[:, packed.ORIENTATION]
    return jnp.concatenate(
        [position + motion.moved, rotated(orientation, motion.turned), motion.velocity, motion.spin], axis=1
    )

"""A step of a whole scene by physics alone: bodies move on by themselves, and what touches is integrated finely.

Where links touch within a step, the scene's step is made of two halves, each with its contacts (`impact`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
from jax import Array

from larp_model import state as packed
from larp_model.mechanics import (
    Articulation,
    BodyMotion,
    Constants,
    articulated_motion,
    mv,
    turn,
    turns,
    velocity_products,
)
from larp_model.physics.ball import ball_motion
from larp_model.physics.collision import Candidates, Links, Rule
from larp_model.physics.impact import integrate
from larp_model.scene import Body, Scene

Correction = Callable[[Body, Array, BodyMotion, float], BodyMotion]
"""(body, its states (n, 13, B), its motion with the batch last, dt [s]) -> its motion, as a network knows better."""


def step(
    scene: Scene, state: Array, control: Array, torque: Array, morphology: Array,
    constants: Mapping[str, Constants], rule: Rule,
    correct: Correction = lambda body, state, motion, dt: motion,
) -> Array:  # fmt: skip
    """Return states (B, L, 13) one `scene.dt` after states (B, L, 13).

    control (B, J, 3) [rad], torque (B, L, 3) [N m], morphology (B or 1, L, 3). constants: of the articulated bodies, by
    name. correct: see `Correction`.
    """
    before, targets, outside = (jnp.moveaxis(each, 0, -1) for each in (state, control, torque))
    sizes = jnp.broadcast_to(jnp.moveaxis(morphology, 0, -1), (len(scene.links), 3, state.shape[0]))

    def free(before: Array, dt: float) -> tuple[BodyMotion, dict[str, Articulation]]:
        motions, articulations = [], {}
        for body in scene.bodies:
            rows = scene.rows(body.name)
            own = before[rows], outside[rows], sizes[rows]
            if body.is_ball:
                motion = ball_motion(body, *own, scene.gravity, dt)
            else:
                aims = targets[scene.motor_rows(body.name)]
                motion, articulations[body.name] = articulated_motion(
                    body, own[0], aims, *own[1:], scene.gravity, dt, constants[body.name]
                )
            motions.append(correct(body, before[rows], motion, dt))
        return BodyMotion(*(jnp.concatenate(each) for each in zip(*motions, strict=True))), articulations

    alone, articulations = free(before, scene.dt)
    after = _after(before, alone)
    if not scene.pairs:
        return jnp.moveaxis(after, -1, 0)
    candidates = Candidates(scene)
    gaps = candidates.gaps(_links(scene, before, outside, sizes, alone, articulations, scene.dt), scene.dt, rule)
    near = jnp.min(gaps, axis=0) < rule.margin

    def half(before: Array, nothing: None) -> tuple[Array, None]:
        dt = 0.5 * scene.dt
        motion, articulations = free(before, dt)
        links = _links(scene, before, outside, sizes, motion, articulations, dt)
        # Balls are integrated with all that touches them, the ground as well.
        balls = jnp.concatenate([jnp.full(len(body.links), body.is_ball) for body in scene.bodies])[:, None, None]
        flying = BodyMotion(
            links.velocity + dt * links.acceleration, links.spin + dt * links.turning,
            dt * (links.velocity + 0.5 * dt * links.acceleration), dt * (links.spin + 0.5 * dt * links.turning),
        )  # fmt: skip
        motion = BodyMotion(*(jnp.where(balls, fly, own) for fly, own in zip(flying, motion, strict=True)))
        gained = integrate(scene, links, articulations, candidates.gaps(links, dt, rule), dt, rule)
        return _after(before, BodyMotion(*(own + more for own, more in zip(motion, gained, strict=True)))), None

    def struck() -> Array:
        finely, _ = jax.lax.scan(half, before, length=2)
        return jnp.where(near, finely, after)

    return jnp.moveaxis(jax.lax.cond(jnp.any(near), struck, lambda: after), -1, 0)


def _links(
    scene: Scene, before: Array, outside: Array, sizes: Array, motion: BodyMotion,
    articulations: dict[str, Articulation], dt: float,
) -> Links:  # fmt: skip
    """Return all links of a scene whose bodies move so within `dt` [s]; balls as if in the air."""
    position, orientation, velocity, spin = (
        before[:, columns]
        for columns in (packed.POSITION, packed.ORIENTATION, packed.VELOCITY, packed.ANGULAR_VELOCITY)
    )
    axes = jnp.array([link.axis for link in scene.links], before.dtype)[..., None]
    half = 0.5 * sizes[:, :1] * mv(turns(orientation), axes)
    acceleration, turning = (motion.velocity - velocity) / dt, (motion.spin - spin) / dt
    uncounted, uncounted_turning = [], []
    down = jnp.array([0.0, 0.0, -scene.gravity], before.dtype)[None, :, None]
    for body in scene.bodies:
        rows = scene.rows(body.name)
        if body.is_ball:
            acceleration = acceleration.at[rows].set(jnp.broadcast_to(down, acceleration[rows].shape))
        if body.joints:
            linear, angular = velocity_products(body, articulations[body.name].tied, spin[rows])
        else:
            linear = angular = jnp.zeros_like(spin[rows])
        uncounted.append(linear)
        uncounted_turning.append(angular)
    uncounted_all, uncounted_turning_all = jnp.concatenate(uncounted), jnp.concatenate(uncounted_turning)
    return Links(
        position, half, velocity, spin, acceleration, turning, uncounted_all, uncounted_turning_all, sizes
    )  # fmt: skip


def _after(before: Array, motion: BodyMotion) -> Array:
    """Return states (L, 13, B) after a motion."""
    position, orientation = before[:, packed.POSITION], before[:, packed.ORIENTATION]
    return jnp.concatenate(
        [position + motion.moved, turn(orientation, motion.turned), motion.velocity, motion.spin], axis=1
    )

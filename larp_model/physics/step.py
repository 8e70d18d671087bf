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

from larp_model.linalg import rotated
from larp_model.physics.ball import ball_motion, flight
from larp_model.physics.collision import Candidates, ContactSettings, Rates
from larp_model.physics.impact import integrate
from larp_model.physics.kinematics import Kinematics, kinematics
from larp_model.physics.motion import Articulation, BodyMotion, Constants, articulated_motion, velocity_products
from larp_model.scene import Body, Scene

# Scenes in which links touch are stepped so many at a time on a CPU: more do not fit into the caches of a core. A GPU
# takes all at once, which is 13 times faster at 512 of them.
CHUNK = 32


class Driven(NamedTuple):
    """States (L, 13, B) before a step, targets (J, 3, B) [rad], torques (L, 3, B) [N m], and sizes (L, 3, B)."""

    state: Array
    targets: Array
    torques: Array
    sizes: Array


BallMotion = Callable[[Body, Kinematics, Array, float, float], BodyMotion]
"""(body, kinematics, torques (1, 3, B), gravity, dt [s]) -> motion (1, 3, B) each."""

Correction = Callable[[Body, Kinematics, BodyMotion, float], BodyMotion]
"""(body, kinematics, motion (n, 3, B) each, dt [s]) -> motion, as a network knows better."""


def step(
    scene: Scene, state: Array, control: Array, torque: Array, morphology: Array,
    constants: Constants, settings: ContactSettings,
    correct: Correction = lambda body, seen, motion, dt: motion,
) -> Array:  # fmt: skip
    """Return states (B, L, 13) one `scene.dt` after states (B, L, 13).

    control (B, J, 3) [rad], torque (B, L, 3) [N m], morphology (B or 1, L, 3). correct: see `Correction`.
    """
    before, targets, torques, sizes = (jnp.moveaxis(each, 0, -1) for each in (state, control, torque, morphology))
    begun = Driven(before, targets, torques, jnp.broadcast_to(sizes, (*sizes.shape[:2], state.shape[0])))
    candidates = Candidates(scene)

    def free(
        driven: Driven, seen: Kinematics, dt: float, of_ball: BallMotion
    ) -> tuple[BodyMotion, dict[str, Articulation]]:
        motions, articulations = [], {}
        for body in scene.bodies:
            own, torques = seen.of(scene, body.name), driven.torques[scene.rows(body.name)]
            if body.is_ball:
                motion = of_ball(body, own, torques, scene.gravity, dt)
            else:
                targets = driven.targets[scene.motor_rows(body.name)]
                motion, articulations[body.name] = articulated_motion(
                    body, own, targets, torques, scene.gravity, dt, constants
                )
            motions.append(correct(body, own, motion, dt))
        return BodyMotion(*(jnp.concatenate(each) for each in zip(*motions, strict=True))), articulations

    def half(driven: Driven, nothing: None) -> tuple[Driven, None]:
        dt, seen = 0.5 * scene.dt, kinematics(scene, driven.state, driven.sizes)
        # Balls are integrated with all that touches them, the ground as well.
        motion, articulations = free(driven, seen, dt, flight)
        rates = _rates(scene, seen, motion, articulations, dt)
        gained = integrate(scene, seen, rates, articulations, candidates.gaps(seen, rates, dt, settings), dt, settings)
        both = BodyMotion(*(own + more for own, more in zip(motion, gained, strict=True)))
        return driven._replace(state=_after(seen, both)), None

    seen = kinematics(scene, begun.state, begun.sizes)
    motion, articulations = free(begun, seen, scene.dt, ball_motion)
    after = _after(seen, motion)
    if scene.pairs:
        rates = _rates(scene, seen, motion, articulations, scene.dt)
        gaps = candidates.gaps(seen, rates, scene.dt, settings)
        near = jnp.min(gaps, axis=0) < settings.margin
        after = _where(near, lambda driven: jax.lax.scan(half, driven, length=2)[0].state, begun, after)
    return jnp.moveaxis(after, -1, 0)


def _where(near: Array, finely: Callable[[Driven], Array], begun: Driven, otherwise: Array) -> Array:
    """Return states (L, 13, B) by `finely` where near (B,), chunk by chunk, and the other states elsewhere."""
    count = near.shape[0]
    # The count may be a symbol: see `jax.export`.
    size = min(CHUNK, count) if isinstance(count, int) and jax.default_backend() == "cpu" else count
    if size == count:
        found = jax.lax.cond(jnp.any(near), finely, lambda driven: driven.state, begun)
        return jnp.where(near, found, otherwise)
    order = jnp.argsort(~near)
    rows = order[np.minimum(np.arange(count + -count % size), count - 1)].reshape(-1, size)

    def chunk(nothing: None, rows: Array) -> tuple[None, Array]:
        own: Driven = jax.tree.map(lambda each: each[..., rows], begun)
        return None, jax.lax.cond(jnp.any(near[rows]), finely, lambda driven: driven.state, own)

    _, chunks = jax.lax.scan(chunk, None, rows)
    found = jnp.moveaxis(chunks, 0, -2).reshape(*otherwise.shape[:2], -1)[..., jnp.argsort(order)]
    return jnp.where(near, found, otherwise)


def _rates(
    scene: Scene, seen: Kinematics, motion: BodyMotion, articulations: dict[str, Articulation], dt: float
) -> Rates:
    """Return the accelerations of all links of a scene, from the motion of its bodies within `dt` [s]."""
    rates = []
    for body in scene.bodies:
        rows = scene.rows(body.name)
        still = jnp.zeros_like(seen.velocity[rows])
        jerks = products = still, still
        if articulation := articulations.get(body.name):
            jerks = articulation.jerk, articulation.angular_jerk
            if body.joints:
                products = velocity_products(body, articulation.anchors, seen.angular_velocity[rows])
        rates.append((*jerks, *products))
    return Rates(
        (motion.velocity - seen.velocity) / dt, (motion.spin - seen.angular_velocity) / dt,
        *(jnp.concatenate(each) for each in zip(*rates, strict=True)),
    )  # fmt: skip


def _after(seen: Kinematics, motion: BodyMotion) -> Array:
    """Return states (L, 13, B) after a motion."""
    return jnp.concatenate(
        [seen.position + motion.moved, rotated(seen.orientation, motion.turned), motion.velocity, motion.spin], axis=1
    )

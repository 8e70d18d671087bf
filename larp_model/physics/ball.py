"""A ball within a step, in the air and on the ground: MuJoCo's law of contact in substeps, each in closed form.

Arrays have the batch last, as in `linalg`: vectors (1, 3, B).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array

from larp_model import state as packed
from larp_model.contact import IMPEDANCE
from larp_model.physics.contact import stuck_or_sliding
from larp_model.physics.motion import BodyMotion, moments
from larp_model.scene import Body

SUBSTEPS = 20


def ball_motion(body: Body, state: Array, outside: Array, sizes: Array, gravity: float, dt: float) -> BodyMotion:
    """Return how a ball in states (1, 13, B) moves on within `dt` [s] if nothing but the ground touches it.

    outside (1, 3, B) [N m], sizes (1, 3, B).
    """
    surface, h = body.surface, dt / SUBSTEPS
    radius, light = sizes[0, 1], 1.0 / sizes[0, 2]
    turns = 1.0 / moments(*(sizes[0, column] for column in range(3)))[0]
    soft = (1.0 - IMPEDANCE) / IMPEDANCE * light  # R of `physics.contact`
    damped = 1.0 - h * surface.damping / IMPEDANCE
    twist = h * turns * outside[0]

    def substep(now: tuple[Array, ...], nothing: None) -> tuple[tuple[Array, ...], None]:
        x, y, z, vx, vy, vz, wx, wy, wz = now
        gap = z - radius
        lever = radius + 0.5 * gap  # contact points are midway between the surfaces
        along, across = light, light + turns * lever**2
        # u_ref - u_free: across, what the lowest point loses by damping; along, what the spring gives as well.
        slip_x, slip_y = vx - lever * wy, vy + lever * wx
        pull_x, pull_y = slip_x * (damped - 1.0) + lever * twist[1], slip_y * (damped - 1.0) - lever * twist[0]
        pull = jnp.sqrt(pull_x**2 + pull_y**2 + 1e-16)
        push = vz * (damped - 1.0) + h * gravity - h * surface.stiffness / IMPEDANCE * gap
        pressing, sideways = stuck_or_sliding(push, pull, along + soft, across + soft, surface.friction)
        normal, share = (jnp.where(gap < 0.0, each, 0.0) for each in (pressing, sideways / pull))
        jx, jy = share * pull_x, share * pull_y
        vx, vy, vz = vx + light * jx, vy + light * jy, vz - h * gravity + light * normal
        wx, wy, wz = wx + twist[0] + turns * lever * jy, wy + twist[1] - turns * lever * jx, wz + twist[2]
        return (x + h * vx, y + h * vy, z + h * vz, vx, vy, vz, wx, wy, wz), None

    position, velocity, spin = (
        state[:, columns] for columns in (packed.POSITION, packed.VELOCITY, packed.ANGULAR_VELOCITY)
    )

    def on_the_ground() -> BodyMotion:
        after, _ = jax.lax.scan(substep, (*position[0], *velocity[0], *spin[0]), length=SUBSTEPS)
        place, moving, turning = (jnp.stack(after[begin : begin + 3])[None] for begin in (0, 3, 6))
        return BodyMotion(moving, turning, place - position, 0.5 * dt * (spin + turning))

    lowest = position[0, 2] - radius + jnp.minimum(dt * velocity[0, 2] - dt**2 * gravity, 0.0)
    return jax.lax.cond(
        jnp.any(lowest < 0.0), on_the_ground, lambda: flight(body, state, outside, sizes, gravity, dt, SUBSTEPS)
    )


def flight(
    body: Body, state: Array, outside: Array, sizes: Array, gravity: float, dt: float, substeps: float = math.inf
) -> BodyMotion:
    """Return `ball_motion` of a ball that nothing touches, as so many substeps have it."""
    velocity, spin = state[:, packed.VELOCITY], state[:, packed.ANGULAR_VELOCITY]
    falling = jnp.array([0.0, 0.0, -gravity], state.dtype)[:, None]
    turns = 1.0 / moments(*(sizes[:, column : column + 1] for column in range(3)))[0]
    turning = spin + dt * turns * outside
    fallen = dt * velocity + 0.5 * dt * (dt + dt / substeps) * falling
    return BodyMotion(velocity + dt * falling, turning, fallen, 0.5 * dt * (spin + turning))

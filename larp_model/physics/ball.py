"""A ball within a step, in the air and on the ground: MuJoCo's law of contact in substeps, each in closed form.

Arrays have the batch last, as in `linalg`: vectors (1, 3, B).
"""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax import Array

from larp_model.physics.contact import IMPEDANCE, stuck_or_sliding
from larp_model.physics.kinematics import Kinematics
from larp_model.physics.motion import BodyMotion, moments
from larp_model.scene import Body

SUBSTEPS = 20


def ball_motion(body: Body, seen: Kinematics, outside: Array, gravity: float, dt: float) -> BodyMotion:
    """Return how a ball moves on within `dt` [s] if nothing but the ground touches it; outside (1, 3, B) [N m]."""
    surface, h = body.surface, dt / SUBSTEPS
    length, radius, mass = seen.sizes[0]
    light, turns, height = 1.0 / mass, 1.0 / moments(length, radius, mass)[0], seen.position[0, 2] - radius
    soft = (1.0 - IMPEDANCE) / IMPEDANCE * light  # R of `physics.contact`
    damped = 1.0 - h * surface.damping / IMPEDANCE
    twist = h * turns * outside[0]

    def substep(now: tuple[Array, ...], nothing: None) -> tuple[tuple[Array, ...], None]:
        x, y, z, vx, vy, vz, wx, wy, wz = now
        gap = height + z
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

    velocity, spin = seen.velocity, seen.angular_velocity

    def on_the_ground() -> BodyMotion:
        still = jnp.zeros_like(velocity[0])
        after, _ = jax.lax.scan(substep, (*still, *velocity[0], *spin[0]), length=SUBSTEPS)
        moved, moving, turning = (jnp.stack(after[begin : begin + 3])[None] for begin in (0, 3, 6))
        return BodyMotion(moving, turning, moved, 0.5 * dt * (spin + turning))

    lowest = height + jnp.minimum(dt * velocity[0, 2] - dt**2 * gravity, 0.0)
    return jax.lax.cond(
        jnp.any(lowest < 0.0), on_the_ground, lambda: flight(body, seen, outside, gravity, dt, SUBSTEPS)
    )


def flight(
    body: Body, seen: Kinematics, outside: Array, gravity: float, dt: float, substeps: float = math.inf
) -> BodyMotion:
    """Return `ball_motion` of a ball that nothing touches, as so many substeps have it."""
    velocity, spin = seen.velocity, seen.angular_velocity
    falling = jnp.array([0.0, 0.0, -gravity], velocity.dtype)[:, None]
    turns = 1.0 / moments(*(seen.sizes[:, column : column + 1] for column in range(3)))[0]
    turning = spin + dt * turns * outside
    fallen = dt * velocity + 0.5 * dt * (dt + dt / substeps) * falling
    return BodyMotion(velocity + dt * falling, turning, fallen, 0.5 * dt * (spin + turning))

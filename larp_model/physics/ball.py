"""A ball within a step, in the air and on the ground: MuJoCo's law of contact in substeps, each in closed form.

Arrays have the batch last, as in `linalg`: vectors (1, 3, B).
"""

from __future__ import annotations

from functools import partial

import jax
import jax.numpy as jnp
from jax import Array

from larp_model.physics.contact import IMPEDANCE, stuck_or_sliding
from larp_model.physics.kinematics import Kinematics
from larp_model.physics.motion import BodyMotion, moments
from larp_model.scene import Body

SUBSTEPS = 20
# Speed [m/s] of a ball below which substeps, in which gravity adds 0.005, do not resolve a bounce.
RESTING = 0.007


@jax.custom_jvp
def timed(impulses: Array, gap: Array, slope: Array) -> Array:
    """Return the impulses (2, B) of a substep; their derivatives are larger by slope (2, B) times those of gaps (B,).

    A ball that comes a moment later is pushed a moment less. Substeps round that moment to whole ones, which their
    derivatives do not see: by them, a ball that bounced five times is a hundred times as sensitive as it is. `slope` is
    what they miss (the saltation matrix: P. Müller, Chaos, Solitons & Fractals 5 (1995), "Calculation of Lyapunov
    exponents for dynamic systems with discontinuities").
    """
    return impulses


@timed.defjvp
def _timed_jvp(primals: tuple[Array, Array, Array], tangents: tuple[Array, Array, Array]) -> tuple[Array, Array]:
    impulses, _, slope = primals
    return impulses, tangents[0] + slope * tangents[1]


def _moment_slope(gap: Array, speed: Array, h: Array | float) -> Array:
    """Return the change (B,) [1/m] by the gap of the time spent on the ground, in substeps of `h` [s].

    It is not 0 where a ball has come or left, at a speed of the gap [m/s], since the substep before.
    """
    crossed = (gap < 0.0) != (gap < h * speed)
    return jnp.where(crossed, -jnp.abs(speed) / (h * (speed**2 + RESTING**2)), 0.0)


def ball_motion(
    body: Body, links: Kinematics, torques: Array, gravity: float, dt: Array | float, on_ground: Array | bool = True
) -> BodyMotion:
    """Return the motion of a ball within `dt` [s] if nothing but the ground touches it; torques (1, 3, B) [N m].

    on_ground: whether the ground does; if not, the ball moves as in the air.
    """
    surface, h = body.surface, dt / SUBSTEPS
    length, radius, mass = links.sizes[0]
    inverse_mass, inverse_moment = 1.0 / mass, 1.0 / moments(length, radius, mass)[0]
    height = links.position[0, 2] - radius
    regularisation = (1.0 - IMPEDANCE) / IMPEDANCE * inverse_mass  # R of `physics.contact`
    damping_factor = 1.0 - h * surface.damping / IMPEDANCE
    angular_gain = h * inverse_moment * torques[0]

    def substep(state: tuple[Array, ...], _: None) -> tuple[tuple[Array, ...], None]:
        x, y, z, vx, vy, vz, wx, wy, wz = state
        gap = height + z
        lever = radius + 0.5 * gap  # contact points are midway between the surfaces
        along, across = inverse_mass, inverse_mass + inverse_moment * lever**2
        # u_ref - u_free: tangential, by damping at the lowest point; normal, by the spring as well.
        slip_x, slip_y = vx - lever * wy, vy + lever * wx
        tangential_x = slip_x * (damping_factor - 1.0) + lever * angular_gain[1]
        tangential_y = slip_y * (damping_factor - 1.0) - lever * angular_gain[0]
        tangential = jnp.sqrt(tangential_x**2 + tangential_y**2 + 1e-16)
        damped = vz * (damping_factor - 1.0) + h * gravity
        admittances = along + regularisation, across + regularisation

        def impulses_at(gap: Array) -> Array:
            normal_change = damped - h * surface.stiffness / IMPEDANCE * gap
            normal_impulse, tangential_impulse = stuck_or_sliding(
                normal_change, tangential, *admittances, surface.friction
            )
            return jnp.stack([normal_impulse, tangential_impulse / tangential])

        touching = impulses_at(jnp.zeros_like(gap))
        normal, share = timed(jnp.where(gap < 0.0, impulses_at(gap), 0.0), gap, _moment_slope(gap, vz, h) * touching)
        jx, jy = share * tangential_x, share * tangential_y
        vx, vy, vz = vx + inverse_mass * jx, vy + inverse_mass * jy, vz - h * gravity + inverse_mass * normal
        wx = wx + angular_gain[0] + inverse_moment * lever * jy
        wy = wy + angular_gain[1] - inverse_moment * lever * jx
        wz = wz + angular_gain[2]
        return (x + h * vx, y + h * vy, z + h * vz, vx, vy, vz, wx, wy, wz), None

    velocity, angular_velocity = links.velocity, links.angular_velocity

    @partial(jax.checkpoint, prevent_cse=False)
    def in_substeps(velocity: Array, angular_velocity: Array) -> BodyMotion:
        zero = jnp.zeros_like(velocity[0])
        after, _ = jax.lax.scan(substep, (*zero, *velocity[0], *angular_velocity[0]), length=SUBSTEPS)
        translation, end_velocity, end_angular_velocity = (
            jnp.stack(after[begin : begin + 3])[None] for begin in (0, 3, 6)
        )
        return BodyMotion(
            end_velocity, end_angular_velocity, translation, 0.5 * dt * (angular_velocity + end_angular_velocity)
        )

    def in_the_air(velocity: Array, angular_velocity: Array) -> BodyMotion:
        gravity_vector = jnp.array([0.0, 0.0, -gravity], velocity.dtype)[:, None]
        end_angular_velocity = angular_velocity + dt * inverse_moment * torques
        # As long as a fall in substeps takes, where the step is one of them.
        square = dt * (dt + jnp.where(on_ground, h, 0.0))
        translation = dt * velocity + 0.5 * square * gravity_vector
        rotation_vector = 0.5 * dt * (angular_velocity + end_angular_velocity)
        return BodyMotion(velocity + dt * gravity_vector, end_angular_velocity, translation, rotation_vector)

    lowest = height + jnp.minimum(dt * velocity[0, 2] - dt**2 * gravity, 0.0)
    touches = on_ground & jnp.any(lowest < 0.0)
    motion: BodyMotion = jax.lax.cond(touches, in_substeps, in_the_air, velocity, angular_velocity)
    return motion

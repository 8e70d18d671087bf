"""Response of an articulated body to impulses: velocities of all its links, of which servos take back a part.

A unit impulse changes the links' velocities by w(t), a time t later. Joints resist at once by their armature alone, and
later by damping and stiffness as well. An implicit step of length T gives

    W(T) = (M + T D + T^2 K)^-1 = integral of w(t) exp(-t / T) dt / T

so that w(t) = W_lasting + W_transient exp(-t / T) is right at once and on average over T.

Arrays have the batch last, as in `linalg`; C impulses are treated side by side, (n, 3, C, B).
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
from jax import Array

from larp_model.linalg import mm
from larp_model.physics.admittance import LinkSystem, admittance
from larp_model.physics.articulated import Momenta, inverse_inertia, packed_inertia
from larp_model.physics.kinematics import motor_scale
from larp_model.physics.motion import Articulation
from larp_model.scene import Body

Arrays = TypeVar("Arrays", Articulation, Array)


class Gains(NamedTuple):
    """Changes (n, 3, C, B) of velocities and angular velocities, per impulse [N s] or angular impulse [N m s]."""

    velocity: Array
    angular_velocity: Array


def responses(
    body: Body, articulation: Articulation, impulses: Momenta, sizes: Array, relaxation_time: float
) -> tuple[Gains, Gains]:
    """Return the lasting and the transient response to impulses (n, 3, C, B) on all links; see the module.

    sizes (n, 3, B). relaxation_time: the module's T [s].
    """
    wrenches = jnp.concatenate([impulses.angular, impulses.linear], axis=1)
    if not body.joints:
        lasting = _gains(mm(packed_inertia(inverse_inertia(articulation.inertia)), wrenches))
        return lasting, Gains(*(jnp.zeros_like(gain) for gain in lasting))
    # W(0) and W(T) side by side.
    doubled = _twice(articulation)
    resistance = jnp.concatenate([_resistance(body, sizes, time) for time in (0.0, relaxation_time)], axis=-1)
    unit = jnp.eye(3, dtype=sizes.dtype)[..., None]
    system = LinkSystem(packed_inertia(doubled.inertia), doubled.anchors, resistance * unit)
    motion = admittance(body, system, _twice(wrenches))
    now, later = jnp.split(motion, 2, axis=-1)
    # W(0) = lasting + transient, W(T) = lasting + transient / 2
    return _gains(2.0 * later - now), _gains(2.0 * (now - later))


def _gains(motion: Array) -> Gains:
    return Gains(motion[:, 3:], motion[:, :3])


def _resistance(body: Body, sizes: Array, time: float) -> Array:
    """Return (n - 1, 1, 1, B) [kg m^2] the angular impulse of joints within a time [s], per angular velocity."""
    scale = motor_scale(body, sizes)
    rows = []
    for joint in body.joints:
        if joint.motor is None:
            rows.append(jnp.full_like(scale, time * joint.damping))
        else:
            motor = joint.motor
            rows.append(scale * (motor.armature + time * motor.damping + time**2 * motor.stiffness))
    return jnp.stack(rows)[:, None, None]


def _twice(arrays: Arrays) -> Arrays:
    """Return arrays (..., B) as (..., 2 B)."""
    doubled: Arrays = jax.tree.map(lambda array: jnp.concatenate([array, array], axis=-1), arrays)
    return doubled

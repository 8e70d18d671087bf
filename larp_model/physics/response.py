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
import numpy as np
from jax import Array

from larp_model.linalg import barrier, cross_columns, mm
from larp_model.physics.articulated import (
    EliminatedJoint,
    Inertia,
    Momenta,
    inverse_inertia,
    inward_pass,
    levels_of,
    packed_inertia,
    shifted_wrench,
    tree,
    with_children,
)
from larp_model.physics.kinematics import Anchors, motor_scale
from larp_model.physics.motion import Articulation
from larp_model.scene import Body

Arrays = TypeVar("Arrays", Articulation, Momenta)


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
    if not body.joints:
        lasting = _gains(body, articulation.anchors, [], inverse_inertia(articulation.inertia), impulses)
        return lasting, Gains(*(jnp.zeros_like(gain) for gain in lasting))
    # W(0) and W(T) side by side.
    doubled = _twice(articulation)
    resistance = jnp.concatenate([_resistance(body, sizes, time) for time in (0.0, relaxation_time)], axis=-1)
    unit = jnp.eye(3, dtype=sizes.dtype)[..., None]
    zero = jnp.zeros_like(doubled.inertia.linear[:, 0])
    levels = levels_of(body, doubled.anchors, zero[1:], zero[1:], resistance * unit)
    root, _, joints = inward_pass(doubled.inertia, Momenta(zero, zero), levels)
    gains = _gains(body, doubled.anchors, joints, inverse_inertia(root), _twice(impulses))
    now, later = (Gains(*gain) for gain in zip(*(jnp.split(gain, 2, axis=-1) for gain in gains), strict=True))
    # W(0) = lasting + transient, W(T) = lasting + transient / 2
    lasting = Gains(*(2.0 * b - a for a, b in zip(now, later, strict=True)))
    return lasting, Gains(*(2.0 * (a - b) for a, b in zip(now, later, strict=True)))


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


def _gains(body: Body, anchors: Anchors, joints: list[EliminatedJoint], root: Inertia, impulses: Momenta) -> Gains:
    """Return the gains of impulses, for joints that `articulated.inward_pass` has eliminated."""
    levels, factors = tree(body), []
    wrenches = jnp.concatenate([impulses.angular, impulses.linear], axis=1)
    from_children, child_parents = wrenches[:0], np.array([], int)
    for (rows, parents), joint in zip(reversed(levels), reversed(joints), strict=True):
        wrench = barrier(with_children(wrenches[rows], rows, from_children, child_parents))
        child, arm = anchors.child[rows - 1], anchors.child[rows - 1] - anchors.parent[rows - 1]
        factored = barrier(mm(joint.inverse_factor, wrench[:, :3] - cross_columns(child, wrench[:, 3:])))
        factors.append(factored)
        reduced = wrench - mm(jnp.swapaxes(joint.factored, 1, 2), factored)
        from_children, child_parents = barrier(shifted_wrench(arm, reduced)), parents
    at_root = with_children(wrenches[:1], np.array([0]), from_children, child_parents)
    motions, order = [mm(packed_inertia(root), at_root)], [np.array([0])]
    for (rows, parents), joint, factored in zip(levels, joints, reversed(factors), strict=True):
        parent_motions = motions[-1][np.searchsorted(order[-1], parents)]
        child, arm = anchors.child[rows - 1], anchors.child[rows - 1] - anchors.parent[rows - 1]
        transported = parent_motions[:, 3:] + cross_columns(arm, parent_motions[:, :3])
        parent_motion = jnp.concatenate([parent_motions[:, :3], transported], axis=1)
        relative = barrier(mm(jnp.swapaxes(joint.inverse_factor, 1, 2), factored) - mm(joint.by_parent, parent_motion))
        velocity = transported + cross_columns(child, relative)
        motions.append(barrier(jnp.concatenate([parent_motions[:, :3] + relative, velocity], axis=1)))
        order.append(rows)
    motion = jnp.concatenate(motions)[np.argsort(np.concatenate(order))]
    return Gains(motion[:, 3:], motion[:, :3])


def _twice(arrays: Arrays) -> Arrays:
    """Return arrays (..., B) as (..., 2 B)."""
    doubled: Arrays = jax.tree.map(lambda array: jnp.concatenate([array, array], axis=-1), arrays)
    return doubled

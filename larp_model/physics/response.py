"""Response of an articulated body to impulses: the velocities of all its links, which servos take back.

What links have gained a time t after a unit impulse is w(t). Joints resist at once by their armature alone, and later
by damping and stiffness as well. An implicit step of length T knows

    W(T) = (M + T D + T^2 K)^-1 = integral of w(t) exp(-t / T) dt / T

so that w(t) = W_kept + W_fading exp(-t / T) is right at once and on average over T.

Arrays have the batch last, as in `linalg`; C impulses are worked on side by side, (n, 3, C, B).
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import barrier, cross_columns, mm
from larp_model.physics.articulated import (
    Inertia,
    Joined,
    Momenta,
    carried_back,
    inverse_inertia,
    inwards,
    levels_of,
    packed_inertia,
    tree,
    with_children,
)
from larp_model.physics.kinematics import Anchors, motor_scale
from larp_model.physics.motion import Articulation
from larp_model.scene import Body

Arrays = TypeVar("Arrays", Articulation, Momenta)


class Gains(NamedTuple):
    """Velocities and spins (n, 3, C, B) that links gain, per impulse [N s] or moment [N m s]."""

    velocity: Array
    spin: Array


def responses(
    body: Body, articulation: Articulation, pushes: Momenta, sizes: Array, fade: float
) -> tuple[Gains, Gains]:
    """Return what links keep and what fades within `fade` [s], of impulses (n, 3, C, B) on all links.

    sizes (n, 3, B). See the module.
    """
    if not body.joints:
        kept = _gained(body, articulation.anchors, [], inverse_inertia(articulation.inertia), pushes)
        return kept, Gains(*(jnp.zeros_like(each) for each in kept))
    # W(0) and W(T) side by side.
    doubled = _twice(articulation)
    resisting = jnp.concatenate([_resistance(body, sizes, after) for after in (0.0, fade)], axis=-1)
    unit = jnp.eye(3, dtype=sizes.dtype)[..., None]
    still = jnp.zeros_like(doubled.inertia.moving[:, 0])
    levels = levels_of(body, doubled.anchors, still[1:], still[1:], resisting * unit)
    whole, _, joints = inwards(doubled.inertia, Momenta(still, still), levels)
    gained = _gained(body, doubled.anchors, joints, inverse_inertia(whole), _twice(pushes))
    now, later = (Gains(*each) for each in zip(*(jnp.split(each, 2, axis=-1) for each in gained), strict=True))
    # W(0) = kept + fading, W(T) = kept + fading / 2
    kept = Gains(*(2.0 * b - a for a, b in zip(now, later, strict=True)))
    return kept, Gains(*(2.0 * (a - b) for a, b in zip(now, later, strict=True)))


def _resistance(body: Body, sizes: Array, after: float) -> Array:
    """Return (n - 1, 1, 1, B) [kg m^2] the moment that joints have taken up after a time [s], per spin."""
    stronger = motor_scale(body, sizes)
    rows = []
    for joint in body.joints:
        if joint.motor is None:
            rows.append(jnp.full_like(stronger, after * joint.damping))
        else:
            motor = joint.motor
            rows.append(stronger * (motor.armature + after * motor.damping + after**2 * motor.stiffness))
    return jnp.stack(rows)[:, None, None]


def _gained(body: Body, anchors: Anchors, joints: list[Joined], root: Inertia, pushes: Momenta) -> Gains:
    """Return what links gain by pushes, the inertias of the tree being known: see `articulated.inwards`."""
    levels, halves = tree(body), []
    every = jnp.concatenate([pushes.turning, pushes.moving], axis=1)
    handed, below = every[:0], np.array([], int)
    for (rows, above), joint in zip(reversed(levels), reversed(joints), strict=True):
        own = barrier(with_children(every[rows], rows, handed, below))
        child, arm = anchors.child[rows - 1], anchors.child[rows - 1] - anchors.parent[rows - 1]
        half = barrier(mm(joint.solved, own[:, :3] - cross_columns(child, own[:, 3:])))
        halves.append(half)
        handed, below = barrier(carried_back(arm, own - mm(jnp.swapaxes(joint.half, 1, 2), half))), above
    at_root = with_children(every[:1], np.array([0]), handed, below)
    motions, order = [mm(packed_inertia(root), at_root)], [np.array([0])]
    for (rows, above), joint, half in zip(levels, joints, reversed(halves), strict=True):
        parent = motions[-1][np.searchsorted(order[-1], above)]
        child, arm = anchors.child[rows - 1], anchors.child[rows - 1] - anchors.parent[rows - 1]
        carried = parent[:, 3:] + cross_columns(arm, parent[:, :3])
        given = jnp.concatenate([parent[:, :3], carried], axis=1)
        relative = barrier(mm(jnp.swapaxes(joint.solved, 1, 2), half) - mm(joint.by_parent, given))
        velocity = carried + cross_columns(child, relative)
        motions.append(barrier(jnp.concatenate([parent[:, :3] + relative, velocity], axis=1)))
        order.append(rows)
    motion = jnp.concatenate(motions)[np.argsort(np.concatenate(order))]
    return Gains(motion[:, 3:], motion[:, :3])


def _twice(arrays: Arrays) -> Arrays:
    """Return arrays (..., B) as (..., 2 B)."""
    doubled: Arrays = jax.tree.map(lambda each: jnp.concatenate([each, each], axis=-1), arrays)
    return doubled

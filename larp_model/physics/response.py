"""Response of an articulated body to impulses: the velocities of all its links, which servos take back.

What links have gained a time t after a unit impulse is w(t). Joints resist at once by their armature alone, and later
by damping and stiffness as well. An implicit step of length T knows

    W(T) = (M + T D + T^2 K)^-1 = integral of w(t) exp(-t / T) dt / T

so that w(t) = W_kept + W_fading exp(-t / T) is right at once and on average over T.

Arrays have the batch last, as in `mechanics`; C impulses are worked on side by side, (n, 3, C, B).
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.kinematics import strength
from larp_model.mechanics import (
    Anchors,
    Articulation,
    Inertia,
    Joined,
    Level,
    Momenta,
    added,
    cross_columns,
    held,
    inverse,
    inwards,
    lower,
    mm,
    tree,
    upper,
)
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
        kept = _gained(body, articulation.tied, [], inverse(articulation.inertia), pushes)
        return kept, Gains(*(jnp.zeros_like(each) for each in kept))
    # W(0) and W(T) side by side.
    doubled = _twice(articulation)
    resisting = jnp.concatenate([_resistance(body, sizes, after) for after in (0.0, fade)], axis=-1)
    unit = jnp.eye(3, dtype=sizes.dtype)[..., None]
    still = jnp.zeros_like(doubled.inertia.moving[:, 0])
    levels = [
        Level(rows, above, *(each[rows - 1] for each in (*doubled.tied, still[1:], still[1:], resisting * unit)))
        for rows, above in tree(body)
    ]
    whole, _, joints = inwards(doubled.inertia, Momenta(still, still), levels)
    root = inverse(Inertia(*(block[:1] for block in whole)))
    gained = _gained(body, doubled.tied, joints, root, _twice(pushes))
    now, later = (Gains(*each) for each in zip(*(jnp.split(each, 2, axis=-1) for each in gained), strict=True))
    # W(0) = kept + fading, W(T) = kept + fading / 2
    kept = Gains(*(2.0 * b - a for a, b in zip(now, later, strict=True)))
    return kept, Gains(*(2.0 * (a - b) for a, b in zip(now, later, strict=True)))


def _resistance(body: Body, sizes: Array, after: float) -> Array:
    """Return (n - 1, 1, 1, B) [kg m^2] the moment that joints have taken up after a time [s], per spin."""
    stronger = strength(body, jnp.moveaxis(sizes, -1, 0))
    rows = []
    for joint in body.joints:
        if joint.motor is None:
            rows.append(jnp.full_like(stronger, after * joint.damping))
        else:
            motor = joint.motor
            rows.append(stronger * (motor.armature + after * motor.damping + after**2 * motor.stiffness))
    return jnp.stack(rows)[:, None, None]


def _gained(body: Body, tied: Anchors, joints: list[Joined], root: Inertia, pushes: Momenta) -> Gains:
    """Return what links gain by pushes, the inertias of the tree being known: see `mechanics.inwards`."""
    levels, alone = tree(body), []
    for (rows, above), joint in zip(reversed(levels), reversed(joints), strict=True):
        own = Momenta(*(each[rows] for each in pushes))
        child, arm = tied.child[rows - 1], tied.child[rows - 1] - tied.parent[rows - 1]
        half = lower(joint.factor, own.turning - cross_columns(child, own.moving))
        alone.append(upper(joint.factor, half))
        moving = own.moving - mm(jnp.swapaxes(joint.half_move, 1, 2), half)
        turning = own.turning - mm(jnp.swapaxes(joint.half_turn, 1, 2), half) - cross_columns(arm, moving)
        pushes = held(Momenta(*(added(a, b, above) for a, b in zip(pushes, Momenta(turning, moving), strict=True))))
    at_root = Momenta(*(each[:1] for each in pushes))
    spin = mm(root.turning, at_root.turning) + mm(root.mixed, at_root.moving)
    velocity = mm(jnp.swapaxes(root.mixed, 1, 2), at_root.turning) + mm(root.moving, at_root.moving)
    known = np.array([0])
    for (rows, above), joint, turned in zip(levels, joints, reversed(alone), strict=True):
        at = np.array([int(np.flatnonzero(known == row)[0]) for row in above])
        child, arm = tied.child[rows - 1], tied.child[rows - 1] - tied.parent[rows - 1]
        carried = velocity[at] + cross_columns(arm, spin[at])
        relative = turned - mm(joint.to_turn, spin[at]) - mm(joint.to_move, carried)
        known = np.concatenate([known, rows])
        velocity = jnp.concatenate([velocity, carried + cross_columns(child, relative)])
        spin = jnp.concatenate([spin, spin[at] + relative])
    order = np.argsort(known)
    return Gains(velocity[order], spin[order])


def _twice(arrays: Arrays) -> Arrays:
    """Return arrays (..., B) as (..., 2 B)."""
    doubled: Arrays = jax.tree.map(lambda each: jnp.concatenate([each, each], axis=-1), arrays)
    return doubled

"""An articulated body and a ball within a time step: what is known before contacts, and where they are after it.

The equations are MuJoCo's, of its semi-implicit Euler rule with implicit damping (`implicitfast`), in the links' own
positions and velocities. Arrays have the batch last, as in `mechanics`: vectors (n, 3, B), matrices (n, 3, 3, B).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import state as packed
from larp_model.compliance import moments
from larp_model.kinematics import strength
from larp_model.mechanics import (
    Anchors,
    Inertia,
    Level,
    Momenta,
    cross,
    inertias,
    local_anchors,
    mv,
    servos,
    tree,
    turn,
    turned_anchors,
    turns,
)
from larp_model.scene import Body


class Free(NamedTuple):
    """The articulated body within a step, without contacts, in the frames of the step's beginning.

    place, orientation, velocity, spin: at the beginning. tied: from links' centres to their joints. inertia, push:
    what is known of the links. levels, undamped: the joints, with and without damping. carried (n - 1, 3, B) [rad/s]:
    what the relative spin gains as its frame turns. drift, drift_turning: what links gain [m/s, rad/s] where neither
    root nor joints accelerate. matrices: rotations.
    """

    place: Array
    orientation: Array
    velocity: Array
    spin: Array
    matrices: Array
    tied: Anchors
    inertia: Inertia
    push: Momenta
    levels: list[Level]
    undamped: list[Level]
    carried: Array
    drift: Array
    drift_turning: Array

    @staticmethod
    def of(body: Body, state: Array, targets: Array, outside: Array, sizes: Array, gravity: float, h: float) -> Free:
        """Return the step of a body in states (n, 13, B), by joint targets (j, 3, B) [rad], torques (n, 3, B) [N m]."""
        place, orientation, velocity, spin = _columns(state)
        matrices, parents = turns(orientation), np.array([joint.parent for joint in body.joints], int)
        inertia = inertias(body, matrices, sizes)
        momentum = mv(inertia.turning, spin)
        falling = velocity + h * jnp.array([0.0, 0.0, -gravity], state.dtype)[:, None]
        push = Momenta(momentum + h * (outside - cross(spin, momentum)), sizes[:, 2:3] * falling)
        stronger = strength(body, jnp.moveaxis(sizes, -1, 0))
        tied = turned_anchors(body, local_anchors(body, sizes), matrices)
        # How the two points of a joint accelerate apart as their links turn.
        closing = h * (
            cross(spin[parents], cross(spin[parents], tied.parent)) - cross(spin[1:], cross(spin[1:], tied.child))
        )
        # Armature and damping act on the relative spin as the child sees it.
        relative = spin[1:] - spin[parents]
        carried = h * cross(spin[1:], relative)
        armature, damping = _resistances(body, stronger)
        pull, _ = servos(body, orientation, matrices, targets, spin, h, stronger)
        pull = pull + (armature + h * damping) * carried
        unit = jnp.broadcast_to(jnp.eye(3, dtype=state.dtype)[..., None], (*relative.shape[:2], *relative.shape[1:]))

        def levels(pull: Array, hold: Array) -> list[Level]:
            given = *tied, closing, pull, hold[:, :, None] * unit
            return [Level(rows, above, *(each[rows - 1] for each in given)) for rows, above in tree(body)]

        drift = _velocity_products(body, tied, closing, carried)
        damped = levels(pull, armature + h * damping)
        undamped = levels(pull - h * damping * (relative + carried), armature)
        return Free(
            place, orientation, velocity, spin, matrices, tied, inertia, push, damped, undamped, carried, *drift
        )  # fmt: skip


class Ball(NamedTuple):
    """The ball within a step, without contacts."""

    place: Array
    orientation: Array
    velocity: Array
    spin: Array
    radius: Array
    inertia: Inertia
    push: Momenta

    @staticmethod
    def of(state: Array, outside: Array, sizes: Array, gravity: float, h: float) -> Ball:
        """Return the step of a ball in states (1, 13, B) under torques (1, 3, B) [N m]."""
        place, orientation, velocity, spin = _columns(state)
        turning, mass = moments(*(sizes[:, column] for column in range(3)))[0][:, None], sizes[:, 2:3]
        unit = jnp.broadcast_to(jnp.eye(3, dtype=state.dtype)[..., None], (1, 3, *spin.shape[1:]))
        falling = velocity + h * jnp.array([0.0, 0.0, -gravity], state.dtype)[:, None]
        inertia = Inertia(turning[:, :, None] * unit, jnp.zeros_like(unit), mass[:, :, None] * unit)
        push = Momenta(turning * spin + h * outside, mass * falling)
        return Ball(place, orientation, velocity, spin, sizes[:, 1:2], inertia, push)


def _velocity_products(body: Body, tied: Anchors, closing: Array, carried: Array) -> tuple[Array, Array]:
    """Return the velocity products: gains (n, 3, B) [m/s] and [rad/s] of links whose root and joints do not accelerate.

    closing, carried: what a joint's points, and the relative spin, gain in the frames of the world.
    """
    velocity = spin = jnp.zeros_like(closing[:1])
    rows = np.array([0])
    for level, above in tree(body):
        known, joint = _places(rows, above), level - 1
        turning = spin[known] + carried[joint]
        carries = velocity[known] + cross(spin[known], tied.parent[joint])
        moving = carries - cross(turning, tied.child[joint]) + closing[joint]
        velocity, spin = jnp.concatenate([velocity, moving]), jnp.concatenate([spin, turning])
        rows = np.concatenate([rows, level])
    order = np.argsort(rows)
    return velocity[order], spin[order]


def moved_on(body: Body, free: Free, velocity: Array, spin: Array, h: float) -> tuple[Array, Array, Array, Array]:
    """Return place, orientation, velocity and spin of all links `h` later, their joints closed.

    velocity, spin: at the end, in the frames of the beginning. As in the engine, root and joints go on with their new
    velocities, each seen from its own frame, and links follow from the root outwards.
    """
    relative = spin[1:] - spin[np.array([joint.parent for joint in body.joints], int)] - free.carried
    rows, turned = np.array([0]), _turned(h * spin[:1])
    places, speeds, spins = free.place[:1] + h * velocity[:1], velocity[:1], spin[:1]
    for level, above in tree(body):
        known, joint = _places(rows, above), level - 1
        before = turns(turned[known])
        after = _times(turned[known], _turned(h * relative[joint]))
        near, far = mv(before, free.tied.parent[joint]), mv(turns(after), free.tied.child[joint])
        turning = spins[known] + mv(before, relative[joint])
        moving = speeds[known] + cross(spins[known], near) - cross(turning, far)
        places = jnp.concatenate([places, places[known] + near - far])
        speeds, spins = jnp.concatenate([speeds, moving]), jnp.concatenate([spins, turning])
        turned, rows = jnp.concatenate([turned, after]), np.concatenate([rows, level])
    order = np.argsort(rows)
    return places[order], _times(turned[order], free.orientation), speeds[order], spins[order]


def _resistances(body: Body, stronger: Array) -> tuple[Array, Array]:
    """Return armature [kg m^2] and damping [N m s/rad] of the joints, (n - 1, 1, B or 1) each."""
    motors = [joint.motor for joint in body.joints]
    armature = jnp.array([[motor.armature if motor else 0.0] for motor in motors])[..., None] * stronger
    damping = jnp.array([[motor.damping if motor else 0.0] for motor in motors])[..., None] * stronger
    return armature, damping + jnp.array([[0.0 if joint.motor else joint.damping] for joint in body.joints])[..., None]


def _columns(state: Array) -> tuple[Array, Array, Array, Array]:
    """Return position, orientation, velocity and spin of states (n, 13, B)."""
    place, orientation, velocity, spin = (
        state[:, columns] for columns in (packed.POSITION, packed.ORIENTATION, packed.VELOCITY, packed.ANGULAR_VELOCITY)
    )
    return place, orientation, velocity, spin


def _places(rows: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    return np.array([int(np.flatnonzero(rows == row)[0]) for row in wanted])


def _turned(rotation_vector: Array) -> Array:
    """Return quaternions (n, 4, B) of small rotation vectors (n, 3, B) [rad]."""
    still = jnp.zeros_like(rotation_vector[:, :1])
    return turn(jnp.concatenate([still + 1.0, still, still, still], axis=1), rotation_vector)


def _times(first: Array, second: Array) -> Array:
    """Return products of quaternions (n, 4, B)."""
    a, u, b, v = first[:, :1], first[:, 1:], second[:, :1], second[:, 1:]
    product = jnp.concatenate([a * b - jnp.sum(u * v, axis=1, keepdims=True), a * v + b * u + cross(u, v)], axis=1)
    return product * jax.lax.rsqrt(jnp.sum(product**2, axis=1, keepdims=True))

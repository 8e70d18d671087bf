"""One step of a body alone: a tree of links on ball joints, their servos, gravity, torque from outside, the ground.

Two stages of length gamma dt make a step of second order that damps what is stiff (R. Alexander, SIAM J. Numerical
Analysis 14 (1977), "SDIRK2"); each solves for the velocities at its end (`articulated`, `ground`). Arrays have the
batch last, as in `linalg`: n links.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import rotation
from larp_model.linalg import barrier, cross, dot, mm, mv, rotated, rotation_matrices
from larp_model.physics.articulated import Inertia, Momenta, tree
from larp_model.physics.ground import Ends, GroundProblem, motion_on_ground
from larp_model.physics.kinematics import Anchors, Kinematics, motor_scale, turned_anchors
from larp_model.scene import Body

GAMMA = 1.0 - math.sqrt(0.5)


@dataclass(frozen=True)
class Constants:
    """Constants of a body's motion that are chosen, not derived.

    closing: share of a joint's displacement that a step takes back (J. Baumgarte, Computer Methods 1 (1972)). standing:
    an end in the ground is held as if by so many times its body's mass. iterations: of Newton's method in which
    the ground's impulses are solved for, at most (`ground`).
    """

    closing: float = 0.2
    standing: float = 3.0
    iterations: int = 3


class BodyMotion(NamedTuple):
    """Motion of a body within a step: (n, 3, B) each, world frame.

    velocity [m/s] and spin [rad/s] at its end; moved [m] and turned [rad] during it.
    """

    velocity: Array
    spin: Array
    moved: Array
    turned: Array


class Articulation(NamedTuple):
    """Inertia of an articulated body's links within a step, the ground's contacts included, and where its joints are.

    jerk, angular_jerk: of the links, (n, 3, B) [m/s^3, rad/s^3].
    """

    inertia: Inertia
    anchors: Anchors
    jerk: Array
    angular_jerk: Array


Carry = tuple[Array, Array, Array, Array]
"""Start of a stage: heights (n, 1, B) and rotation vectors (n, 3, B) gained, velocities and spins (n, 3, B)."""


def articulated_motion(
    body: Body, seen: Kinematics, targets: Array, outside: Array, gravity: float, dt: float,
    constants: Constants = Constants(),
) -> tuple[BodyMotion, Articulation]:  # fmt: skip
    """Return how a body moves on within `dt` [s] if nothing but the ground touches it, and its inertia on the way.

    targets (j, 3, B) of its joints [rad], outside (n, 3, B) [N m] torque. The inertia is that of the first stage.
    """
    h, sizes, local = GAMMA * dt, seen.sizes, seen.local_anchors
    parents = np.array([joint.parent for joint in body.joints], int)
    orientation, velocity, spin = seen.orientation, seen.velocity, seen.angular_velocity
    stronger = motor_scale(body, sizes)
    down = jnp.array([0.0, 0.0, -gravity], velocity.dtype)[:, None]
    closing = -constants.closing / dt * seen.displacement

    def stage(
        raised: Array, turned: Array, velocity: Array, spin: Array
    ) -> tuple[tuple[Array, Array], tuple[Inertia, Anchors]]:
        """Return velocities and spins `h` later of links raised (n, 1, B) [m] and turned (n, 3, B) [rad] before."""
        start = rotated(orientation, turned)
        matrices = rotation_matrices(rotated(start, h * spin))
        inertia = inertias(body, matrices, sizes)
        momentum, mass = mv(inertia.turning, spin), sizes[:, 2:3]
        push = Momenta(momentum + h * (outside - cross(spin, momentum)), mass * (velocity + h * down))
        anchors = turned_anchors(local, matrices, slice(1, None), parents)
        before = rotation_matrices(start)
        pull, hold = servos(body, start, before, targets, spin, h, stronger)
        height = seen.position[:, 2:] + raised
        anchors, pull, hold = barrier((anchors, pull, hold))
        ends = Ends.of(body, before, height, velocity, spin, sizes, h, velocity_products(body, anchors, spin))
        whole = jnp.sum(jnp.broadcast_to(mass, velocity[:, :1].shape), axis=0, keepdims=True)
        problem = GroundProblem(inertia, push, anchors, closing, pull, hold, ends, constants.standing * whole, h)
        motion = motion_on_ground(body, constants.iterations, problem, velocity + h * down, spin)
        on_ground, _ = problem.linear(motion)
        return (motion.velocity, motion.spin), (jax.tree.map(jnp.add, inertia, on_ground), anchors)

    ratio = (1.0 - GAMMA) / GAMMA

    def advance(begun: Carry, nothing: None) -> tuple[Carry, tuple[tuple[Array, Array], tuple[Inertia, Anchors]]]:
        raised, turned, velocity, spin = begun
        after, tree = stage(raised, turned, velocity, spin)
        late = (1.0 - GAMMA) * dt
        goes_on = velocity + ratio * (after[0] - velocity), spin + ratio * (after[1] - spin)
        return (late * after[0][:, 2:], late * after[1], *goes_on), (after, tree)

    still = jnp.zeros_like(spin)
    _, ((velocities, spins), stages) = jax.lax.scan(advance, (still[:, 2:], still, velocity, spin), length=2)
    moved, turned = (dt * ((1.0 - GAMMA) * one + GAMMA * two) for one, two in (velocities, spins))
    inertia, anchors = jax.tree.map(lambda each: each[0], stages)
    # Accelerations k_1 and k_2 at GAMMA and 1 of the step are (1 - GAMMA) k_1 + GAMMA k_2 on average, as if straight.
    jerk, angular_jerk = (
        ((after[1] - before) / dt - (after[0] - before) / h) / (GAMMA * (1.0 - GAMMA) * dt)
        for after, before in ((velocities, velocity), (spins, spin))
    )
    return BodyMotion(velocities[1], spins[1], moved, turned), Articulation(inertia, anchors, jerk, angular_jerk)


def velocity_products(body: Body, anchors: Anchors, spin: Array) -> tuple[Array, Array]:
    """Return accelerations (n, 3, B) [m/s^2] and [rad/s^2] of links whose root and joints do not accelerate.

    MuJoCo leaves them out of a contact's acceleration. anchors: from links' centres to their joints.
    """
    parents = np.array([joint.parent for joint in body.joints], int)
    # How the two points of a joint accelerate apart as their links turn, and the joint's axes with the child.
    closing = cross(spin[parents], cross(spin[parents], anchors.parent))
    closing -= cross(spin[1:], cross(spin[1:], anchors.child))
    carried = cross(spin[1:], spin[1:] - spin[parents])
    velocity = turning = jnp.zeros_like(spin[:1])
    rows = np.array([0])
    for level, above in tree(body):
        known, joint = np.array([int(np.flatnonzero(rows == row)[0]) for row in above]), level - 1
        outer = turning[known] + carried[joint]
        moving = velocity[known] + cross(turning[known], anchors.parent[joint]) - cross(outer, anchors.child[joint])
        velocity, turning = jnp.concatenate([velocity, moving + closing[joint]]), jnp.concatenate([turning, outer])
        rows = np.concatenate([rows, level])
    order = np.argsort(rows)
    return velocity[order], turning[order]


def servos(
    body: Body, orientation: Array, matrices: Array, targets: Array, spin: Array, h: float, stronger: Array
) -> tuple[Array, Array]:
    """Return pull (n - 1, 3, B) and hold (n - 1, 3, 3, B) of all joints within `h` [s]; see `articulated`.

    orientation (n, 4, B) and its matrices (n, 3, 3, B), targets (j, 3, B) [rad], spin (n, 3, B); stronger (B or 1,) is
    `kinematics.motor_scale`. A servo that is at its limit pulls on, and yields.
    """
    links, batch = len(body.links), spin.shape[-1]
    motors, passive = np.zeros((4, links - 1, 1, 1), np.float32), np.zeros((links - 1, 1, 1), np.float32)
    aim, motor_rows = jnp.zeros((links - 1, 3, batch), spin.dtype), []
    for child, joint in enumerate(body.joints):
        motor = joint.motor
        if motor is None:
            passive[child] = joint.damping
        else:
            motors[:, child, 0, 0] = motor.stiffness, motor.torque_limit, motor.armature, motor.damping
            motor_rows.append(child)
    stiffness, limit, armature, damping = stronger * jnp.asarray(motors)
    parents = np.array([joint.parent for joint in body.joints], int)
    matrices = matrices[1:]
    unit = jnp.eye(3, dtype=spin.dtype)[..., None]
    free = armature + h * (damping + passive)
    pull = armature * (spin[1:] - spin[parents])
    if not motor_rows:
        return pull, jnp.broadcast_to(free[:, :, None] * unit, (links - 1, 3, 3, batch))
    aim = aim.at[np.array(motor_rows)].set(targets)
    wanted = stiffness * (aim - angles(orientation[parents], orientation[1:]))
    giving = h**2 * stiffness * (jnp.abs(wanted) < limit)
    hold = mm(matrices * giving[:, None], jnp.swapaxes(matrices, 1, 2)) + free[:, :, None] * unit
    return pull + h * mv(matrices, jnp.clip(wanted, -limit, limit)), hold


def angles(parent: Array, child: Array) -> Array:
    """Return rotation vectors (n, 3, B) [rad] of children against their parents, from their orientations (n, 4, B)."""
    w, v, a, u = parent[:, :1], parent[:, 1:], child[:, :1], child[:, 1:]
    relative = jnp.concatenate([w * a + dot(v, u), w * u - a * v - cross(v, u)], axis=1)
    return jnp.moveaxis(rotation.to_rotation_vector(jnp.moveaxis(relative, 1, -1)), -1, 1)


def moments(length: Array, radius: Array, mass: Array) -> tuple[Array, Array]:
    """Return moments of inertia (*,) [kg m^2] of solid capsules, about their axis and across it."""
    sphere = 4.0 / 3.0 * radius / (length + 4.0 / 3.0 * radius)
    rod, caps = mass * (1.0 - sphere), mass * sphere
    along = (0.5 * rod + 0.4 * caps) * radius**2
    across = rod * (length**2 / 12.0 + radius**2 / 4.0)
    across += caps * (0.4 * radius**2 + length**2 / 4.0 + 0.375 * length * radius)
    return along, across


def inertias(body: Body, matrices: Array, sizes: Array) -> Inertia:
    """Return those of the links alone, in world axes."""
    along, across = moments(sizes[:, 0], sizes[:, 1], sizes[:, 2])
    axes = np.array([link.axis for link in body.links], np.float32)
    axis = mv(matrices, jnp.asarray(axes, matrices.dtype)[..., None])
    outer = axis[:, :, None] * axis[:, None, :]
    unit = jnp.eye(3, dtype=matrices.dtype)[..., None]
    turning = across[:, None, None] * unit + (along - across)[:, None, None] * outer
    moving = jnp.broadcast_to(sizes[:, 2][:, None, None] * unit, turning.shape)
    return Inertia(turning, jnp.zeros_like(turning), moving)

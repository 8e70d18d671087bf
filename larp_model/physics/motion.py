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
from larp_model.linalg import barrier, combined, cross, dot, mm, mv, outer, rotated, rotation_matrices, rows
from larp_model.physics.articulated import Inertia, Momenta
from larp_model.physics.ground import Ends, GroundProblem, motion_on_ground
from larp_model.physics.kinematics import Anchors, Kinematics, motor_scale, turned_anchors
from larp_model.scene import Body

GAMMA = 1.0 - math.sqrt(0.5)


@dataclass(frozen=True)
class Constants:
    """Constants of a body's motion that are chosen, not derived.

    closing: share of a joint's displacement that a step takes back (J. Baumgarte, Computer Methods 1 (1972)). standing:
    regularisation mass of a contact with the ground, in masses of the body. iterations: of Newton's method for the
    ground's impulses, at most (`ground`).
    """

    closing: float = 0.2
    standing: float = 3.0
    iterations: int = 3


class BodyMotion(NamedTuple):
    """Motion of a body within a step: (n, 3, B) each, world frame.

    velocity [m/s] and angular_velocity [rad/s] at its end; translation [m] and rotation_vector [rad] during it.
    """

    velocity: Array
    angular_velocity: Array
    translation: Array
    rotation_vector: Array


class Articulation(NamedTuple):
    """Inertia of an articulated body's links within a step, the ground's contacts included, and where its joints are.

    jerk, angular_jerk: of the links, (n, 3, B) [m/s^3, rad/s^3].
    """

    inertia: Inertia
    anchors: Anchors
    jerk: Array
    angular_jerk: Array


class StageStart(NamedTuple):
    """Start of a stage: rise (n, 1, B) [m] and rotation vector (n, 3, B) [rad] from the step's start, velocities."""

    rise: Array
    rotation_vector: Array
    velocity: Array
    angular_velocity: Array


class StageEnd(NamedTuple):
    """Velocities (n, 3, B) at the end of a stage, and inertia, the ground's contacts included, and anchors there."""

    velocity: Array
    angular_velocity: Array
    inertia: Inertia
    anchors: Anchors


class BodyInputs(NamedTuple):
    """Inputs of both stages of a step: see `articulated_motion`.

    gravity: (3, 1) [m/s^2]. scale: see `motor_scale`. closing: of the joints, see `articulated.Level`.
    """

    links: Kinematics
    targets: Array
    torques: Array
    gravity: Array
    scale: Array
    closing: Array


def articulated_motion(
    body: Body, links: Kinematics, targets: Array, torques: Array, gravity: float, dt: Array | float,
    constants: Constants = Constants(),
) -> tuple[BodyMotion, Articulation]:  # fmt: skip
    """Return the motion of a body within `dt` [s] if nothing but the ground touches it, and its inertia meanwhile.

    targets (j, 3, B) of its joints [rad], torques (n, 3, B) [N m], external. The inertia is that of the first stage.
    """
    h, remaining_time = GAMMA * dt, (1.0 - GAMMA) * dt
    velocity, angular_velocity = links.velocity, links.angular_velocity
    scale = motor_scale(body, links.sizes)
    down = jnp.array([0.0, 0.0, -gravity], velocity.dtype)[:, None]
    inputs = BodyInputs(links, targets, torques, down, scale, -constants.closing / dt * links.displacement)
    ratio = (1.0 - GAMMA) / GAMMA

    def advance(start: StageStart, _: None) -> tuple[StageStart, StageEnd]:
        end = _stage(body, constants, inputs, start, h)
        extrapolated = (
            start.velocity + ratio * (end.velocity - start.velocity),
            start.angular_velocity + ratio * (end.angular_velocity - start.angular_velocity),
        )
        rise, rotation_vector = remaining_time * end.velocity[:, 2:], remaining_time * end.angular_velocity
        return StageStart(rise, rotation_vector, *extrapolated), end

    zero = jnp.zeros_like(angular_velocity)
    first = StageStart(zero[:, 2:], zero, velocity, angular_velocity)
    _, (velocities, angular_velocities, stage_inertias, stage_anchors) = jax.lax.scan(advance, first, length=2)
    translation, rotation_vector = (
        dt * ((1.0 - GAMMA) * one + GAMMA * two) for one, two in (velocities, angular_velocities)
    )
    # Accelerations k_1 and k_2 at GAMMA and 1 of the step are (1 - GAMMA) k_1 + GAMMA k_2 on average, as if straight.
    jerk, angular_jerk = (
        ((after[1] - before) / dt - (after[0] - before) / h) / (GAMMA * (1.0 - GAMMA) * dt)
        for after, before in ((velocities, velocity), (angular_velocities, angular_velocity))
    )
    motion = BodyMotion(velocities[1], angular_velocities[1], translation, rotation_vector)
    inertia, anchors = jax.tree.map(lambda values: values[0], (stage_inertias, stage_anchors))
    return motion, Articulation(inertia, anchors, jerk, angular_jerk)


def _stage(body: Body, constants: Constants, inputs: BodyInputs, start: StageStart, h: Array | float) -> StageEnd:
    """Return the end of a stage of `h` [s]."""
    links, targets, torques, gravity, scale, closing = inputs
    velocity, angular_velocity, sizes = start.velocity, start.angular_velocity, links.sizes
    parents = body.parents
    orientation = rotated(links.orientation, start.rotation_vector)
    end_matrices = rotation_matrices(rotated(orientation, h * angular_velocity))
    matrices = rotation_matrices(orientation)
    inertia = inertias(body, end_matrices, sizes)
    momentum, mass = mv(inertia.angular, angular_velocity), sizes[:, 2:3]
    turning = precessing(body, matrices, sizes, angular_velocity, h)
    gyroscopic = cross(turning, mv(inertia.angular, turning))
    momenta = Momenta(momentum + h * (torques - gyroscopic), mass * (velocity + h * gravity))
    anchors = turned_anchors(links.local_anchors, end_matrices, np.arange(1, len(body.links)), parents)
    impulse, resistance = servos(body, orientation, matrices, targets, angular_velocity, h, scale)
    height = links.position[:, 2:] + start.rise
    anchors, impulse, resistance = barrier((anchors, impulse, resistance))
    products = velocity_products(body, anchors, angular_velocity)
    ends = Ends.of(body, matrices, height, velocity, angular_velocity, sizes, h, products)
    total_mass = jnp.sum(jnp.broadcast_to(mass, velocity[:, :1].shape), axis=0, keepdims=True)
    problem = GroundProblem(
        inertia, momenta, anchors, closing, impulse, resistance, ends, constants.standing * total_mass, h
    )
    motion = motion_on_ground(body, constants.iterations, problem, velocity + h * gravity, angular_velocity)
    ground_inertia, _ = problem.linear(motion)
    total_inertia = jax.tree.map(jnp.add, inertia, ground_inertia)
    return StageEnd(motion.velocity, motion.angular_velocity, total_inertia, anchors)


def precessing(body: Body, matrices: Array, sizes: Array, angular_velocity: Array, h: Array | float) -> Array:
    """Return the angular velocities (n, 3, B) [rad/s] of links after `h` [s] in which nothing acts on them.

    A capsule is a symmetric top, which precesses about its angular momentum. Gyroscopic torques at the start of a stage
    would add energy to it, those at its end do not. matrices: (n, 3, 3, B), of the orientations.
    """
    along, across = moments(sizes[:, 0], sizes[:, 1], sizes[:, 2])
    axis = axes_of(body, matrices)
    share = ((along - across) / across)[:, None] * dot(axis, angular_velocity)
    return angular_velocity + h * share * cross(axis, angular_velocity)


def velocity_products(body: Body, anchors: Anchors, angular_velocity: Array) -> tuple[Array, Array]:
    """Return accelerations (n, 3, B) [m/s^2] and [rad/s^2] of links whose root and joints do not accelerate.

    MuJoCo leaves them out of a contact's acceleration. anchors: from links' centres to their joints.
    """
    child_turning, parent_turning = angular_velocity[1:], rows(angular_velocity, body.parents)
    # Relative acceleration of the two points of a joint as their links turn, and of the joint's axes with the child.
    separation = cross(parent_turning, cross(parent_turning, anchors.parent))
    separation -= cross(child_turning, cross(child_turning, anchors.child))
    relative = cross(child_turning, child_turning - parent_turning)
    # Both add up along the joints to the root.
    angular = combined(body.ancestors, relative)
    separation += cross(rows(angular, body.parents), anchors.parent) - cross(angular[1:], anchors.child)
    return combined(body.ancestors, separation), angular


def servos(
    body: Body,
    orientation: Array,
    matrices: Array,
    targets: Array,
    angular_velocity: Array,
    h: Array | float,
    scale: Array,
) -> tuple[Array, Array]:
    """Return impulse (n - 1, 3, B) and resistance (n - 1, 3, 3, B) of all joints within `h` [s]; see `articulated`.

    orientation (n, 4, B) and its matrices (n, 3, 3, B), targets (j, 3, B) [rad], angular_velocity (n, 3, B); scale
    (B or 1,) is `kinematics.motor_scale`. A servo at its torque limit has no stiffness.
    """
    links, batch = len(body.links), angular_velocity.shape[-1]
    motors, passive = np.zeros((4, links - 1, 1, 1), np.float32), np.zeros((links - 1, 1, 1), np.float32)
    padded_targets, motor_rows = jnp.zeros((links - 1, 3, batch), angular_velocity.dtype), []
    for child, joint in enumerate(body.joints):
        motor = joint.motor
        if motor is None:
            passive[child] = joint.damping
        else:
            motors[:, child, 0, 0] = motor.stiffness, motor.torque_limit, motor.armature, motor.damping
            motor_rows.append(child)
    stiffness, limit, armature, damping = scale * jnp.asarray(motors)
    parents = body.parents
    matrices = matrices[1:]
    unit = jnp.eye(3, dtype=angular_velocity.dtype)[..., None]
    damping_and_armature = armature + h * (damping + passive)
    impulse = armature * (angular_velocity[1:] - rows(angular_velocity, parents))
    if not motor_rows:
        return impulse, jnp.broadcast_to(damping_and_armature[:, :, None] * unit, (links - 1, 3, 3, batch))
    padded_targets = padded_targets.at[np.array(motor_rows)].set(targets)
    torque = stiffness * (padded_targets - angles(rows(orientation, parents), orientation[1:]))
    spring = h**2 * stiffness * (jnp.abs(torque) < limit)
    resistance = mm(matrices * spring[:, None], jnp.swapaxes(matrices, 1, 2)) + damping_and_armature[:, :, None] * unit
    return impulse + h * mv(matrices, jnp.clip(torque, -limit, limit)), resistance


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


def axes_of(body: Body, matrices: Array) -> Array:
    """Return the axes (n, 3, B) of the links' capsules in world axes, by rotations (n, 3, 3, B)."""
    axes = np.array([link.axis for link in body.links], np.float32)
    return mv(matrices, jnp.asarray(axes, matrices.dtype)[..., None])


def inertias(body: Body, matrices: Array, sizes: Array) -> Inertia:
    """Return the inertias of the links alone, in world axes."""
    along, across = moments(sizes[:, 0], sizes[:, 1], sizes[:, 2])
    axis = axes_of(body, matrices)
    unit = jnp.eye(3, dtype=matrices.dtype)[..., None]
    angular = across[:, None, None] * unit + (along - across)[:, None, None] * outer(axis, axis)
    linear = jnp.broadcast_to(sizes[:, 2][:, None, None] * unit, angular.shape)
    return Inertia(angular, jnp.zeros_like(angular), linear)

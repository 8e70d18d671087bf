"""The articulated-body algorithm: velocities of a tree of links on ball joints with servos.

The equations are those of R. Featherstone (Rigid Body Dynamics Algorithms (2008), 7.3), with velocities at the end of a
time h instead of accelerations as unknowns, so that servos and damping are implicit:

    A_i V_i' = P_i + W_i                        link i of momenta P_i, under the impulse W_i of its joint
    V_i' = X_i V_p' + S_i y_i + c_i             its joint lets it turn against its parent p, by y_i [rad/s]
    S_i^T W_i = T_i - G_i y_i                   its servo's impulse and resistance: G = h D + h^2 K + armature

Arrays have the batch last, as in `linalg`: n links of one level of the tree.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import barrier, cross, cross_columns, cross_rows, inverse, inverse_cholesky, mm, mv
from larp_model.physics.kinematics import Anchors
from larp_model.scene import Body


class Inertia(NamedTuple):
    """Symmetric matrices (n, 6, 6, B) from angular velocities and velocities to momenta, in blocks (n, 3, 3, B)."""

    angular: Array
    coupling: Array
    linear: Array


class Momenta(NamedTuple):
    """Angular and linear momenta (n, 3, B)."""

    angular: Array
    linear: Array


class Level(NamedTuple):
    """Links at the same depth of the tree, and their joints with their parents.

    rows, parents (n,): in the body. Batch last: child, parent (n, 3, B) [m] from the links' centres to the joint;
    closing (n, 3, B) [m/s]: the equations' c. impulse (n, 3, B), resistance (n, 3, 3, B): their T and G.
    """

    rows: np.ndarray
    parents: np.ndarray
    child: Array
    parent: Array
    closing: Array
    impulse: Array
    resistance: Array


class EliminatedJoint(NamedTuple):
    """A level's joints, whose angular velocities are relative_velocity (n, 3, B) [rad/s] less by_parent (n, 3, 6, B) V.

    V: angular velocity and velocity of the child's centre if it moved with its parent. inverse_factor (n, 3, 3, B):
    L^-1, of the lower triangle L in L L' = S' A S + G. factored (n, 3, 6, B): L^-1 S' A. by_parent: L'^-1 of that.
    """

    relative_velocity: Array
    by_parent: Array
    factored: Array
    inverse_factor: Array


def tree(body: Body) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return rows of links and of their parents, level by level from the root's children outwards."""
    depth = [0]
    for joint in body.joints:
        depth.append(depth[joint.parent] + 1)
    levels = []
    for level in range(1, max(depth) + 1):
        rows = np.flatnonzero(np.array(depth) == level)
        levels.append((rows, np.array([body.joints[row - 1].parent for row in rows])))
    return levels


def levels_of(body: Body, anchors: Anchors, closing: Array, impulse: Array, resistance: Array) -> list[Level]:
    """Return the levels of a body from the root outwards, from values of all its joints (n - 1, ...); see `Level`."""
    joints = (*anchors, closing, impulse, resistance)
    return [Level(rows, parents, *(values[rows - 1] for values in joints)) for rows, parents in tree(body)]


def solve(inertia: Inertia, momenta: Momenta, levels: list[Level]) -> tuple[Array, Array]:
    """Return velocities and angular velocities (n, 3, B) of links of these momenta under their joints' impulses."""
    inertia, momenta, joints = inward_pass(inertia, momenta, levels)
    motions, order = [jnp.concatenate(_root(inertia, momenta), axis=1)], [np.array([0])]
    for level, joint in zip(levels, joints, strict=True):
        parent_motion = motions[-1][np.searchsorted(order[-1], level.parents)]
        transported = parent_motion[:, 3:] + cross(level.child - level.parent, parent_motion[:, :3])
        relative = joint.relative_velocity - mv(
            joint.by_parent, jnp.concatenate([parent_motion[:, :3], transported], axis=1)
        )
        velocity = transported + cross(level.child, relative) + level.closing
        motions.append(barrier(jnp.concatenate([parent_motion[:, :3] + relative, velocity], axis=1)))
        order.append(level.rows)
    motion = jnp.concatenate(motions)[np.argsort(np.concatenate(order))]
    return motion[:, 3:], motion[:, :3]


def inward_pass(
    inertia: Inertia, momenta: Momenta, levels: list[Level]
) -> tuple[Inertia, Momenta, list[EliminatedJoint]]:
    """Return the articulated-body inertia and momenta (1, ...) of the root, and the joints of the levels.

    Inertia and momenta of a link are the columns of one matrix (n, 6, 7, B), whose every operation is one loop.
    """
    augmented = jnp.concatenate(
        [packed_inertia(inertia), jnp.concatenate([momenta.angular, momenta.linear], 1)[:, :, None]], 2
    )
    eliminated, from_children, child_parents = [], augmented[:0], np.array([], int)
    for level in reversed(levels):
        link = barrier(with_children(augmented[level.rows], level.rows, from_children, child_parents))
        child, arm = level.child, level.child - level.parent
        # A S, and S' A S + G
        along = link[:, :, :3] + cross_rows(link[:, :, 3:6], child)
        factor = inverse_cholesky(along[:, :3] - cross_columns(child, along[:, 3:]) + level.resistance)
        momentum = link[:, :, 6] - mv(link[:, :, 3:6], level.closing)
        impulse = level.impulse + momentum[:, :3] - cross(child, momentum[:, 3:])
        # L^-1 (S' A), with which A - A S (L L')^-1 S' A stays positive in 32 bits, also of light links on stiff joints
        factored = barrier(mm(factor, jnp.concatenate([jnp.swapaxes(along, 1, 2), impulse[:, :, None]], axis=2)))
        relative = mm(jnp.swapaxes(factor, 1, 2), factored)
        eliminated.append(EliminatedJoint(relative[:, :, 6], relative[:, :, :6], factored[:, :, :6], factor))
        # What the joint passes on: A - A S (S' A S + G)^-1 S' A, about the parent's centre
        own_columns = jnp.concatenate([link[:, :, :6], momentum[:, :, None]], axis=2)
        reduced = barrier(own_columns - mm(jnp.swapaxes(factored[:, :, :6], 1, 2), factored))
        shifted = shifted_wrench(arm, reduced)
        at_parent = shifted[:, :, :3] + cross_rows(shifted[:, :, 3:6], arm)
        from_children, child_parents = barrier(jnp.concatenate([at_parent, shifted[:, :, 3:]], axis=2)), level.parents
    root = with_children(augmented[:1], np.array([0]), from_children, child_parents)
    root_inertia = Inertia(root[:, :3, :3], root[:, :3, 3:6], root[:, 3:, 3:6])
    return root_inertia, Momenta(root[:, :3, 6], root[:, 3:, 6]), eliminated[::-1]


def _root(inertia: Inertia, momenta: Momenta) -> tuple[Array, Array]:
    """Return angular velocity and velocity (1, 3, B) of the root, by the Schur complement of its linear block."""
    inverse_mass = inverse(inertia.linear)
    lever = mm(inertia.coupling, inverse_mass)
    angular_velocity = mv(
        inverse(inertia.angular - mm(lever, jnp.swapaxes(inertia.coupling, 1, 2))),
        momenta.angular - mv(lever, momenta.linear),
    )
    return angular_velocity, mv(
        inverse_mass, momenta.linear - mv(jnp.swapaxes(inertia.coupling, 1, 2), angular_velocity)
    )


def packed_inertia(inertia: Inertia) -> Array:
    """Return inertias (n, 6, 6, B) by their blocks."""
    coupling = jnp.swapaxes(inertia.coupling, 1, 2)
    upper_rows = jnp.concatenate([inertia.angular, inertia.coupling], axis=2)
    return jnp.concatenate([upper_rows, jnp.concatenate([coupling, inertia.linear], axis=2)], axis=1)


def inverse_inertia(inertia: Inertia) -> Inertia:
    """Return the matrices from momenta to angular velocities and velocities."""
    inverse_mass = inverse(inertia.linear)
    lever = mm(inertia.coupling, inverse_mass)
    angular = inverse(inertia.angular - mm(lever, jnp.swapaxes(inertia.coupling, 1, 2)))
    coupling = -mm(angular, lever)
    return Inertia(angular, coupling, inverse_mass - mm(jnp.swapaxes(lever, 1, 2), coupling))


def with_children(total: Array, rows: np.ndarray, from_children: Array, parents: np.ndarray) -> Array:
    """Return the values (n, ...) of links in these rows, plus those passed on by children (m, ...) of these parents."""
    children = [np.flatnonzero(parents == row) for row in rows]
    from_children = jnp.concatenate([from_children, jnp.zeros_like(total[:1])])
    for number in range(max(map(len, children), default=0)):
        row_of_child = [child_rows[number] if number < len(child_rows) else len(parents) for child_rows in children]
        total = total + from_children[np.array(row_of_child)]
    return total


def shifted_wrench(arm: Array, wrench: Array) -> Array:
    """Return moments and forces (n, 6, k, B) about the point from which their own is `arm` (n, 3, B) away."""
    return jnp.concatenate([wrench[:, :3] - cross_columns(arm, wrench[:, 3:]), wrench[:, 3:]], axis=1)

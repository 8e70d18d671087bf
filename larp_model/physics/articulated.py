"""The articulated-body algorithm: velocities of a tree of links on ball joints, whose servos pull.

The equations are those of R. Featherstone (Rigid Body Dynamics Algorithms (2008), 7.3), with velocities at the end of a
time h instead of accelerations as unknowns, so that servos and damping are implicit:

    A_i V_i' = P_i + W_i                        link i, under the impulse W_i of its joint
    V_i' = X_i V_p' + S_i y_i + c_i             its joint lets it turn against its parent p, by y_i [rad/s]
    S_i^T W_i = T_i - G_i y_i                   and pulls: G = h D + h^2 K + armature

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
    """Symmetric matrices (n, 6, 6, B) from spins and velocities to their momenta, in blocks (n, 3, 3, B)."""

    turning: Array
    mixed: Array
    moving: Array


class Momenta(NamedTuple):
    """Momenta (n, 3, B) of turning and of moving."""

    turning: Array
    moving: Array


class Level(NamedTuple):
    """Links as far from the root as each other, and the joints that tie them to their parents.

    rows, parents (n,): in the body. Batch last: child, parent (n, 3, B) [m] from the links' centres to the joint;
    closing (n, 3, B) [m/s]; pull (n, 3, B) and hold (n, 3, 3, B) are the equations' T and G.
    """

    rows: np.ndarray
    parents: np.ndarray
    child: Array
    parent: Array
    closing: Array
    pull: Array
    hold: Array


class Joined(NamedTuple):
    """A level's joints: spins (n, 3, B) [rad/s] that pushes give them alone, and what their parents' motion takes off.

    solved: L^-1 (n, 3, 3, B), of the lower triangle L in L L' = S' A S + G. half (n, 3, 6, B): L^-1 S' A. by_parent
    (n, 3, 6, B): L'^-1 of that, spin per spin and velocity that the parent gives its child's centre.
    """

    turned: Array
    by_parent: Array
    half: Array
    solved: Array


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


def levels_of(body: Body, anchors: Anchors, closing: Array, pull: Array, hold: Array) -> list[Level]:
    """Return the levels of a body from the root outwards, of what all its joints (n - 1, ...) have; see `Level`."""
    joints = (*anchors, closing, pull, hold)
    return [Level(rows, parents, *(each[rows - 1] for each in joints)) for rows, parents in tree(body)]


def solve(inertia: Inertia, push: Momenta, levels: list[Level]) -> tuple[Array, Array]:
    """Return velocities and spins (n, 3, B) with which links part under their pushes and their joints' impulses."""
    inertia, push, joints = inwards(inertia, push, levels)
    motions, order = [jnp.concatenate(_root(inertia, push), axis=1)], [np.array([0])]
    for level, joint in zip(levels, joints, strict=True):
        above = motions[-1][np.searchsorted(order[-1], level.parents)]
        carried = above[:, 3:] + cross(level.child - level.parent, above[:, :3])
        relative = joint.turned - mv(joint.by_parent, jnp.concatenate([above[:, :3], carried], axis=1))
        velocity = carried + cross(level.child, relative) + level.closing
        motions.append(barrier(jnp.concatenate([above[:, :3] + relative, velocity], axis=1)))
        order.append(level.rows)
    motion = jnp.concatenate(motions)[np.argsort(np.concatenate(order))]
    return motion[:, 3:], motion[:, :3]


def inwards(inertia: Inertia, push: Momenta, levels: list[Level]) -> tuple[Inertia, Momenta, list[Joined]]:
    """Return inertia and push (1, ...) of the root with all that hangs on it, and the joints of the levels.

    Inertia and push of a link are the columns of one matrix (n, 6, 7, B), whose every operation is one loop.
    """
    every = jnp.concatenate([packed_inertia(inertia), jnp.concatenate([push.turning, push.moving], 1)[:, :, None]], 2)
    passed, handed, below = [], every[:0], np.array([], int)
    for level in reversed(levels):
        own = barrier(with_children(every[level.rows], level.rows, handed, below))
        child, arm = level.child, level.child - level.parent
        # A S, and S' A S + G
        along = own[:, :, :3] + cross_rows(own[:, :, 3:6], child)
        factor = inverse_cholesky(along[:, :3] - cross_columns(child, along[:, 3:]) + level.hold)
        moved = own[:, :, 6] - mv(own[:, :, 3:6], level.closing)
        pull = level.pull + moved[:, :3] - cross(child, moved[:, 3:])
        # L^-1 (S' A), with which A - A S (L L')^-1 S' A stays positive in 32 bits, however light a link is held
        half = barrier(mm(factor, jnp.concatenate([jnp.swapaxes(along, 1, 2), pull[:, :, None]], axis=2)))
        relative = mm(jnp.swapaxes(factor, 1, 2), half)
        passed.append(Joined(relative[:, :, 6], relative[:, :, :6], half[:, :, :6], factor))
        # What the joint hands on: A - A S (S' A S + G)^-1 S' A, seen from the parent's centre
        kept = jnp.concatenate([own[:, :, :6], moved[:, :, None]], axis=2)
        left = barrier(kept - mm(jnp.swapaxes(half[:, :, :6], 1, 2), half))
        shifted = carried_back(arm, left)
        seen_there = shifted[:, :, :3] + cross_rows(shifted[:, :, 3:6], arm)
        handed, below = barrier(jnp.concatenate([seen_there, shifted[:, :, 3:]], axis=2)), level.parents
    root = with_children(every[:1], np.array([0]), handed, below)
    whole = Inertia(root[:, :3, :3], root[:, :3, 3:6], root[:, 3:, 3:6])
    return whole, Momenta(root[:, :3, 6], root[:, 3:, 6]), passed[::-1]


def _root(inertia: Inertia, push: Momenta) -> tuple[Array, Array]:
    """Return spin and velocity (1, 3, B) of a link without a parent, by the Schur complement of what moves."""
    still = inverse(inertia.moving)
    lever = mm(inertia.mixed, still)
    spin = mv(
        inverse(inertia.turning - mm(lever, jnp.swapaxes(inertia.mixed, 1, 2))), push.turning - mv(lever, push.moving)
    )
    return spin, mv(still, push.moving - mv(jnp.swapaxes(inertia.mixed, 1, 2), spin))


def packed_inertia(inertia: Inertia) -> Array:
    """Return inertias (n, 6, 6, B) by their blocks."""
    mixed = jnp.swapaxes(inertia.mixed, 1, 2)
    upper_rows = jnp.concatenate([inertia.turning, inertia.mixed], axis=2)
    return jnp.concatenate([upper_rows, jnp.concatenate([mixed, inertia.moving], axis=2)], axis=1)


def inverse_inertia(inertia: Inertia) -> Inertia:
    """Return the matrices from momenta to spins and velocities."""
    still = inverse(inertia.moving)
    lever = mm(inertia.mixed, still)
    turning = inverse(inertia.turning - mm(lever, jnp.swapaxes(inertia.mixed, 1, 2)))
    mixed = -mm(turning, lever)
    return Inertia(turning, mixed, still - mm(jnp.swapaxes(lever, 1, 2), mixed))


def with_children(own: Array, rows: np.ndarray, handed: Array, parents: np.ndarray) -> Array:
    """Return links (n, ...) in these rows of a body with what their children (m, ...), of these parents, hand on."""
    children = [np.flatnonzero(parents == row) for row in rows]
    handed = jnp.concatenate([handed, jnp.zeros_like(own[:1])])
    for number in range(max(map(len, children), default=0)):
        chosen = [each[number] if number < len(each) else len(parents) for each in children]
        own = own + handed[np.array(chosen)]
    return own


def carried_back(arm: Array, wrench: Array) -> Array:
    """Return moments and forces (n, 6, k, B) about the point that is `arm` (n, 3, B) away from the given ones'."""
    return jnp.concatenate([wrench[:, :3] - cross_columns(arm, wrench[:, 3:]), wrench[:, 3:]], axis=1)

"""Admittance of an articulated body, and derivatives of its motion by the equations that the motion solves.

Links of motions V (angular velocity and velocity) and joints of impulses f obey, with the inertia A of the links, their
wrenches W, and the matrix C of the relative velocities of the joints' two points,

    A V + D' G D V - C' f = W        D V: the joints' angular velocities, G: their resistance
    C V = c                          c: closing velocities of the joints

The matrix is symmetric, so that its derivatives need no pass through the algorithm that solves it: dV is the solution
for the tangents of both sides at fixed V and f, and in reverse mode the same solution for the cotangents of V.

Arrays have the batch last, as in `linalg`: n links, C columns of wrenches treated side by side, (n, 6, C, B).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import barrier, combined, cross_columns, mm
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
from larp_model.physics.kinematics import Anchors
from larp_model.scene import Body


class LinkSystem(NamedTuple):
    """The module's matrix: A (n, 6, 6, B), anchors of the joints, and their resistance G (n - 1, 3, 3, B)."""

    inertia: Array
    anchors: Anchors
    resistance: Array


class LinkEquations(NamedTuple):
    """The module's equations: the matrix, wrenches W (n, 6, C, B) and closing velocities c (n - 1, 3, C, B)."""

    system: LinkSystem
    wrenches: Array
    closing: Array


class Elimination(NamedTuple):
    """Joints that `articulated.inward_pass` has eliminated, by levels, and the inverse inertia of the root."""

    joints: list[EliminatedJoint]
    root: Inertia


def eliminated(body: Body, system: LinkSystem) -> Elimination:
    """Return a body's system, solved for all but its right-hand sides."""
    blocks = system.inertia
    inertia = Inertia(blocks[:, :3, :3], blocks[:, :3, 3:], blocks[:, 3:, 3:])
    zero = jnp.zeros_like(blocks[:, 0, :3])
    levels = levels_of(body, system.anchors, zero[1:], zero[1:], system.resistance)
    root, _, joints = inward_pass(inertia, Momenta(zero, zero), levels)
    return Elimination(joints, inverse_inertia(root))


def motions(body: Body, anchors: Anchors, elimination: Elimination, wrenches: Array) -> Array:
    """Return the motions (n, 6, C, B) by wrenches (n, 6, C, B), of joints that do not close."""
    levels, factors = tree(body), []
    from_children, child_parents = wrenches[:0], np.array([], int)
    for (rows, parents), joint in zip(reversed(levels), reversed(elimination.joints), strict=True):
        wrench = barrier(with_children(wrenches[rows], rows, from_children, child_parents))
        child, arm = anchors.child[rows - 1], anchors.child[rows - 1] - anchors.parent[rows - 1]
        factored = barrier(mm(joint.inverse_factor, wrench[:, :3] - cross_columns(child, wrench[:, 3:])))
        factors.append(factored)
        reduced = wrench - mm(jnp.swapaxes(joint.factored, 1, 2), factored)
        from_children, child_parents = barrier(shifted_wrench(arm, reduced)), parents
    at_root = with_children(wrenches[:1], np.array([0]), from_children, child_parents)
    by_level, order = [mm(packed_inertia(elimination.root), at_root)], [np.array([0])]
    for (rows, parents), joint, factored in zip(levels, elimination.joints, reversed(factors), strict=True):
        parent_motions = by_level[-1][np.searchsorted(order[-1], parents)]
        child, arm = anchors.child[rows - 1], anchors.child[rows - 1] - anchors.parent[rows - 1]
        transported = parent_motions[:, 3:] + cross_columns(arm, parent_motions[:, :3])
        parent_motion = jnp.concatenate([parent_motions[:, :3], transported], axis=1)
        relative = barrier(mm(jnp.swapaxes(joint.inverse_factor, 1, 2), factored) - mm(joint.by_parent, parent_motion))
        velocity = transported + cross_columns(child, relative)
        by_level.append(barrier(jnp.concatenate([parent_motions[:, :3] + relative, velocity], axis=1)))
        order.append(rows)
    return jnp.concatenate(by_level)[np.argsort(np.concatenate(order))]


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def admittance(body: Body, system: LinkSystem, wrenches: Array) -> Array:
    """Return the motions (n, 6, C, B) of a body's links by wrenches (n, 6, C, B)."""
    return motions(body, system.anchors, eliminated(body, system), wrenches)


@admittance.defjvp
def _admittance_jvp(
    body: Body, primals: tuple[LinkSystem, Array], tangents: tuple[LinkSystem, Array]
) -> tuple[Array, Array]:
    system, wrenches = primals
    elimination = eliminated(body, system)
    motion = motions(body, system.anchors, elimination, wrenches)

    def equations(system: LinkSystem, wrenches: Array) -> LinkEquations:
        return LinkEquations(system, wrenches, jnp.zeros_like(motion[1:, :3]))

    return motion, solution_tangent(body, elimination, motion, *jax.jvp(equations, primals, tangents))


def solution_tangent(
    body: Body, elimination: Elimination, motion: Array, equations: LinkEquations, tangent: LinkEquations
) -> Array:
    """Return the tangent (n, 6, C, B) of the motion that solves a body's equations, by the tangent of these.

    elimination: of the system of these equations.
    """
    joint_impulses = _joint_impulses(body, equations, motion)
    _, (imbalance, opening) = jax.jvp(
        lambda equations: _residuals(body, equations, motion, joint_impulses), (equations,), (tangent,)
    )
    # Velocities that close the joints, of links that do not turn, and the rest by the admittance.
    closing = combined(body.ancestors, opening)
    momenta = mm(equations.system.inertia[:, :, 3:], closing)
    anchors = equations.system.anchors

    def solve(_: object, wrenches: Array) -> Array:
        return motions(body, anchors, elimination, wrenches)

    # The admittance is its own transpose; this says so to JAX, which never asks for the matrix.
    rest = jax.lax.custom_linear_solve(lambda same: same, imbalance - momenta, solve, symmetric=True)
    return jnp.concatenate([rest[:, :3], rest[:, 3:] + closing], axis=1)


def _residuals(body: Body, equations: LinkEquations, motion: Array, joint_impulses: Array) -> tuple[Array, Array]:
    """Return what motions and joints' impulses (n - 1, 3, C, B) lack of solving the equations.

    Of momenta (n, 6, C, B), and of relative velocities of the joints' points (n - 1, 3, C, B).
    """
    (inertia, anchors, resistance), wrenches, closing = equations
    parents = body.parents
    (turning, moving), (parent_turning, parent_moving) = (
        (part[:, :3], part[:, 3:]) for part in (motion[1:], motion[parents])
    )
    torques = -mm(resistance, turning - parent_turning)
    at_child = jnp.concatenate([torques + cross_columns(anchors.child, joint_impulses), joint_impulses], axis=1)
    at_parent = jnp.concatenate([torques + cross_columns(anchors.parent, joint_impulses), joint_impulses], axis=1)
    imbalance = wrenches + on_links(body, at_child, at_parent) - mm(inertia, motion)
    child_point, parent_point = (
        moving - cross_columns(anchors.child, turning),
        parent_moving - cross_columns(anchors.parent, parent_turning),
    )
    return imbalance, closing - (child_point - parent_point)


def _joint_impulses(body: Body, equations: LinkEquations, motion: Array) -> Array:
    """Return the impulses f (n - 1, 3, C, B) of the joints: momenta that the links beyond them gain."""
    gained = mm(equations.system.inertia[:, 3:], motion) - equations.wrenches[:, 3:]
    return combined(body.ancestors.T, gained)


def on_links(body: Body, at_child: Array, at_parent: Array) -> Array:
    """Return sums (n, ..., B) on links of what joints exert (n - 1, ..., B) on children, and against their parents."""
    links = np.arange(len(body.links))[:, None]
    incidence = np.concatenate([links == np.arange(1, len(body.links)), links == body.parents], axis=1)
    return combined(incidence, jnp.concatenate([at_child, -at_parent]))

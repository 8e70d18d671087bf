"""How much a link gives way to an impulse: it drags along its parents, through joints that hold fast or loosely.

Newton-Euler for one link, its joint's other side yielding by W_p, propagated outwards from the root (as in
R. Featherstone, Rigid Body Dynamics Algorithms (2008), 7.4). With j the joint, and G_xy = 1/m - [x] I^-1 [y] what the
free link yields at x to an impulse at y,

    W(x) = G_xx - G_xj (G_jj + W_p)^-1 G_jx

Joints carry no moment here. What does stiffen them during an impact, the motor's armature and damping, is counted as
inertia of the outer link. `mechanics.fading` does without that, at a higher price.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.kinematics import anchors, picked, strength
from larp_model.scene import Body, Joint, Vector

# For how long a motor's damping acts during an impact, as far as its armature-like effect goes [s].
HELD = 0.002


def moments(length: Array, radius: Array, mass: Array) -> tuple[Array, Array]:
    """Moments of inertia (*,) [kg m^2] of solid capsules, about their axis and across it."""
    sphere = 4.0 / 3.0 * radius / (length + 4.0 / 3.0 * radius)
    rod, caps = mass * (1.0 - sphere), mass * sphere
    along = (0.5 * rod + 0.4 * caps) * radius**2
    across = rod * (length**2 / 12.0 + radius**2 / 4.0)
    across += caps * (0.4 * radius**2 + length**2 / 4.0 + 0.375 * length * radius)
    return along, across


def stiffening(joint: Joint, held: Array | float, strength: Array) -> Array | float:
    """Moment that a joint takes up during an impact per spin that its links part with [kg m^2], (*,) or ().

    strength: (*,), see `kinematics.strength`.
    """
    motor = joint.motor
    return held * joint.damping if motor is None else strength * (motor.armature + held * motor.damping)


def resisting(joint: Joint, after: Array | float, strength: Array) -> Array:
    """Moment that a joint has taken up a while (*,) [s] after its links began to part, per spin [kg m^2]: (*,).

    It is the joint's inertia, damping and stiffness, as an implicit step of that length sees them.
    """
    spring = 0.0 if joint.motor is None else joint.motor.stiffness
    return stiffening(joint, after, strength) + strength * after**2 * spring


def compliance(
    body: Body, rows: np.ndarray, matrices: Array, points: Array, morphology: Array, held: float = HELD,
    chosen: Array | None = None,
) -> Array:  # fmt: skip
    """Velocity gained per impulse, (B, P, 3, 3) [1/kg], by a point of each of P links of a body, in world axes.

    points: (B, P or K, 3) [m] from the links' centres. The rest is as in `yields`.
    """
    return yielding(_links(body, rows, matrices, morphology, held, chosen), skew(points))


def yields(
    body: Body, rows: np.ndarray, matrices: Array, morphology: Array, held: float = HELD, chosen: Array | None = None
) -> Array:
    """Velocity and spin (B, P, 6, 6) gained by P links of a body per impulse and moment about their centres.

    rows: (P,) the links. matrices: (B, n, 3, 3) rotations of the body's links. morphology (B or 1, n, 3). held: see
    `HELD`. chosen: (B, K, P) one-hot rows of the K links that are asked for; see `kinematics.picked`.
    """
    lightness, inverse, arm, stiff = jnp.broadcast_arrays(*_links(body, rows, matrices, morphology, held, chosen))
    zero, joint = jnp.zeros_like(inverse), jnp.concatenate([lightness, -arm @ inverse], axis=-1)
    free = jnp.concatenate(
        [jnp.concatenate([lightness, zero], axis=-1), jnp.concatenate([zero, inverse], axis=-1)], axis=-2
    )
    return free - jnp.swapaxes(joint, -1, -2) @ stiff @ joint


def _links(
    body: Body, rows: np.ndarray, matrices: Array, morphology: Array, held: float, chosen: Array | None
) -> tuple[Array, Array, Array, Array]:
    """Of the links 1/m, I^-1, and of their joints [j] and (G_jj + W_p)^-1, (B, P, 3, 3) each."""
    known: dict[int, tuple[Array, Array, Array, Array]] = {}
    stronger = strength(body, morphology)
    identity = jnp.eye(3, dtype=matrices.dtype)

    def place(row: int, point: Vector) -> Array:
        local = anchors([point], [body.links[row].axis], morphology[..., row : row + 1, :])
        return jnp.sum(matrices[..., row, :, :] * local, axis=-1)

    def of(row: int) -> tuple[Array, Array, Array, Array]:
        """Of a link 1/m, I^-1, and of its joint [j] and (G_jj + W_p)^-1, (B, 3, 3) each; of the root zeros for both."""
        if row not in known:
            length, radius, mass = (morphology[..., row, column] for column in range(3))
            along, across = moments(length, radius, mass)
            stiffer = stiffening(body.joints[row - 1], held, stronger) if row else 0.0
            along, across = (along + stiffer)[..., None, None], (across + stiffer)[..., None, None]
            axis = matrices[..., row, :, :] @ jnp.asarray(body.links[row].axis, matrices.dtype)
            outer = axis[..., :, None] * axis[..., None, :]
            lightness, inverse = identity / mass[..., None, None], (identity - outer) / across + outer / along
            arm = stiff = jnp.zeros_like(outer)
            if row:
                joint = body.joints[row - 1]
                arm = skew(place(row, joint.child_anchor))
                onto = yielding(of(joint.parent), skew(place(joint.parent, joint.parent_anchor)))
                stiff = invert(lightness - arm @ inverse @ arm + onto)
            known[row] = lightness, inverse, arm, stiff
        return known[row]

    links, places = np.unique(rows, return_inverse=True)
    alone = [of(int(row)) for row in links]
    stacked = (jnp.stack(jnp.broadcast_arrays(*each), axis=-3)[:, places] for each in zip(*alone, strict=True))
    lightness, inverse, arm, stiff = (picked(each, chosen) for each in stacked)
    return lightness, inverse, arm, stiff


def yielding(link: tuple[Array, Array, Array, Array], point: Array) -> Array:
    """W (*, 3, 3) at the point x of a link, given as [x]; see `compliance` for what is known of the link."""
    lightness, inverse, arm, stiff = link
    across = lightness - point @ inverse @ arm
    return lightness - point @ inverse @ point - across @ stiff @ jnp.swapaxes(across, -1, -2)


def skew(vector: Array) -> Array:
    """Matrices (*, 3, 3) of the cross product with vectors (*, 3)."""
    x, y, z = jnp.moveaxis(vector, -1, 0)
    zero = jnp.zeros_like(x)
    return jnp.stack(
        [jnp.stack([zero, -z, y], -1), jnp.stack([z, zero, -x], -1), jnp.stack([-y, x, zero], -1)], axis=-2
    )


def invert(matrix: Array) -> Array:
    """Inverses of regular matrices (*, 3, 3), by their adjugates: far quicker in batches than a solver."""
    a, b, c = matrix[..., 0, :], matrix[..., 1, :], matrix[..., 2, :]
    adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)], axis=-1)
    determinant = jnp.sum(a * adjugate[..., :, 0], axis=-1)
    return adjugate / determinant[..., None, None]

"""c(.): where two capsules are closest, and when they meet within a step.

A ball is a capsule of length 0 and the ground a plane, so one description serves all contacts. All functions act on
leading dimensions, are differentiable, and keep finite values and gradients for coincident, parallel and zero-length
segments.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from larp_model.vector import Vector

# The share of the constraint that is a spring; the rest follows the free motion (MuJoCo's impedance).
IMPEDANCE = 0.99


class Segment(NamedTuple):
    """Axis of a capsule: centre (*, 3) [m], half vector (*, 3) [m] from the centre to one end, radius (*,) [m]."""

    centre: Array
    half: Array
    radius: Array


class Closest(NamedTuple):
    """Closest points of two capsules.

    normal: unit vector (*, 3) from the first to the second. distance: (*,) [m], negative when they overlap.
    point: (*, 3) [m] midway between the surfaces. along: (*, 2) place on each axis, -1 to 1.
    """

    normal: Array
    distance: Array
    point: Array
    along: Array


def _dot(a: Array, b: Array) -> Array:
    return jnp.sum(a * b, axis=-1)


def norm(vector: Array) -> Array:
    """Length (*,) of vectors (*, n), with gradient zero at zero."""
    squared = _dot(vector, vector)
    zero = squared < 1e-20
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def normalise(vector: Array, otherwise: Array) -> Array:
    """Unit vectors (*, 3); `otherwise` (3,) where the vector is zero."""
    squared = _dot(vector, vector)[..., None]
    zero = squared < 1e-20
    return jnp.where(zero, otherwise, vector * jnp.where(zero, 1.0, squared) ** -0.5)


def closest(first: Segment, second: Segment) -> Closest:
    """Closest points of two capsules: see `nearest`."""
    one, two = (Axis(Vector.of(each.centre), Vector.of(each.half), each.radius) for each in (first, second))
    normal, distance, point, along = nearest(one, two)
    return Closest(normal.array, distance, point.array, jnp.stack(along, axis=-1))


class Axis(NamedTuple):
    """A segment by its components."""

    centre: Vector
    half: Vector
    radius: Array


def nearest(first: Axis, second: Axis) -> tuple[Vector, Array, Vector, tuple[Array, Array]]:
    """Closest points of two capsules (C. Ericson, Real-Time Collision Detection, 5.1.9), as in `Closest`.

    Where axes are parallel the middle of their overlap is taken; where they cross or coincide, the normal is z.
    """
    between = first.centre - second.centre
    aa, bb = first.half.dot(first.half), second.half.dot(second.half)
    ab, ac, bc = first.half.dot(second.half), first.half.dot(between), second.half.dot(between)
    aa, bb = jnp.where(aa < 1e-12, 1.0, aa), jnp.where(bb < 1e-12, 1.0, bb)  # every place on a ball's axis is one
    determinant = aa * bb - ab * ab
    parallel = determinant < 1e-6 * aa * bb
    # On parallel axes every place of the overlap is closest: take its middle, projected on the first axis.
    reach = jnp.abs(ab) / aa
    low = jnp.maximum(-1.0, -ac / aa - reach)
    high = jnp.minimum(1.0, -ac / aa + reach)
    middle = jnp.clip(0.5 * (low + high), -1.0, 1.0)
    crossing = jnp.clip((ab * bc - ac * bb) / jnp.where(parallel, 1.0, determinant), -1.0, 1.0)
    s = jnp.where(parallel, middle, crossing)
    t = jnp.clip((ab * s + bc) / bb, -1.0, 1.0)
    s = jnp.where(parallel & (jnp.abs(t) < 1.0), s, jnp.clip((ab * t - ac) / aa, -1.0, 1.0))
    on_first, on_second = first.centre + first.half * s, second.centre + second.half * t
    apart = on_second - on_first
    squared = apart.dot(apart)
    zero = squared < 1e-20
    length = jnp.sqrt(jnp.where(zero, 1.0, squared))
    normal = Vector(
        *(
            jnp.where(zero, axis, each / length)
            for axis, each in zip((0.0, 0.0, 1.0), (apart.x, apart.y, apart.z), strict=True)
        )
    )
    distance = jnp.where(zero, 0.0, length) - first.radius - second.radius
    point = (on_first + normal * first.radius + on_second - normal * second.radius) * 0.5
    return normal, distance, point, (s, t)


def moved(segment: Segment, velocity: Array, angular_velocity: Array, time: Array) -> Segment:
    """The segment after `time` (*,) [s] at constant velocity (*, 3) [m/s] and angular velocity (*, 3) [rad/s].

    The axis turns to first order and keeps its length.
    """
    time = time[..., None]
    turned = segment.half + time * jnp.cross(angular_velocity, segment.half)
    shrink = norm(segment.half) / jnp.maximum(norm(turned), 1e-12)
    return Segment(segment.centre + time * velocity, turned * shrink[..., None], segment.radius)


def time_of_impact(distance: Array, approach: Array, limit: Array | float) -> Array:
    """(*,) [s] until a gap `distance` closes at speed `approach`, within [0, limit]; `limit` if it does not.

    It jumps where bodies that part touch at just no distance: there alone no gradient is that of the differences.
    """
    closing = approach > 1e-3
    time = jnp.maximum(distance, 0.0) / jnp.where(closing, approach, 1.0)
    return jnp.where(closing | (distance <= 0.0), jnp.minimum(time, limit), limit)


def smooth_gate(gap: Array, margin: float) -> Array:
    """1 where gap <= 0, 0 where gap >= margin, and smooth between."""
    x = jnp.clip(1.0 - gap / margin, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)

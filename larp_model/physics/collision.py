"""Collision of capsules: closest points, time of impact, and the pairs of links that can touch in a step.

A ball is a capsule of length 0, so one description serves all pairs of links. Values and gradients stay finite for
coincident, parallel and zero-length axes. Arrays have the batch last, as in `linalg`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import contract, cross, dot, norm
from larp_model.physics.kinematics import Kinematics
from larp_model.scene import Scene, Surface


class CapsuleShapes(NamedTuple):
    """Capsules by their axes: centre (n, 3, B) [m], half (n, 3, B) [m] from there to one end, radius (n, 1, B) [m]."""

    centre: Array
    half: Array
    radius: Array


class ClosestPoints(NamedTuple):
    """Closest points of n pairs of capsules.

    normal: unit vectors (n, 3, B) from the first to the second. distance: (n, 1, B) [m], negative where they overlap.
    point: (n, 3, B) [m] midway between the surfaces. along: (n, 2, B) place on each axis, -1 to 1.
    """

    normal: Array
    distance: Array
    point: Array
    along: Array


def closest(first: CapsuleShapes, second: CapsuleShapes) -> ClosestPoints:
    """Return the closest points of pairs of capsules (C. Ericson, Real-Time Collision Detection, 5.1.9).

    Where axes are parallel the middle of their overlap is taken; where they cross or coincide, the normal is z.
    """
    between = first.centre - second.centre
    aa, bb = dot(first.half, first.half), dot(second.half, second.half)
    ab, ac, bc = dot(first.half, second.half), dot(first.half, between), dot(second.half, between)
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
    on_first, on_second = first.centre + s * first.half, second.centre + t * second.half
    offset = on_second - on_first
    squared = dot(offset, offset)
    zero = squared < 1e-20
    length = jnp.sqrt(jnp.where(zero, 1.0, squared))
    up = jnp.array([0.0, 0.0, 1.0], offset.dtype)[:, None]
    normal = jnp.where(zero, up, offset / length)
    distance = jnp.where(zero, 0.0, length) - first.radius - second.radius
    point = 0.5 * (on_first + first.radius * normal + on_second - second.radius * normal)
    return ClosestPoints(normal, distance, point, jnp.concatenate([s, t], axis=1))


def advanced(capsules: CapsuleShapes, velocity: Array, angular_velocity: Array, time: Array) -> CapsuleShapes:
    """Return capsules after times (n, 1, B) [s] at constant velocities (n, 3, B) [m/s] and [rad/s].

    The axes turn to first order and keep their length.
    """
    half = capsules.half + time * cross(angular_velocity, capsules.half)
    shrink = norm(capsules.half) / jnp.maximum(norm(half), 1e-12)
    return CapsuleShapes(capsules.centre + time * velocity, shrink * half, capsules.radius)


def time_of_impact(distance: Array, approach: Array, limit: Array | float) -> Array:
    """Return times (*,) [s] until gaps `distance` close at speeds `approach`, within [0, limit]; else `limit`.

    It jumps where bodies that separate are at zero distance: there alone its gradient is not that of differences.
    """
    closing = approach > 1e-3
    time = jnp.maximum(distance, 0.0) / jnp.where(closing, approach, 1.0)
    return jnp.where(closing | (distance <= 0.0), jnp.minimum(time, limit), limit)


def smooth_gate(gap: Array, margin: float) -> Array:
    """Return 1 where gap <= 0, 0 where gap >= margin, and smoothly between."""
    x = jnp.clip(1.0 - gap / margin, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


@dataclass(frozen=True)
class ContactSettings:
    """Settings of the contact solver and of its integration in time.

    contacts: number of pairs of links, the nearest, that are solved for. substeps: of a step. iterations: of Newton's
    method. fade: relaxation time [s] of transient velocities, see `response`. margin: links touch within a step where
    their gap falls below this [m]. moments: number of times within a step at which gaps are computed.
    """

    contacts: int = 2
    substeps: int = 10
    iterations: int = 4
    fade: float = 0.003
    margin: float = 0.005
    moments: int = 5


class Rates(NamedTuple):
    """Accelerations of the links of a scene in a step in which no other link touches them, (L, 3, B) each.

    acceleration [m/s^2], angular_acceleration [rad/s^2]: mean ones, which change by jerk, angular_jerk [m/s^3,
    rad/s^3]. velocity_product, angular_velocity_product: parts of them that contacts do not count, see
    `motion.velocity_products`.
    """

    acceleration: Array
    angular_acceleration: Array
    jerk: Array
    angular_jerk: Array
    velocity_product: Array
    angular_velocity_product: Array


@dataclass(frozen=True)
class Candidates:
    """Pairs of links of a scene that can touch, and its balls."""

    scene: Scene

    @cached_property
    def rows(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of both links of every pair of links, (P,) each."""
        rows = [
            (self.scene.index(pair.first, first), self.scene.index(pair.second, second))
            for pair in self.scene.pairs
            for first in pair.first_links
            for second in pair.second_links
        ]
        first, second = np.array(rows, int).reshape(-1, 2).T
        return first, second

    @cached_property
    def surfaces(self) -> tuple[Surface, ...]:
        """Return the surface of every pair of links."""
        counts = [(pair.surface, len(pair.first_links) * len(pair.second_links)) for pair in self.scene.pairs]
        return tuple(surface for surface, count in counts for _ in range(count))

    @cached_property
    def balls(self) -> tuple[str, ...]:
        """Return the names of the balls."""
        return tuple(body.name for body in self.scene.bodies if body.is_ball)

    def gaps(self, links: Kinematics, rates: Rates, dt: Array | float, settings: ContactSettings) -> Array:
        """Return the smallest gap (P, B) [m] of every pair of links within `dt` [s], at their mean accelerations."""
        first, second = self.rows

        def at(time: Array) -> Array:
            position = links.position + time * (links.velocity + 0.5 * time * rates.acceleration)
            half = turned_vectors(links.half, time * (links.angular_velocity + 0.5 * time * rates.angular_acceleration))
            one, two = (CapsuleShapes(position[rows], half[rows], links.sizes[rows, 1:2]) for rows in (first, second))
            return closest(one, two).distance[:, 0]

        times = jnp.linspace(0.0, dt, settings.moments, dtype=links.state.dtype)
        return jnp.min(jax.lax.map(at, times), axis=0)


class Sides(NamedTuple):
    """The S sides of contacts, a link each: of K pairs of links the K first and the K second ones, then the balls.

    one_hot: (S, L, B), the link of each side. owners: names of the bodies that it can belong to.
    """

    one_hot: Array
    owners: tuple[frozenset[str], ...]

    def of(self, values: Array) -> Array:
        """Return the values (S, ..., B) of the sides, from those of all links (L, ..., B)."""
        return select(self.one_hot, values)


def sides_of(candidates: Candidates, selection: Array) -> Sides:
    """Return the sides of K pairs of links, selected by one-hot rows (K, P, B), and of all balls."""
    scene, (first, second) = candidates.scene, candidates.rows
    identity = np.eye(len(scene.links))
    of_links = [select(selection, jnp.asarray(identity[rows], selection.dtype)[..., None]) for rows in (first, second)]
    batch = selection.shape[-1]
    of_balls = [
        jnp.broadcast_to(jnp.asarray(identity[scene.rows(name)], selection.dtype)[..., None], (1, len(identity), batch))
        for name in candidates.balls
    ]
    firsts, seconds = (frozenset(getattr(pair, end) for pair in scene.pairs) for end in ("first", "second"))
    owners = (
        *[firsts] * len(selection),
        *[seconds] * len(selection),
        *(frozenset([name]) for name in candidates.balls),
    )
    return Sides(jnp.concatenate([*of_links, *of_balls]), owners)


def turned_vectors(vector: Array, by: Array) -> Array:
    """Return vectors (n, 3, B) turned by small rotation vectors (n, 3, B) [rad], to the second order."""
    once = cross(by, vector)
    return vector + once + 0.5 * cross(by, once)


def select(one_hot: Array, values: Array) -> Array:
    """Return the values (S, ..., B) that one-hot rows (S, L, B) select from (L, ..., B or 1)."""
    flat = values.reshape(len(values), -1, values.shape[-1])
    selected = contract("sl,lk->sk", one_hot, flat)
    return selected.reshape(len(one_hot), *values.shape[1:-1], selected.shape[-1])

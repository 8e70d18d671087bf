"""Pairs of links that can touch in a step: their smallest gaps, and their closest points.

Arrays have the batch last, as in `linalg`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.contact import Axis, nearest
from larp_model.linalg import cross
from larp_model.physics.kinematics import Kinematics
from larp_model.scene import Scene, Surface
from larp_model.vector import Vector


@dataclass(frozen=True)
class ContactSettings:
    """Settings of the contact solver and of its integration in time.

    contacts: how many pairs of links, the nearest, are looked at. substeps: of a step. iterations: of Newton's method.
    fade: time [s] within which servos take back what links have gained, see `response`. margin: links touch within a
    step where their gap falls below this [m]. moments: so often in a step their gap is looked at.
    """

    contacts: int = 2
    substeps: int = 10
    iterations: int = 4
    fade: float = 0.003
    margin: float = 0.005
    moments: int = 5


class Rates(NamedTuple):
    """How the links of a scene accelerate in a step in which no other link touches them, (L, 3, B) each.

    acceleration [m/s^2], angular_acceleration [rad/s^2]: mean ones, which change by jerk, angular_jerk [m/s^3,
    rad/s^3]. uncounted, uncounted_angular: parts of them that contacts do not count, see `motion.velocity_products`.
    """

    acceleration: Array
    angular_acceleration: Array
    jerk: Array
    angular_jerk: Array
    uncounted: Array
    uncounted_angular: Array


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

    def gaps(self, seen: Kinematics, rates: Rates, dt: float, settings: ContactSettings) -> Array:
        """Return the smallest gap (P, B) [m] of every pair of links within `dt` [s], as they accelerate on average."""
        first, second = self.rows

        def at(time: Array) -> Array:
            position = seen.position + time * (seen.velocity + 0.5 * time * rates.acceleration)
            half = turned(seen.half, time * (seen.angular_velocity + 0.5 * time * rates.angular_acceleration))
            one, two = ((position[rows], half[rows], seen.sizes[rows, 1]) for rows in (first, second))
            return closest(one, two)[1]

        times = jnp.linspace(0.0, dt, settings.moments, dtype=seen.state.dtype)
        return jnp.min(jax.lax.map(at, times), axis=0)


class Sides(NamedTuple):
    """The S links of K contacts and nb balls on the ground: K first links, K second links, the balls.

    which: (S, L, B) one-hot. owners: names of the bodies that each can be of.
    """

    which: Array
    owners: tuple[frozenset[str], ...]

    def of(self, values: Array) -> Array:
        """Return the sides' values (S, ..., B), out of those of all links (L, ..., B)."""
        return picked(self.which, values)


def sides_of(candidates: Candidates, chosen: Array) -> Sides:
    """Return the sides of the pairs of links chosen by one-hot rows (K, P, B), and of all balls."""
    scene, (first, second) = candidates.scene, candidates.rows
    every = np.eye(len(scene.links))
    of_links = [picked(chosen, jnp.asarray(every[rows], chosen.dtype)[..., None]) for rows in (first, second)]
    batch = chosen.shape[-1]
    of_balls = [
        jnp.broadcast_to(jnp.asarray(every[scene.rows(name)], chosen.dtype)[..., None], (1, len(every), batch))
        for name in candidates.balls
    ]
    firsts, seconds = (frozenset(getattr(pair, end) for pair in scene.pairs) for end in ("first", "second"))
    owners = (*[firsts] * len(chosen), *[seconds] * len(chosen), *(frozenset([name]) for name in candidates.balls))
    return Sides(jnp.concatenate([*of_links, *of_balls]), owners)


def closest(first: tuple[Array, Array, Array], second: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
    """Return normals (n, 3, B), gaps (n, B) and contact points (n, 3, B) of capsules (centre, half axis, radius)."""
    one, two = (Axis(_vector(centre), _vector(half), radius) for centre, half, radius in (first, second))
    normal, gap, point, _ = nearest(one, two)
    along, at = (jnp.stack([each.x, each.y, each.z], axis=1) for each in (normal, point))
    return along, gap, at


def _vector(vectors: Array) -> Vector:
    return Vector(vectors[:, 0], vectors[:, 1], vectors[:, 2])


def turned(vector: Array, by: Array) -> Array:
    """Return vectors (n, 3, B) turned by small rotation vectors (n, 3, B) [rad], to the second order."""
    once = cross(by, vector)
    return vector + once + 0.5 * cross(by, once)


def picked(which: Array, values: Array) -> Array:
    """Return (S, ..., B) what one-hot rows (S, L, B) take of values (L, ..., B or 1)."""
    rows = which.reshape(*which.shape[:2], *[1] * (values.ndim - 2), which.shape[-1])
    total = rows[:, 0] * values[0]
    for row in range(1, len(values)):
        total += rows[:, row] * values[row]
    return total

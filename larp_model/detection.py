"""Contact detection in recorded states: which links of two bodies touch within a step, and when.

The simulator detects its own contacts: see `physics.collision`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import state as packed
from larp_model.linalg import cross, dot
from larp_model.physics.collision import CapsuleShapes, ClosestPoints, advanced, closest, smooth_gate, time_of_impact
from larp_model.physics.kinematics import Kinematics, kinematics
from larp_model.scene import Body, Pair, Scene
from larp_model.state import Trajectories

# Links whose gap within a step is larger are not near each other [m].
MARGIN = 0.03
# Newton steps of conservative advancement: three leave less than a millimetre at 10 m/s.
ADVANCES = 3
# A link is struck whose velocity changes by more than this in a step [m/s].
PUSH = 0.3


class ContactPoints(NamedTuple):
    """P pairs of links at the moment at which they touch in a step, (B, P) each.

    gap: [m] when the step begins. lowest: the smallest within it [m]. near: 1 where the links touch within the step,
    falling to 0 over the margin. remaining: [s] of the step. normal: (B, P, 3) from the first to the second, world.
    """

    gap: Array
    lowest: Array
    near: Array
    remaining: Array
    normal: Array


def link_pairs(pair: Pair, first: Body, second: Body) -> tuple[np.ndarray, np.ndarray]:
    """Return rows in their bodies of the first and second link of every pair of links that can touch, (P,) each."""
    rows = [(first.link(one), second.link(other)) for one in pair.first_links for other in pair.second_links]
    return np.array(rows)[:, 0], np.array(rows)[:, 1]


def capsules(links: Kinematics, rows: np.ndarray) -> CapsuleShapes:
    """Return the capsules of links in these rows (P,)."""
    return CapsuleShapes(links.position[rows], links.half[rows], links.sizes[rows, 1:2])


def detect(
    pair: Pair, bodies: tuple[Body, Body], links: tuple[Kinematics, Kinematics], after: tuple[Array, Array], dt: float
) -> ContactPoints:
    """Return the contact points of the links of a pair of bodies within `dt` [s].

    links: both when the step begins. after: states (n, 13, B) of both with the velocities at its end. Links move on,
    evenly accelerated, until they touch (conservative advancement), so that a foot that crosses the ball within a step
    is detected.
    """
    rows = link_pairs(pair, *bodies)
    first, second = (capsules(start, link_rows) for start, link_rows in zip(links, rows, strict=True))
    (v1, w1), (v2, w2) = (
        (start.velocity[link_rows], start.angular_velocity[link_rows])
        for start, link_rows in zip(links, rows, strict=True)
    )
    (v1_end, w1_end), (v2_end, w2_end) = (
        (after_step[link_rows, packed.VELOCITY], after_step[link_rows, packed.ANGULAR_VELOCITY])
        for after_step, link_rows in zip(after, rows, strict=True)
    )
    dv1, dw1, dv2, dw2 = v1_end - v1, w1_end - w1, v2_end - v2, w2_end - w2

    def closest_at(time: Array) -> tuple[ClosestPoints, Array]:
        share = time / dt
        one = advanced(first, v1 + 0.5 * share * dv1, w1 + 0.5 * share * dw1, time)
        two = advanced(second, v2 + 0.5 * share * dv2, w2 + 0.5 * share * dw2, time)
        points = closest(one, two)
        relative = v1 + share * dv1 + cross(w1 + share * dw1, points.point - one.centre)
        relative -= v2 + share * dv2 + cross(w2 + share * dw2, points.point - two.centre)
        return points, dot(relative, points.normal)

    def advance(time: Array, _: None) -> tuple[Array, Array]:
        points, approach = closest_at(time)
        ahead = time_of_impact(points.distance, approach, dt - time)
        # Links that accelerated touched earlier than their first speeds imply.
        back = jnp.minimum(points.distance, 0.0) / jnp.where(approach > 1e-3, approach, jnp.inf)
        return time + jnp.where(points.distance > 0.0, ahead, jnp.maximum(back, -time)), points.distance

    # A scan, because an unrolled loop would be compiled as many times over.
    time, gaps = jax.lax.scan(advance, jnp.zeros_like(v1[:, :1]), length=ADVANCES)
    points, _ = closest_at(time)
    lowest = jnp.minimum(gaps[0], points.distance)
    near, normal = smooth_gate(lowest, MARGIN), jnp.moveaxis(points.normal, -1, 0)
    return ContactPoints(gaps[0, :, 0].T, lowest[:, 0].T, near[:, 0].T, (dt - time)[:, 0].T, normal)


def contact_points(
    scene: Scene, state: Array, morphology: Array, after: Array | None = None
) -> list[tuple[Pair, ContactPoints]]:
    """Return every pair of the scene and its contact points, in states (B, L, 13), morphologies (B or 1, L, 3).

    after: states (B, L, 13) whose velocities are those at the end of the step; as they are by default.
    """
    links = kinematics(scene, jnp.moveaxis(state, 0, -1), jnp.moveaxis(morphology, 0, -1))
    end = links.state if after is None else jnp.moveaxis(after, 0, -1)
    points_by_pair = []
    for pair in scene.pairs:
        first, second = scene.body(pair.first), scene.body(pair.second)
        of_bodies = links.of(scene, pair.first), links.of(scene, pair.second)
        ends = end[scene.rows(pair.first)], end[scene.rows(pair.second)]
        points_by_pair.append((pair, detect(pair, (first, second), of_bodies, ends, scene.dt)))
    return points_by_pair


def first_contact(scene: Scene, states: Array, morphology: Array) -> Array:
    """Return (E,) the first step t in which a pair's contact changes the second link's velocity.

    states (E, T + 1, L, 13), morphology (E or 1, L, 3). The contact falls between states t and t + 1. -1 where there
    is none.
    """
    if not scene.pairs:
        return jnp.full(states.shape[0], -1)
    free = jnp.array([0.0, 0.0, -scene.gravity * scene.dt], states.dtype)

    def strikes(before: Array, after: Array) -> Array:
        struck = jnp.zeros(before.shape[0], bool)
        for pair, points in contact_points(scene, before, morphology):
            _, second = link_pairs(pair, scene.body(pair.first), scene.body(pair.second))
            second = second + scene.rows(pair.second).start
            change = packed.velocity(after)[:, second] - packed.velocity(before)[:, second] - free
            pushed = jnp.sum(change**2, axis=-1) > PUSH**2
            struck |= jnp.any((points.near > 0.1) & pushed, axis=1)
        return struck

    def advance(carry: None, step: tuple[Array, Array]) -> tuple[None, Array]:
        return carry, strikes(*step)

    by_time = jnp.moveaxis(states, 1, 0)
    _, hits = jax.lax.scan(advance, None, (by_time[:-1], by_time[1:]))
    return jnp.where(hits.any(axis=0), jnp.argmax(hits, axis=0), -1)


def first_contacts(scene: Scene, episodes: Trajectories, chunk: int = 512) -> np.ndarray:
    """Return `first_contact` (E,) of many trajectories, chunk by chunk."""
    count = len(episodes.states)
    rows = np.minimum(np.arange(count + -count % chunk), count - 1).reshape(-1, chunk)
    steps = (_first_contact(scene, episodes.states[chunk_rows], episodes.morphology[chunk_rows]) for chunk_rows in rows)
    return np.concatenate(list(steps))[:count]


_first_contact = jax.jit(first_contact, static_argnums=0)

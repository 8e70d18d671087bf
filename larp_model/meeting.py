"""Geometry of contacts in recorded states: the moment within a step at which links of two bodies meet, if any.

The simulator finds its own contacts: see `physics.collision`.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import contact
from larp_model import state as packed
from larp_model.contact import Closest, Segment
from larp_model.physics.kinematics import Kinematics, kinematics
from larp_model.scene import Body, Pair, Scene
from larp_model.state import Trajectories

# Links whose gap within a step is larger do not feel each other [m].
MARGIN = 0.03
# Newton steps of conservative advancement: three leave less than a millimetre at 10 m/s.
ADVANCES = 3


class Meeting(NamedTuple):
    """P pairs of links at the moment at which they meet in a step; vectors (B, P, 3) in the world frame.

    gap: (B, P) [m] when the step begins. lowest: the smallest seen [m]. near: 1 where the links touch within the step,
    falling to 0 over the margin. remaining: (B, P) [s] of the step. normal: from the first to the second.
    """

    gap: Array
    lowest: Array
    near: Array
    remaining: Array
    normal: Array


def rows_of(pair: Pair, first: Body, second: Body) -> tuple[np.ndarray, np.ndarray]:
    """Return rows in their bodies of the first and second link of every pair of links that can touch, (P,) each."""
    rows = [(first.link(one), second.link(other)) for one in pair.first_links for other in pair.second_links]
    return np.array(rows)[:, 0], np.array(rows)[:, 1]


def segments(seen: Kinematics, rows: np.ndarray) -> Segment:
    """Return the axes (B, P, ...) of links by their rows (P,)."""
    return Segment(*(jnp.moveaxis(each[rows], -1, 0) for each in (seen.position, seen.half, seen.sizes[:, 1])))


def meet(
    pair: Pair, bodies: tuple[Body, Body], seen: tuple[Kinematics, Kinematics], after: tuple[Array, Array], dt: float
) -> Meeting:
    """Return where the links of a pair of bodies meet within `dt` [s].

    seen: both when the step begins. after: states (B, n, 13) of both with the velocities at its end. Links move on,
    evenly accelerated, until they meet (conservative advancement), so that a foot that crosses the ball within a step
    is seen.
    """
    rows = rows_of(pair, *bodies)
    axes = [segments(own, links) for own, links in zip(seen, rows, strict=True)]
    velocities = [
        (packed.velocity(each)[:, links], packed.angular_velocity(each)[:, links])
        for own, end, links in zip(seen, after, rows, strict=True)
        for each in (jnp.moveaxis(own.state, -1, 0), end)
    ]
    (v1, w1), (v1_end, w1_end), (v2, w2), (v2_end, w2_end) = velocities
    dv1, dw1, dv2, dw2 = v1_end - v1, w1_end - w1, v2_end - v2, w2_end - w2

    def closest_at(time: Array) -> tuple[Closest, Array]:
        share = (time / dt)[..., None]
        half = 0.5 * share
        one = contact.moved(axes[0], v1 + half * dv1, w1 + half * dw1, time)
        two = contact.moved(axes[1], v2 + half * dv2, w2 + half * dw2, time)
        found = contact.closest(one, two)
        relative = v1 + share * dv1 + jnp.cross(w1 + share * dw1, found.point - one.centre)
        relative -= v2 + share * dv2 + jnp.cross(w2 + share * dw2, found.point - two.centre)
        return found, jnp.sum(relative * found.normal, axis=-1)

    def advance(time: Array, nothing: None) -> tuple[Array, Array]:
        found, approach = closest_at(time)
        ahead = contact.time_of_impact(found.distance, approach, dt - time)
        # Links that sped up met earlier than their first speeds told.
        back = jnp.minimum(found.distance, 0.0) / jnp.where(approach > 1e-3, approach, jnp.inf)
        return time + jnp.where(found.distance > 0.0, ahead, jnp.maximum(back, -time)), found.distance

    # A scan, because an unrolled loop would be compiled as many times over.
    time, gaps = jax.lax.scan(advance, jnp.zeros(axes[0].radius.shape, v1.dtype), length=ADVANCES)
    found, _ = closest_at(time)
    lowest = jnp.minimum(gaps[0], found.distance)
    return Meeting(gaps[0], lowest, contact.smooth_gate(lowest, MARGIN), dt - time, found.normal)


def meetings(scene: Scene, state: Array, morphology: Array, after: Array | None = None) -> list[tuple[Pair, Meeting]]:
    """Return every pair of the scene and how its links meet, in states (B, L, 13) of a morphology (B or 1, L, 3).

    after: states (B, L, 13) whose velocities are those at the end of the step; as they are by default.
    """
    seen = kinematics(scene, jnp.moveaxis(state, 0, -1), jnp.moveaxis(morphology, 0, -1))
    end = state if after is None else after
    found = []
    for pair in scene.pairs:
        names = pair.first, pair.second
        first, second = (scene.body(name) for name in names)
        one, two = (seen.of(scene, name) for name in names)
        ends = end[:, scene.rows(pair.first)], end[:, scene.rows(pair.second)]
        found.append((pair, meet(pair, (first, second), (one, two), ends, scene.dt)))
    return found


def first_contact(scene: Scene, states: Array, morphology: Array) -> Array:
    """Return (E,) the first step t in which a pair's contact changes the second link's velocity.

    states (E, T + 1, L, 13), morphology (E or 1, L, 3). The contact falls between states t and t + 1. -1 where there
    is none.
    """
    if not scene.pairs:
        return jnp.full(states.shape[0], -1)
    free = jnp.array([0.0, 0.0, -scene.gravity * scene.dt], states.dtype)

    def hit(before: Array, after: Array) -> Array:
        found = jnp.zeros(before.shape[0], bool)
        for pair, meeting in meetings(scene, before, morphology):
            _, second = rows_of(pair, scene.body(pair.first), scene.body(pair.second))
            second = second + scene.rows(pair.second).start
            pushed = contact.norm(packed.velocity(after) - packed.velocity(before) - free)[:, second] > 0.3
            found |= jnp.any((meeting.near > 0.1) & pushed, axis=1)
        return found

    def advance(carry: None, step: tuple[Array, Array]) -> tuple[None, Array]:
        return carry, hit(*step)

    by_time = jnp.moveaxis(states, 1, 0)
    _, hits = jax.lax.scan(advance, None, (by_time[:-1], by_time[1:]))
    return jnp.where(hits.any(axis=0), jnp.argmax(hits, axis=0), -1)


def first_contacts(scene: Scene, episodes: Trajectories, chunk: int = 512) -> np.ndarray:
    """Return `first_contact` (E,) of many trajectories, chunk by chunk."""
    count = len(episodes.states)
    rows = np.minimum(np.arange(count + -count % chunk), count - 1).reshape(-1, chunk)
    found = (_first_contact(scene, episodes.states[each], episodes.morphology[each]) for each in rows)
    return np.concatenate(list(found))[:count]


_first_contact = jax.jit(first_contact, static_argnums=0)

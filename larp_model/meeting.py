"""How the links of two bodies meet within a step: when, where, how fast, and what a free impact would do.

Physics alone; what the contact network makes of it is in `parts.contact`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import contact
from larp_model import state as packed
from larp_model.compliance import HELD, compliance
from larp_model.contact import Closest, Segment
from larp_model.kinematics import Kinematics, kinematics, picked
from larp_model.scene import Body, Pair, Scene
from larp_model.state import Trajectories


@dataclass(frozen=True)
class MeetingConstants:
    """What is chosen here, not derived.

    margin: links whose gap within a step is larger do not feel each other [m]. advances: Newton steps of conservative
    advancement; three leave less than a millimetre at 10 m/s. held: see `compliance`.
    """

    margin: float = 0.03
    advances: int = 3
    held: float = HELD


class Velocities(NamedTuple):
    """Of links, (B, n, 3) each: velocity [m/s] of the centre of mass and spin [rad/s], world frame."""

    velocity: Array
    spin: Array

    @staticmethod
    def of(state: Array) -> Velocities:
        """Those of states (B, n, 13)."""
        return Velocities(packed.velocity(state), packed.angular_velocity(state))


class Party(NamedTuple):
    """One body of a pair and those of its links that can touch, one for each pair of links (P,).

    free: the velocities at the end of the step if nothing touches. gives: how the links give way, (B, P, 6, 6) each, as
    far as a contact's base wants to know it once for all. chosen: one-hot rows (B, K, P) of those pairs that are looked
    at; all by default.
    """

    body: Body
    rows: np.ndarray
    seen: Kinematics
    free: Velocities
    gives: tuple[Array, ...] = ()
    chosen: Array | None = None

    def of(self, values: Array) -> Array:
        """What values (B or 1, n, ...) of the body's links say of these, (B, P or K, ...)."""
        return picked(values[:, self.rows], self.chosen)

    @property
    def segment(self) -> Segment:
        """The links' axes when the step begins."""
        return self.seen.segments(self.rows, self.chosen)

    @property
    def before(self) -> Velocities:
        """The links' velocities when the step begins, (B, P, 3)."""
        return Velocities(*(self.of(each) for each in Velocities.of(self.seen.state)))

    @property
    def after(self) -> Velocities:
        """The links' velocities when the step ends, if nothing touches, (B, P, 3)."""
        return Velocities(*(self.of(each) for each in self.free))

    @property
    def gained(self) -> Velocities:
        """The difference of the two."""
        return Velocities(*(after - before for after, before in zip(self.after, self.before, strict=True)))


class Meeting(NamedTuple):
    """P pairs of links at the moment at which they meet in a step; vectors (B, P, 3) in the world frame.

    gap: (B, P) [m] when the step begins. lowest: the smallest seen [m]. near: 1 where the links touch within the step,
    falling to 0 over the margin. remaining: (B, P) [s] of the step. normal: from the first to the second. depth: (B, P)
    [m] of penetration. relative: velocity [m/s] of the first against the second, at the contact; approach (B, P) [m/s]
    along the normal, slide across it. gained: of the relative velocity, in the step if nothing touches. arms: from
    either link's centre to the contact [m]. segments: both links. given: velocity (B, P, 3) [m/s] between them per
    impulse along the normal. mass: (B, P) effective mass [kg] along the normal, the links' parents included.
    """

    gap: Array
    lowest: Array
    near: Array
    remaining: Array
    normal: Array
    depth: Array
    relative: Array
    approach: Array
    slide: Array
    gained: Array
    arms: tuple[Array, Array]
    segments: tuple[Segment, Segment]
    given: Array
    mass: Array

    def flipped(self) -> Meeting:
        """The same as the second body sees it."""
        return self._replace(
            normal=-self.normal, relative=-self.relative, slide=-self.slide, gained=-self.gained, given=-self.given,
            arms=self.arms[::-1], segments=self.segments[::-1],
        )  # fmt: skip


def rows_of(pair: Pair, first: Body, second: Body) -> tuple[np.ndarray, np.ndarray]:
    """Rows in their bodies of the first and second link of every pair of links that can touch, (P,) each."""
    rows = [(first.link(one), second.link(other)) for one in pair.first_links for other in pair.second_links]
    return np.array(rows)[:, 0], np.array(rows)[:, 1]


def parties(
    pair: Pair, bodies: tuple[Body, Body], seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]
) -> tuple[Party, Party]:
    """Both bodies of a pair."""
    one, two = (Party(*each) for each in zip(bodies, rows_of(pair, *bodies), seen, free, strict=True))
    return one, two


def meet(
    pair: Pair, first: Party, second: Party, dt: float, constants: MeetingConstants = MeetingConstants()
) -> Meeting:
    """The contacts of a pair of bodies.

    Both links move on, evenly accelerated, until they meet (conservative advancement); the gap, normal and speeds are
    those of that moment, so that a foot that crosses the ball within a step is seen.
    """
    a, b = first.segment, second.segment
    (v1, w1), (dv1, dw1), (v2, w2), (dv2, dw2) = first.before, first.gained, second.before, second.gained

    def closest_at(time: Array) -> tuple[Closest, Array, Array, Array, Array, tuple[Segment, Segment]]:
        share = (time / dt)[..., None]
        half = 0.5 * share
        one = contact.moved(a, v1 + half * dv1, w1 + half * dw1, time)
        two = contact.moved(b, v2 + half * dv2, w2 + half * dw2, time)
        found = contact.closest(one, two)
        arm1, arm2 = found.point - one.centre, found.point - two.centre
        relative = v1 + share * dv1 + jnp.cross(w1 + share * dw1, arm1)
        relative -= v2 + share * dv2 + jnp.cross(w2 + share * dw2, arm2)
        approach = jnp.sum(relative * found.normal, axis=-1)
        return found, arm1, arm2, relative, approach, (one, two)

    def advance(time: Array, nothing: None) -> tuple[Array, Array]:
        found, _, _, _, approach, _ = closest_at(time)
        ahead = contact.time_of_impact(found.distance, approach, dt - time)
        # Links that sped up met earlier than their first speeds told.
        back = jnp.minimum(found.distance, 0.0) / jnp.where(approach > 1e-3, approach, jnp.inf)
        return time + jnp.where(found.distance > 0.0, ahead, jnp.maximum(back, -time)), found.distance

    # A scan, because an unrolled loop would be compiled as many times over.
    time, gaps = jax.lax.scan(advance, jnp.zeros(a.radius.shape, v1.dtype), length=constants.advances)
    found, arm1, arm2, relative, approach, segments = closest_at(time)
    gained = dv1 + jnp.cross(dw1, arm1) - dv2 - jnp.cross(dw2, arm2)
    lowest = jnp.minimum(gaps[0], found.distance)
    given = sum(
        compliance(each.body, each.rows, each.seen.matrices, arm, each.seen.morphology, constants.held, each.chosen)
        for each, arm in ((first, arm1), (second, arm2))
    )
    along_normal = jnp.sum(given * found.normal[..., None, :], axis=-1)
    return Meeting(
        gap=gaps[0],
        lowest=lowest,
        near=contact.smooth_gate(lowest, constants.margin),
        remaining=dt - time,
        normal=found.normal,
        depth=jnp.maximum(-found.distance, 0.0),
        relative=relative,
        approach=approach,
        slide=relative - approach[..., None] * found.normal,
        gained=gained,
        arms=(arm1, arm2),
        segments=segments,
        given=along_normal,
        mass=1.0 / jnp.sum(along_normal * found.normal, axis=-1),
    )


def within_reach(first: Party, second: Party, dt: float, constants: MeetingConstants = MeetingConstants()) -> Array:
    """(B, P) which links of the pair may come nearer than the margin within the step.

    False only where `near` of their meeting is zero: along the line between them their ends come no faster than this.
    """
    found = contact.closest(first.segment, second.segment)
    speeds = []
    for mine, others in ((first.before, second.before), (first.after, second.after)):
        closing = jnp.sum((mine.velocity - others.velocity) * found.normal, axis=-1)
        swings = (
            0.5 * party.of(party.seen.morphology)[..., 0] * contact.norm(own.spin)
            for party, own in ((first, mine), (second, others))
        )
        speeds.append(closing + sum(swings))
    return ~(found.distance - dt * jnp.maximum(jnp.maximum(*speeds), 0.0) >= constants.margin)


def gatherings(
    scene: Scene, state: Array, morphology: Array, after: Array | None = None
) -> list[tuple[Pair, Party, Party]]:
    """Every pair of the scene and its bodies in states (B, L, 13) of a morphology (B or 1, L, 3).

    after: states (B, L, 13) whose velocities are those at the end of the step; as they are by default.
    """
    seen, free = kinematics(scene, state, morphology), state if after is None else after
    found = []
    for pair in scene.pairs:
        first, second = scene.body(pair.first), scene.body(pair.second)
        one, two = (
            (seen.of(scene, body.name), Velocities.of(free[:, scene.rows(body.name)])) for body in (first, second)
        )
        found.append((pair, *parties(pair, (first, second), (one[0], two[0]), (one[1], two[1]))))
    return found


def meetings(scene: Scene, state: Array, morphology: Array, after: Array | None = None) -> list[tuple[Pair, Meeting]]:
    """Every pair of the scene and how its links meet; see `gatherings`."""
    return [
        (pair, meet(pair, first, second, scene.dt))
        for pair, first, second in gatherings(scene, state, morphology, after)
    ]


def first_contact(scene: Scene, states: Array, morphology: Array) -> Array:
    """(E,) the first step t of states (E, T + 1, L, 13) in which a pair's contact changes the second link's velocity.

    morphology (E or 1, L, 3). The contact falls between states t and t + 1. -1 where there is none.
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
    """`first_contact` (E,) of many trajectories, chunk by chunk."""
    count = len(episodes.states)
    rows = np.minimum(np.arange(count + -count % chunk), count - 1).reshape(-1, chunk)
    found = (_first_contact(scene, episodes.states[each], episodes.morphology[each]) for each in rows)
    return np.concatenate(list(found))[:count]


_first_contact = jax.jit(first_contact, static_argnums=0)

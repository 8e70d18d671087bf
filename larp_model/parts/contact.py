"""Contact of two bodies: what is known of the impulse between their links, and a network that corrects it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import contact, meeting
from larp_model.kinematics import Kinematics, picked
from larp_model.meeting import Meeting, Party, Velocities
from larp_model.networks import Measured, Perceptron, Size, Statistics, Weights, bounded, evaluate
from larp_model.parts.part import Hits, name_of
from larp_model.parts.sphere import RARELY
from larp_model.scene import Body, Pair

UP = np.array([0.0, 0.0, 1.0], np.float32)


class KnownContact(NamedTuple):
    """What is known of P pairs of links that meet; vectors (B, P, 3) in the world frame.

    change: (B, P) of the speed at which they part [m/s]. lag: (B, P) [s] for which the impulses act on positions.
    impulses: on both links, the ground's answer included [N s]; moments: of these about the links' centres [N m s];
    travel: see `Hits`. speeds [m/s] and scalars (B, P): what the network sees of all that.
    """

    change: Array
    lag: Array
    impulses: tuple[Array, Array]
    moments: tuple[Array, Array]
    travel: tuple[Array, Array]
    speeds: tuple[Array, ...]
    scalars: tuple[Array, ...]


class ContactBase(Protocol):
    """What is known of a contact before anything learned is asked."""

    def prepared(self, party: Party) -> Party:
        """A party with what is worked out once for all its links."""

    def known(self, first: Party, second: Party, met: Meeting, part: Contact) -> KnownContact:
        """What the links of two bodies do to each other."""

    def flipped(self, known: KnownContact) -> KnownContact:
        """The same from the other's side."""


class LearnedImpulse(NamedTuple):
    """What a network adds: impulse (B, P, 3) [N s] on the other, and by how much (B, P, 1) [s] all of it acts longer.

    lifts: impulses (B, P, 3) [N s] with which the ground holds both.
    """

    impulse: Array
    late: Array
    lifts: tuple[Array, Array]

    def flipped(self) -> LearnedImpulse:
        """The same from the other's side."""
        return LearnedImpulse(-self.impulse, self.late, self.lifts[::-1])

    def mean(self, other: LearnedImpulse) -> LearnedImpulse:
        """Half of both."""
        return jax.tree.map(lambda a, b: 0.5 * (a + b), self, other)

    @staticmethod
    def none(met: Meeting) -> LearnedImpulse:
        """Nothing beyond what is known."""
        nothing = jnp.zeros_like(met.normal)
        return LearnedImpulse(nothing, nothing[..., :1], (nothing, nothing))


@dataclass(frozen=True)
class Contact:
    """An impulse between two links, and how the ground holds against it; none where they are apart.

    What the network adds to what its base knows is made of the contact's own vectors, and what it sees of them are
    their products: turned or mirrored, everything is as before. The same from either side: bodies are in the order of
    their kinds, and where they are of one kind both views are taken, and their mean.

    bounds: what the network may add, so that no state, however odd, is thrown out of the world: share of the known
    change, normal speed [m/s], shares along the slide and along the four vectors of `view`, speeds up from the ground
    [m/s], lag [ms]. size: of the network; None where nothing is learned. grounded: height of a link above the ground at
    which it is not felt [m]. arm: unit of arms [m].
    """

    bodies: tuple[Body, Body]
    pair: Pair
    dt: float
    gravity: float
    base: ContactBase
    size: Size | None
    bounds: tuple[float, ...] = (1.0, 3.0, 1.0, 1.0, 1.0, 1.0, 1.0, 3.0, 3.0, 5.0)
    grounded: float = 0.03
    arm: float = 0.1
    constants: meeting.MeetingConstants = field(default_factory=meeting.MeetingConstants)

    @property
    def name(self) -> str:
        """Of its network."""
        return f"contact/{name_of(*self.bodies)}"

    def networks(self) -> dict[str, Perceptron]:
        """See `PairPart`."""
        return {} if self.size is None else {self.name: self.size.network(len(self.bounds))}

    def meet(
        self, weights: Weights, seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]
    ) -> tuple[Hits, Hits]:
        """See `PairPart`. Contact by contact, for of all links that could touch most scenes have one near, or none."""
        first, second = meeting.parties(self.pair, self.bodies, seen, free)
        within = meeting.within_reach(first, second, self.dt, self.constants)
        # The first of a scene that is near is its number 1, and so on.
        number = jnp.where(within, jnp.cumsum(within, axis=1), 0)
        none = Hits.none(seen[0]), Hits.none(seen[1])

        def touch(both: tuple[Party, Party], found: tuple[Hits, Hits], turn: Array) -> tuple[tuple[Hits, Hits], None]:
            mine = number == turn

            def one_more() -> tuple[Hits, Hits]:
                more = self.touch(weights, *(party._replace(chosen=mine[:, None]) for party in both))
                there = jnp.any(mine, axis=1)[:, None, None]
                one, two = (
                    hits.plus(jax.tree.map(lambda each: jnp.where(there, each, 0.0), new))
                    for hits, new in zip(found, more, strict=True)
                )
                return one, two

            return jax.lax.cond(jnp.any(mine), one_more, lambda: found), None

        def all_of_them() -> tuple[Hits, Hits]:
            both = self.base.prepared(first), self.base.prepared(second)
            return jax.lax.scan(partial(touch, both), none, 1 + jnp.arange(number.shape[1]))[0]

        # Steps without contact are by far the most.
        one, two = jax.lax.cond(jnp.any(within), all_of_them, lambda: none)
        return one, two

    def touch(self, weights: Weights, first: Party, second: Party) -> tuple[Hits, Hits]:
        """What links that meet do to each other's bodies."""
        met = meeting.meet(self.pair, first, second, self.dt, self.constants)
        known = self.base.known(first, second, met, self)
        push = self.view(weights, first, second, met, known)
        if self.symmetric:
            push = push.mean(self.view(weights, second, first, met.flipped(), self.base.flipped(known)).flipped())
        one, two = (
            _onto(party, met, known, push, number, sign)
            for number, (party, sign) in enumerate(((first, -1.0), (second, 1.0)))
        )
        return one, two

    def measure(self, seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]) -> Measured:
        """See `PairPart`."""
        if self.size is None:
            return {}
        first, second = map(self.base.prepared, meeting.parties(self.pair, self.bodies, seen, free))
        met = meeting.meet(self.pair, first, second, self.dt, self.constants)
        known = self.base.known(first, second, met, self)
        views = [self.inputs(first, second, met, known)]
        if self.symmetric:
            views.append(self.inputs(second, first, met.flipped(), self.base.flipped(known)))
        inputs, near = jnp.concatenate(views), jnp.concatenate([met.near] * len(views))
        return {self.name: (Statistics.of(inputs.reshape(-1, inputs.shape[-1]), near.reshape(-1) + RARELY), None)}

    @property
    def symmetric(self) -> bool:
        """Whether both bodies are of one kind."""
        return self.bodies[0].kind == self.bodies[1].kind

    def inputs(self, me: Party, other: Party, met: Meeting, known: KnownContact) -> Array:
        """What the network sees (B, P, F): products of the contact's vectors, scalars, and which links meet."""
        swings = (jnp.cross(party.before.spin, arm) for party, arm in zip((me, other), met.arms, strict=True))
        up = jnp.broadcast_to(jnp.asarray(UP, met.normal.dtype), met.normal.shape)
        vectors = jnp.stack(
            [met.normal, met.slide, up, met.mass[..., None] * met.given, met.gained, *known.speeds, *met.arms, *swings],
            axis=-2,
        )
        products = jnp.sum(vectors[..., :, None, :] * vectors[..., None, :, :], axis=-1)
        each = [products[..., row, row:] for row in range(vectors.shape[-2])]
        scalars = [
            jnp.clip(met.gap, -0.1, 0.2),
            jnp.clip(met.lowest, -0.05, 0.05),
            met.remaining,
            met.approach,
            *known.scalars,
            met.mass,
        ]
        for party, segment in zip((me, other), met.segments, strict=True):
            sizes = jnp.broadcast_to(party.of(party.seen.morphology), (*met.gap.shape, 3))
            scalars += [
                jnp.minimum(_clearance(party, segment.centre), 0.3),
                party.before.velocity[..., 2],
                *jnp.moveaxis(sizes, -1, 0),
            ]
        which = []
        for party in (me, other):
            links, places = np.unique(party.rows, return_inverse=True)
            named = picked(jnp.eye(len(links), dtype=met.gap.dtype)[None, places], party.chosen)
            which.append(jnp.broadcast_to(named, (*met.gap.shape, len(links))))
        return jnp.concatenate([*each, jnp.stack(scalars, axis=-1), *which], axis=-1)

    def view(self, weights: Weights, me: Party, other: Party, met: Meeting, known: KnownContact) -> LearnedImpulse:
        """What one body does to the other, by its own lights, beyond what is known; nothing without a network.

        Along the normal: a share of the known change, and a speed. Across it: along the slide, and, in shares of that
        change, along the directions in which the links give way, of up, and of both arms.
        """
        if self.size is None:
            return LearnedImpulse.none(met)
        outputs = evaluate(self.networks()[self.name], weights, self.name, self.inputs(me, other, met, known))
        outputs = bounded(outputs, self.bounds) * met.near[..., None]
        scale, add, along, *shares, lift, other_lift, late = jnp.split(outputs, len(self.bounds), axis=-1)
        change, mass = known.change[..., None], met.mass[..., None]
        up = jnp.asarray(UP, change.dtype)
        velocity = (change * scale + add) * met.normal + along * met.slide
        directions = (mass * met.given, up, met.arms[0] / self.arm, met.arms[1] / self.arm)
        for share, direction in zip(shares, directions, strict=True):
            across = direction - jnp.sum(direction * met.normal, axis=-1, keepdims=True) * met.normal
            velocity += share * change * across
        lifts = (
            mass * speed * contact.smooth_gate(_clearance(party, segment.centre), self.grounded)[..., None] * up
            for speed, party, segment in zip((lift, other_lift), (me, other), met.segments, strict=True)
        )
        one, two = lifts
        return LearnedImpulse(mass * velocity, 0.001 * late, (one, two))


def _clearance(party: Party, centre: Array) -> Array:
    """How far links at centres (B, P, 3) are above the ground (B, P) [m]."""
    segment = party.segment
    return centre[..., 2] - jnp.abs(segment.half[..., 2]) - segment.radius


def _onto(party: Party, met: Meeting, known: KnownContact, push: LearnedImpulse, number: int, sign: float) -> Hits:
    """What is known and what is learned do to one of the bodies: its number, and the sign of impulses on it."""
    own = picked(jnp.eye(len(party.body.links), dtype=push.late.dtype)[None, party.rows], party.chosen)
    impulse, lift = sign * push.impulse, push.lifts[number]
    half = party.segment.half
    foot = -jnp.sign(half[..., 2:]) * half  # the ground holds against the lower end
    all_of_it = known.impulses[number] + impulse + lift
    moment = known.moments[number] + jnp.cross(met.arms[number], impulse) + jnp.cross(foot, lift)
    travel = known.travel[number] + (impulse + lift) * known.lag[..., None] + all_of_it * push.late
    hits = jnp.concatenate([all_of_it, moment], axis=-1), travel
    return Hits(*(jnp.sum(own[..., None] * each[:, :, None], axis=1) for each in hits))

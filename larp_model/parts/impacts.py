"""What is known of a contact: the free impact of its links, or how they press on each other and on the ground."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from larp_model import contact, soft_contact
from larp_model.compliance import moments, yields
from larp_model.kinematics import picked
from larp_model.mechanics import fading
from larp_model.meeting import Meeting, Party
from larp_model.parts.contact import UP, Contact, KnownContact
from larp_model.soft_contact import Loose, Rule, Side, Tied
from larp_model.vector import Vector


@dataclass(frozen=True)
class FreeImpact:
    """A damped spring along the normal, solved in closed form: nothing of friction, nor of the ground.

    impedance: see `contact.impact`.
    """

    impedance: float = contact.IMPEDANCE

    def prepared(self, party: Party) -> Party:
        """See `Base`: nothing is."""
        return party

    def known(self, first: Party, second: Party, met: Meeting, part: Contact) -> KnownContact:
        """See `ContactBase`."""
        dt = part.dt
        acceleration = jnp.sum(met.gained * met.normal, axis=-1) / dt
        surface = part.pair.surface
        free = contact.impact(met.depth, met.approach, acceleration, surface, met.remaining, self.impedance)
        impulse = (met.mass * free.change)[..., None] * met.normal
        both = -impulse, impulse
        one, two = (jnp.cross(arm, each) for arm, each in zip(met.arms, both, strict=True))
        travel = tuple(each * free.lag[..., None] for each in both)
        return KnownContact(free.change, free.lag, both, (one, two), (travel[0], travel[1]), (), tuple(free))

    def flipped(self, known: KnownContact) -> KnownContact:
        """See `ContactBase`."""
        return _flipped(known)


@dataclass(frozen=True)
class SoftContacts:
    """Links press on each other, and balls on the ground, from where they meet to the end of the step.

    Of a ball on the ground it is what the ground does more than if nothing touched the ball.
    """

    rule: Rule = field(default_factory=Rule)

    def prepared(self, party: Party) -> Party:
        """See `ContactBase`."""
        if party.body.is_ball or not self.rule.fades:
            return party
        seen, (links, places) = party.seen, np.unique(party.rows, return_inverse=True)
        gives = fading(party.body, links, seen.matrices, seen.morphology, self.rule.fades)
        return party._replace(gives=tuple(each[:, places] for each in gives))

    def known(self, first: Party, second: Party, met: Meeting, part: Contact) -> KnownContact:
        """See `ContactBase`."""
        one, two = (_side(party, met, number, part) for number, party in enumerate((first, second)))
        ground1, ground2 = (party.body.surface if party.body.is_ball else None for party in (first, second))
        time, apart = met.remaining, jnp.zeros(met.remaining.shape, bool)
        if grounded := bool(ground1 or ground2):
            one, two, time = jax.tree.map(lambda each: jnp.stack([each, each]), (one, two, time))
            apart = jnp.stack([apart, ~apart])
        found = soft_contact.press((one, two), part.pair.surface, (ground1, ground2), time, apart, self.rule)
        if grounded:
            found = jax.tree.map(lambda each: each[0] - each[1], found)
        (impulse1, moment1, travel1), (impulse2, moment2, travel2), between = jax.tree.map(
            lambda vector: vector.array, found, is_leaf=lambda each: isinstance(each, Vector)
        )
        mass = met.mass[..., None]
        through = jnp.sum(between * met.normal, axis=-1)
        lag = jnp.sum(travel2 * met.normal, axis=-1) / jnp.maximum(through, 1e-6)
        change, lag = through / met.mass, jnp.clip(lag, 0.0, met.remaining)
        speeds = between / mass, (impulse1 + between) / mass, (impulse2 - between) / mass
        return KnownContact(
            change, lag, (impulse1, impulse2), (moment1, moment2), (travel1, travel2), speeds, (change, lag)
        )

    def flipped(self, known: KnownContact) -> KnownContact:
        """See `ContactBase`."""
        between, one, two = known.speeds
        return _flipped(known)._replace(speeds=(-between, two, one))


def _flipped(known: KnownContact) -> KnownContact:
    return known._replace(impulses=known.impulses[::-1], moments=known.moments[::-1], travel=known.travel[::-1])


def _side(party: Party, met: Meeting, number: int, part: Contact) -> Side:
    """A link at the moment at which it meets the other."""
    segment, seen = met.segments[number], party.seen
    share = 1.0 - (met.remaining / part.dt)[..., None]
    velocity, spin = (was + share * gained for was, gained in zip(party.before, party.gained, strict=True))
    acceleration, turning = (each / part.dt for each in party.gained)
    length, radius, mass = jnp.moveaxis(jnp.broadcast_to(party.of(seen.morphology), velocity.shape), -1, 0)
    gives: Loose | Tied
    if party.body.is_ball:
        acceleration = acceleration - part.gravity * jnp.asarray(UP, velocity.dtype)
        gives = Loose(1.0 / mass, 1.0 / moments(length, radius, mass)[0])
    elif party.gives:
        lasts, *passes = (picked(each, party.chosen) for each in party.gives)
        gives = Tied(lasts, tuple(passes))
    else:
        held = part.constants.held
        gives = Tied(yields(party.body, party.rows, seen.matrices, seen.morphology, held, party.chosen))
    return Side(
        Vector.of(segment.centre), Vector.of(segment.half), segment.radius, Vector.of(velocity), Vector.of(spin),
        Vector.of(acceleration), Vector.of(turning), gives,
    )  # fmt: skip

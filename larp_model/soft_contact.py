"""Two links that press on each other, and balls among them on the ground, by MuJoCo's law of soft contacts.

A contact's relative acceleration a, free a0, and its force f obey (MuJoCo documentation, Computation, "Constraint
model")

    a = a0 + A f,    a + R f = -k p n - b v,    R = (1 - d) / d A,    f in the friction cone,

p the gap along the normal n, v the relative velocity, d the impedance. From where the links meet to the end of the step
this is integrated by the implicit midpoint rule; in every substep the forces are found by projected Gauss-Seidel
sweeps, contact by contact, from those of the substep before. What forces have made of a link that others are tied to
fades, and is carried along.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from larp_model import contact
from larp_model.scene import Surface
from larp_model.vector import Vector


@dataclass(frozen=True)
class Rule:
    """How finely it is integrated.

    fades: times [s] with which links that are tied to others are pulled back, as in `mechanics.fading`; they are held
    at once where there are none.
    """

    substeps: int = 10
    sweeps: int = 8
    impedance: float = contact.IMPEDANCE
    fades: tuple[float, ...] = ()


class Symmetric(NamedTuple):
    """A symmetric matrix, (*,) each."""

    xx: Array
    yy: Array
    zz: Array
    xy: Array
    yz: Array
    zx: Array

    def plus(self, other: Symmetric) -> Symmetric:
        """The sum."""
        return Symmetric(*(mine + others for mine, others in zip(self, other, strict=True)))

    def of(self, vector: Vector) -> Vector:
        """Times a vector."""
        x, y, z = vector.x, vector.y, vector.z
        return Vector(
            self.xx * x + self.xy * y + self.zx * z, self.xy * x + self.yy * y + self.yz * z,
            self.zx * x + self.yz * y + self.zz * z,
        )  # fmt: skip


class Loose(NamedTuple):
    """What a ball gives way: velocity per impulse [1/kg], and spin per moment [1/(kg m^2)], (*,) each."""

    light: Array
    turns: Array

    def twist(self, force: Vector, moment: Vector) -> tuple[Vector, Vector]:
        """What a force and a moment do to velocity and spin."""
        return force * self.light, moment * self.turns

    def at(self, arm: Vector) -> Symmetric:
        """How the point at an arm gives way to a force there."""
        x, y, z, light, turns = arm.x, arm.y, arm.z, self.light, self.turns
        return Symmetric(
            light + turns * (y * y + z * z), light + turns * (z * z + x * x), light + turns * (x * x + y * y),
            -turns * x * y, -turns * y * z, -turns * z * x,
        )  # fmt: skip


class Tied(NamedTuple):
    """What a link gives way that others are tied to: (*, 6, 6), see `compliance.yields`.

    passing: what it gives way at first besides, (*, 6, 6) for each of the rule's fades.
    """

    matrix: Array
    passing: tuple[Array, ...] = ()

    def within(self, time: Array, rule: Rule) -> Tied:
        """What it gives way on average while a force lasts, (*,) [s]."""
        given = self.matrix
        for fade, part in zip(rule.fades, self.passing, strict=True):
            given = given + (fade / time * (1.0 - jnp.exp(-time / fade)))[..., None, None] * part
        return Tied(given)

    def twist(self, force: Vector, moment: Vector) -> tuple[Vector, Vector]:
        """What a force and a moment do to velocity and spin."""
        given = (force.x, force.y, force.z, moment.x, moment.y, moment.z)
        zero = jnp.zeros_like(force.x)
        rows = [sum((self.matrix[..., row, i] * each for i, each in enumerate(given)), zero) for row in range(6)]
        return Vector(*rows[:3]), Vector(*rows[3:])

    def at(self, arm: Vector) -> Symmetric:
        """How the point at an arm gives way to a force there."""
        zero = jnp.zeros_like(arm.x)
        one = zero + 1.0
        rows = []
        for axis in (Vector(one, zero, zero), Vector(zero, one, zero), Vector(zero, zero, one)):
            v, w = self.twist(axis, arm.cross(axis))
            rows.append(v + w.cross(arm))
        return Symmetric(rows[0].x, rows[1].y, rows[2].z, rows[0].y, rows[1].z, rows[2].x)


class Side(NamedTuple):
    """A link: segment, velocity and spin where it meets the other, its free accelerations, and how it gives way."""

    centre: Vector
    half: Vector
    radius: Array
    velocity: Vector
    spin: Vector
    acceleration: Vector
    turning: Vector
    gives: Loose | Tied

    def free(self, arm: Vector) -> Vector:
        """The free acceleration of the point at an arm."""
        return self.acceleration + self.turning.cross(arm)


class Moves(NamedTuple):
    """What moves in a substep."""

    centre: Vector
    half: Vector
    velocity: Vector
    spin: Vector

    def at(self, arm: Vector) -> Vector:
        """The velocity of the point at an arm."""
        return self.velocity + self.spin.cross(arm)

    def after(self, acceleration: Vector, turning: Vector, h: Array) -> Moves:
        """All that a while later."""
        velocity, spin = self.velocity + acceleration * h, self.spin + turning * h
        turned = (self.spin + spin).cross(self.half) * (0.5 * h)
        return Moves(self.centre + (self.velocity + velocity) * (0.5 * h), self.half + turned, velocity, spin)


class Done(NamedTuple):
    """To a link: impulse [N s], its moment about the link's centre, and impulse times how long it acts [N s^2]."""

    impulse: Vector
    moment: Vector
    travel: Vector


Twist = tuple[Vector, Vector]
"""A velocity and a spin."""


def _fading(side: Side, kept: tuple[Twist, ...], h: Array, rule: Rule) -> Side:
    """The side as it loses within `h` what passes of that which it keeps from earlier forces."""
    acceleration, turning = side.acceleration, side.turning
    for fade, (velocity, spin) in zip(rule.fades, kept, strict=False):
        rate = (jnp.exp(-h / fade) - 1.0) / h
        acceleration, turning = acceleration + velocity * rate, turning + spin * rate
    return side._replace(acceleration=acceleration, turning=turning)


def _keeps(
    passing: tuple[Array, ...], kept: tuple[Twist, ...], force: Vector, moment: Vector, h: Array, rule: Rule
) -> tuple[Twist, ...]:
    """What a side keeps after a force and a moment have acted on it for `h`."""
    after = []
    for fade, part, (velocity, spin) in zip(rule.fades, passing, kept, strict=False):
        left = jnp.exp(-h / fade)
        v, w = Tied(part).twist(force, moment)
        gained = fade * (1.0 - left)
        after.append((velocity * left + v * gained, spin * left + w * gained))
    return tuple(after)


# Between the links, and of the ground on those that lie on it.
_Forces = tuple[Vector, dict[int, Vector]]
_Kept = tuple[tuple[Twist, ...], tuple[Twist, ...]]
_Carried = tuple[tuple[Moves, Moves], tuple[Done, Done], Vector, _Forces, _Kept]


def press(
    both: tuple[Side, Side], surface: Surface, grounds: tuple[Surface | None, Surface | None], time: Array,
    apart: Array, rule: Rule = Rule(),
) -> tuple[Done, Done, Vector]:  # fmt: skip
    """What contacts do to both links within `time` (*,) [s], and the first's impulse on the second.

    grounds: the surfaces with which the links, balls, lie on the ground; None where it is not looked at. apart: (*,)
    where true the links pass through each other, and only the ground is felt.
    """
    # What is left of the step may be nothing.
    h, one, zero = jnp.maximum(time / rule.substeps, 1e-7), jnp.ones_like(time), jnp.zeros_like(time)
    nothing, up = Vector(zero, zero, zero), Vector(zero, zero, one)
    lying = {index: ground for index, ground in enumerate(grounds) if ground}
    passing = tuple(() if isinstance(side.gives, Loose) else side.gives.passing for side in both)
    fresh = [
        side if isinstance(side.gives, Loose) else side._replace(gives=side.gives.within(h, rule)) for side in both
    ]

    def substep(carry: _Carried, number: Array) -> tuple[_Carried, None]:
        moves, done, between, forces, kept = carry
        sides = [_fading(side, before, h, rule) for side, before in zip(fresh, kept, strict=True)]
        normal, gap, point, _ = contact.nearest(
            *(contact.Axis(own.centre, own.half, side.radius) for own, side in zip(moves, sides, strict=True))
        )
        arms = (point - moves[0].centre, point - moves[1].centre)
        speed = moves[1].at(arms[1]) - moves[0].at(arms[0])
        free = sides[1].free(arms[1]) - sides[0].free(arms[0])
        gives = sides[0].gives.at(arms[0]).plus(sides[1].gives.at(arms[1]))
        met = _asked(surface, rule, h, gap, normal, speed, free, gives, ~apart)
        below = {}
        for index in lying:
            side, own, arm = sides[index], moves[index], up * -sides[index].radius
            lowest = own.centre.z - side.radius
            asked = _asked(
                lying[index], rule, h, lowest, up, own.at(arm), side.free(arm), side.gives.at(arm), one > 0.0
            )
            below[index] = arm, asked
        push, floor = forces[0] * met.on, {index: forces[1][index] * below[index][1].on for index in lying}

        def sweep(found: _Forces, _: None) -> tuple[_Forces, None]:
            push, floor = found[0], dict(found[1])
            others = nothing
            for index in lying:
                v, w = sides[index].gives.twist(floor[index], below[index][0].cross(floor[index]))
                others = others + (v + w.cross(arms[index])) * (1.0 if index else -1.0)
            push = met.solve(push, others)
            for index in lying:
                own = push * (1.0 if index else -1.0)
                v, w = sides[index].gives.twist(own, arms[index].cross(own))
                arm, ground = below[index]
                floor[index] = ground.solve(floor[index], v + w.cross(arm))
            return (push, floor), None

        # A scan, because unrolled sweeps take minutes to compile with their derivatives.
        (push, floor), _ = jax.lax.scan(sweep, (push, floor), length=rule.sweeps)
        left = time - (number + 0.5) * h
        after, felt, keep = [], [], []
        for index, (side, own, so_far) in enumerate(zip(sides, moves, done, strict=True)):
            force = push * (1.0 if index else -1.0)
            moment = arms[index].cross(force)
            if index in lying:
                force, moment = force + floor[index], moment + below[index][0].cross(floor[index])
            v, w = side.gives.twist(force, moment)
            keep.append(_keeps(passing[index], kept[index], force, moment, h, rule))
            after.append(own.after(side.acceleration + v, side.turning + w, h))
            felt.append(
                Done(so_far.impulse + force * h, so_far.moment + moment * h, so_far.travel + force * (h * left))
            )
        return (
            (after[0], after[1]), (felt[0], felt[1]), between + push * h, (push, floor), (keep[0], keep[1])
        ), None  # fmt: skip

    first, second = (Moves(side.centre, side.half, side.velocity, side.spin) for side in both)
    idle = Done(nothing, nothing, nothing)
    none, other = (((nothing, nothing),) * len(parts) for parts in passing)
    start = ((first, second), (idle, idle), nothing, (nothing, {index: nothing for index in lying}), (none, other))
    (_, done, between, _, _), _ = jax.lax.scan(substep, start, jnp.arange(rule.substeps, dtype=time.dtype))
    return done[0], done[1], between


class _Asked(NamedTuple):
    """A contact in a substep: which acceleration its force has to bring about, and how easily.

    on: 0 where the links are apart. gives: of the force; along the normal, and on average across it. soft: R. more: of
    the acceleration, along and across, as much as it changes what is asked within half a substep.
    """

    normal: Vector
    wanted: Vector
    free: Vector
    gives: Symmetric
    along: Array
    across: Array
    soft: Array
    more: tuple[Array, Array]
    friction: float
    on: Array

    def solve(self, force: Vector, others: Vector) -> Vector:
        """A better force, where other forces add this to the acceleration."""
        n = self.normal
        acceleration = self.free + others + self.gives.of(force)
        pressing, along, wanted = force.dot(n), acceleration.dot(n), self.wanted.dot(n)
        left = wanted - self.more[0] * along - self.soft * pressing
        pressed = jnp.maximum(pressing + left / (self.more[0] * self.along + self.soft), 0.0)
        slide = force - n * pressing
        lacks = (self.wanted - n * wanted) - (acceleration - n * along) * self.more[1] - slide * self.soft
        slide = slide + lacks * (1.0 / (self.more[1] * self.across + self.soft))
        squared, limit = slide.dot(slide), self.friction * pressed
        over = squared > limit * limit
        slide = slide * jnp.where(over, limit / jnp.sqrt(jnp.where(over, squared, 1.0)), 1.0)
        return (n * pressed + slide) * self.on


def _asked(
    surface: Surface, rule: Rule, h: Array, gap: Array, normal: Vector, speed: Vector, free: Vector, gives: Symmetric,
    there: Array,
) -> _Asked:  # fmt: skip
    ahead = gap + 0.5 * h * speed.dot(normal)
    damped = 0.5 * h * surface.damping
    along = gives.of(normal).dot(normal)
    across = 0.5 * (gives.xx + gives.yy + gives.zz - along)
    soft = (1.0 - rule.impedance) / rule.impedance * along
    wanted = speed * -surface.damping - normal * (surface.stiffness * ahead)
    more = (1.0 + damped + 0.25 * h * h * surface.stiffness, 1.0 + damped)
    return _Asked(
        normal, wanted, free, gives, along, across, soft, more, surface.friction,
        (there & (ahead < 0.0)).astype(gap.dtype),
    )  # fmt: skip

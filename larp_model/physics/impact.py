"""Contacts of links with links, and of balls with the ground, within a step: integrated in contact space.

Bodies move on as if nothing touched them, but for the ground that carries articulated bodies, and respond to impulses
linearly (`response`). So a step's contacts are solved for between the few links that touch, in substeps, by the law of
`contact`, and all other links are told once what became of it. Substeps leapfrog: velocities change at once at their
middle, by the forces of where the sides are then, so that MuJoCo's motion at small steps is met to second order in h.

Arrays have the batch last, as in `linalg`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import cross, cross_columns, cross_rows, mv
from larp_model.physics import contact
from larp_model.physics.articulated import Momenta
from larp_model.physics.collision import (
    Candidates,
    CapsuleShapes,
    ContactSettings,
    Rates,
    Sides,
    closest,
    picked,
    sides_of,
    turned,
)
from larp_model.physics.contact import IMPEDANCE, ContactProblem
from larp_model.physics.kinematics import Kinematics
from larp_model.physics.motion import Articulation, BodyMotion, moments
from larp_model.physics.response import responses
from larp_model.scene import Scene, Surface

UP = np.array([0.0, 0.0, 1.0])[None, :, None]


class SideStates(NamedTuple):
    """The sides in a substep, (S, 3, B) each, and (C, 3, B) impulses of the one before.

    centre, half: at its middle. velocity, spin: when it begins. fading, fading_turning: the part of them that servos
    take back.
    """

    centre: Array
    half: Array
    velocity: Array
    spin: Array
    fading: Array
    fading_turning: Array
    impulses: Array


Spread = dict[str, tuple[list[int], tuple[Array, Array]]]
"""By articulated body: the sides that it may be, and the velocities that its links gain by impulses there."""

Totals = tuple[tuple[Array, Array], tuple[Array, Array]]
"""Impulses and moments (2, S, 3, B), kept and fading: what is there at the end of the step, and summed over time."""


def integrate(
    scene: Scene,
    seen: Kinematics,
    rates: Rates,
    articulations: dict[str, Articulation],
    gaps: Array,
    dt: float,
    settings: ContactSettings,
) -> BodyMotion:
    """Return what contacts within `dt` [s] add to the motion (L, 3, B) of all links; see the module.

    articulations: of the articulated bodies by name. gaps: (P, B), see `Candidates.gaps`.
    """
    candidates = Candidates(scene)
    count = min(settings.contacts, len(gaps))
    chosen = jax.nn.one_hot(jnp.argsort(gaps, axis=0)[:count], len(gaps), axis=1, dtype=gaps.dtype)
    sides = sides_of(candidates, chosen)
    spread = {
        name: _spread(scene, name, articulation, sides, seen.sizes, settings)
        for name, articulation in articulations.items()
        if any(name in owners for owners in sides.owners)
    }
    totals = System(candidates, seen, rates, chosen, sides, spread, dt, settings).run()
    parts = []
    for body in scene.bodies:
        rows = scene.rows(body.name)
        if body.is_ball:
            light, turns = _looseness(seen.sizes[rows])
            on = sides.which[:, rows.start][:, None]
            (v, w), (x, t) = ((jnp.sum(on * f[0], axis=0), jnp.sum(on * m[0], axis=0)) for f, m in totals)
            parts.append(BodyMotion(light * v[None], turns * w[None], light * x[None], turns * t[None]))
        elif body.name in spread:
            mine, (velocity, spin) = spread[body.name]
            found = []
            for forces, torques in totals:
                wrench = jnp.stack([jnp.concatenate([forces[:, side], torques[:, side]], axis=1) for side in mine], 1)
                wrench = wrench.reshape(2, -1, wrench.shape[-1])
                found += [_summed(each, wrench) for each in (velocity, spin)]
            parts.append(BodyMotion(*found))
        else:
            parts.append(BodyMotion(*[jnp.zeros_like(seen.position[rows])] * 4))
    return BodyMotion(*(jnp.concatenate(each) for each in zip(*parts, strict=True)))


def _spread(
    scene: Scene, name: str, articulation: Articulation, sides: Sides, sizes: Array, settings: ContactSettings
) -> tuple[list[int], tuple[Array, Array]]:
    """Return the sides that a body may be, and what its links gain by impulses there, (2, n, 3, 6 of each, B) each."""
    rows, body = scene.rows(name), scene.body(name)
    mine = [number for number, owners in enumerate(sides.owners) if name in owners]
    unit = jnp.eye(3, 6, dtype=sizes.dtype)[None, :, :, None]
    on = sides.which[:, rows]
    moving = jnp.concatenate([on[side][:, None, None] * unit for side in mine], axis=2)
    turning = jnp.concatenate([on[side][:, None, None] * jnp.roll(unit, 3, axis=2) for side in mine], axis=2)
    kept, fading = responses(body, articulation, Momenta(turning, moving), sizes[rows], settings.fade)
    velocity, spin = (jnp.stack(each) for each in zip(kept, fading, strict=True))
    return mine, (velocity, spin)


def _couplings(scene: Scene, sides: Sides, spread: Spread) -> tuple[np.ndarray, tuple[Array, Array]]:
    """Return n pairs of sides (2, n) of articulated bodies, and what the first gains by impulses at the second.

    Velocity and spin (2, n, 3, 6, B), kept and fading.
    """
    found: dict[tuple[int, int], list[Array]] = {}
    for name, (mine, gains) in spread.items():
        on = sides.which[:, scene.rows(name)]
        for number, other in enumerate(mine):
            columns = [each[:, :, :, 6 * number : 6 * number + 6] for each in gains]
            for side in mine:
                own = [picked(on[side][None], jnp.moveaxis(each, 1, 0))[0] for each in columns]
                before = found.get((side, other))
                found[side, other] = own if before is None else [a + b for a, b in zip(before, own, strict=True)]
    empty = jnp.zeros((2, 0, 3, 6, sides.which.shape[-1]), sides.which.dtype)
    velocity, spin = (
        jnp.stack([each[number] for each in found.values()], axis=1) if found else empty for number in (0, 1)
    )
    return np.array([*found], int).reshape(-1, 2).T, (velocity, spin)


def _same_balls(scene: Scene, sides: Sides, balls: Sequence[str]) -> tuple[np.ndarray, Array]:
    """Return n pairs of sides (2, n) that may be one and the same ball, and (n, B) 1 where they are, else 0."""
    every = range(len(sides.owners))
    same = [
        (one, two)
        for one in every
        for two in every
        if any(name in sides.owners[one] & sides.owners[two] for name in balls)
    ]
    first, second = rows = np.array(same, int).reshape(-1, 2).T
    which = sides.which[:, np.array([scene.rows(name).start for name in balls], int)]
    return rows, jnp.sum(which[first] * which[second], axis=1)


def _looseness(sizes: Array) -> tuple[Array, Array]:
    """Return a ball's 1 / mass [1/kg] and 1 / moment of inertia, (n, 1, B) each."""
    return 1.0 / sizes[:, 2:3], 1.0 / moments(sizes[:, 0], sizes[:, 1], sizes[:, 2])[0][:, None]


class System:
    """The contacts of a step: all that stays the same in its substeps.

    C contacts of S sides: pairs of links first, then balls on the ground. settings, dt [s]: see `integrate`.
    """

    def __init__(
        self,
        candidates: Candidates,
        seen: Kinematics,
        rates: Rates,
        chosen: Array,
        sides: Sides,
        spread: Spread,
        dt: float,
        settings: ContactSettings,
    ) -> None:
        scene, balls = candidates.scene, candidates.balls
        self.pairs, self.balls, self.sides = len(chosen), len(balls), len(sides.owners)
        self.dt, self.h, self.settings, self.dtype = dt, dt / settings.substeps, settings, chosen.dtype
        self.coupled, self.couplings = _couplings(scene, sides, spread)
        self.same, self.together = _same_balls(scene, sides, balls)
        self.position, self.half, self.velocity, self.spin, self.radius, self.light, self.turns = (
            sides.of(each)
            for each in (
                seen.position, seen.half, seen.velocity, seen.angular_velocity, seen.sizes[:, 1:2],
                *_looseness(seen.sizes),
            )
        )  # fmt: skip
        self.rates = Rates(*(sides.of(each) for each in rates))
        # Second links count against first ones, and balls against the ground.
        pairs, rest = range(self.pairs), range(self.pairs, self.pairs + self.balls)
        self.contact_of = np.array([*pairs, *pairs, *rest])
        self.sign = np.array([-1.0] * self.pairs + [1.0] * (self.sides - self.pairs))
        surfaces = candidates.surfaces, [scene.body(name).surface for name in balls]
        self.stiffness, self.damping, self.friction = (
            self._constants(name, chosen, *surfaces) for name in ("stiffness", "damping", "friction")
        )
        self.mass = self._mass()
        # Of what fades, so much is left after a substep, and so much of what was gained at its middle.
        self.left = float(np.exp(-self.h / settings.fade))
        self.remaining = float(np.exp(-0.5 * self.h / settings.fade))

    def _constants(self, name: str, chosen: Array, of_pairs: Sequence[Surface], of_balls: Sequence[Surface]) -> Array:
        """Return a constant of the contacts' surfaces, (C, 1, B)."""
        every, own = (
            jnp.array([getattr(surface, name) for surface in surfaces], self.dtype)[:, None, None]
            for surfaces in (of_pairs, of_balls)
        )
        found = picked(chosen, every)
        return jnp.concatenate([found, jnp.broadcast_to(own, (len(own), *found.shape[1:]))])

    def _mass(self) -> Array:
        """Return m (C, 1, B) [kg] of `contact`, by the mean inverse masses of the sides at their centres."""
        alone = self.coupled[0] == self.coupled[1]
        at_once = jnp.sum(self.couplings[0][:, alone], axis=0)
        mean = (at_once[:, 0, 0] + at_once[:, 1, 1] + at_once[:, 2, 2]) / 3.0
        weights = _onto(mean[None], self.coupled[0][alone], self.sides)
        alone = self.same[0] == self.same[1]
        own = self.same[0][alone]
        weights = weights + _onto((self.together[alone] * self.light[own, 0])[None], own, self.sides)
        return IMPEDANCE / (1.0 - IMPEDANCE) / _onto(weights, self.contact_of, self.pairs + self.balls)[0][:, None]

    def relative(self, at_sides: Array) -> Array:
        """Return what second links do against first ones, and balls against the ground, (C, 3, B)."""
        pairs = self.pairs
        return jnp.concatenate([at_sides[pairs : 2 * pairs] - at_sides[:pairs], at_sides[2 * pairs :]])

    def contacts(self, moves: SideStates) -> tuple[Array, Array, Array]:
        """Return arms (S, 3, B) [m] from sides to contact points, normals (C, 3, B), and gaps (C, 1, B) [m]."""
        pairs, radius = self.pairs, self.radius
        one, two = (
            CapsuleShapes(moves.centre[side], moves.half[side], radius[side])
            for side in (slice(pairs), slice(pairs, 2 * pairs))
        )
        found = closest(one, two)
        arms = jnp.concatenate([found.point, found.point]) - moves.centre[: 2 * pairs]
        up = jnp.broadcast_to(jnp.asarray(UP, self.dtype), (self.balls, *found.normal.shape[1:]))
        height = moves.centre[2 * pairs :, 2:] - radius[2 * pairs :]
        # Contact points are midway between the surfaces.
        arms = jnp.concatenate([arms, -(radius[2 * pairs :] + 0.5 * height) * up])
        return arms, jnp.concatenate([found.normal, up]), jnp.concatenate([found.distance, height])

    def gains(self, arms: Array) -> tuple[Array, Array]:
        """Return velocities and spins (2, n, 3, 3, B), kept and fading, of coupled sides by impulses at contacts."""
        linear, angular = (
            each[:, :, :, :3] + cross_rows(each[:, :, :, 3:], arms[self.coupled[1]]) for each in self.couplings
        )
        return linear, angular

    def admittance(self, arms: Array, gains: tuple[Array, Array]) -> Array:
        """Return A (C, C, 3, 3, B) [1/kg] of `contact`."""
        (linear, angular), unit = gains, jnp.eye(3, dtype=self.dtype)[..., None]
        at_contact = linear - cross_columns(arms[self.coupled[0]], angular)
        one, two = arms[self.same[0]], arms[self.same[1]]
        # -[r] [s] = (r s) 1 - s r'
        inner = one[:, 0] * two[:, 0] + one[:, 1] * two[:, 1] + one[:, 2] * two[:, 2]
        turned_by = inner[:, None, None] * unit - two[:, :, None] * one[:, None]
        light, turns = (each[self.same[0]][:, None] for each in (self.light, self.turns))
        of_balls = self.together[:, None, None] * (light * unit + turns * turned_by)
        every = range(self.pairs + self.balls)
        blocks = [[jnp.zeros((3, 3, arms.shape[-1]), self.dtype) for _ in every] for _ in every]
        for (first, second), matrices in (
            (self.coupled, at_contact[0] + self.remaining * at_contact[1]), (self.same, of_balls),
        ):  # fmt: skip
            signs, rows, columns = self.sign[first] * self.sign[second], self.contact_of[first], self.contact_of[second]
            for row, column, sign, matrix in zip(rows, columns, signs.tolist(), matrices, strict=True):
                blocks[row][column] += sign * matrix
        return jnp.stack([jnp.stack(row) for row in blocks])

    def gained(self, gains: tuple[Array, Array], on_sides: Array, torques: Array) -> tuple[Array, Array]:
        """Return what sides gain, (2, S, 3, B) kept and fading, by impulses and their moments (S, 3, B)."""
        found = []
        for gain, loose, each in zip(gains, (self.light, self.turns), (on_sides, torques), strict=True):
            own = (self.together[:, None] * loose[self.same[1]] * each[self.same[1]])[None]
            of_balls = _onto(own, self.same[0], self.sides)
            of_links = _onto(mv(gain, on_sides[self.coupled[1]]), self.coupled[0], self.sides)
            found.append(of_links + jnp.concatenate([of_balls, jnp.zeros_like(of_balls)]))
        return found[0], found[1]

    def substep(self, carry: tuple[SideStates, Totals], number: Array) -> tuple[tuple[SideStates, Totals], None]:
        """Return the sides, and the impulses up to there, after the next substep."""
        (moves, totals), h = carry, self.h
        arms, normal, gap = self.contacts(moves)
        gains = self.gains(arms)
        # Accelerations are mean ones where `late` is zero. What servos take back is no acceleration of the joints.
        late = (number + 0.5) * h - 0.5 * self.dt
        rates = self.rates
        faster = h * (rates.acceleration + late * rates.jerk) + (self.left - 1.0) * moves.fading
        spinning = h * (rates.angular_acceleration + late * rates.angular_jerk)
        spinning += (self.left - 1.0) * moves.fading_turning
        now = self.relative(moves.velocity + cross(moves.spin, arms))
        uncounted = self.relative(rates.uncounted + cross(rates.uncounted_angular, arms))
        problem = ContactProblem(
            velocity=now + self.relative(faster + cross(spinning, arms)),
            admittance=self.admittance(arms, gains),
            reference=contact.spring(self.stiffness, self.damping, now, gap, normal, h) + h * uncounted,
            mass=self.mass,
            normal=normal,
            friction=self.friction,
            active=jax.lax.stop_gradient((gap < 0.0).astype(self.dtype)),
        )
        impulses = contact.impulses_of(problem, jax.lax.stop_gradient(moves.impulses), self.settings.iterations)
        on_sides = jnp.concatenate([-impulses[: self.pairs], impulses])
        torques = cross(arms, on_sides)
        gained, gained_turning = self.gained(gains, on_sides, torques)
        velocity = moves.velocity + faster + gained[0] + self.remaining * gained[1]
        spin = moves.spin + spinning + gained_turning[0] + self.remaining * gained_turning[1]
        after = SideStates(
            centre=moves.centre + h * velocity,
            half=turned(moves.half, h * spin),
            velocity=velocity,
            spin=spin,
            fading=self.left * moves.fading + self.remaining * gained[1],
            fading_turning=self.left * moves.fading_turning + self.remaining * gained_turning[1],
            impulses=impulses,
        )
        # Of these impulses so much is there at the end of the step, and acts, all in all, for so long.
        rest, fade = self.dt - (number + 0.5) * h, self.settings.fade
        fades = jnp.exp(-rest / fade)
        there = jnp.stack([jnp.ones_like(rest), fades])
        lasts = jnp.stack([rest, fade * (1.0 - fades)])
        (forces, moments), (travel, swing) = totals
        there, lasts = (each[:, None, None, None] for each in (there, lasts))
        sums = (
            (forces + there * on_sides, moments + there * torques),
            (travel + lasts * on_sides, swing + lasts * torques),
        )
        return (after, sums), None

    def run(self) -> Totals:
        """Return the impulses of all substeps."""
        still = jnp.zeros_like(self.position)
        none = jnp.zeros((self.pairs + self.balls, *still.shape[1:]), self.dtype)
        ahead = self.position + 0.5 * self.h * self.velocity, turned(self.half, 0.5 * self.h * self.spin)
        begun = SideStates(*ahead, self.velocity, self.spin, still, still, none)
        nothing = jnp.zeros((2, *still.shape), self.dtype)
        numbers = jnp.arange(self.settings.substeps, dtype=self.dtype)
        (_, totals), _ = jax.lax.scan(self.substep, (begun, ((nothing, nothing), (nothing, nothing))), numbers)
        return totals


def _onto(parts: Array, rows: np.ndarray, count: int) -> Array:
    """Return (m, count, ..., B) with parts (m, n, ..., B) added up in these rows."""
    nothing = jnp.zeros((parts.shape[0], *parts.shape[2:]), parts.dtype)
    return jnp.stack([sum((parts[:, i] for i in np.flatnonzero(rows == row)), nothing) for row in range(count)], axis=1)


def _summed(gains: Array, wrench: Array) -> Array:
    """Return (n, 3, B) gains (2, n, 3, k, B) times wrenches (2, k, B), kept and fading together."""
    # A sum of slices: XLA hands a reduction to a library that takes ten times as long to begin.
    each = [gains[part, :, :, k] * wrench[part, k] for part in range(2) for k in range(wrench.shape[1])]
    return sum(each[1:], each[0])

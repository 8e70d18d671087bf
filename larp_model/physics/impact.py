"""Contacts of links with links, and of balls with the ground, within a step: integrated in contact space.

Bodies move as if nothing touched them, but for the ground under articulated bodies, and respond to impulses linearly
(`response`). So a step's contacts are solved for between the few links that touch, in substeps, by the law of
`contact`, and the summed impulses then move all links of the bodies. Substeps leapfrog: velocities change at the middle
of a substep, by the forces at the positions there, so that the error against MuJoCo at small steps is of second order
in h.

Arrays have the batch last, as in `linalg`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import contract, cross, cross_columns, cross_rows, mv, saved
from larp_model.physics import contact
from larp_model.physics.articulated import Momenta
from larp_model.physics.collision import (
    Candidates,
    CapsuleShapes,
    ContactSettings,
    Rates,
    Sides,
    closest,
    select,
    sides_of,
    turned_vectors,
)
from larp_model.physics.contact import IMPEDANCE, ContactProblem
from larp_model.physics.kinematics import Kinematics
from larp_model.physics.motion import Articulation, BodyMotion, moments
from larp_model.physics.response import responses
from larp_model.scene import Scene, Surface

UP = np.array([0.0, 0.0, 1.0])[None, :, None]


class SideStates(NamedTuple):
    """The sides in a substep, (S, 3, B) each, and the impulses (C, 3, B) of the one before, for a warm start.

    centre, half: at its middle. velocity, angular_velocity: at its start. transient_velocity,
    transient_angular_velocity: the part of them that servos take back.
    """

    centre: Array
    half: Array
    velocity: Array
    angular_velocity: Array
    transient_velocity: Array
    transient_angular_velocity: Array
    impulses: Array


SideGains = dict[str, tuple[list[int], tuple[Array, Array]]]
"""By articulated body: the sides that it can be, and the gains of its links by impulses there, see `_side_gains`."""

ImpulseTotals = tuple[tuple[Array, Array], tuple[Array, Array]]
"""Sums of impulses and angular impulses (2, S, 3, B), weighted for their lasting and transient effects: on velocities
at the end of the step, and on displacements within it, where each is multiplied by the time that it acts."""


def integrate(
    scene: Scene,
    links: Kinematics,
    rates: Rates,
    articulations: dict[str, Articulation],
    gaps: Array,
    dt: Array | float,
    settings: ContactSettings,
) -> BodyMotion:
    """Return the motion (L, 3, B) of all links that contacts within `dt` [s] add; see the module.

    articulations: of the articulated bodies by name. gaps: (P, B), see `Candidates.gaps`.
    """
    candidates = Candidates(scene)
    count = min(settings.contacts, len(gaps))
    selection = jax.nn.one_hot(saved(jnp.argsort(gaps, axis=0)[:count]), len(gaps), axis=1, dtype=gaps.dtype)
    sides = sides_of(candidates, selection)
    side_gains = {
        name: _side_gains(scene, name, articulation, sides, links.sizes, settings)
        for name, articulation in articulations.items()
        if any(name in owners for owners in sides.owners)
    }
    totals = ContactSystem(candidates, links, rates, selection, sides, side_gains, dt, settings).run()
    parts = []
    for body in scene.bodies:
        rows = scene.rows(body.name)
        if body.is_ball:
            parts.append(_ball_change(links.sizes[rows], sides.one_hot[:, rows.start], totals))
        elif body.name in side_gains:
            parts.append(_articulated_change(*side_gains[body.name], totals))
        else:
            parts.append(BodyMotion(*[jnp.zeros_like(links.position[rows])] * 4))
    return BodyMotion(*(jnp.concatenate(fields) for fields in zip(*parts, strict=True)))


def _ball_change(sizes: Array, one_hot: Array, totals: ImpulseTotals) -> BodyMotion:
    """Return the motion (1, 3, B) that impulses add to a ball of sizes (1, 3, B), which is the sides one_hot (S, B)."""
    inverse_mass, inverse_moment = _inverse_inertias(sizes)
    is_side = one_hot[:, None]
    (v, w), (x, t) = ((jnp.sum(is_side * f[0], axis=0), jnp.sum(is_side * m[0], axis=0)) for f, m in totals)
    return BodyMotion(
        inverse_mass * v[None], inverse_moment * w[None], inverse_mass * x[None], inverse_moment * t[None]
    )


def _articulated_change(own_sides: list[int], gains: tuple[Array, Array], totals: ImpulseTotals) -> BodyMotion:
    """Return the motion (n, 3, B) that impulses at a body's own sides add to its links; gains: see `_side_gains`."""
    fields = []
    for impulses, angular_impulses in totals:
        wrench = [jnp.concatenate([impulses[:, side], angular_impulses[:, side]], axis=1) for side in own_sides]
        flat = jnp.stack(wrench, 1).reshape(2, -1, wrench[0].shape[-1])
        fields += [_summed(gain, flat) for gain in gains]
    return BodyMotion(*fields)


def _side_gains(
    scene: Scene, name: str, articulation: Articulation, sides: Sides, sizes: Array, settings: ContactSettings
) -> tuple[list[int], tuple[Array, Array]]:
    """Return the sides that a body can be, and its links' gains by wrenches there, (2, n, 3, 6 a side, B) each."""
    rows, body = scene.rows(name), scene.body(name)
    own_sides = [number for number, owners in enumerate(sides.owners) if name in owners]
    unit = jnp.eye(3, 6, dtype=sizes.dtype)[None, :, :, None]
    one_hot = sides.one_hot[:, rows]
    linear = jnp.concatenate([one_hot[side][:, None, None] * unit for side in own_sides], axis=2)
    angular = jnp.concatenate([one_hot[side][:, None, None] * jnp.roll(unit, 3, axis=2) for side in own_sides], axis=2)
    lasting, transient = responses(body, articulation, Momenta(angular, linear), sizes[rows], settings.fade)
    velocity, angular_velocity = (jnp.stack(values) for values in zip(lasting, transient, strict=True))
    return own_sides, (velocity, angular_velocity)


def _couplings(scene: Scene, sides: Sides, side_gains: SideGains) -> tuple[np.ndarray, tuple[Array, Array]]:
    """Return n pairs of sides (2, n) of articulated bodies, and the gains of the first by wrenches at the second.

    Velocity and angular velocity (2, n, 3, 6, B), lasting and transient.
    """
    couplings: dict[tuple[int, int], list[Array]] = {}
    for name, (own_sides, gains) in side_gains.items():
        one_hot = sides.one_hot[:, scene.rows(name)]
        for number, other in enumerate(own_sides):
            columns = [array[:, :, :, 6 * number : 6 * number + 6] for array in gains]
            for side in own_sides:
                gains_of_pair = [select(one_hot[side][None], jnp.moveaxis(array, 1, 0))[0] for array in columns]
                previous = couplings.get((side, other))
                couplings[side, other] = (
                    gains_of_pair if previous is None else [a + b for a, b in zip(previous, gains_of_pair, strict=True)]
                )
    empty = jnp.zeros((2, 0, 3, 6, sides.one_hot.shape[-1]), sides.one_hot.dtype)
    velocity, angular_velocity = (
        jnp.stack([array[number] for array in couplings.values()], axis=1) if couplings else empty for number in (0, 1)
    )
    return np.array([*couplings], int).reshape(-1, 2).T, (velocity, angular_velocity)


def _same_balls(scene: Scene, sides: Sides, balls: Sequence[str]) -> tuple[np.ndarray, Array]:
    """Return n pairs of sides (2, n) that may be one and the same ball, and (n, B) 1 where they are, else 0."""
    numbers = range(len(sides.owners))
    pairs = [
        (one, two)
        for one in numbers
        for two in numbers
        if any(name in sides.owners[one] & sides.owners[two] for name in balls)
    ]
    first, second = rows = np.array(pairs, int).reshape(-1, 2).T
    one_hot = sides.one_hot[:, np.array([scene.rows(name).start for name in balls], int)]
    return rows, jnp.sum(one_hot[first] * one_hot[second], axis=1)


def _inverse_inertias(sizes: Array) -> tuple[Array, Array]:
    """Return a ball's 1 / mass [1/kg] and 1 / moment of inertia, (n, 1, B) each."""
    return 1.0 / sizes[:, 2:3], 1.0 / moments(sizes[:, 0], sizes[:, 1], sizes[:, 2])[0][:, None]


class ContactSystem:
    """The contacts of a step: all that is constant in its substeps.

    C contacts of S sides: pairs of links first, then balls on the ground. settings, dt [s]: see `integrate`.
    """

    def __init__(
        self,
        candidates: Candidates,
        links: Kinematics,
        rates: Rates,
        selection: Array,
        sides: Sides,
        side_gains: SideGains,
        dt: Array | float,
        settings: ContactSettings,
    ) -> None:
        scene, balls = candidates.scene, candidates.balls
        self.pairs, self.balls, self.sides = len(selection), len(balls), len(sides.owners)
        self.dt, self.h, self.settings, self.dtype = dt, dt / settings.substeps, settings, selection.dtype
        self.coupled_sides, self.couplings = _couplings(scene, sides, side_gains)
        self.ball_pairs, self.same_ball = _same_balls(scene, sides, balls)
        self.position, self.half, self.velocity, self.angular_velocity, self.radius = (
            sides.of(values)
            for values in (links.position, links.half, links.velocity, links.angular_velocity, links.sizes[:, 1:2])
        )
        self.inverse_mass, self.inverse_moment = (sides.of(values) for values in _inverse_inertias(links.sizes))
        self.rates = Rates(*(sides.of(values) for values in rates))
        # Velocities of contacts are those of second links relative to first ones, and of balls relative to the ground.
        pairs, rest = range(self.pairs), range(self.pairs, self.pairs + self.balls)
        self.contact_of = np.array([*pairs, *pairs, *rest])
        self.sign = np.array([-1.0] * self.pairs + [1.0] * (self.sides - self.pairs))
        surfaces = candidates.surfaces, [scene.body(name).surface for name in balls]
        self.stiffness, self.damping, self.friction = (
            self._constants(name, selection, *surfaces) for name in ("stiffness", "damping", "friction")
        )
        self.mass = self._mass()
        # Decay of transient velocities over a substep, and over half of it.
        self.decay = jnp.exp(-self.h / settings.fade)
        self.half_decay = jnp.exp(-0.5 * self.h / settings.fade)

    def _constants(
        self, name: str, selection: Array, of_pairs: Sequence[Surface], of_balls: Sequence[Surface]
    ) -> Array:
        """Return a constant of the contacts' surfaces, (C, 1, B)."""
        pair_values, ball_values = (
            jnp.array([getattr(surface, name) for surface in surfaces], self.dtype)[:, None, None]
            for surfaces in (of_pairs, of_balls)
        )
        selected = select(selection, pair_values)
        return jnp.concatenate([selected, jnp.broadcast_to(ball_values, (len(ball_values), *selected.shape[1:]))])

    def _mass(self) -> Array:
        """Return m (C, 1, B) [kg] of `contact`, by the mean inverse masses of the sides at their centres."""
        diagonal = self.coupled_sides[0] == self.coupled_sides[1]
        at_once = jnp.sum(self.couplings[0][:, diagonal], axis=0)
        mean = (at_once[:, 0, 0] + at_once[:, 1, 1] + at_once[:, 2, 2]) / 3.0
        weights = _scattered(mean[None], self.coupled_sides[0][diagonal], self.sides)
        diagonal = self.ball_pairs[0] == self.ball_pairs[1]
        own = self.ball_pairs[0][diagonal]
        weights = weights + _scattered((self.same_ball[diagonal] * self.inverse_mass[own, 0])[None], own, self.sides)
        return IMPEDANCE / (1.0 - IMPEDANCE) / _scattered(weights, self.contact_of, self.pairs + self.balls)[0][:, None]

    def relative(self, at_sides: Array) -> Array:
        """Return values (C, 3, B) of second links relative to first ones, and of balls, from those of all sides."""
        pairs = self.pairs
        return jnp.concatenate([at_sides[pairs : 2 * pairs] - at_sides[:pairs], at_sides[2 * pairs :]])

    def contacts(self, state: SideStates) -> tuple[Array, Array, Array]:
        """Return arms (S, 3, B) [m] from sides to contact points, normals (C, 3, B), and gaps (C, 1, B) [m]."""
        pairs, radius = self.pairs, self.radius
        one, two = (
            CapsuleShapes(state.centre[side], state.half[side], radius[side])
            for side in (slice(pairs), slice(pairs, 2 * pairs))
        )
        points = closest(one, two)
        arms = jnp.concatenate([points.point, points.point]) - state.centre[: 2 * pairs]
        up = jnp.broadcast_to(jnp.asarray(UP, self.dtype), (self.balls, *points.normal.shape[1:]))
        height = state.centre[2 * pairs :, 2:] - radius[2 * pairs :]
        # Contact points are midway between the surfaces.
        arms = jnp.concatenate([arms, -(radius[2 * pairs :] + 0.5 * height) * up])
        return arms, jnp.concatenate([points.normal, up]), jnp.concatenate([points.distance, height])

    def gains(self, arms: Array) -> tuple[Array, Array]:
        """Return gains (2, n, 3, 3, B), lasting and transient, of coupled sides by impulses at contact points."""
        linear, angular = (
            gain[:, :, :, :3] + cross_rows(gain[:, :, :, 3:], arms[self.coupled_sides[1]]) for gain in self.couplings
        )
        return linear, angular

    def admittance(self, arms: Array, gains: tuple[Array, Array]) -> Array:
        """Return A (C, C, 3, 3, B) [1/kg] of `contact`."""
        (linear, angular), unit = gains, jnp.eye(3, dtype=self.dtype)[..., None]
        at_contact = linear - cross_columns(arms[self.coupled_sides[0]], angular)
        one, two = arms[self.ball_pairs[0]], arms[self.ball_pairs[1]]
        # -[r] [s] = (r s) 1 - s r'
        inner = one[:, 0] * two[:, 0] + one[:, 1] * two[:, 1] + one[:, 2] * two[:, 2]
        turned_by = inner[:, None, None] * unit - two[:, :, None] * one[:, None]
        inverse_mass, inverse_moment = (
            values[self.ball_pairs[0]][:, None] for values in (self.inverse_mass, self.inverse_moment)
        )
        of_balls = self.same_ball[:, None, None] * (inverse_mass * unit + inverse_moment * turned_by)
        numbers = range(self.pairs + self.balls)
        blocks = [[jnp.zeros((3, 3, arms.shape[-1]), self.dtype) for _ in numbers] for _ in numbers]
        for (first, second), matrices in (
            (self.coupled_sides, at_contact[0] + self.half_decay * at_contact[1]), (self.ball_pairs, of_balls),
        ):  # fmt: skip
            signs, rows, columns = self.sign[first] * self.sign[second], self.contact_of[first], self.contact_of[second]
            for row, column, sign, matrix in zip(rows, columns, signs.tolist(), matrices, strict=True):
                blocks[row][column] += sign * matrix
        return jnp.stack([jnp.stack(row) for row in blocks])

    def velocity_changes(
        self, gains: tuple[Array, Array], side_impulses: Array, side_moments: Array
    ) -> tuple[Array, Array]:
        """Return velocity changes of sides (2, S, 3, B), lasting and transient, by impulses and moments (S, 3, B)."""
        changes = []
        for gain, inverse, impulses in zip(
            gains, (self.inverse_mass, self.inverse_moment), (side_impulses, side_moments), strict=True
        ):
            own = (self.same_ball[:, None] * inverse[self.ball_pairs[1]] * impulses[self.ball_pairs[1]])[None]
            of_balls = _scattered(own, self.ball_pairs[0], self.sides)
            of_links = _scattered(mv(gain, side_impulses[self.coupled_sides[1]]), self.coupled_sides[0], self.sides)
            changes.append(of_links + jnp.concatenate([of_balls, jnp.zeros_like(of_balls)]))
        return changes[0], changes[1]

    def substep(
        self, carry: tuple[SideStates, ImpulseTotals], number: Array
    ) -> tuple[tuple[SideStates, ImpulseTotals], None]:
        """Return the sides, and the impulses up to there, after the next substep."""
        (state, totals), h = carry, self.h
        arms, normal, gap = self.contacts(state)
        gains = self.gains(arms)
        # Accelerations are the mean ones in the middle of the step. Relaxation is no acceleration of the joints.
        from_middle = (number + 0.5) * h - 0.5 * self.dt
        rates = self.rates
        velocity_change = h * (rates.acceleration + from_middle * rates.jerk)
        velocity_change += (self.decay - 1.0) * state.transient_velocity
        angular_velocity_change = h * (rates.angular_acceleration + from_middle * rates.angular_jerk)
        angular_velocity_change += (self.decay - 1.0) * state.transient_angular_velocity
        contact_velocity = self.relative(state.velocity + cross(state.angular_velocity, arms))
        velocity_product = self.relative(rates.velocity_product + cross(rates.angular_velocity_product, arms))
        reference = contact.reference_velocity(self.stiffness, self.damping, contact_velocity, gap, normal, h)
        problem = ContactProblem(
            velocity=contact_velocity + self.relative(velocity_change + cross(angular_velocity_change, arms)),
            admittance=self.admittance(arms, gains),
            reference=reference + h * velocity_product,
            mass=self.mass,
            normal=normal,
            friction=self.friction,
            active=jax.lax.stop_gradient((gap < 0.0).astype(self.dtype)),
        )
        impulses = contact.impulses_of(problem, jax.lax.stop_gradient(state.impulses), self.settings.iterations)
        side_impulses = jnp.concatenate([-impulses[: self.pairs], impulses])
        side_moments = cross(arms, side_impulses)
        gain, angular_gain = self.velocity_changes(gains, side_impulses, side_moments)
        transient, angular_transient = self.half_decay * gain[1], self.half_decay * angular_gain[1]
        velocity = state.velocity + velocity_change + gain[0] + transient
        angular_velocity = state.angular_velocity + angular_velocity_change + angular_gain[0] + angular_transient
        after = SideStates(
            centre=state.centre + h * velocity,
            half=turned_vectors(state.half, h * angular_velocity),
            velocity=velocity,
            angular_velocity=angular_velocity,
            transient_velocity=self.decay * state.transient_velocity + transient,
            transient_angular_velocity=self.decay * state.transient_angular_velocity + angular_transient,
            impulses=impulses,
        )
        return (after, self._added(totals, side_impulses, side_moments, number)), None

    def _added(self, totals: ImpulseTotals, impulses: Array, moments: Array, number: Array) -> ImpulseTotals:
        """Return totals with impulses and angular impulses (S, 3, B) of a substep added."""
        # Shares of their effects at the end of the step, and times for which they act until then.
        remaining_time, relaxation_time = self.dt - (number + 0.5) * self.h, self.settings.fade
        relaxation = jnp.exp(-remaining_time / relaxation_time)
        share = jnp.stack([jnp.ones_like(remaining_time), relaxation])[:, None, None, None]
        time = jnp.stack([remaining_time, relaxation_time * (1.0 - relaxation)])[:, None, None, None]
        (impulse_sum, moment_sum), (impulse_time, moment_time) = totals
        return (
            (impulse_sum + share * impulses, moment_sum + share * moments),
            (impulse_time + time * impulses, moment_time + time * moments),
        )

    def run(self) -> ImpulseTotals:
        """Return the impulses of all substeps."""
        zeros = jnp.zeros_like(self.position)
        no_impulses = jnp.zeros((self.pairs + self.balls, *zeros.shape[1:]), self.dtype)
        centre = self.position + 0.5 * self.h * self.velocity
        half = turned_vectors(self.half, 0.5 * self.h * self.angular_velocity)
        start = SideStates(centre, half, self.velocity, self.angular_velocity, zeros, zeros, no_impulses)
        no_totals = jnp.zeros((2, *zeros.shape), self.dtype)
        numbers = jnp.arange(self.settings.substeps, dtype=self.dtype)
        (_, totals), _ = jax.lax.scan(self.substep, (start, ((no_totals, no_totals), (no_totals, no_totals))), numbers)
        return totals


def _scattered(parts: Array, rows: np.ndarray, count: int) -> Array:
    """Return (m, count, ..., B) with parts (m, n, ..., B) summed into these rows."""
    zeros = jnp.zeros((parts.shape[0], *parts.shape[2:]), parts.dtype)
    return jnp.stack([sum((parts[:, i] for i in np.flatnonzero(rows == row)), zeros) for row in range(count)], axis=1)


def _summed(gains: Array, wrench: Array) -> Array:
    """Return (n, 3, B) gains (2, n, 3, k, B) times wrenches (2, k, B), lasting and transient together."""
    return contract("pnik,pk->ni", gains, wrench)

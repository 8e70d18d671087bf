"""One step in time of an articulated body, a ball and the ground, all their contacts in one solve.

The law is MuJoCo's soft contact (its documentation, "Computation", "Constraint model"). A contact point has the
relative velocity u, the normal n and the gap p < 0. Its force f and acceleration a obey

    a + R f = a_ref,    f in the friction cone K,    a_ref = -b / d u - k / d p n,    R = (1 - d) / d w

with the surface's stiffness k and damping b, the impedance d, and the inverse weight w of both links in the reference
pose: f is the projection of (a_ref - a) / R onto K. Friction and normal force are found together: where a contact
slides, its normal acceleration rises with the slip (E. Todorov, "Convex and analytically invertible dynamics with
contacts and constraints", 2014). Over a time step h, of the impulse J = h f,

    J = P_K(m (u_ref - u')),    m = 1 / R [kg],    u_ref = u + h a_ref,    u' = u + h a

All J are found by Newton's method with an exact line search. Linear around the last u', J = q - M u', a contact is a
mass M that moves along, and the articulated-body algorithm takes it into its inertia. The ball is eliminated from its
contacts first; where several links touch it at once, each sees what the others did in the iteration before, which
converges more slowly.

Arrays have the batch last, as in `mechanics`: vectors (n, 3, B), matrices (n, 3, 3, B).
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.contact import IMPEDANCE, Axis, nearest
from larp_model.errors import InputError
from larp_model.mechanics import (
    Ends,
    Inertia,
    Momenta,
    cross,
    cross_columns,
    cross_rows,
    held,
    inverse,
    mm,
    mv,
    responses,
    solve,
    turn,
)
from larp_model.physics.articulated import Ball, Free, moved_on
from larp_model.scene import Body, Scene, Surface
from larp_model.vector import Vector

AllVelocities = tuple[Array, Array, Array, Array]
"""[m/s] and [rad/s] of the links (n, 3, B), and of the ball (1, 3, B)."""

AtContacts = tuple[Array, Array, Array]
"""Vectors (n, 3, B) at the contacts of links with the ground, of the ball with the ground, of links with the ball."""

Tree = TypeVar("Tree", Inertia, Momenta)

# Halvings of the interval in which the line search looks: to a 256th of a step.
HALVINGS = 8


class Contacts(NamedTuple):
    """n contact points, each of a link and what it touches.

    arm: (n, 3, B) [m] from the link's centre. normal: (n or 1, 3, B or 1). reference: u_ref (n, 3, B) [m/s]. mass: m
    (n, 1, B or 1) [kg]. active: (n, 1, B) 1 where the gap is negative, else 0. friction: coefficient.
    """

    arm: Array
    normal: Array
    reference: Array
    mass: Array
    active: Array
    friction: float

    @staticmethod
    def of(
        surface: Surface, arm: Array, normal: Array, velocity: Array, gap: Array, inverse_weight: Array, h: float
    ) -> Contacts:
        """Return contacts of velocity (n, 3, B) [m/s], gap (n, 1, B) [m] and inverse weight (n, 1, B or 1) [1/kg]."""
        slowed = velocity * (1.0 - h * surface.damping / IMPEDANCE)
        reference = slowed - h * surface.stiffness / IMPEDANCE * gap * normal
        mass = IMPEDANCE / ((1.0 - IMPEDANCE) * inverse_weight)
        return Contacts(arm, normal, reference, mass, held((gap < 0.0).astype(gap.dtype)), surface.friction)

    def impulse(self, velocity: Array) -> Array:
        """Return J (n, 3, B) [N s] at velocities u' (n, 3, B)."""
        return self.active * projection(self.mass * (self.reference - velocity), self.normal, self.friction)[0]

    def linear(self, velocity: Array) -> tuple[Array, Array]:
        """Return M (n, 3, 3, B) [kg] and q (n, 3, B) [N s] of J = q - M u', around velocities u' (n, 3, B)."""
        impulse, slope = projection(self.mass * (self.reference - velocity), self.normal, self.friction)
        mass = held((self.active * self.mass)[:, None] * slope)
        return mass, self.active * impulse + mv(mass, velocity)


def projection(wanted: Array, normal: Array, friction: float) -> tuple[Array, Array]:
    """Return the points (n, 3, B) of the friction cone nearest to those wanted, and the slopes (n, 3, 3, B)."""
    unit = jnp.eye(3, dtype=wanted.dtype)[..., None]
    along = jnp.sum(wanted * normal, axis=1, keepdims=True)
    tangent = wanted - along * normal
    length = jnp.sqrt(jnp.sum(tangent**2, axis=1, keepdims=True) + 1e-12)
    direction = tangent / length
    edge = normal + friction * direction
    share = (along + friction * length) / (1.0 + friction**2)
    across = unit - normal[:, :, None] * normal[:, None] - direction[:, :, None] * direction[:, None]
    bent = jnp.clip(friction * share / length, 0.0, 1.0)
    sliding = edge[:, :, None] * edge[:, None] / (1.0 + friction**2) + bent[:, None] * across
    # One decision for all blocks of a matrix: a compiler may work it out anew for each, and round otherwise.
    inside, pushed = held((length <= friction * along, friction * length > -along))
    point = jnp.where(inside, wanted, share * edge) * pushed
    return point, jnp.where(inside[:, None], unit, sliding) * pushed[:, None]


def inverse_weights(scene: Scene, morphology: Array) -> Array:
    """Return (L, B or 1) [1/kg] the mean velocity gained by a link's centre per impulse there, in the reference pose.

    MuJoCo's constant approximation, `body_invweight0`, by which R is set. morphology (B or 1, L, 3).
    """
    parts = []
    for body in scene.bodies:
        sizes = morphology[:, scene.rows(body.name)]
        upright = jnp.broadcast_to(jnp.eye(3, dtype=sizes.dtype), (sizes.shape[0], len(body.links), 3, 3))
        gained = responses(body, np.arange(len(body.links)), upright, sizes, (0.0,))[0]
        parts.append(jnp.trace(gained[..., :3, :3], axis1=-2, axis2=-1).T / 3.0)
    return jnp.concatenate(parts)


def step(
    scene: Scene, state: Array, control: Array, torque: Array, morphology: Array, weights: Array, h: float,
    iterations: int = 6,
) -> Array:  # fmt: skip
    """Return states (B, L, 13) `h` [s] after states (B, L, 13), as MuJoCo's semi-implicit Euler rule has them.

    scene: an articulated body, and a ball that it may touch. control (B, J, 3) [rad], torque (B, L, 3) [N m],
    morphology (B or 1, L, 3). weights: see `inverse_weights`. Damping is implicit; contact forces are found with
    undamped joints, as in the engine's `implicitfast`.
    """
    require_supported(scene)
    body, links = scene.bodies[0], len(scene.bodies[0].links)
    whole, targets, outside, sizes = (jnp.moveaxis(each, 0, -1) for each in (state, control, torque, morphology))
    free = Free.of(body, whole[:links], targets, outside[:links], sizes[:links], scene.gravity, h)
    ball = Ball.of(whole[links:], outside[links:], sizes[links:], scene.gravity, h)
    touching = Touching.of(scene, free, ball, sizes, weights[:, None], h)
    on_links, on_floor, between = impulses_of(free, ball, touching, iterations)

    ends, rows = touching.ends, touching.rows
    pushed = _sum(
        free.push, _both_ends(_push(ends.arm, on_links)), _onto(rows, links, _push(touching.links.arm, -between))
    )
    velocity, spin = solve(free.inertia, pushed, free.levels)
    on_ball = _sum(ball.push, _push(touching.floor.arm, on_floor), _total(_push(touching.ball_arm, between)))
    ball_velocity, ball_spin = _moved(inverse(ball.inertia), on_ball)
    moved = moved_on(body, free, velocity, spin, h)
    rolled = ball.place + h * ball_velocity, turn(ball.orientation, h * ball_spin), ball_velocity, ball_spin
    after = jnp.concatenate([jnp.concatenate(each, axis=1) for each in (moved, rolled)])
    return jnp.moveaxis(after, -1, 0)


def require_supported(scene: Scene) -> None:
    """Refuse scenes other than of an articulated body and a ball."""
    kinds = [body.is_ball for body in scene.bodies]
    if kinds != [False, True] or len(scene.pairs) != 1 or scene.pairs[0].of_itself:
        names = ", ".join(body.kind for body in scene.bodies)
        raise InputError(f"scene has {names}, but needs an articulated body, a ball, and their pair alone")


class Touching(NamedTuple):
    """All contacts of a step: ends of links with the ground, the ball with it, and links, by their rows, with the ball.

    ball_arm: (P, 3, B) [m] from the ball's centre to where links touch it.
    """

    ends: Contacts
    floor: Contacts
    links: Contacts
    ball_arm: Array
    rows: np.ndarray

    @staticmethod
    def of(scene: Scene, free: Free, ball: Ball, sizes: Array, weight: Array, h: float) -> Touching:
        """Return the contacts of a body and a ball, of sizes (L, 3, B) and inverse weights (L, 1, B or 1) [1/kg]."""
        (body, sphere), (pair,), links = scene.bodies, scene.pairs, len(scene.bodies[0].links)
        up = jnp.array([0.0, 0.0, 1.0], free.place.dtype)[None, :, None]
        found = Ends.of(body, free.matrices, free.place[:, 2:], free.velocity, free.spin, sizes[:links], h)
        # Contact points are midway between the surfaces.
        found = found._replace(arm=found.arm - 0.5 * found.clearance * up)
        speed = found.velocity(free.velocity, free.spin)
        twice = jnp.concatenate([weight[:links], weight[:links]])
        ends = Contacts.of(body.surface, found.arm, up, speed, found.clearance, twice, h)
        gap = ball.place[:, 2:] - ball.radius
        lowest = -(ball.radius + 0.5 * gap) * up
        falling = ball.velocity + cross(ball.spin, lowest)
        floor = Contacts.of(sphere.surface, lowest, up, falling, gap, weight[links:], h)
        rows = np.array([body.link(name) for name in pair.first_links])
        arm, ball_arm, normal, apart = _closest(body, rows, free, ball, sizes[rows])
        relative = ball.velocity + cross(ball.spin, ball_arm) - free.velocity[rows] - cross(free.spin[rows], arm)
        hit = Contacts.of(pair.surface, arm, normal, relative, apart, weight[rows] + weight[links:], h)
        # Of a contact's acceleration the engine counts what root and joints gain, not what follows from velocities.
        ends = ends._replace(reference=ends.reference + found.velocity(free.drift, free.drift_turning))
        drift = free.drift[rows] + cross(free.drift_turning[rows], arm)
        return Touching(ends, floor, hit._replace(reference=hit.reference - drift), ball_arm, rows)

    def velocities(self, moving: AllVelocities) -> AtContacts:
        """Return relative velocities [m/s] at all contacts."""
        velocity, spin, ball_velocity, ball_spin = moving
        at_ends = jnp.concatenate([velocity, velocity]) + cross(jnp.concatenate([spin, spin]), self.ends.arm)
        on_ball = ball_velocity + cross(ball_spin, self.ball_arm)
        return at_ends, ball_velocity + cross(ball_spin, self.floor.arm), on_ball - self.of_links(velocity, spin)

    def of_links(self, velocity: Array, spin: Array) -> Array:
        """Return velocities [m/s] of links where they touch the ball."""
        return velocity[self.rows] + cross(spin[self.rows], self.links.arm)

    @property
    def kinds(self) -> tuple[Contacts, Contacts, Contacts]:
        """All contacts."""
        return self.ends, self.floor, self.links


def impulses_of(free: Free, ball: Ball, touching: Touching, iterations: int) -> AtContacts:
    """Return the impulses [N s] of all contacts, by Newton's method; see the module."""

    def newton(found: tuple[AllVelocities, AtContacts], first: Array) -> tuple[tuple[AllVelocities, AtContacts], None]:
        moving, impulses = found
        new_moving, new_impulses = _newton_step(free, ball, touching, moving)
        before, after = touching.velocities(moving), touching.velocities(new_moving)
        share = _line_search(touching.kinds, before, after, impulses, new_impulses)
        share = jnp.where(first, 1.0, share)  # velocities at the beginning are no solution for any impulses
        mixed: tuple[AllVelocities, AtContacts] = jax.tree.map(
            lambda old, new: old + share * (new - old), found, (new_moving, new_impulses)
        )
        return mixed, None

    begun = free.velocity, free.spin, ball.velocity, ball.spin
    nothing = jax.tree.map(jnp.zeros_like, touching.velocities(begun))
    (_, impulses), _ = jax.lax.scan(newton, (begun, nothing), jnp.arange(iterations) == 0)
    return impulses


def _newton_step(free: Free, ball: Ball, touching: Touching, guess: AllVelocities) -> tuple[AllVelocities, AtContacts]:
    """Return velocities and impulses where all contacts are linear around a guess."""
    at_ends, at_floor, between = touching.velocities(guess)
    before, arm = touching.of_links(*guess[:2]), touching.ball_arm
    end_mass, end_push = touching.ends.linear(at_ends)
    floor_mass, floor_push = touching.floor.linear(at_floor)
    mass, push = touching.links.linear(between)
    # The ball on the ground, and with the masses of all contacts with links.
    on_floor = _sum(ball.inertia, _inertia(touching.floor.arm, floor_mass))
    fixed = _sum(ball.push, _push(touching.floor.arm, floor_push))
    gives = inverse(_sum(on_floor, _total(_inertia(arm, mass))))
    # What it does under all contacts, as links moved before, but the one that is looked at.
    follows = _push(arm, mv(mass, before))
    pushed = _sum(fixed, _total(_sum(_push(arm, push), follows)))
    ball_velocity, ball_spin = _moved(gives, jax.tree.map(jnp.subtract, pushed, follows))
    on_links = mass - mm(mass, mm(_admittance(gives, arm), mass))
    pressed = push - mv(mass, ball_velocity + cross(ball_spin, arm))
    links, rows = free.place.shape[0], touching.rows
    bears = _sum(
        free.inertia, _both_ends(_inertia(touching.ends.arm, end_mass)),
        _onto(rows, links, _inertia(touching.links.arm, on_links)),
    )  # fmt: skip
    pushes = _sum(
        free.push, _both_ends(_push(touching.ends.arm, end_push)),
        _onto(rows, links, _push(touching.links.arm, -pressed)),
    )  # fmt: skip
    bears, pushes = held((bears, pushes))
    velocity, spin = solve(bears, pushes, free.undamped)
    # The ball takes what its links have felt, so that momentum is kept where several touch it.
    felt = pressed + mv(on_links, touching.of_links(velocity, spin))
    moving = velocity, spin, *_moved(inverse(on_floor), _sum(fixed, _total(_push(arm, felt))))
    at_ends, at_floor, _ = touching.velocities(moving)
    return moving, (end_push - mv(end_mass, at_ends), floor_push - mv(floor_mass, at_floor), felt)


def _line_search(
    kinds: tuple[Contacts, ...], before: AtContacts, after: AtContacts, was: AtContacts, new: AtContacts
) -> Array:
    """Return the share (B,) of a Newton step that makes the cost of the convex problem least.

    The cost's slope along the step is that of velocities at the contacts, from `before` to `after`, times what the
    impulses, which the velocities came from, are more than those that the velocities call for.
    """

    def slope(share: Array) -> Array:
        total = jnp.zeros_like(share)
        for kind, first, last, one, two in zip(kinds, before, after, was, new, strict=True):
            change = last - first
            more = one + share * (two - one) - kind.impulse(first + share * change)
            total += jnp.sum(change * more, axis=(0, 1))
        return total

    whole = jnp.ones_like(before[0][0, 0])

    def halve(bounds: tuple[Array, Array], nothing: None) -> tuple[tuple[Array, Array], None]:
        low, high = bounds
        middle = 0.5 * (low + high)
        rising = slope(middle) > 0.0
        return (jnp.where(rising, low, middle), jnp.where(rising, middle, high)), None

    (low, high), _ = jax.lax.scan(halve, (jnp.zeros_like(whole), whole), length=HALVINGS)
    return jnp.where(slope(whole) <= 0.0, whole, 0.5 * (low + high))


def _closest(
    body: Body, rows: np.ndarray, free: Free, ball: Ball, sizes: Array
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    """Return arms from links and ball to their contact points, normals (P, 3, B), and gaps (P, 1, B) [m]."""
    axes = jnp.array([body.links[row].axis for row in rows], free.place.dtype)[..., None]
    half, centre = 0.5 * sizes[:, :1] * mv(free.matrices[rows], axes), free.place[rows]
    zero = jnp.zeros_like(centre[:, 0])
    link = Axis(_vector(centre), _vector(half), sizes[:, 1] + zero)
    other = Axis(_vector(jnp.broadcast_to(ball.place, half.shape)), Vector(zero, zero, zero), ball.radius[:, 0] + zero)
    normal, gap, point, _ = nearest(link, other)
    normals, points = (jnp.stack([each.x, each.y, each.z], axis=1) for each in (normal, point))
    return points - centre, points - ball.place, normals, gap[:, None]


def _vector(vectors: Array) -> Vector:
    return Vector(vectors[:, 0], vectors[:, 1], vectors[:, 2])


def _inertia(arm: Array, mass: Array) -> Inertia:
    """Return the inertia of masses (n, 3, 3, B) at arms (n, 3, B), about where the arms begin."""
    mixed = cross_columns(arm, mass)
    return Inertia(-cross_rows(mixed, arm), mixed, mass)


def _push(arm: Array, impulse: Array) -> Momenta:
    return Momenta(cross(arm, impulse), impulse)


def _sum(*parts: Tree) -> Tree:
    result: Tree = jax.tree.map(lambda *each: sum(each[1:], each[0]), *parts)
    return result


def _total(parts: Tree) -> Tree:
    result: Tree = jax.tree.map(lambda each: jnp.sum(each, axis=0, keepdims=True), parts)
    return result


def _both_ends(ends: Tree) -> Tree:
    """Return the sums (n, ...) over both ends of all links (2 n, ...)."""
    result: Tree = jax.tree.map(lambda each: each[: len(each) // 2] + each[len(each) // 2 :], ends)
    return result


def _onto(rows: np.ndarray, links: int, parts: Tree) -> Tree:
    """Return arrays of all links that hold these parts in these rows and zeros elsewhere."""
    result: Tree = jax.tree.map(lambda each: jnp.zeros((links, *each.shape[1:]), each.dtype).at[rows].add(each), parts)
    return result


def _moved(gives: Inertia, push: Momenta) -> tuple[Array, Array]:
    """Return velocity and spin (n, 3, B) by an inverse inertia (1, ...)."""
    spin = mv(gives.turning, push.turning) + mv(gives.mixed, push.moving)
    return mv(jnp.swapaxes(gives.mixed, 1, 2), push.turning) + mv(gives.moving, push.moving), spin


def _admittance(gives: Inertia, arm: Array) -> Array:
    """Return (n, 3, 3, B) the velocity of the points at arms per impulse there, by an inverse inertia (1, ...)."""
    across = gives.mixed + cross_rows(gives.turning, arm)
    return gives.moving + cross_rows(jnp.swapaxes(gives.mixed, 1, 2), arm) - cross_columns(arm, across)

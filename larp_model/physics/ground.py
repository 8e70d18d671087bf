"""The ground under an articulated body: contacts of both ends of all its links, solved together with its motion.

MuJoCo's soft contact: the impulse J on an end whose velocity is v' is the projection of m (v - v') onto the friction
cone, with the regularisation mass m and the target velocity v of the contact (see `physics.contact`). Where J is taken
as linear around a guess, it adds to the inertia and to the momentum of the link, and one pass of `articulated.solve`
gives all velocities: a step of Newton's method.

Arrays have the batch last, as in `linalg`: n links, 2 n ends.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import barrier, cross, cross_columns, cross_rows, mm, mv, saved
from larp_model.physics.admittance import LinkEquations, LinkSystem, eliminated, on_links, solution_tangent
from larp_model.physics.articulated import Inertia, Momenta, levels_of, packed_inertia, solve
from larp_model.physics.contact import projection
from larp_model.physics.kinematics import Anchors
from larp_model.scene import Body

# Newton's method ends where no impulse has a larger error, as a share of the body's largest and in units of the
# precision: 1e-3 in 32 bits.
TOLERANCE = 1e4


class Ends(NamedTuple):
    """Both ends of all links, (2 n, ..., B), one end of each after the other, and their target velocity.

    arm: their lowest points [m] from the links' centres. clearance: their height [m]. target_velocity: that [m/s] at
    which neither the spring of the body's surface nor friction acts on them.
    """

    arm: Array
    clearance: Array
    target_velocity: Array

    @staticmethod
    def of(
        body: Body, matrices: Array, height: Array, velocity: Array, angular_velocity: Array, sizes: Array,
        h: Array | float,
        accelerations: tuple[Array, Array],
    ) -> Ends:  # fmt: skip
        """Return the ends of links by rotations (n, 3, 3, B), heights (n, 1, B) [m] and first velocities (n, 3, B).

        accelerations: those of the links, (n, 3, B) [m/s^2] and [rad/s^2], that contacts do not count.
        """
        surface, upright = body.surface, _upright(matrices)
        axes = jnp.array([link.axis for link in body.links], matrices.dtype)[..., None]
        half, down = 0.5 * sizes[:, :1] * mv(matrices, axes), sizes[:, 1:2] * upright
        arm = jnp.concatenate([half - down, -half - down])
        speed, clearance = twice(velocity) + cross(twice(angular_velocity), arm), twice(height) + arm[:, 2:]
        speed += h * (twice(accelerations[0]) + cross(twice(accelerations[1]), arm))
        damped = 1.0 + h * surface.damping
        rising = (speed[:, 2:] - h * surface.stiffness * clearance) / (damped + h**2 * surface.stiffness)
        return Ends(arm, clearance, speed * (1.0 - upright) / damped + rising * upright)

    def velocity(self, velocity: Array, angular_velocity: Array) -> Array:
        """Return the ends' velocities (2 n, 3, B), from those of the links."""
        return twice(velocity) + cross(twice(angular_velocity), self.arm)

    def inertia_at_links(self, masses: Array) -> Inertia:
        """Return the inertia of links, from masses (2 n, 3, 3, B) [kg] at the ends."""
        mixed, links = cross_columns(self.arm, masses), len(self.arm) // 2
        added = Inertia(-cross_rows(mixed, self.arm), mixed, masses)
        totals: Inertia = jax.tree.map(lambda ends: ends[:links] + ends[links:], added)
        return totals

    def momenta_at_links(self, momenta: Array) -> Momenta:
        """Return momenta of links, from momenta (2 n, 3, B) at the ends."""
        links = len(self.arm) // 2
        return Momenta(*(ends[:links] + ends[links:] for ends in (cross(self.arm, momenta), momenta)))


class GroundMotion(NamedTuple):
    """Velocities [m/s] and angular velocities [rad/s] of links (n, 3, B) under the ground's impulses.

    active (2 n, 1, B): active set, 1 where an end is in the ground, else 0. impulses (2 n, 3, B) [N s]: projections at
    these velocities. slopes (2 n, 3, 3, B) [kg]: their negative derivatives by the ends' velocities.
    """

    velocity: Array
    angular_velocity: Array
    active: Array
    impulses: Array
    slopes: Array


class GroundProblem(NamedTuple):
    """Links of a body within `h` [s]: inertia and momenta without the ground, their joints, and their ends.

    anchors, closing, impulse, resistance: of the joints, see `Level`. mass (1, 1, B) [kg]: the module's m.
    """

    inertia: Inertia
    momenta: Momenta
    anchors: Anchors
    closing: Array
    impulse: Array
    resistance: Array
    ends: Ends
    mass: Array
    h: Array | float

    def impulses_at(self, body: Body, velocity: Array, angular_velocity: Array) -> tuple[Array, Array]:
        """Return impulses (2 n, 3, B) of ends as if all were in the ground, and slopes: see `projection`."""
        end_velocities = self.ends.velocity(velocity, angular_velocity)
        up = jnp.broadcast_to(_upright(end_velocities), end_velocities.shape)
        return projection(self.mass * (self.ends.target_velocity - end_velocities), up, body.surface.friction)

    def at(self, body: Body, velocity: Array, angular_velocity: Array, active: Array) -> GroundMotion:
        """Return the motion of velocities (n, 3, B) with its impulses; ends that were `active` before stay so."""
        end_velocities = self.ends.velocity(velocity, angular_velocity)
        active = jnp.maximum(active, ramp(-self.ends.clearance - self.h * end_velocities[:, 2:], 1e-5))
        impulses, slopes = self.impulses_at(body, velocity, angular_velocity)
        return GroundMotion(
            velocity,
            angular_velocity,
            active,
            active * impulses,
            barrier(active[:, None] * self.mass[:, None] * slopes),
        )

    def linear(self, guess: GroundMotion) -> tuple[Inertia, Momenta]:
        """Return inertia and momenta that impulses, linear around a guess, add to those of the links."""
        end_velocities = self.ends.velocity(guess.velocity, guess.angular_velocity)
        momenta = guess.impulses + mv(guess.slopes, end_velocities)
        return self.ends.inertia_at_links(guess.slopes), self.ends.momenta_at_links(momenta)

    def newton(self, body: Body, guess: GroundMotion) -> GroundMotion:
        """Return the motion under impulses that are linear around a guess."""
        levels = levels_of(body, self.anchors, self.closing, self.impulse, self.resistance)
        inertia, momenta = barrier(jax.tree.map(jnp.add, (self.inertia, self.momenta), self.linear(guess)))
        return self.at(body, *solve(inertia, momenta, levels), guess.active)

    def converged(self, before: GroundMotion, after: GroundMotion) -> Array:
        """Return (B,) where the impulses are those that were linear around the motion before, or are not finite."""
        change = self.ends.velocity(after.velocity - before.velocity, after.angular_velocity - before.angular_velocity)
        error = after.impulses - before.impulses + mv(before.slopes, change)
        residual, largest = (jnp.max(jnp.abs(values), axis=(0, 1)) for values in (error, after.impulses))
        below: Array = ~(residual > TOLERANCE * np.finfo(largest.dtype).eps * largest)
        return below


def motion_on_ground(
    body: Body, iterations: int, problem: GroundProblem, velocity: Array, angular_velocity: Array
) -> GroundMotion:
    """Return the motion of a body on the ground, from a guess of its velocities (n, 3, B).

    iterations: of Newton's method, at most; a body's motion is final once it has converged, whatever others need.
    """
    guess = problem.at(body, velocity, angular_velocity, jnp.zeros_like(problem.ends.clearance))
    return _solution(body, iterations, problem, jax.lax.stop_gradient(guess))


NewtonCarry = tuple[Array, Array, GroundMotion]
"""Iterations done, bodies (B,) that have not converged, and the motion."""


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _solution(body: Body, iterations: int, problem: GroundProblem, guess: GroundMotion) -> GroundMotion:
    def continues(carry: NewtonCarry) -> Array:
        number, unconverged, _ = carry
        return (number < iterations) & jnp.any(unconverged)

    def newton(carry: NewtonCarry) -> NewtonCarry:
        number, unconverged, before = carry
        after = problem.newton(body, before)
        updated = jax.tree.map(partial(jnp.where, unconverged), after, before)
        return number + 1, unconverged & ~problem.converged(before, after), updated

    unconverged = jnp.ones(guess.velocity.shape[-1], bool)
    return jax.lax.while_loop(continues, newton, (jnp.array(0), unconverged, guess))[2]


@_solution.defjvp
def _solution_jvp(
    body: Body, iterations: int, primals: tuple[GroundProblem, GroundMotion],
    tangents: tuple[GroundProblem, GroundMotion],
) -> tuple[GroundMotion, GroundMotion]:  # fmt: skip
    """Differentiate the equations that the solution obeys, see `admittance`."""
    problem, guess = primals
    solution: GroundMotion = saved(jax.lax.stop_gradient(_solution(body, iterations, problem, guess)))
    active = solution.active
    ground_blocks = jax.lax.stop_gradient(packed_inertia(problem.ends.inertia_at_links(solution.slopes)))
    motion = jnp.concatenate([solution.angular_velocity, solution.velocity], axis=1)[:, :, None]

    def equations(problem: GroundProblem) -> LinkEquations:
        """Return those that the motion solves, of ground impulses that it calls for and that stay linear around it."""
        impulses, _ = problem.impulses_at(body, solution.velocity, solution.angular_velocity)
        momenta = problem.ends.momenta_at_links(active * impulses)
        wrenches = jnp.concatenate(
            [problem.momenta.angular + momenta.angular, problem.momenta.linear + momenta.linear], axis=1
        )
        servos = on_links(body, problem.impulse, problem.impulse)
        wrenches = wrenches.at[:, :3].add(servos)[:, :, None] + mm(ground_blocks, motion)
        system = LinkSystem(packed_inertia(problem.inertia) + ground_blocks, problem.anchors, problem.resistance)
        return LinkEquations(system, wrenches, problem.closing[:, :, None])

    values, tangent = jax.jvp(equations, (problem,), tangents[:1])
    change = solution_tangent(body, eliminated(body, values.system), motion, values, tangent)[:, :, 0]
    velocity_tangents = change[:, 3:], change[:, :3]
    _, solution_tangents = jax.jvp(
        lambda problem, *velocities: problem.at(body, *velocities, active),
        (problem, solution.velocity, solution.angular_velocity),
        (tangents[0], *velocity_tangents),
    )
    return solution, solution_tangents


def ramp(value: Array, width: float) -> Array:
    """Return 0 where a value is negative, 1 from `width` on, and no slope between.

    A compiler evaluates a comparison again for every block of a matrix, and may round otherwise: blocks that disagree
    make no positive matrix. A ramp differs as little as its argument.
    """
    return jax.lax.stop_gradient(jnp.clip(value / width, 0.0, 1.0))


def twice(links: Array) -> Array:
    """Return links (n, ...) for both of their ends (2 n, ...)."""
    return jnp.concatenate([links, links])


def _upright(like: Array) -> Array:
    """Return the vertical (3, 1), in the precision of another array."""
    return jnp.array([0.0, 0.0, 1.0], like.dtype)[:, None]

"""MuJoCo's law of soft contacts, for all contacts of a scene in one solve.

A contact point has the relative velocity u, the normal n and the gap p < 0. Its force f and acceleration a obey
(MuJoCo's documentation, "Computation", "Constraint model")

    a + R f = a_ref,    f in the friction cone K,    a_ref = -b / d u - k / d p n,    R = (1 - d) / d W

with the surface's stiffness k and damping b, the impedance d, and the mean inverse mass W of both links at their
centres (MuJoCo takes that of the reference pose): f is the projection of (a_ref - a) / R onto K. Friction and normal
force are coupled: where a contact slides, its normal acceleration rises with the slip (E. Todorov, "Convex and
analytically invertible dynamics with contacts and constraints", 2014). Over a time h, of the impulses J = h f,

    J = P_K(m (u_ref - u')),    m = 1 / R,    u_ref = u + h a_ref,    u' = u_free + A J

with the admittance A of all contacts. Newton's method solves for all J, with an exact line search, and differentiated
by this condition, not through the iterations: dJ = P_K' d(m (u_ref - u_free - A J)).

Arrays have the batch last, as in `linalg`: vectors (n, 3, B), matrices (n, 3, 3, B).
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.linalg import barrier, dot, inverse, mm, mv, saved

# The share of the constraint that is a spring; the rest follows the free motion (MuJoCo's impedance).
IMPEDANCE = 0.99
# Points of the line search, in shares of a Newton step.
SHARES = (0.015625, 0.0625, 0.125, 0.25, 0.375, 0.5, 0.75, 1.0)
# Largest error of an impulse, as a share of the scene's largest and in units of the precision: 1e-4 in 32 bits.
TOLERANCE = 1000.0


class NewtonState(NamedTuple):
    """Impulses and velocities u' (C, 3, B); `ContactProblem.impulses_and_slopes_at` these velocities."""

    impulses: Array
    velocity: Array
    projected: Array
    slope: Array


class ContactProblem(NamedTuple):
    """C contacts: the module's u_free (C, 3, B) [m/s], A (C, C, 3, 3, B) [1/kg], u_ref (C, 3, B) [m/s] and m (C, 1, B).

    normal: (C, 3, B). friction: coefficients (C, 1, B or 1). active: (C, 1, B) 1 where there is contact, else 0.
    """

    velocity: Array
    admittance: Array
    reference: Array
    mass: Array
    normal: Array
    friction: Array
    active: Array

    def after(self, impulses: Array) -> Array:
        """Return the velocities u' (C, 3, B) under impulses (C, 3, B)."""
        total = self.velocity
        for number in range(len(impulses)):
            total += mv(self.admittance[:, number], impulses[number][None])
        return total

    def impulses_at(self, velocity: Array) -> Array:
        """Return the impulses (C, 3, B), projected on the friction cone, at velocities u'."""
        return self.active * projected(self.mass * (self.reference - velocity), self.normal, self.friction)

    def impulses_and_slopes_at(self, velocity: Array) -> tuple[Array, Array]:
        """Return the impulses (C, 3, B) at velocities u', and their negative derivatives (C, 3, 3, B) [kg] by u'."""
        point, slope = projection(self.mass * (self.reference - velocity), self.normal, self.friction)
        return self.active * point, barrier((self.active * self.mass)[:, None] * slope)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def impulses_of(problem: ContactProblem, guess: Array, iterations: int) -> Array:
    """Return the impulses J (C, 3, B) [N s] of all contacts; see the module.

    iterations: of Newton's method, at most; a scene ends where its residual is below `TOLERANCE`, whatever others do.
    """

    def unconverged(state: NewtonState) -> Array:
        residual, largest = (
            jnp.max(jnp.abs(values), axis=(0, 1)) for values in (state.projected - state.impulses, state.impulses)
        )
        above: Array = residual > TOLERANCE * np.finfo(largest.dtype).eps * largest
        return above

    def at(impulses: Array, velocity: Array) -> NewtonState:
        return NewtonState(impulses, velocity, *problem.impulses_and_slopes_at(velocity))

    def newton(carry: tuple[Array, NewtonState]) -> tuple[Array, NewtonState]:
        number, state = carry
        impulses, velocity, projected_impulses, slope = state
        # Linear around the velocities, J = q - M u'.
        offset = projected_impulses + mv(slope, velocity)
        new_velocity = solve_blocks(_matrix(problem.admittance, slope), problem.after(offset))
        new_impulses = offset - mv(slope, new_velocity)
        share = jnp.where(
            unconverged(state), _line_search(problem, (velocity, new_velocity), (impulses, new_impulses)), 0.0
        )
        return number + 1, at(
            impulses + share * (new_impulses - impulses), velocity + share * (new_velocity - velocity)
        )

    def continues(carry: tuple[Array, NewtonState]) -> Array:
        return (carry[0] < iterations) & jnp.any(unconverged(carry[1]))

    start = _decoupled_impulses(problem, guess * problem.active)
    _, solution = jax.lax.while_loop(continues, newton, (jnp.array(0), at(start, problem.after(start))))
    return solution.impulses


@impulses_of.defjvp
def _impulses_jvp(
    iterations: int, primals: tuple[ContactProblem, Array], tangents: tuple[ContactProblem, Array]
) -> tuple[Array, Array]:
    problem, guess = primals
    impulses = saved(impulses_of(problem, guess, iterations))
    _, change = jax.jvp(lambda primal: primal.impulses_at(primal.after(impulses)), (problem,), (tangents[0],))
    _, slope = problem.impulses_and_slopes_at(problem.after(impulses))
    # dJ + M A dJ = change; M (1 + A M)^-1 = (1 + M A)^-1 M, and dJ = change - M (1 + A M)^-1 A change.
    at_rest = problem._replace(velocity=jnp.zeros_like(problem.velocity))
    return impulses, change - mv(slope, solve_blocks(_matrix(problem.admittance, slope), at_rest.after(change)))


def _decoupled_impulses(problem: ContactProblem, guess: Array) -> Array:
    """Return impulses (C, 3, B) of every contact where the others' are those of the guess: see `stuck_or_sliding`.

    The tangential admittance of a contact is the mean of all directions.
    """
    own_admittance = jnp.stack([problem.admittance[number, number] for number in range(len(guess))])
    velocity_change = problem.reference - (problem.after(guess) - mv(own_admittance, guess))
    normal_admittance = dot(problem.normal, mv(own_admittance, problem.normal))
    tangential_admittance = (
        0.5 * (own_admittance[:, 0, 0] + own_admittance[:, 1, 1] + own_admittance[:, 2, 2])[:, None]
        - 0.5 * normal_admittance
    )
    normal_change, tangent, tangential_change = _split(velocity_change, problem.normal)
    regularisation = 1.0 / problem.mass
    normal_impulse, tangential_impulse = stuck_or_sliding(
        normal_change,
        tangential_change,
        normal_admittance + regularisation,
        tangential_admittance + regularisation,
        problem.friction,
    )
    return problem.active * (normal_impulse * problem.normal + tangential_impulse / tangential_change * tangent)


def stuck_or_sliding(
    normal_change: Array,
    tangential_change: Array,
    normal_admittance: Array,
    tangential_admittance: Array,
    friction: Array | float,
) -> tuple[Array, Array]:
    """Return the normal and tangential impulses (*,) of contacts with equal admittance in all tangential directions.

    normal_change, tangential_change: parts of u_ref - u_free, (*,) [m/s]. normal_admittance, tangential_admittance:
    A + 1 / m [1/kg]. The module's condition is one of two unknowns then: a contact sticks, J = (u_ref - u_free) /
    (A + 1 / m), or slides in that tangential direction where J is outside the friction cone.
    """
    normal, tangent = normal_change / normal_admittance, tangential_change / tangential_admittance
    sliding = jnp.maximum(normal_change + friction * tangential_change, 0.0) / (
        normal_admittance + friction**2 * tangential_admittance
    )
    slides = tangent > friction * normal
    return jnp.where(slides, sliding, normal), jnp.where(slides, friction * sliding, tangent)


def projection(vector: Array, normal: Array, friction: Array | float) -> tuple[Array, Array]:
    """Return the points (n, 3, B) of the friction cone nearest to vectors, and their derivatives (n, 3, 3, B).

    friction: coefficients, (n, 1, B or 1) or one. The derivatives are symmetric and not negative.
    """
    friction = jnp.broadcast_to(jnp.asarray(friction, vector.dtype), vector[:, :1].shape)
    unit = jnp.eye(3, dtype=vector.dtype)[..., None]
    along, tangent, length = _split(vector, normal)
    direction = tangent / length
    edge = normal + friction * direction
    steep = 1.0 / (1.0 + friction**2)
    share = (along + friction * length) * steep
    across = unit - normal[:, :, None] * normal[:, None] - direction[:, :, None] * direction[:, None]
    bent = jnp.clip(friction * share / length, 0.0, 1.0)
    sliding = edge[:, :, None] * edge[:, None] * steep[:, None] + bent[:, None] * across
    # One decision for all blocks of a matrix: a compiler may evaluate it again for each, and round otherwise.
    inside, pushed = barrier((length <= friction * along, friction * length > -along))
    point = jnp.where(inside, vector, share * edge) * pushed
    return point, jnp.where(inside[:, None], unit, sliding) * pushed[:, None]


def projected(vector: Array, normal: Array, friction: Array | float) -> Array:
    """Return the points of `projection` alone."""
    along, tangent, length = _split(vector, normal)
    pressing = jnp.maximum(along + friction * length, 0.0) / (1.0 + friction**2)
    slides = length > friction * along
    return jnp.where(slides, pressing * (normal + friction / length * tangent), vector)


def _split(vector: Array, normal: Array) -> tuple[Array, Array, Array]:
    """Return normal parts (n, 1, B) and tangential parts (n, 3, B) of vectors, and lengths (n, 1, B) of the latter."""
    along = dot(vector, normal)
    tangent = vector - along * normal
    return along, tangent, jnp.sqrt(dot(tangent, tangent) + 1e-12)


def solve_blocks(matrix: list[list[Array]], right: Array) -> Array:
    """Return x (C, 3, B) of M x = right (C, 3, B), M of C x C blocks (1, 3, 3, B) that need no pivoting."""
    count = len(matrix)
    rows, values = [list(row) for row in matrix], [right[i : i + 1] for i in range(count)]
    pivots = []
    for i in range(count):
        pivots.append(inverse(rows[i][i]))
        for j in range(i + 1, count):
            factor = mm(rows[j][i], pivots[i])
            values[j] = values[j] - mv(factor, values[i])
            for k in range(i + 1, count):
                rows[j][k] = rows[j][k] - mm(factor, rows[i][k])
    solution = list(values)
    for i in reversed(range(count)):
        substituted = sum((mv(rows[i][j], solution[j]) for j in range(i + 1, count)), jnp.zeros_like(values[i]))
        solution[i] = mv(pivots[i], values[i] - substituted)
    return jnp.concatenate(solution)


def _matrix(admittance: Array, mass: Array) -> list[list[Array]]:
    """Return the blocks of 1 + A M, of masses M (C, 3, 3, B)."""
    unit, count = jnp.eye(3, dtype=mass.dtype)[..., None], len(mass)
    rows = range(count)
    blocks = mm(jnp.concatenate([admittance[row] for row in rows]), jnp.concatenate([mass] * count))
    return [[blocks[count * i + j : count * i + j + 1] + (unit if i == j else 0.0) for j in rows] for i in rows]


def _line_search(problem: ContactProblem, velocities: tuple[Array, Array], impulses: tuple[Array, Array]) -> Array:
    """Return the share (B,) of a Newton step that minimises the cost of the convex problem.

    The cost's slope along the step is the change of velocities times the difference of the impulses, of which the
    velocities follow, from the projected impulses at these velocities. It rises with the share, and is interpolated
    linearly between `SHARES`, which are evaluated side by side.
    """
    (first, last), (one, two) = velocities, impulses
    velocity_change, impulse_change = last - first, two - one
    shares = jnp.asarray(SHARES, first.dtype)[:, None]
    count, contacts = len(SHARES), len(first)

    def at_all(values: Array) -> Array:
        return jnp.broadcast_to(values, (count, *values.shape)).reshape(count * contacts, *values.shape[1:])

    trial_velocity = (first + shares[:, None, None] * velocity_change).reshape(count * contacts, *first.shape[1:])
    unprojected = at_all(problem.mass) * (at_all(problem.reference) - trial_velocity)
    called_for = at_all(problem.active) * projected(unprojected, at_all(problem.normal), at_all(problem.friction))
    residual = one + shares[:, None, None] * impulse_change - called_for.reshape(count, *first.shape)
    slopes = _total(velocity_change * residual)
    at_none = _total((velocity_change * (one - problem.impulses_at(first)))[None])[0]
    # The last share before which the slope is negative, and the straight line to the next.
    before = jnp.concatenate([at_none[None], slopes[:-1]])
    low = jnp.concatenate([jnp.zeros_like(shares[:1]), shares[:-1]])
    crossing = low + (shares - low) * jnp.clip(-before / jnp.maximum(slopes - before, 1e-30), 0.0, 1.0)
    result = jnp.ones_like(at_none)
    for number in reversed(range(count)):
        result = jnp.where(slopes[number] > 0.0, crossing[number], result)
    return result


def _total(values: Array) -> Array:
    """Return the sums (n, B) of vectors (n, C, 3, B)."""
    rows = [values[:, contact, axis] for contact in range(values.shape[1]) for axis in range(3)]
    return sum(rows[1:], rows[0])


def reference_velocity(
    stiffness: Array, damping: Array, velocity: Array, gap: Array, normal: Array, h: Array | float
) -> Array:
    """Return the module's u_ref (C, 3, B) [m/s] of contacts of a velocity u (C, 3, B) [m/s] and a gap (C, 1, B) [m]."""
    return velocity * (1.0 - h * damping / IMPEDANCE) - h * stiffness / IMPEDANCE * gap * normal

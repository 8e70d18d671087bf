"""One step of a body alone: a tree of links on ball joints, their servos, gravity, torque from outside, the ground.

What physics says of it is not learned: this is the base to which a network adds what is left. The equations are those
of R. Featherstone's articulated-body algorithm (Rigid Body Dynamics Algorithms (2008), 7.3), with velocities at the end
of a stage instead of accelerations as unknowns, so that servos and damping are implicit:

    A_i V_i' = P_i + W_i                        link i, under the impulse W_i of its joint
    V_i' = X_i V_p' + S_i y_i + c_i             its joint lets it turn against its parent p, by y_i [rad/s]
    S_i^T W_i = T_i - G_i y_i                   and pulls: G = h D + h^2 K + armature

Two stages of length gamma dt make a step of second order that damps what is stiff (R. Alexander, SIAM J. Numerical
Analysis 14 (1977), "SDIRK2"). Inside, arrays have the batch last, so that small matrices are worked on side by side:
vectors (n, 3, B), matrices (n, 3, 3, B), n links of one level of the tree.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import rotation
from larp_model import state as packed
from larp_model.kinematics import anchors, strength
from larp_model.scene import Body, Vector

GAMMA = 1.0 - math.sqrt(0.5)


@dataclass(frozen=True)
class Constants:
    """What is chosen here, not derived.

    closing: share of a joint's displacement that a step takes back (J. Baumgarte, Computer Methods 1 (1972)). standing:
    an end in the ground is held as if by so many times its body's mass. rounds: Newton steps in which the ground's
    forces are found, all of them at once (`reaction`).
    """

    closing: float = 0.2
    standing: float = 3.0
    rounds: int = 3


class BodyMotion(NamedTuple):
    """What becomes of a body within a step: (B, n, 3) each, world frame.

    velocity [m/s] and spin [rad/s] at its end; moved [m] and turned [rad] during it.
    """

    velocity: Array
    spin: Array
    moved: Array
    turned: Array


class Inertia(NamedTuple):
    """Symmetric matrices (n, 6, 6, B) from spins and velocities to their momenta, in blocks (n, 3, 3, B)."""

    turning: Array
    mixed: Array
    moving: Array


class Momenta(NamedTuple):
    """Momenta (n, 3, B) of turning and of moving."""

    turning: Array
    moving: Array


class Anchors(NamedTuple):
    """Of all joints, by their children and by their parents, (n - 1, 3, B) each."""

    child: Array
    parent: Array


class Articulation(NamedTuple):
    """Inertia of an articulated body's links within a step, the ground's contacts included, and where its joints are.

    Batch last.
    """

    inertia: Inertia
    tied: Anchors


Begun = tuple[Array, Array, Array, Array]
"""What a stage starts from: see `free_motion`."""


class Level(NamedTuple):
    """Links as far from the root as each other, and the joints that tie them to their parents.

    rows, parents (n,): in the body. Batch last: child, parent (n, 3, B) [m] from the links' centres to the joint;
    closing (n, 3, B) [m/s]; pull (n, 3, B) and hold (n, 3, 3, B) are the equations' T and G.
    """

    rows: np.ndarray
    parents: np.ndarray
    child: Array
    parent: Array
    closing: Array
    pull: Array
    hold: Array


def free_motion(
    body: Body, state: Array, control: Array, torque: Array, morphology: Array, gravity: float, dt: float,
    constants: Constants = Constants(),
) -> BodyMotion:  # fmt: skip
    """How a body in states (B, n, 13) moves on within `dt` [s] if nothing but the ground touches it.

    control (B, j, 3) joint targets [rad], torque (B, n, 3) [N m] from outside, morphology (B or 1, n, 3).
    """
    before, targets, outside, sizes = (jnp.moveaxis(each, 0, -1) for each in (state, control, torque, morphology))
    motion, _ = articulated_motion(body, before, targets, outside, sizes, gravity, dt, constants)
    return BodyMotion(*(jnp.moveaxis(each, -1, 0) for each in motion))


def articulated_motion(
    body: Body, state: Array, targets: Array, outside: Array, sizes: Array, gravity: float, dt: float,
    constants: Constants = Constants(),
) -> tuple[BodyMotion, Articulation]:  # fmt: skip
    """Return `free_motion` with the batch last, and with what the body moves in the first of its two stages.

    state (n, 13, B), targets (j, 3, B) [rad], outside (n, 3, B) [N m], sizes (n, 3, B or 1).
    """
    h = GAMMA * dt
    position, orientation, velocity, spin = (
        state[:, columns] for columns in (packed.POSITION, packed.ORIENTATION, packed.VELOCITY, packed.ANGULAR_VELOCITY)
    )
    local, stronger = local_anchors(body, sizes), strength(body, jnp.moveaxis(sizes, -1, 0))
    child, parent = turned_anchors(body, local, turns(orientation))
    parents = np.array([joint.parent for joint in body.joints], int)
    gap = position[parents] + parent - (position[1:] + child)
    down = jnp.array([0.0, 0.0, -gravity], state.dtype)[:, None]

    def stage(raised: Array, turned: Array, velocity: Array, spin: Array) -> tuple[tuple[Array, Array], Articulation]:
        """Velocities and spins `h` later, of links raised by (n, 1, B) [m] and turned by (n, 3, B) [rad] before."""
        start = turn(orientation, turned)
        matrices = turns(turn(start, h * spin))
        inertia = inertias(body, matrices, sizes)
        momentum, mass = mv(inertia.turning, spin), sizes[:, 2:3]
        push = Momenta(momentum + h * (outside - cross(spin, momentum)), mass * (velocity + h * down))
        tied = turned_anchors(body, local, matrices)
        before = turns(start)
        pull, hold = servos(body, start, before, targets, spin, h, stronger)
        height = position[:, 2:] + raised
        tied, pull, hold = held((tied, pull, hold))
        levels = [
            Level(rows, parents, *(each[rows - 1] for each in (*tied, constants.closing / dt * gap, pull, hold)))
            for rows, parents in tree(body)
        ]

        def parting(bearing: tuple[Inertia, Momenta]) -> tuple[Array, Array]:
            """Velocities and spins under what the ground adds to inertia and push."""
            bears, pushed = held(jax.tree.map(jnp.add, (inertia, push), bearing))
            return solve(bears, pushed, levels)

        ends = Ends.of(body, before, height, velocity, spin, sizes, h, velocity_products(body, tied, spin))
        whole = jnp.sum(jnp.broadcast_to(mass, velocity[:, :1].shape), axis=0, keepdims=True)
        firm = constants.standing * whole

        def round_of(guess: tuple[Array, Array, Array], nothing: None) -> tuple[tuple[Array, Array, Array], None]:
            velocity, spin, met = guess
            there = ends.velocity(velocity, spin)
            met = jnp.maximum(met, ramp(-ends.clearance - h * there[:, 2:], 1e-5))
            return (*parting(ends.found(there, met, firm, body.surface.friction)), met), None

        falls = velocity + h * down, spin, jnp.zeros_like(ends.clearance)
        (velocity, spin, met), _ = jax.lax.scan(round_of, falls, length=constants.rounds)
        bearing, _ = ends.found(ends.velocity(velocity, spin), met, firm, body.surface.friction)
        return (velocity, spin), Articulation(jax.tree.map(jnp.add, inertia, bearing), tied)

    ratio = (1.0 - GAMMA) / GAMMA

    def advance(begun: Begun, nothing: None) -> tuple[Begun, tuple[tuple[Array, Array], Articulation]]:
        raised, turned, velocity, spin = begun
        after, articulation = stage(raised, turned, velocity, spin)
        late = (1.0 - GAMMA) * dt
        goes_on = velocity + ratio * (after[0] - velocity), spin + ratio * (after[1] - spin)
        return (late * after[0][:, 2:], late * after[1], *goes_on), (after, articulation)

    still = jnp.zeros_like(spin)
    _, ((velocities, spins), stages) = jax.lax.scan(advance, (still[:, 2:], still, velocity, spin), length=2)
    moved, turned = (dt * ((1.0 - GAMMA) * one + GAMMA * two) for one, two in (velocities, spins))
    first: Articulation = jax.tree.map(lambda each: each[0], stages)
    return BodyMotion(velocities[1], spins[1], moved, turned), first


def velocity_products(body: Body, tied: Anchors, spin: Array) -> tuple[Array, Array]:
    """Return accelerations (n, 3, B) [m/s^2] and [rad/s^2] of links whose root and joints do not accelerate.

    MuJoCo leaves them out of a contact's acceleration. tied: from links' centres to their joints.
    """
    parents = np.array([joint.parent for joint in body.joints], int)
    # How the two points of a joint accelerate apart as their links turn, and the joint's axes with the child.
    closing = cross(spin[parents], cross(spin[parents], tied.parent))
    closing -= cross(spin[1:], cross(spin[1:], tied.child))
    carried = cross(spin[1:], spin[1:] - spin[parents])
    velocity = turning = jnp.zeros_like(spin[:1])
    rows = np.array([0])
    for level, above in tree(body):
        known, joint = np.array([int(np.flatnonzero(rows == row)[0]) for row in above]), level - 1
        outer = turning[known] + carried[joint]
        moving = velocity[known] + cross(turning[known], tied.parent[joint]) - cross(outer, tied.child[joint])
        velocity, turning = jnp.concatenate([velocity, moving + closing[joint]]), jnp.concatenate([turning, outer])
        rows = np.concatenate([rows, level])
    order = np.argsort(rows)
    return velocity[order], turning[order]


def inverse(inertia: Inertia) -> Inertia:
    """From momenta to spin and velocity."""
    still = invert(inertia.moving)
    lever = mm(inertia.mixed, still)
    turning = invert(inertia.turning - mm(lever, jnp.swapaxes(inertia.mixed, 1, 2)))
    mixed = -mm(turning, lever)
    return Inertia(turning, mixed, still - mm(jnp.swapaxes(lever, 1, 2), mixed))


def tree(body: Body) -> list[tuple[np.ndarray, np.ndarray]]:
    """Rows of links and of their parents, level by level from the root's children outwards."""
    depth = [0]
    for joint in body.joints:
        depth.append(depth[joint.parent] + 1)
    levels = []
    for level in range(1, max(depth) + 1):
        rows = np.flatnonzero(np.array(depth) == level)
        levels.append((rows, np.array([body.joints[row - 1].parent for row in rows])))
    return levels


def turn(orientation: Array, rotation_vector: Array) -> Array:
    """Orientations (n, 4, B) turned by rotation vectors (n, 3, B) [rad], right to the second order."""
    w, v = orientation[:, :1], orientation[:, 1:]
    half = 0.5 * rotation_vector
    real = w - _dot(half, v)
    imaginary = v + w * half + cross(half, v)
    scale = jax.lax.rsqrt(real**2 + _dot(imaginary, imaginary))
    return scale * jnp.concatenate([real, imaginary], axis=1)


def turns(orientation: Array) -> Array:
    """Rotation matrices (n, 3, 3, B) of orientations (n, 4, B)."""
    w, x, y, z = (orientation[:, k] for k in range(4))
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)


def angles(parent: Array, child: Array) -> Array:
    """Rotation vectors (n, 3, B) [rad] of children against their parents, from their orientations (n, 4, B)."""
    w, v, a, u = parent[:, :1], parent[:, 1:], child[:, :1], child[:, 1:]
    relative = jnp.concatenate([w * a + _dot(v, u), w * u - a * v - cross(v, u)], axis=1)
    return jnp.moveaxis(rotation.to_rotation_vector(jnp.moveaxis(relative, 1, -1)), -1, 1)


def _dot(first: Array, second: Array) -> Array:
    x, y, z = (first[:, k : k + 1] * second[:, k : k + 1] for k in range(3))
    return x + y + z


def local_anchors(body: Body, sizes: Array) -> Anchors:
    """Where joints are in the frames of their children and of their parents, (n - 1, 3, B or 1) [m] each."""

    def place(rows: list[int], points: list[Vector]) -> Array:
        chosen = jnp.moveaxis(sizes[np.array(rows, int)], -1, 0)
        return jnp.moveaxis(anchors(points, [body.links[row].axis for row in rows], chosen), 0, -1)

    return Anchors(
        place(list(range(1, len(body.links))), [joint.child_anchor for joint in body.joints]),
        place([joint.parent for joint in body.joints], [joint.parent_anchor for joint in body.joints]),
    )


def turned_anchors(body: Body, local: Anchors, matrices: Array) -> Anchors:
    """The same from the links' centres, (n - 1, 3, B) [m], of links so turned (n, 3, 3, B)."""
    parents = np.array([joint.parent for joint in body.joints], int)
    return Anchors(mv(matrices[1:], local.child), mv(matrices[parents], local.parent))


def moments(length: Array, radius: Array, mass: Array) -> tuple[Array, Array]:
    """Return moments of inertia (*,) [kg m^2] of solid capsules, about their axis and across it."""
    sphere = 4.0 / 3.0 * radius / (length + 4.0 / 3.0 * radius)
    rod, caps = mass * (1.0 - sphere), mass * sphere
    along = (0.5 * rod + 0.4 * caps) * radius**2
    across = rod * (length**2 / 12.0 + radius**2 / 4.0)
    across += caps * (0.4 * radius**2 + length**2 / 4.0 + 0.375 * length * radius)
    return along, across


def inertias(body: Body, matrices: Array, sizes: Array) -> Inertia:
    """Of the links alone, in world axes."""
    along, across = moments(sizes[:, 0], sizes[:, 1], sizes[:, 2])
    axes = np.array([link.axis for link in body.links], np.float32)
    axis = mv(matrices, jnp.asarray(axes, matrices.dtype)[..., None])
    outer = axis[:, :, None] * axis[:, None, :]
    unit = jnp.eye(3, dtype=matrices.dtype)[..., None]
    turning = across[:, None, None] * unit + (along - across)[:, None, None] * outer
    moving = jnp.broadcast_to(sizes[:, 2][:, None, None] * unit, turning.shape)
    return Inertia(turning, jnp.zeros_like(turning), moving)


def servos(
    body: Body, orientation: Array, matrices: Array, targets: Array, spin: Array, h: float, stronger: Array
) -> tuple[Array, Array]:
    """Pull (n - 1, 3, B) and hold (n - 1, 3, 3, B) of all joints within `h` [s]; see the module's equations.

    orientation (n, 4, B) and its matrices (n, 3, 3, B), targets (j, 3, B) [rad], spin (n, 3, B); stronger (B or 1,) is
    `kinematics.strength`. A servo that is at its limit pulls on, and yields.
    """
    links, batch = len(body.links), spin.shape[-1]
    motors, passive = np.zeros((4, links - 1, 1, 1), np.float32), np.zeros((links - 1, 1, 1), np.float32)
    aim, motor_rows = jnp.zeros((links - 1, 3, batch), spin.dtype), []
    for child, joint in enumerate(body.joints):
        motor = joint.motor
        if motor is None:
            passive[child] = joint.damping
        else:
            motors[:, child, 0, 0] = motor.stiffness, motor.torque_limit, motor.armature, motor.damping
            motor_rows.append(child)
    stiffness, limit, armature, damping = stronger * jnp.asarray(motors)
    parents = np.array([joint.parent for joint in body.joints], int)
    matrices = matrices[1:]
    unit = jnp.eye(3, dtype=spin.dtype)[..., None]
    free = armature + h * (damping + passive)
    pull = armature * (spin[1:] - spin[parents])
    if not motor_rows:
        return pull, jnp.broadcast_to(free[:, :, None] * unit, (links - 1, 3, 3, batch))
    aim = aim.at[np.array(motor_rows)].set(targets)
    wanted = stiffness * (aim - angles(orientation[parents], orientation[1:]))
    giving = h**2 * stiffness * (jnp.abs(wanted) < limit)
    hold = mm(matrices * giving[:, None], jnp.swapaxes(matrices, 1, 2)) + free[:, :, None] * unit
    return pull + h * mv(matrices, jnp.clip(wanted, -limit, limit)), hold


class Ends(NamedTuple):
    """Both ends of all links, (2 n, ..., B), one end of each after the other, and how the ground wants them to move.

    arm: their lowest points [m] from the links' centres. clearance: their height [m]. allowed: the velocity [m/s] at
    which neither the spring of the body's surface nor friction pushes them.
    """

    arm: Array
    clearance: Array
    allowed: Array

    @staticmethod
    def of(
        body: Body, matrices: Array, height: Array, velocity: Array, spin: Array, sizes: Array, h: float,
        gains: tuple[Array, Array],
    ) -> Ends:  # fmt: skip
        """Return the ends of links by rotations (n, 3, 3, B), heights (n, 1, B) [m] and first velocities (n, 3, B).

        gains: accelerations of the links, (n, 3, B) [m/s^2] and [rad/s^2], that contacts do not count.
        """
        surface, upright = body.surface, _upright(matrices)
        axes = jnp.array([link.axis for link in body.links], matrices.dtype)[..., None]
        half, down = 0.5 * sizes[:, :1] * mv(matrices, axes), sizes[:, 1:2] * upright
        arm = jnp.concatenate([half - down, -half - down])
        speed, clearance = twice(velocity) + cross(twice(spin), arm), twice(height) + arm[:, 2:]
        speed += h * (twice(gains[0]) + cross(twice(gains[1]), arm))
        damped = 1.0 + h * surface.damping
        rising = (speed[:, 2:] - h * surface.stiffness * clearance) / (damped + h**2 * surface.stiffness)
        return Ends(arm, clearance, speed * (1.0 - upright) / damped + rising * upright)

    def velocity(self, velocity: Array, spin: Array) -> Array:
        """The ends' velocities (2 n, 3, B), from the links'."""
        return twice(velocity) + cross(twice(spin), self.arm)

    def found(self, guess: Array, met: Array, firm: Array, friction: float) -> tuple[Inertia, Momenta]:
        """What they add to their links' inertia and push: the ground's impulses, linear around velocities `guess`.

        met (2 n, 1, B): 1 where an end is in the ground. firm (1, 1, B) [kg]: see `reaction`.
        """
        impulse, slope = reaction(firm * (self.allowed - guess), friction)
        hold = held(met[:, None] * firm[:, None] * slope)
        return self.held_by(hold, met * impulse + mv(hold, guess))

    def held_by(self, hold: Array, push: Array) -> tuple[Inertia, Momenta]:
        """Inertia and push of the links whose ends masses (2 n, 3, 3, B) [kg] hold and momenta (2 n, 3, B) push."""
        mixed, links = cross_columns(self.arm, hold), len(self.arm) // 2
        added = Inertia(-cross_rows(mixed, self.arm), mixed, hold), Momenta(cross(self.arm, push), push)
        both: tuple[Inertia, Momenta] = jax.tree.map(lambda each: each[:links] + each[links:], added)
        return both


def reaction(asked: Array, friction: float) -> tuple[Array, Array]:
    """Impulses (n, 3, B) in the friction cone that are nearest to those asked for, and their slopes (n, 3, 3, B).

    MuJoCo's soft contact: the impulse J on a point whose velocity is v' minimises the kinetic energy together with the
    squared distance of what is asked, r (v - v') with the mass r that holds the point and the velocity v that the
    ground allows, from the polar cone, so that J is its projection onto the cone (E. Todorov, "Convex and analytically
    invertible dynamics with contacts and constraints", 2014). The slopes are symmetric and not negative.
    """
    upright, unit = _upright(asked), jnp.eye(3, dtype=asked.dtype)[..., None]
    pressing, sideways = asked[:, 2:], asked * (1.0 - upright)
    pull = jnp.sqrt(jnp.sum(sideways**2, axis=1, keepdims=True) + 1e-12)
    along = upright + friction * sideways / pull
    share = (pressing + friction * pull) / (1.0 + friction**2)
    across = unit - upright[:, None] * upright - (sideways / pull)[:, :, None] * (sideways / pull)[:, None]
    bent = jnp.clip(friction * share / pull, 0.0, 1.0)
    sliding = along[:, :, None] * along[:, None] / (1.0 + friction**2) + bent[:, None] * across
    stands, pushed = held((pull <= friction * pressing, friction * pull > -pressing))  # see `ramp`
    impulse = jnp.where(stands, asked, share * along) * pushed
    return impulse, jnp.where(stands[:, None], unit, sliding) * pushed[:, None]


def twice(links: Array) -> Array:
    """Of both ends of every link."""
    return jnp.concatenate([links, links])


def _upright(like: Array) -> Array:
    """The vertical (3, 1), in the precision of another array."""
    return jnp.array([0.0, 0.0, 1.0], like.dtype)[:, None]


def ramp(value: Array, width: float) -> Array:
    """0 where a value is negative, 1 from `width` on, and no slope between.

    A compiler works a comparison out anew beside every block of a matrix, and may round otherwise: blocks that are not
    of one mind make no matrix that is positive. A ramp differs as little as its argument.
    """
    return jax.lax.stop_gradient(jnp.clip(value / width, 0.0, 1.0))


class Joined(NamedTuple):
    """A level's joints: spins (n, 3, B) [rad/s] that pushes give them alone, and what their parents' motion takes off.

    solved: L^-1 (n, 3, 3, B), of the lower triangle L in L L' = S' A S + G. half (n, 3, 6, B): L^-1 S' A. by_parent
    (n, 3, 6, B): L'^-1 of that, spin per spin and velocity that the parent gives its child's centre.
    """

    turned: Array
    by_parent: Array
    half: Array
    solved: Array


def inwards(inertia: Inertia, push: Momenta, levels: list[Level]) -> tuple[Inertia, Momenta, list[Joined]]:
    """Return inertia and push (1, ...) of the root with all that hangs on it, and the joints of the levels.

    Inertia and push of a link are the columns of one matrix (n, 6, 7, B), whose every operation is one loop.
    """
    every = jnp.concatenate([packed_inertia(inertia), jnp.concatenate([push.turning, push.moving], 1)[:, :, None]], 2)
    passed, handed, below = [], every[:0], np.array([], int)
    for level in reversed(levels):
        own = held(with_children(every[level.rows], level.rows, handed, below))
        child, arm = level.child, level.child - level.parent
        # A S, and S' A S + G
        along = own[:, :, :3] + cross_rows(own[:, :, 3:6], child)
        factor = inverse_cholesky(along[:, :3] - cross_columns(child, along[:, 3:]) + level.hold)
        moved = own[:, :, 6] - mv(own[:, :, 3:6], level.closing)
        pull = level.pull + moved[:, :3] - cross(child, moved[:, 3:])
        # L^-1 (S' A), with which A - A S (L L')^-1 S' A stays positive in 32 bits, however light a link is held
        half = held(mm(factor, jnp.concatenate([jnp.swapaxes(along, 1, 2), pull[:, :, None]], axis=2)))
        relative = mm(jnp.swapaxes(factor, 1, 2), half)
        passed.append(Joined(relative[:, :, 6], relative[:, :, :6], half[:, :, :6], factor))
        # What the joint hands on: A - A S (S' A S + G)^-1 S' A, seen from the parent's centre
        kept = jnp.concatenate([own[:, :, :6], moved[:, :, None]], axis=2)
        left = held(kept - mm(jnp.swapaxes(half[:, :, :6], 1, 2), half))
        shifted = carried_back(arm, left)
        seen_there = shifted[:, :, :3] + cross_rows(shifted[:, :, 3:6], arm)
        handed, below = held(jnp.concatenate([seen_there, shifted[:, :, 3:]], axis=2)), level.parents
    root = with_children(every[:1], np.array([0]), handed, below)
    whole = Inertia(root[:, :3, :3], root[:, :3, 3:6], root[:, 3:, 3:6])
    return whole, Momenta(root[:, :3, 6], root[:, 3:, 6]), passed[::-1]


def packed_inertia(inertia: Inertia) -> Array:
    """Return inertias (n, 6, 6, B) by their blocks."""
    mixed = jnp.swapaxes(inertia.mixed, 1, 2)
    upper_rows = jnp.concatenate([inertia.turning, inertia.mixed], axis=2)
    return jnp.concatenate([upper_rows, jnp.concatenate([mixed, inertia.moving], axis=2)], axis=1)


def with_children(own: Array, rows: np.ndarray, handed: Array, parents: np.ndarray) -> Array:
    """Return links (n, ...) in these rows of a body with what their children (m, ...), of these parents, hand on."""
    children = [np.flatnonzero(parents == row) for row in rows]
    handed = jnp.concatenate([handed, jnp.zeros_like(own[:1])])
    for number in range(max(map(len, children), default=0)):
        chosen = [each[number] if number < len(each) else len(parents) for each in children]
        own = own + handed[np.array(chosen)]
    return own


def carried_back(arm: Array, wrench: Array) -> Array:
    """Return moments and forces (n, 6, k, B) about the point that is `arm` (n, 3, B) away from the given ones'."""
    return jnp.concatenate([wrench[:, :3] - cross_columns(arm, wrench[:, 3:]), wrench[:, 3:]], axis=1)


def solve(inertia: Inertia, push: Momenta, levels: list[Level]) -> tuple[Array, Array]:
    """Velocities and spins (n, 3, B) with which links part under their pushes and their joints' impulses."""
    inertia, push, joints = inwards(inertia, push, levels)
    motions, order = [jnp.concatenate(_root(inertia, push), axis=1)], [np.array([0])]
    for level, joint in zip(levels, joints, strict=True):
        above = motions[-1][np.searchsorted(order[-1], level.parents)]
        carried = above[:, 3:] + cross(level.child - level.parent, above[:, :3])
        relative = joint.turned - mv(joint.by_parent, jnp.concatenate([above[:, :3], carried], axis=1))
        velocity = carried + cross(level.child, relative) + level.closing
        motions.append(held(jnp.concatenate([above[:, :3] + relative, velocity], axis=1)))
        order.append(level.rows)
    motion = jnp.concatenate(motions)[np.argsort(np.concatenate(order))]
    return motion[:, 3:], motion[:, :3]


def _root(inertia: Inertia, push: Momenta) -> tuple[Array, Array]:
    """Spin and velocity (1, 3, B) of a link without a parent, by the Schur complement of what moves."""
    still = invert(inertia.moving)
    lever = mm(inertia.mixed, still)
    spin = mv(
        invert(inertia.turning - mm(lever, jnp.swapaxes(inertia.mixed, 1, 2))), push.turning - mv(lever, push.moving)
    )
    return spin, mv(still, push.moving - mv(jnp.swapaxes(inertia.mixed, 1, 2), spin))


held = jax.lax.optimization_barrier
# Sums and stacks of slices, for XLA makes one quick loop over the batch of them, and a slow one of a reduction.


def mv(matrix: Array, vector: Array) -> Array:
    """Return matrices (n, m, k, B) times vectors (n, k, B)."""
    parts = [matrix[:, :, k] * vector[:, None, k] for k in range(matrix.shape[2])]
    return sum(parts[1:], parts[0])


def mm(first: Array, second: Array) -> Array:
    """Return products of matrices (n, l, k, B) and (n, k, m, B)."""
    parts = [first[:, :, k, None] * second[:, None, k] for k in range(first.shape[2])]
    return sum(parts[1:], parts[0])


def cross(first: Array, second: Array) -> Array:
    """Of vectors (n, 3, B)."""
    return _cross(first, second, 1)


def cross_columns(vector: Array, matrix: Array) -> Array:
    """[v] M: each column of M (n, 3, 3, B) crossed from the left with v (n, 3, B)."""
    return _cross(vector[:, :, None], matrix, 1)


def cross_rows(matrix: Array, vector: Array) -> Array:
    """M [v]: each row of M (n, 3, 3, B) crossed with v (n, 3, B)."""
    return _cross(matrix, vector[:, None], 2)


def _cross(first: Array, second: Array, axis: int) -> Array:
    (a, b, c), (x, y, z) = (jnp.moveaxis(each, axis, 0) for each in (first, second))
    return jnp.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=axis)


def inverse_cholesky(matrix: Array) -> Array:
    """Return L^-1 (n, 3, 3, B) of positive definite matrices L L' and lower triangles L."""
    a = jax.lax.rsqrt(matrix[:, 0, 0])
    b, c = matrix[:, 1, 0] * a, matrix[:, 2, 0] * a
    d = jax.lax.rsqrt(matrix[:, 1, 1] - b * b)
    e = (matrix[:, 2, 1] - c * b) * d
    f = jax.lax.rsqrt(matrix[:, 2, 2] - c * c - e * e)
    none = jnp.zeros_like(a)
    rows = ((a, none, none), (-b * a * d, d, none), ((e * b * d - c) * a * f, -e * d * f, f))
    return held(jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1))


def invert(matrix: Array) -> Array:
    """Inverses of regular matrices (n, 3, 3, B), by their adjugates."""
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    adjugate = jnp.stack([cross(b, c), cross(c, a), cross(a, b)], axis=2)
    x, y, z = (a[:, k] * adjugate[:, k, 0] for k in range(3))
    return adjugate / (x + y + z)[:, None, None]

"""Inputs of the networks: what they see of a body, of a ball and of a contact; and their normalisation.

Everything is invariant to shifts along the ground; in the heading frame also to turns about z.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import compliance, contact, rotation
from larp_model import state as packed
from larp_model.scene import Body, Pair, Scene

# Scale of the pooled contact features, an impulse [N s] and its moment [N m s].
IMPULSE_SCALE = 1.0, 0.1
# Links whose gap within a step is larger than this do not feel each other [m].
NEAR = 0.03
# Normalised inputs are held within this many standard deviations.
RANGE = 10.0


class Statistics(NamedTuple):
    """Mean and spread of a feature vector (F,), from data; features that never vary keep spread 1."""

    mean: Array
    spread: Array

    @staticmethod
    def of(samples: Array, weight: Array | None = None) -> Statistics:
        """Statistics of samples (N, F), each counted by its weight (N,)."""
        share = jnp.ones(samples.shape[0]) if weight is None else weight
        share = (share / share.sum())[:, None]
        mean = jnp.sum(share * samples, axis=0)
        spread = jnp.sqrt(jnp.sum(share * (samples - mean) ** 2, axis=0))
        return Statistics(mean, jnp.where(spread > 1e-5, spread, 1.0))

    def normalise(self, features: Array) -> Array:
        """Features (*, F) in standard deviations from the mean, within +-RANGE."""
        return jnp.clip((features - self.mean) / self.spread, -RANGE, RANGE)

    def restore(self, outputs: Array) -> Array:
        """Outputs (*, F) in their own units."""
        return outputs * self.spread + self.mean


def morphology_of(scene: Scene) -> Array:
    """The morphology (L, 3) that the scene has by itself."""
    return jnp.asarray(scene.morphology)


def anchors(
    points: list[tuple[float, float, float]], axes: list[tuple[float, float, float]], morphology: Array
) -> Array:
    """Joint anchors (*, J, 3) [m] in the frames of links of a morphology (*, J, 3)."""
    axis, point = np.asarray(axes, np.float32), np.asarray(points, np.float32)
    along = np.sum(axis * point, axis=-1, keepdims=True) * axis
    return 0.5 * morphology[..., 0:1] * along + morphology[..., 1:2] * (point - along)


def displacement(scene: Scene, state: Array, morphology: Array) -> Array:
    """Joint displacement (*, number of joints, 3) [m], world frame: the joint by the child, less by the parent."""
    joints = list(scene.joints())
    if not joints:
        return jnp.zeros((*state.shape[:-2], 0, 3), state.dtype)
    children, parents = [c for c, _, _ in joints], [p for _, p, _ in joints]
    links = scene.links
    matrices = rotation.matrix(packed.orientation(state))
    places = []
    for found, points in (
        (children, [j.child_anchor for _, _, j in joints]),
        (parents, [j.parent_anchor for _, _, j in joints]),
    ):
        rows = np.array(found)
        offset = anchors(points, [links[r].axis for r in rows], morphology[..., rows, :])
        places.append(packed.position(state)[..., rows, :] + _apply(matrices[..., rows, :, :], offset))
    return places[0] - places[1]


def _apply(matrices: Array, vectors: Array) -> Array:
    return jnp.sum(matrices * vectors[..., None, :], axis=-1)


def _apply_inverse(matrices: Array, vectors: Array) -> Array:
    """Vectors (*, V, 3) seen from the frames (*, 3, 3)."""
    return jnp.sum(matrices[..., None, :, :] * vectors[..., :, None], axis=-2)


def _flat(*parts: Array) -> Array:
    """Features (B, ...) side by side, (B, F)."""
    return jnp.concatenate([part.reshape(part.shape[0], -1) for part in parts], axis=-1)


def servo_torques(body: Body, state: Array, control: Array) -> Array:
    """The torques (B, j, 3) [N m], world frame, with which a body's servos pull their links towards their targets.

    state (B, n, 13), control (B, j, 3) rotation vectors [rad]. stiffness x (target - joint angle), within the motors'
    limits; their damping is left out, for it is linear in the angular velocities.
    """
    children = np.array([child for child, _, _ in body.motors])
    parents = np.array([joint.parent for _, joint, _ in body.motors])
    stiffness = np.array([motor.stiffness for _, _, motor in body.motors], np.float32)[:, None]
    limit = np.array([motor.torque_limit for _, _, motor in body.motors], np.float32)[:, None]
    turned = packed.orientation(state)
    relative = rotation.multiply(rotation.conjugate(turned[:, parents]), turned[:, children])
    pull = jnp.clip(stiffness * (control - rotation.to_rotation_vector(relative)), -limit, limit)
    return _apply(rotation.matrix(turned[:, children]), pull)


def ends_on_ground(body: Body, state: Array, morphology: Array, dt: float) -> tuple[Array, Array]:
    """How the two ends of every link are to the ground: velocities (B, 2 n, 3) where near it, and scalars (B, 6 n).

    The scalars are clearance [m], nearness (1 on the ground, falling off over 3 cm), and depth [m] after `dt`.
    """
    axes = np.array([link.axis for link in body.links], np.float32)
    half = _apply(rotation.matrix(packed.orientation(state)), 0.5 * morphology[..., 0:1] * axes)
    arms = jnp.concatenate([half, -half], axis=-2)
    place, velocity, spin, radius = (
        jnp.concatenate([part, part], axis=-2)
        for part in (
            packed.position(state),
            packed.velocity(state),
            packed.angular_velocity(state),
            morphology[..., 1:2],
        )
    )
    velocity = velocity + jnp.cross(spin, arms)
    clearance = (place + arms)[..., 2] - radius[..., 0]
    near = jnp.exp(-jnp.maximum(clearance, 0.0) / 0.03)
    deep = jnp.minimum(clearance + dt * velocity[..., 2], 0.0)
    return near[..., None] * velocity, jnp.concatenate([jnp.minimum(clearance, 0.1), near, deep], axis=-1)


def body_inputs(
    body: Body, turn: Array, state: Array, control: Array, torque: Array, apart: Array, morphology: Array, aided: bool,
    dt: float,
) -> Array:  # fmt: skip
    """Inputs (B, F) of the dynamics network, in the frame turned by `turn` (B, 2) about z.

    state (B, n, 13), control (B, j, 3), torque (B, n, 3), joint displacement `apart` (B, n - 1, 3), morphology (B or
    1, n, 3) of the body's n links. As the paper lists them, contacts apart: root-relative position, height, rotation
    matrix, velocities, length, radius, displacement, target quaternion, torque. aided: `servo_torques` and
    `ends_on_ground` besides.
    """
    size, links = state.shape[0], len(body.links)
    position = packed.position(state)
    columns = jnp.moveaxis(rotation.matrix(packed.orientation(state)), -1, -2)
    vectors = [
        position - position[:, :1],
        columns.reshape(size, 3 * links, 3),
        packed.velocity(state),
        packed.angular_velocity(state),
        apart,
        torque,
    ]
    scalars = [
        position[..., 2],
        rotation.from_rotation_vector(control),
        jnp.broadcast_to(morphology[..., :2], (size, links, 2)),
    ]
    if aided:
        velocities, ends = ends_on_ground(body, state, morphology, dt)
        vectors += [velocities, *([servo_torques(body, state, control)] if body.motors else [])]
        scalars.append(ends)
    turned = rotation.about_z(jnp.concatenate(vectors, axis=1), rotation.opposite(turn)[:, None])
    return _flat(turned, *scalars)


def inputs_after(
    body: Body, turn: Array, state: Array, soon: Array, apart: Array, morphology: Array, dt: float
) -> Array:
    """Inputs (B, F) of a network that corrects what mechanics says: how links (B, n, 13) are to the ground.

    soon (B, n, 13): with the velocities that they will have. Capsules are seen by their axes alone: how one has rolled
    about its own changes nothing.
    """
    links = len(body.links)
    position = packed.position(state)
    axes = jnp.array([link.axis for link in body.links], state.dtype)
    velocities, ends = ends_on_ground(body, soon, morphology, dt)
    vectors = [
        position - position[:, :1],
        _apply(rotation.matrix(packed.orientation(state)), axes),
        packed.velocity(soon),
        packed.angular_velocity(soon),
        apart,
        velocities,
    ]
    turned = rotation.about_z(jnp.concatenate(vectors, axis=1), rotation.opposite(turn)[:, None])
    return _flat(turned, position[..., 2], jnp.broadcast_to(morphology, (len(state), links, 3)), ends)


def with_pooled(inputs: Array, turn: Array, pooled: Array) -> Array:
    """Inputs (B, F + 6 n) of a network that also sees the pooled contact features (B, n, 6) of its n links."""
    parts = [pooled[..., :3] / IMPULSE_SCALE[0], pooled[..., 3:] / IMPULSE_SCALE[1]]
    turned = rotation.about_z(jnp.concatenate(parts, axis=1), rotation.opposite(turn)[:, None])
    return _flat(inputs, turned)


def with_pooled_statistics(statistics: Statistics, body: Body) -> Statistics:
    """The statistics of `with_pooled` of those of its inputs: pooled features are left as they are scaled."""
    pooled = 6 * len(body.links)
    return Statistics(
        jnp.concatenate([statistics.mean, jnp.zeros(pooled)]), jnp.concatenate([statistics.spread, jnp.ones(pooled)])
    )


class Ground(NamedTuple):
    """A ball and the ground within one step: scalars (B, F) for its network and what they are made of."""

    inputs: Array
    bounce: contact.Impact
    near: Array
    slip: Array


def ball_inputs(body: Body, state: Array, pooled: Array, morphology: Array, gravity: float, dt: float) -> Ground:
    """Inputs of a ball's network: scalars only, so that turning the world about z changes nothing.

    state (B, 13), pooled impulse (B, 6), morphology (B or 1, 3). slip (B, 3): of the ball's lowest point [m/s].
    near (B,): 1 where the ball touches the ground within the step, falling to 0 over 1 cm above it.
    """
    radius = morphology[..., 1]
    velocity, spin = packed.velocity(state), packed.angular_velocity(state)
    gap, falling = state[..., 2] - radius, -velocity[..., 2]
    closing = falling + 0.5 * gravity * dt
    start = contact.time_of_impact(gap, closing, dt)
    bounce = contact.impact(jnp.maximum(-gap, 0.0), falling + gravity * start, gravity, body.surface, dt - start)
    lowest = jnp.minimum(gap, gap - closing * dt)
    near = smooth_gate(lowest, 0.01)
    up = jnp.array([0.0, 0.0, 1.0], state.dtype)
    slip = (velocity - radius[..., None] * jnp.cross(spin, up)) * (1.0 - up)
    along = velocity * (1.0 - up)
    inputs = jnp.stack(
        [
            jnp.clip(lowest, -0.05, 0.05),
            falling,
            start,
            bounce.change,
            bounce.lag,
            contact.norm(slip),
            contact.norm(along),
            jnp.sum(slip * along, axis=-1),
            spin[..., 2],
            pooled[..., 2],
            contact.norm(pooled[..., :3]),
        ],
        axis=-1,
    )
    return Ground(inputs, bounce, near, slip)


def smooth_gate(gap: Array, margin: float) -> Array:
    """1 where gap <= 0, 0 where gap >= margin, and smooth between."""
    x = jnp.clip(1.0 - gap / margin, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


class Touch(NamedTuple):
    """Contact of P pairs of links within one step; vectors (B, P, 3) in the world frame.

    inputs: (B, P, F) for the contact network, in the first link's frame. gap: (B, P) [m] when the step begins.
    impact: along the normal. near: (B, P), 1 where the links touch within the step, falling to 0 over `NEAR`.
    normal: from the first to the second. slide: tangential velocity [m/s] of the first against the second.
    first_arm, second_arm: from the links' centres to the contact [m]. mass: (B, P) effective mass [kg] of the contact
    along the normal, the links' parents included.
    """

    inputs: Array
    gap: Array
    impact: contact.Impact
    near: Array
    normal: Array
    slide: Array
    first_arm: Array
    second_arm: Array
    mass: Array


def pair_rows(scene: Scene, pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    """Rows in the state of the first and second link of every pair of links that can touch, (P,) each."""
    rows = [
        (scene.index(pair.first, first), scene.index(pair.second, second))
        for first in pair.first_links
        for second in pair.second_links
    ]
    first, second = np.array(rows).T
    return first, second


def _segments(scene: Scene, state: Array, rows: np.ndarray, matrices: Array, morphology: Array) -> contact.Segment:
    axes = np.array([scene.links[row].axis for row in rows], np.float32)
    half = _apply(matrices, 0.5 * morphology[..., rows, 0:1] * axes)
    radius = jnp.broadcast_to(morphology[..., rows, 1], (*state.shape[:-2], len(rows)))
    return contact.Segment(packed.position(state)[..., rows, :], half, radius)


def contact_inputs(scene: Scene, pair: Pair, state: Array, free: Array, morphology: Array) -> Touch:
    """The contacts of `pair` in states (B, L, 13), at the moment the links meet in the step.

    free: states (B, L, 13) after the step if nothing touched; of it, the velocities count. Both links move on,
    evenly accelerated, until they meet (conservative advancement); the gap, normal and speeds are those of that
    moment, so that a foot that crosses the ball within a step is seen.
    """
    first, second = pair_rows(scene, pair)
    matrices = rotation.matrix(packed.orientation(state))
    turn = matrices[..., first, :, :]
    a = _segments(scene, state, first, turn, morphology)
    b = _segments(scene, state, second, matrices[..., second, :, :], morphology)

    def motion(rows: np.ndarray) -> tuple[Array, Array, Array, Array]:
        velocity, spin = packed.velocity(state)[..., rows, :], packed.angular_velocity(state)[..., rows, :]
        gained = packed.velocity(free)[..., rows, :] - velocity
        turned = packed.angular_velocity(free)[..., rows, :] - spin
        return velocity, spin, gained, turned

    v1, w1, dv1, dw1 = motion(first)
    v2, w2, dv2, dw2 = motion(second)

    def closest_at(time: Array) -> tuple[contact.Closest, Array, Array, Array, Array]:
        share = (time / scene.dt)[..., None]
        half = 0.5 * share
        one = contact.moved(a, v1 + half * dv1, w1 + half * dw1, time)
        two = contact.moved(b, v2 + half * dv2, w2 + half * dw2, time)
        found = contact.closest(one, two)
        arm1, arm2 = found.point - one.centre, found.point - two.centre
        relative = v1 + share * dv1 + jnp.cross(w1 + share * dw1, arm1)
        relative -= v2 + share * dv2 + jnp.cross(w2 + share * dw2, arm2)
        return found, arm1, arm2, relative, jnp.sum(relative * found.normal, axis=-1)

    def advance(time: Array, nothing: None) -> tuple[Array, Array]:
        found, _, _, _, approach = closest_at(time)
        ahead = contact.time_of_impact(found.distance, approach, scene.dt - time)
        # Links that sped up met earlier than their first speeds told.
        back = jnp.minimum(found.distance, 0.0) / jnp.where(approach > 1e-3, approach, jnp.inf)
        return time + jnp.where(found.distance > 0.0, ahead, jnp.maximum(back, -time)), found.distance

    # A scan, because an unrolled loop would be compiled as many times over.
    time, gaps = jax.lax.scan(advance, jnp.zeros(a.radius.shape, state.dtype), length=contact.ADVANCES)
    found, arm1, arm2, relative, approach = closest_at(time)
    remaining = scene.dt - time
    gained = dv1 + jnp.cross(dw1, arm1) - dv2 - jnp.cross(dw2, arm2)
    acceleration = jnp.sum(gained * found.normal, axis=-1) / scene.dt
    impact = contact.impact(jnp.maximum(-found.distance, 0.0), approach, acceleration, pair.surface, remaining)
    lowest = jnp.minimum(gaps[0], found.distance)
    near = smooth_gate(lowest, NEAR)
    slide = relative - approach[..., None] * found.normal

    given = compliance.compliance(scene, first, matrices, arm1, morphology)
    given += compliance.compliance(scene, second, matrices, arm2, morphology)
    along_normal = jnp.sum(given * found.normal[..., None, :], axis=-1)
    mass = 1.0 / jnp.sum(along_normal * found.normal, axis=-1)
    up = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0], state.dtype), v1.shape)
    vectors = [found.normal, arm1, relative, v1, w1, w2, up, dv1, dw1, mass[..., None] * along_normal]
    local = _apply_inverse(turn, jnp.stack(vectors, axis=-2))
    scalars = jnp.stack(
        [
            jnp.clip(gaps[0], -0.1, 0.2),
            jnp.clip(lowest, -0.05, 0.05),
            remaining,
            approach,
            impact.change,
            impact.lag,
            impact.gap,
            b.centre[..., 2] - b.radius,
            v2[..., 2],
            mass,
        ],
        axis=-1,
    )
    which = jnp.broadcast_to(jnp.eye(len(first), dtype=state.dtype), (*time.shape, len(first)))
    inputs = jnp.concatenate([local.reshape(*time.shape, -1), scalars, which], axis=-1)
    return Touch(inputs, gaps[0], impact, near, found.normal, slide, arm1, arm2, mass)


def within_reach(scene: Scene, pair: Pair, state: Array, free: Array, morphology: Array) -> Array:
    """() whether any links of the pair, in any of the states (B, L, 13), may come nearer than `contact_inputs` minds.

    False only where all `near` of those inputs are zero: no point of a link moves faster than this bound.
    """
    first, second = pair_rows(scene, pair)
    matrices = rotation.matrix(packed.orientation(state))
    a, b = (_segments(scene, state, rows, matrices[..., rows, :, :], morphology) for rows in (first, second))
    speeds = []
    for each in (state, free):
        velocity, spin = packed.velocity(each), contact.norm(packed.angular_velocity(each))
        swing = sum(0.5 * morphology[..., rows, 0] * spin[..., rows] for rows in (first, second))
        speeds.append(contact.norm(velocity[..., second, :] - velocity[..., first, :]) + swing)
    lowest = contact.closest(a, b).distance - scene.dt * jnp.maximum(*speeds)
    return jnp.any(~(lowest >= NEAR))


def paper_contact_inputs(scene: Scene, pair: Pair, state: Array, morphology: Array) -> tuple[Array, Array]:
    """Inputs (B, P, F) of the paper's f_c as each of the two links sees the other, world frame.

    phi of both links (position relative to the first body's root, quaternion, velocities, length, radius, mass), and
    of c(.) the contact point relative to the link, the normal and the distance, at the start of the step.
    """
    first, second = pair_rows(scene, pair)
    matrices = rotation.matrix(packed.orientation(state))
    found = contact.closest(
        _segments(scene, state, first, matrices[..., first, :, :], morphology),
        _segments(scene, state, second, matrices[..., second, :, :], morphology),
    )
    root = state[..., scene.rows(pair.first).start, :3] * jnp.array([1.0, 1.0, 0.0], state.dtype)
    sizes = jnp.broadcast_to(morphology, (*state.shape[:-2], *morphology.shape[-2:]))
    phi = jnp.concatenate([packed.position(state) - root[..., None, :], state[..., 3:], sizes], axis=-1)
    distance = found.distance[..., None]

    def seen(me: np.ndarray, other: np.ndarray, normal: Array) -> Array:
        arm = found.point - packed.position(state)[..., me, :]
        return jnp.concatenate([phi[..., me, :], phi[..., other, :], arm, normal, distance], axis=-1)

    return seen(first, second, found.normal), seen(second, first, -found.normal)


def random_turns(key: Array, count: int) -> Array:
    """Cosines and sines (count, 2) of uniform turns about z."""
    angle = jax.random.uniform(key, (count,), maxval=2.0 * jnp.pi)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def turn_states(state: Array, turn: Array) -> Array:
    """States (*, L, 13) turned about the world's z by `turn` (*, 2)."""
    turn = turn[..., None, :]
    half = jnp.arctan2(turn[..., 1], turn[..., 0]) / 2.0
    zero = jnp.zeros_like(half)
    quaternion = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1)
    return packed.pack(
        rotation.about_z(packed.position(state), turn),
        rotation.multiply(quaternion, packed.orientation(state)),
        rotation.about_z(packed.velocity(state), turn),
        rotation.about_z(packed.angular_velocity(state), turn),
    )


def first_contact(scene: Scene, states: Array, morphology: Array) -> Array:
    """(E,) the first step t of states (E, T + 1, L, 13) in which a pair's contact changes the second link's velocity.

    morphology (E or 1, L, 3). The contact falls between states t and t + 1. -1 where there is none.
    """
    if not scene.pairs:
        return jnp.full(states.shape[0], -1)
    free = jnp.array([0.0, 0.0, -scene.gravity * scene.dt], states.dtype)

    def hit(before: Array, after: Array) -> Array:
        found = jnp.zeros(before.shape[0], bool)
        for pair in scene.pairs:
            _, second = pair_rows(scene, pair)
            pushed = contact.norm(packed.velocity(after) - packed.velocity(before) - free)[:, second] > 0.3
            found |= jnp.any((contact_inputs(scene, pair, before, before, morphology).near > 0.1) & pushed, axis=1)
        return found

    def advance(carry: None, step: tuple[Array, Array]) -> tuple[None, Array]:
        return carry, hit(*step)

    by_time = jnp.moveaxis(states, 1, 0)
    _, hits = jax.lax.scan(advance, None, (by_time[:-1], by_time[1:]))
    return jnp.where(hits.any(axis=0), jnp.argmax(hits, axis=0), -1)

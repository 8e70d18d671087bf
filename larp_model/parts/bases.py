"""What an articulated body's changes are built upon: nothing, or the mechanics of the body alone on the ground."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import contact, mechanics, rotation
from larp_model import state as packed
from larp_model.kinematics import Kinematics, apply, ends_on_ground, strength
from larp_model.meeting import Velocities
from larp_model.networks import side_by_side
from larp_model.parts.articulated import Known, changes_of
from larp_model.parts.part import Hits
from larp_model.scene import Body


@dataclass(frozen=True)
class FromNothing:
    """The network has to say all, in the frame of the body's heading.

    It sees what the paper lists, contacts apart, and what it would else have to find out from rotations: the torques
    of the servos and how the ends of the links are to the ground.
    """

    def begin(
        self, body: Body, seen: Kinematics, control: Array, torque: Array, gravity: float, dt: float
    ) -> Known:
        """See `BodyBase`."""
        turn = rotation.heading(packed.orientation(seen.state)[:, 0])
        vectors, scalars = paper_inputs(body, seen, control, torque)
        velocities, ends = ends_on_ground(seen, *Velocities.of(seen.state), dt)
        vectors += [velocities, *([servo_torques(body, seen, control)] if body.motors else [])]
        turned = rotation.about_z(jnp.concatenate(vectors, axis=1), rotation.opposite(turn)[:, None])
        return Known(jnp.zeros((1, 1, 1, 3), seen.state.dtype), turn, side_by_side(turned, *scalars, ends))

    def answer(self, body: Body, seen: Kinematics, hits: Hits, dt: float) -> Array:
        """See `Base`: nothing is known."""
        return jnp.zeros((1, 1, 1, 3), seen.state.dtype)


@dataclass(frozen=True)
class OverMechanics:
    """The network corrects what mechanics says, in the frame of the course of the root's axis.

    It sees how the links are to the ground with the velocities that they will have. Capsules are seen by their axes
    alone: how one has rolled about its own changes nothing. constants: see `mechanics.Constants`. lasting: joints
    resist impulses for as long as those have acted on average, instead of at once.
    """

    constants: mechanics.Constants = field(default_factory=mechanics.Constants)
    lasting: bool = False

    def begin(
        self, body: Body, seen: Kinematics, control: Array, torque: Array, gravity: float, dt: float
    ) -> Known:
        """See `BodyBase`."""
        state, links = seen.state, len(body.links)
        free = mechanics.free_motion(body, state, control, torque, seen.morphology, gravity, dt, self.constants)
        turn = rotation.course(packed.orientation(state)[:, 0], body.links[0].axis)
        position = packed.position(state)
        axes = jnp.array([link.axis for link in body.links], state.dtype)
        velocities, ends = ends_on_ground(seen, free.velocity, free.spin, dt)
        vectors = [
            position - position[:, :1], apply(seen.matrices, axes), free.velocity, free.spin, seen.displacement,
            velocities,
        ]  # fmt: skip
        turned = rotation.about_z(jnp.concatenate(vectors, axis=1), rotation.opposite(turn)[:, None])
        sizes = jnp.broadcast_to(seen.morphology, (state.shape[0], links, 3))
        inputs = side_by_side(turned, position[..., 2], sizes, ends)
        after = Velocities(free.velocity, free.spin)
        return Known(changes_of(state, after, free.moved, free.turned, dt), turn, inputs)

    def answer(self, body: Body, seen: Kinematics, hits: Hits, dt: float) -> Array:
        """See `BodyBase`. All impulses together act on positions for as long as they do on average."""
        push = hits.push
        impulse, travel = (contact.norm(each).sum(axis=-1) for each in (push[..., :3], hits.travel))
        acting = travel / jnp.maximum(impulse, 1e-6)
        given = body, seen.state, push, seen.morphology, self.constants, acting if self.lasting else None
        gained = jnp.stack(mechanics.impulse_response(*given), axis=1)
        return jnp.concatenate([gained, (acting - 0.5 * dt)[:, None, None, None] * gained], axis=1)


def paper_inputs(body: Body, seen: Kinematics, control: Array, torque: Array) -> tuple[list[Array], list[Array]]:
    """What the paper's dynamics network sees, contacts apart: vectors (B, V, 3), world frame, and scalars (B, ...).

    control (B, j, 3), torque (B, n, 3). Root-relative position, rotation matrix, velocities, displacement, torque;
    height, target quaternion, length and radius.
    """
    state, size, links = seen.state, seen.state.shape[0], len(body.links)
    position = packed.position(state)
    vectors = [
        position - position[:, :1],
        jnp.moveaxis(seen.matrices, -1, -2).reshape(size, 3 * links, 3),
        *Velocities.of(state),
        seen.displacement,
        torque,
    ]
    sizes = jnp.broadcast_to(seen.morphology[..., :2], (size, links, 2))
    return vectors, [position[..., 2], rotation.from_rotation_vector(control), sizes]


def servo_torques(body: Body, seen: Kinematics, control: Array) -> Array:
    """The torques (B, j, 3) [N m], world frame, with which a body's servos pull their links towards their targets.

    control (B, j, 3) rotation vectors [rad]. stiffness x (target - joint angle), within the motors' limits; their
    damping is left out, for it is linear in the angular velocities.
    """
    children = np.array([child for child, _, _ in body.motors])
    parents = np.array([joint.parent for _, joint, _ in body.motors])
    stronger = strength(body, seen.morphology)[:, None, None]
    stiffness, limit = (
        stronger * np.array([getattr(motor, name) for _, _, motor in body.motors], np.float32)[:, None]
        for name in ("stiffness", "torque_limit")
    )
    turned = packed.orientation(seen.state)
    relative = rotation.multiply(rotation.conjugate(turned[:, parents]), turned[:, children])
    pull = jnp.clip(stiffness * (control - rotation.to_rotation_vector(relative)), -limit, limit)
    return apply(seen.matrices[:, children], pull)

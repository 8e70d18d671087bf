"""The model that ships: physics says how bodies move and touch, and networks correct articulated bodies' motion.

Without networks (size None) it is physics alone, of any scene.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax.numpy as jnp
from jax import Array

from larp_model import rotation
from larp_model import state as packed
from larp_model.kinematics import Kinematics, apply, ends_on_ground, kinematics
from larp_model.learned.model import network_name
from larp_model.networks import Measured, Perceptron, Size, Statistics, Weights, bounded, evaluate, side_by_side
from larp_model.physics.collision import ContactSettings
from larp_model.physics.motion import BodyMotion, Constants, free_motion
from larp_model.physics.step import step as physics_step
from larp_model.scene import Body, Scene


@dataclass(frozen=True)
class ResidualModel:
    """Physics, and what a network adds to the motion of each articulated body where no other body touches it.

    A network sees and answers in the frame of the course of the root's axis. It sees how links are to the ground with
    the velocities that physics gives them, and capsules by their axes alone. size: of the networks; None for none.
    bound: what they may add, in standard deviations of what physics lacks.
    """

    scene: Scene
    size: Size | None = None
    constants: Constants = field(default_factory=Constants)
    contacts: ContactSettings = field(default_factory=ContactSettings)
    bound: float = 10.0

    invariant = True
    # Physics is made of many small loops.
    side_by_side = 32

    def on(self, scene: Scene) -> ResidualModel:
        """See `Model`."""
        return replace(self, scene=scene)

    def networks(self) -> dict[str, Perceptron]:
        """See `Model`."""
        if self.size is None:
            return {}
        bodies = (body for body in self.scene.bodies if not body.is_ball)
        return {network_name("dynamics", body): self.size.network(12 * len(body.links)) for body in bodies}

    def step(
        self, weights: Weights, state: Array, control: Array, torque: Array, morphology: Array, stop_gradient: bool
    ) -> Array:
        """See `Model`; no contact has a network, so that there are no inputs to hold fixed."""

        def correct(body: Body, before: Array, sizes: Array, motion: BodyMotion, dt: float) -> BodyMotion:
            if self.size is None or body.is_ball:
                return motion
            seen = kinematics(self.scene.only(body.name), *(jnp.moveaxis(each, -1, 0) for each in (before, sizes)))
            corrected = self._corrected(body, weights, seen, BodyMotion(*(jnp.moveaxis(m, -1, 0) for m in motion)), dt)
            return BodyMotion(*(jnp.moveaxis(each, 0, -1) for each in corrected))

        return physics_step(self.scene, state, control, torque, morphology, self.constants, self.contacts, correct)

    def _corrected(self, body: Body, weights: Weights, seen: Kinematics, motion: BodyMotion, dt: float) -> BodyMotion:
        """Return the motion within `dt` [s], (B, n, 3), as the network knows better."""
        name = network_name("dynamics", body)
        turn, inputs = network_inputs(body, seen, motion, dt)
        outputs = weights.outputs[name].restore(self.answer(weights, name, inputs))
        vectors = rotation.about_z(outputs.reshape(len(inputs), -1, 3), turn[:, None])
        # Of a shorter step it is that share.
        added = dt / self.scene.dt * vectors.reshape(len(inputs), 4, -1, 3)
        velocity, spin = added[:, 0], added[:, 1]
        return BodyMotion(
            motion.velocity + velocity, motion.spin + spin,
            motion.moved + 0.5 * dt * velocity + added[:, 2], motion.turned + 0.5 * dt * spin + added[:, 3],
        )  # fmt: skip

    def measure(self, before: Array, after: Array, control: Array, torque: Array, morphology: Array) -> Measured:
        """See `Model`."""
        examples = self.examples(before, after, control, torque, morphology)
        return {name: (Statistics.of(inputs), Statistics.of(outputs)) for name, inputs, outputs in examples}

    def examples(
        self, before: Array, after: Array, control: Array, torque: Array, morphology: Array
    ) -> list[tuple[str, Array, Array]]:
        """Return of each articulated body the name of its network, inputs (B, F), and what physics lacks (B, O).

        From true steps (B, L, 13) -> (B, L, 13). Where links touch within a step, more is lacking than a network can
        know.
        """
        scene, dt, found = self.scene, self.scene.dt, []
        for body in scene.bodies if self.size else ():
            if body.is_ball:
                continue
            rows = scene.rows(body.name)
            seen = kinematics(scene.only(body.name), before[:, rows], morphology[:, rows])
            targets, torques = control[:, scene.motor_rows(body.name)], torque[:, rows]
            motion = free_motion(body, seen.state, targets, torques, seen.morphology, scene.gravity, dt, self.constants)
            turn, inputs = network_inputs(body, seen, motion, dt)
            left = changes(seen.state, true_motion(seen.state, after[:, rows]), dt) - changes(seen.state, motion, dt)
            outputs = rotation.about_z(left.reshape(len(after), -1, 3), rotation.opposite(turn)[:, None])
            found.append((network_name("dynamics", body), inputs, outputs.reshape(len(after), -1)))
        return found

    def answer(self, weights: Weights, name: str, inputs: Array) -> Array:
        """Return what a network adds (B, O), for inputs (B, F), in standard deviations of what physics lacks."""
        return bounded(evaluate(self.networks()[name], weights, name, inputs), self.bound)


def network_inputs(body: Body, seen: Kinematics, motion: BodyMotion, dt: float) -> tuple[Array, Array]:
    """Return the frame of a body's network, cosine and sine (B, 2), and its inputs (B, F)."""
    state, links = seen.state, body.links
    turn = rotation.course(packed.orientation(state)[:, 0], links[0].axis)
    position, axes = packed.position(state), jnp.array([link.axis for link in links], state.dtype)
    velocities, ends = ends_on_ground(seen, motion.velocity, motion.spin, dt)
    vectors = [
        position - position[:, :1], apply(seen.matrices, axes), motion.velocity, motion.spin, seen.displacement,
        velocities,
    ]  # fmt: skip
    turned = rotation.about_z(jnp.concatenate(vectors, axis=1), rotation.opposite(turn)[:, None])
    sizes = jnp.broadcast_to(seen.morphology, (state.shape[0], len(links), 3))
    return turn, side_by_side(turned, position[..., 2], sizes, ends)


def true_motion(state: Array, after: Array) -> BodyMotion:
    """Return the motion (B, n, 3) that leads from states (B, n, 13) to others."""
    relative = rotation.multiply(packed.orientation(after), rotation.conjugate(packed.orientation(state)))
    moved = packed.position(after) - packed.position(state)
    return BodyMotion(
        packed.velocity(after), packed.angular_velocity(after), moved, rotation.to_rotation_vector(relative)
    )


def changes(state: Array, motion: BodyMotion, dt: float) -> Array:
    """Return a motion of states (B, n, 13) as changes (B, 4, n, 3), what networks add to.

    Of velocity [m/s] and spin [rad/s], and corrections [m, rad] of the trapezoidal step x' = x + (v + v') dt / 2.
    """
    velocity, spin = packed.velocity(state), packed.angular_velocity(state)
    moved = motion.moved - 0.5 * dt * (velocity + motion.velocity)
    turned = motion.turned - 0.5 * dt * (spin + motion.spin)
    return jnp.stack([motion.velocity - velocity, motion.spin - spin, moved, turned], axis=1)

"""The model that ships: physics of bodies and contacts, with residual networks for the motion of articulated bodies.

Without networks (size None) it is physics alone, of any scene.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax.numpy as jnp
from jax import Array

from larp_model import rotation
from larp_model import state as packed
from larp_model.learned.model import network_name
from larp_model.linalg import mv
from larp_model.networks import Measured, Perceptron, Size, Statistics, Weights, bounded, evaluate, side_by_side
from larp_model.physics.collision import ContactSettings
from larp_model.physics.kinematics import Kinematics, ends_on_ground, kinematics
from larp_model.physics.motion import BodyMotion, Constants, articulated_motion
from larp_model.physics.step import step as physics_step
from larp_model.scene import Body, Scene


@dataclass(frozen=True)
class ResidualModel:
    """Physics, and a residual network for the motion of each articulated body where no other body touches it.

    Inputs and outputs of a network are in the frame of the course of the root's axis. Inputs describe the motion by
    physics, also relative to the ground, and capsules by their axes alone. size: of the networks; None for none.
    bound: of their outputs, in standard deviations of the errors of physics.
    """

    scene: Scene
    size: Size | None = None
    constants: Constants = field(default_factory=Constants)
    contacts: ContactSettings = field(default_factory=ContactSettings)
    bound: float = 10.0

    invariant = True
    # Physics consists of many small loops.
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
        """See `Model`; contacts have no network, so that `stop_gradient` has no effect."""

        def correct(body: Body, links: Kinematics, motion: BodyMotion, dt: Array | float) -> BodyMotion:
            physics_alone = self.size is None or body.is_ball
            return motion if physics_alone else self._corrected(body, weights, links, motion, dt)

        return physics_step(self.scene, state, control, torque, morphology, self.constants, self.contacts, correct)

    def _corrected(
        self, body: Body, weights: Weights, links: Kinematics, motion: BodyMotion, dt: Array | float
    ) -> BodyMotion:
        """Return the motion (n, 3, B) within `dt` [s] as the network corrects it."""
        name = network_name("dynamics", body)
        turn, inputs = network_inputs(body, links, motion, dt)
        outputs = weights.outputs[name].restore(self.answer(weights, name, inputs))
        vectors = rotation.about_z(outputs.reshape(len(inputs), -1, 3), turn[:, None])
        # Of a shorter step, the same share.
        added = dt / self.scene.dt * vectors.reshape(len(inputs), 4, -1, 3)
        velocity, angular_velocity, translation, rotation_vector = (
            jnp.moveaxis(added[:, part], 0, -1) for part in range(4)
        )
        return BodyMotion(
            motion.velocity + velocity, motion.angular_velocity + angular_velocity,
            motion.translation + 0.5 * dt * velocity + translation,
            motion.rotation_vector + 0.5 * dt * angular_velocity + rotation_vector,
        )  # fmt: skip

    def measure(self, before: Array, after: Array, control: Array, torque: Array, morphology: Array) -> Measured:
        """See `Model`."""
        examples = self.examples(before, after, control, torque, morphology)
        return {name: (Statistics.of(inputs), Statistics.of(outputs)) for name, inputs, outputs in examples}

    def examples(
        self, before: Array, after: Array, control: Array, torque: Array, morphology: Array
    ) -> list[tuple[str, Array, Array]]:
        """Return of each articulated body the name of its network, inputs (B, F), and errors of physics (B, O).

        From true steps (B, L, 13) -> (B, L, 13). Errors of steps in which links touch cannot be predicted from the
        inputs.
        """
        scene, dt, examples = self.scene, self.scene.dt, []
        state, end, targets, torques, sizes = (
            jnp.moveaxis(array, 0, -1) for array in (before, after, control, torque, morphology)
        )
        all_links = kinematics(scene, state, sizes)
        for body in scene.bodies if self.size else ():
            if body.is_ball:
                continue
            rows, links, name = scene.rows(body.name), all_links.of(scene, body.name), network_name("dynamics", body)
            motion, _ = articulated_motion(
                body, links, targets[scene.motor_rows(body.name)], torques[rows], scene.gravity, dt, self.constants
            )
            turn, inputs = network_inputs(body, links, motion, dt)
            error = changes(links, true_motion(links, end[rows]), dt) - changes(links, motion, dt)
            vectors = jnp.moveaxis(error, -1, 0).reshape(len(after), -1, 3)
            outputs = rotation.about_z(vectors, rotation.opposite(turn)[:, None])
            examples.append((name, inputs, outputs.reshape(len(after), -1)))
        return examples

    def answer(self, weights: Weights, name: str, inputs: Array) -> Array:
        """Return outputs (B, O) of a network for inputs (B, F), in standard deviations of the errors of physics."""
        return bounded(evaluate(self.networks()[name], weights, name, inputs), self.bound)


def network_inputs(body: Body, links: Kinematics, motion: BodyMotion, dt: Array | float) -> tuple[Array, Array]:
    """Return the frame of a body's network, cosine and sine (B, 2), and its inputs (B, F)."""
    turn = rotation.course(links.orientation[0].T, body.links[0].axis)
    axes = jnp.array([link.axis for link in body.links], links.state.dtype)[..., None]
    velocities, ends = ends_on_ground(links, motion.velocity, motion.angular_velocity, dt)
    vectors = [
        links.position - links.position[:1], mv(links.matrices, axes), motion.velocity, motion.angular_velocity,
        links.displacement, velocities,
    ]  # fmt: skip
    rotated = rotation.about_z(jnp.moveaxis(jnp.concatenate(vectors), -1, 0), rotation.opposite(turn)[:, None])
    other_inputs = links.position[:, 2], links.sizes, ends
    return turn, side_by_side(rotated, *(jnp.moveaxis(array, -1, 0) for array in other_inputs))


def true_motion(links: Kinematics, after: Array) -> BodyMotion:
    """Return the motion (n, 3, B) from the states of links to states (n, 13, B) afterwards."""
    before, after = (jnp.moveaxis(array, -1, 0) for array in (links.state, after))
    relative = rotation.multiply(packed.orientation(after), rotation.conjugate(packed.orientation(before)))
    motion = BodyMotion(
        packed.velocity(after), packed.angular_velocity(after),
        packed.position(after) - packed.position(before), rotation.to_rotation_vector(relative),
    )  # fmt: skip
    return BodyMotion(*(jnp.moveaxis(array, 0, -1) for array in motion))


def changes(links: Kinematics, motion: BodyMotion, dt: Array | float) -> Array:
    """Return a motion as changes (4, n, 3, B), to which networks add.

    Of velocity [m/s] and angular velocity [rad/s], and corrections [m, rad] of the trapezoidal step
    x' = x + (v + v') dt / 2.
    """
    velocity, angular_velocity = links.velocity, links.angular_velocity
    translation = motion.translation - 0.5 * dt * (velocity + motion.velocity)
    rotation_vector = motion.rotation_vector - 0.5 * dt * (angular_velocity + motion.angular_velocity)
    return jnp.stack(
        [motion.velocity - velocity, motion.angular_velocity - angular_velocity, translation, rotation_vector]
    )

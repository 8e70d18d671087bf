"""Parts of one design: physics says how bodies move and touch, and networks correct the motion of articulated ones.

All contacts are found together by `physics.step`, so that the parts of pairs hold what it needs, and no network.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import jax.numpy as jnp
from jax import Array

from larp_model import rotation
from larp_model import state as packed
from larp_model.kinematics import Kinematics, apply, ends_on_ground
from larp_model.mechanics import BodyMotion, Constants, free_motion
from larp_model.meeting import Velocities
from larp_model.networks import Measured, Perceptron, Size, Statistics, Weights, bounded, evaluate, side_by_side
from larp_model.parts.articulated import changes_between, changes_of, to_world
from larp_model.parts.part import name_of
from larp_model.physics.collision import ContactSettings
from larp_model.scene import Body, Pair


@dataclass(frozen=True)
class ResidualBody:
    """An articulated body: mechanics, and what a network adds to its motion where no other body touches it.

    The network sees and answers in the frame of the course of the root's axis. It sees how links are to the ground with
    the velocities that mechanics gives them, and capsules by their axes alone. size: of the network; None for none.
    bound: what it may add, in standard deviations of what mechanics lacks.
    """

    body: Body
    dt: float
    gravity: float
    size: Size | None
    constants: Constants = field(default_factory=lambda: Constants(rounds=3, products=True, standing=3.0))
    bound: float = 10.0

    invariant = True

    @property
    def name(self) -> str:
        """Return the name of its network."""
        return f"dynamics/{name_of(self.body)}"

    def networks(self) -> dict[str, Perceptron]:
        """See `BodyPart`."""
        return {} if self.size is None else {self.name: self.size.network(12 * len(self.body.links))}

    def corrected(self, weights: Weights, seen: Kinematics, motion: BodyMotion, dt: float) -> BodyMotion:
        """Return the motion within `dt` [s], (B, n, 3), as the network knows better."""
        turn, inputs = self._inputs(seen, motion, dt)
        outputs = bounded(evaluate(self.networks()[self.name], weights, self.name, inputs), self.bound)
        # Of a shorter step it is that share.
        changes = dt / self.dt * to_world(weights.outputs[self.name].restore(outputs), turn)
        velocity, spin = changes[:, 0], changes[:, 1]
        return BodyMotion(
            motion.velocity + velocity, motion.spin + spin,
            motion.moved + 0.5 * dt * velocity + changes[:, 2], motion.turned + 0.5 * dt * spin + changes[:, 3],
        )  # fmt: skip

    def measure(self, seen: Kinematics, after: Array, control: Array, torque: Array) -> tuple[Measured, Velocities]:
        """See `BodyPart`."""
        if self.size is None:
            return {}, Velocities.of(after)
        motion = free_motion(
            self.body, seen.state, control, torque, seen.morphology, self.gravity, self.dt, self.constants
        )
        turn, inputs = self._inputs(seen, motion, self.dt)
        known = changes_of(seen.state, Velocities(motion.velocity, motion.spin), motion.moved, motion.turned, self.dt)
        left = (changes_between(seen.state, after, self.dt) - known).reshape(len(after), -1, 3)
        outputs = rotation.about_z(left, rotation.opposite(turn)[:, None]).reshape(len(after), -1)
        return {self.name: (Statistics.of(inputs), Statistics.of(outputs))}, Velocities.of(after)

    def _inputs(self, seen: Kinematics, motion: BodyMotion, dt: float) -> tuple[Array, Array]:
        """Return the frame of the network, cosine and sine (B, 2), and its inputs (B, F)."""
        state, links = seen.state, self.body.links
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


@dataclass(frozen=True)
class FreeBall:
    """A ball: see `physics.ball`."""

    body: Body
    dt: float
    gravity: float

    invariant = True

    def networks(self) -> dict[str, Perceptron]:
        """See `BodyPart`."""
        return {}

    def measure(self, seen: Kinematics, after: Array, control: Array, torque: Array) -> tuple[Measured, Velocities]:
        """See `BodyPart`."""
        return {}, Velocities.of(after)


@dataclass(frozen=True)
class SoftContact:
    """Two bodies that can touch: see `physics.impact`."""

    bodies: tuple[Body, Body]
    pair: Pair
    dt: float
    gravity: float
    settings: ContactSettings = field(default_factory=ContactSettings)

    def networks(self) -> dict[str, Perceptron]:
        """See `PairPart`."""
        return {}

    def measure(self, seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]) -> Measured:
        """See `PairPart`."""
        return {}

"""A tree of links: what is known of its step, the changes that a network adds, and what impulses add to those.

Changes are vectors (B, 4, n, 3) in the world frame: of velocity [m/s] and spin [rad/s], and corrections [m, rad] of the
trapezoidal step x' = x + (v + v') dt / 2, which an impact within the step needs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from larp_model import contact, rotation
from larp_model import state as packed
from larp_model.kinematics import Kinematics
from larp_model.meeting import Velocities
from larp_model.networks import Measured, Perceptron, Size, Statistics, Weights, bounded, evaluate, side_by_side
from larp_model.parts.part import Hits, Moving, name_of
from larp_model.scene import Body


class Known(NamedTuple):
    """What is known of a step before anything learned is asked.

    changes: (B or 1, 4 or 1, n or 1, 3). turn: cosine and sine (B, 2) of the frame in which the network sees and
    answers. inputs: (B, F) of the network.
    """

    changes: Array
    turn: Array
    inputs: Array


class BodyBase(Protocol):
    """What the changes of an articulated body are built upon."""

    def begin(
        self, body: Body, seen: Kinematics, control: Array, torque: Array, gravity: float, dt: float
    ) -> Known:
        """What is known of a body that nothing but the ground touches."""

    def answer(self, body: Body, seen: Kinematics, hits: Hits, dt: float) -> Array:
        """What is known of what contacts add to the changes, (B or 1, 4 or 1, n or 1, 3)."""


@dataclass(frozen=True)
class Response:
    """What impulses do to a body: a network that adds to what is known, and nothing where there are none.

    felt: impulse from which it is heard in full [N s]. scale: of an impulse [N s] and its moment [N m s], as inputs.
    """

    size: Size
    felt: float = 0.2
    scale: tuple[float, float] = (1.0, 0.1)

    def inputs(self, inputs: Array, turn: Array, hits: Hits) -> Array:
        """What the network sees (B, F + 6 n): the other's inputs, and the pushes in its frame."""
        return side_by_side(inputs, rotation.about_z(hits.scaled(self.scale), rotation.opposite(turn)[:, None]))


@dataclass(frozen=True)
class Articulated:
    """Changes are what the base knows and what its network adds, within +-bound standard deviations.

    response: none where no pair names the body.
    """

    body: Body
    dt: float
    gravity: float
    base: BodyBase
    size: Size
    response: Response | None = None
    bound: float = 20.0

    invariant = True

    @property
    def name(self) -> str:
        """Of the network of its changes."""
        return f"dynamics/{name_of(self.body)}"

    @property
    def response_name(self) -> str:
        """Of the network of its response."""
        return f"response/{name_of(self.body)}"

    def networks(self) -> dict[str, Perceptron]:
        """See `BodyPart`."""
        outputs = 12 * len(self.body.links)
        own = {self.name: self.size.network(outputs)}
        return own if self.response is None else own | {self.response_name: self.response.size.network(outputs)}

    def move(self, weights: Weights, seen: Kinematics, control: Array, torque: Array) -> Moving:
        """See `BodyPart`."""
        known = self.base.begin(self.body, seen, control, torque, self.gravity, self.dt)
        outputs = bounded(evaluate(self.networks()[self.name], weights, self.name, known.inputs), self.bound)
        changes = known.changes + to_world(weights.outputs[self.name].restore(outputs), known.turn)
        velocity, spin = Velocities.of(seen.state)
        # What the motors do meanwhile is no small part of an impact.
        return Moving(Velocities(velocity + changes[:, 0], spin + changes[:, 1]), (known, changes))

    def respond(self, weights: Weights, seen: Kinematics, moving: Moving, hits: Hits) -> Array:
        """See `BodyPart`."""
        known, changes = moving.kept
        response = self.response
        if response is not None:

            def answer() -> Array:
                inputs = response.inputs(known.inputs, known.turn, hits)
                outputs = evaluate(self.networks()[self.response_name], weights, self.response_name, inputs)
                felt = jnp.tanh(contact.norm(hits.push[..., :3]).sum(axis=-1, keepdims=True) / response.felt)
                outputs = weights.outputs[self.name].spread * bounded(outputs, self.bound) * felt
                return changes + self.base.answer(self.body, seen, hits, self.dt) + to_world(outputs, known.turn)

            changes = jax.lax.cond(jnp.any(hits.push != 0.0), answer, lambda: changes)
        return integrate(seen.state, changes, self.dt)

    def measure(self, seen: Kinematics, after: Array, control: Array, torque: Array) -> tuple[Measured, Velocities]:
        """See `BodyPart`."""
        known = self.base.begin(self.body, seen, control, torque, self.gravity, self.dt)
        left = (changes_between(seen.state, after, self.dt) - known.changes).reshape(len(after), -1, 3)
        outputs = rotation.about_z(left, rotation.opposite(known.turn)[:, None]).reshape(len(after), -1)
        alone = Statistics.of(known.inputs)
        found: Measured = {self.name: (alone, Statistics.of(outputs))}
        if self.response is not None:
            found[self.response_name] = alone.beside(6 * len(self.body.links)), None
        return found, Velocities.of(after)


def to_world(outputs: Array, turn: Array) -> Array:
    """A network's outputs (B, 12 n) as changes (B, 4, n, 3) in the world frame."""
    size = outputs.shape[0]
    return rotation.about_z(outputs.reshape(size, -1, 3), turn[:, None]).reshape(size, 4, -1, 3)


def integrate(state: Array, changes: Array, dt: float) -> Array:
    """The next states (B, n, 13) after changes (B, 4, n, 3)."""
    velocity = packed.velocity(state) + changes[:, 0]
    spin = packed.angular_velocity(state) + changes[:, 1]
    moved = 0.5 * dt * (packed.velocity(state) + velocity) + changes[:, 2]
    turned = 0.5 * dt * (packed.angular_velocity(state) + spin) + changes[:, 3]
    return packed.pack(
        packed.position(state) + moved, rotation.integrate(packed.orientation(state), turned), velocity, spin
    )


def changes_between(state: Array, after: Array, dt: float) -> Array:
    """The changes (B, 4, n, 3) with which `integrate` would give `after`."""
    relative = rotation.multiply(packed.orientation(after), rotation.conjugate(packed.orientation(state)))
    moved, turned = packed.position(after) - packed.position(state), rotation.to_rotation_vector(relative)
    return changes_of(state, Velocities.of(after), moved, turned, dt)


def changes_of(state: Array, after: Velocities, moved: Array, turned: Array, dt: float) -> Array:
    """The changes (B, 4, n, 3) of links that end so fast and have moved [m] and turned [rad] so far, (B, n, 3)."""
    velocity, spin = Velocities.of(state)
    corrections = moved - 0.5 * dt * (velocity + after.velocity), turned - 0.5 * dt * (spin + after.spin)
    return jnp.stack([after.velocity - velocity, after.spin - spin, *corrections], axis=1)

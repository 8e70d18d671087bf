"""f_d and f_c of the paper, to the letter: both see the world's axes, and what contact means is learned.

M. Andriluka et al., "Learned neural physics simulation for articulated 3D human pose reconstruction" (2024).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import detection, rotation
from larp_model import state as packed
from larp_model.learned.model import network_name
from larp_model.networks import Measured, Perceptron, Size, Statistics, Weights, bounded, evaluate, side_by_side
from larp_model.physics.collision import closest
from larp_model.physics.kinematics import Kinematics, kinematics
from larp_model.scene import Body, Pair, Scene

# Weight of links that are apart in a contact network's statistics, for where none are near.
APART = 1e-3


@dataclass(frozen=True)
class Sizes:
    """Sizes of the networks of articulated bodies, of balls, and of contacts, by default the paper's."""

    body: Size = field(default_factory=lambda: Size(12, 512, skip=False))
    ball: Size = field(default_factory=lambda: Size(12, 128, skip=False))
    contact: Size = field(default_factory=lambda: Size(6, 128, skip=False))


@dataclass(frozen=True)
class PaperModel:
    """The paper's model: a network of each kind of body, f_d, and one of each two kinds that can touch, f_c.

    bound: of f_d's outputs, in their standard deviations. scale: of the two halves of what f_c gives to f_d.
    """

    scene: Scene
    sizes: Sizes = field(default_factory=Sizes)
    bound: float = 20.0
    scale: tuple[float, float] = (1.0, 0.1)

    invariant = False
    side_by_side = 8

    def on(self, scene: Scene) -> PaperModel:
        """See `Model`."""
        return replace(self, scene=scene)

    def networks(self) -> dict[str, Perceptron]:
        """See `Model`."""
        bodies = {
            network_name("dynamics", body): (self.sizes.ball if body.is_ball else self.sizes.body).network(
                6 * len(body.links)
            )
            for body in self.scene.bodies
        }
        contacts = {
            network_name("contact", *both): self.sizes.contact.network(6) for _, both in pairs_by_kind(self.scene)
        }
        return bodies | contacts

    def step(
        self, weights: Weights, state: Array, control: Array, torque: Array, morphology: Array, stop_gradient: bool
    ) -> Array:
        """See `Model`: f_d of each body sees the sum of f_c over the contacts of its links (equation 1)."""
        scene, networks = self.scene, self.networks()
        seen = kinematics(scene, jnp.moveaxis(state, 0, -1), jnp.moveaxis(morphology, 0, -1))
        by_body = {body.name: seen.of(scene, body.name) for body in scene.bodies}
        pushes = {
            body.name: jnp.zeros((*state[:, scene.rows(body.name)].shape[:2], 6), state.dtype) for body in scene.bodies
        }
        for pair, both in pairs_by_kind(scene):
            touching = by_body[pair.first], by_body[pair.second]
            name = network_name("contact", *both)
            features = contact_inputs(pair, both, jax.lax.stop_gradient(touching) if stop_gradient else touching)
            for body, links, of_link in zip(both, detection.link_pairs(pair, *both), features, strict=True):
                onto = jax.nn.one_hot(links, len(body.links), dtype=state.dtype)
                push = jnp.einsum("bpf,pl->blf", evaluate(networks[name], weights, name, of_link), onto)
                pushes[body.name] += push
        after = []
        for body in scene.bodies:
            name, own, push = network_name("dynamics", body), by_body[body.name], pushes[body.name]
            scaled = push[..., :3] / self.scale[0], push[..., 3:] / self.scale[1]
            rows, motors = scene.rows(body.name), scene.motor_rows(body.name)
            inputs = side_by_side(body_inputs(body, own, control[:, motors], torque[:, rows]), *scaled)
            outputs = bounded(evaluate(networks[name], weights, name, inputs), self.bound)
            velocities = weights.outputs[name].restore(outputs).reshape(len(state), 2, len(body.links), 3)
            velocity, spin = velocities[:, 0], velocities[:, 1]
            before = state[:, rows]
            position = packed.position(before) + scene.dt * velocity
            turned = rotation.integrate(packed.orientation(before), scene.dt * spin)
            after.append(packed.pack(position, turned, velocity, spin))
        return jnp.concatenate(after, axis=1)

    def measure(self, before: Array, after: Array, control: Array, torque: Array, morphology: Array) -> Measured:
        """See `Model`; of contacts where links are near, for elsewhere they count for nothing."""
        scene = self.scene
        seen = kinematics(scene, jnp.moveaxis(before, 0, -1), jnp.moveaxis(morphology, 0, -1))
        measured = Measured()
        for body in scene.bodies:
            rows, motors = scene.rows(body.name), scene.motor_rows(body.name)
            inputs = body_inputs(body, seen.of(scene, body.name), control[:, motors], torque[:, rows])
            velocities = packed.velocity(after[:, rows]), packed.angular_velocity(after[:, rows])
            outputs = Statistics.of(side_by_side(*velocities))
            measured[network_name("dynamics", body)] = Statistics.of(inputs).beside(6 * len(body.links)), outputs
        for pair, both in pairs_by_kind(scene):
            own = seen.of(scene, pair.first), seen.of(scene, pair.second)
            features = jnp.concatenate(contact_inputs(pair, both, own), axis=1)
            points = detection.detect(pair, both, own, (own[0].state, own[1].state), scene.dt)
            near = jnp.tile(points.near, (1, 2)).reshape(-1) + APART
            measured[network_name("contact", *both)] = (
                Statistics.of(features.reshape(-1, features.shape[-1]), near), None
            )  # fmt: skip
        return measured


def pairs_by_kind(scene: Scene) -> Iterator[tuple[Pair, tuple[Body, Body]]]:
    """Yield the scene's pairs with their bodies in the order of their kinds, whichever is named first."""
    for pair in scene.pairs:
        first, second = scene.body(pair.first), scene.body(pair.second)
        yield (pair, (first, second)) if first.kind <= second.kind else (pair.flipped(), (second, first))


def body_inputs(body: Body, seen: Kinematics, control: Array, torque: Array) -> Array:
    """Return what f_d sees (B, F), contacts apart; control (B, j, 3) [rad], torque (B, n, 3) [N m].

    Root-relative position, rotation matrix, velocities, displacement, torque; height, target quaternion, length and
    radius.
    """
    vectors = [
        seen.position - seen.position[:1],
        jnp.swapaxes(seen.matrices, 1, 2).reshape(-1, *seen.position.shape[1:]),
        seen.velocity,
        seen.angular_velocity,
        seen.displacement,
    ]
    before, height, sizes = (
        jnp.moveaxis(each, -1, 0) for each in (jnp.concatenate(vectors), seen.position[:, 2], seen.sizes[:, :2])
    )
    return side_by_side(before, torque, height, rotation.from_rotation_vector(control), sizes)


def contact_inputs(pair: Pair, bodies: tuple[Body, Body], seen: tuple[Kinematics, Kinematics]) -> tuple[Array, Array]:
    """Return what f_c sees (B, P, F) of the first link of each pair of links, and of the second: phi of both and c(.).

    phi: position relative to the first body's root, quaternion, velocities, length, radius, mass. c(.): the contact
    point relative to the link, the normal and the distance, when the step begins.
    """
    rows = detection.link_pairs(pair, *bodies)
    found = closest(*(detection.capsules(own, links) for own, links in zip(seen, rows, strict=True)))
    root = seen[0].position[:1] * jnp.array([[1.0], [1.0], [0.0]], seen[0].state.dtype)

    def phi(own: Kinematics, links: np.ndarray) -> Array:
        return jnp.concatenate([own.position - root, own.state[:, 3:], own.sizes], axis=1)[links]

    first, second = (phi(*each) for each in zip(seen, rows, strict=True))
    arms = [found.point - own.position[links] for own, links in zip(seen, rows, strict=True)]
    by_first = jnp.concatenate([first, second, arms[0], found.normal, found.distance], axis=1)
    by_second = jnp.concatenate([second, first, arms[1], -found.normal, found.distance], axis=1)
    return jnp.moveaxis(by_first, -1, 0), jnp.moveaxis(by_second, -1, 0)

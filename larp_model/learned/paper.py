"""f_d and f_c of the paper, to the letter: inputs in the world's axes, and contacts learned as well.

M. Andriluka et al., "Learned neural physics simulation for articulated 3D human pose reconstruction" (2024).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import detection, rotation
from larp_model import state as packed
from larp_model.errors import InputError
from larp_model.learned.model import network_name
from larp_model.names import require_known
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


# Inputs of f_d that a variant may leave out.
OPTIONAL = ("displacement", "torque")


@dataclass(frozen=True)
class Variant:
    """Choices that differ from the paper's, for experiments with them.

    contact: f_c gives a feature to f_d, or an impulse that is added to its velocities, or there is none. left_out: some
    of `OPTIONAL`. rotation: how orientations are given to f_d. root_frame: vectors are in the frame of the course of
    the root's axis. outputs: of f_d, velocities or their changes.
    """

    contact: Literal["feature", "impulse", "none"] = "feature"
    left_out: tuple[str, ...] = ()
    rotation: Literal["matrix", "quaternion"] = "matrix"
    root_frame: bool = False
    outputs: Literal["velocity", "change"] = "velocity"

    def __post_init__(self) -> None:
        for name, options in (
            ("contact", ("feature", "impulse", "none")),
            ("rotation", ("matrix", "quaternion")),
            ("outputs", ("velocity", "change")),
        ):
            require_known(f"variant.{name}", getattr(self, name), options)
        for name in self.left_out:
            require_known("variant.left_out", name, OPTIONAL)
        if self.root_frame and (self.rotation != "matrix" or self.contact != "none"):
            raise InputError("variant.root_frame is set, but needs rotation 'matrix' and contact 'none'")


@dataclass(frozen=True)
class PaperModel:
    """The paper's model: a network of each kind of body, f_d, and one of each two kinds that can touch, f_c.

    bound: of f_d's outputs, in their standard deviations. scale: of the two halves of what f_c gives to f_d.
    """

    scene: Scene
    sizes: Sizes = field(default_factory=Sizes)
    bound: float = 20.0
    scale: tuple[float, float] = (1.0, 0.1)
    variant: Variant = field(default_factory=Variant)

    side_by_side = 8

    @property
    def invariant(self) -> bool:
        """See `Model`."""
        return self.variant.root_frame

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
        contacts = {network_name("contact", *both): self.sizes.contact.network(6) for _, both in self._touching()}
        return bodies | contacts

    def _touching(self) -> Iterator[tuple[Pair, tuple[Body, Body]]]:
        """Yield the pairs that have a contact network; see `pairs_by_kind`."""
        return iter(()) if self.variant.contact == "none" else pairs_by_kind(self.scene)

    def step(
        self, weights: Weights, state: Array, control: Array, torque: Array, morphology: Array, stop_gradient: bool
    ) -> Array:
        """See `Model`: an input of f_d of each body is the sum of f_c over the contacts of its links (equation 1)."""
        scene, networks = self.scene, self.networks()
        links = kinematics(scene, jnp.moveaxis(state, 0, -1), jnp.moveaxis(morphology, 0, -1))
        by_body = {body.name: links.of(scene, body.name) for body in scene.bodies}
        effects = {
            body.name: jnp.zeros((*state[:, scene.rows(body.name)].shape[:2], 6), state.dtype) for body in scene.bodies
        }
        for pair, both in self._touching():
            touching = by_body[pair.first], by_body[pair.second]
            name = network_name("contact", *both)
            features = contact_inputs(pair, both, jax.lax.stop_gradient(touching) if stop_gradient else touching)
            for body, link_rows, of_link in zip(both, detection.link_pairs(pair, *both), features, strict=True):
                onto = jax.nn.one_hot(link_rows, len(body.links), dtype=state.dtype)
                effect = jnp.einsum("bpf,pl->blf", evaluate(networks[name], weights, name, of_link), onto)
                effects[body.name] += effect
        after = []
        for body in scene.bodies:
            name, body_links, effect = network_name("dynamics", body), by_body[body.name], effects[body.name]
            effect = jnp.stack([effect[..., :3] / self.scale[0], effect[..., 3:] / self.scale[1]], axis=1)
            nothing, is_impulse = jnp.zeros_like(effect), self.variant.contact == "impulse"
            rows, motors = scene.rows(body.name), scene.motor_rows(body.name)
            inputs, turn = self.body_inputs(body, body_links, control[:, motors], torque[:, rows])
            inputs = side_by_side(inputs, nothing if is_impulse else effect)
            outputs = bounded(evaluate(networks[name], weights, name, inputs), self.bound)
            vectors = weights.outputs[name].restore(outputs).reshape(len(state), 2, len(body.links), 3)
            velocities = rotation.about_z(vectors, turn[:, None, None]) + (effect if is_impulse else nothing)
            before = state[:, rows]
            if self.variant.outputs == "change":
                velocities += _velocities(before)
            velocity, angular_velocity = velocities[:, 0], velocities[:, 1]
            position = packed.position(before) + scene.dt * velocity
            orientation = rotation.integrate(packed.orientation(before), scene.dt * angular_velocity)
            after.append(packed.pack(position, orientation, velocity, angular_velocity))
        return jnp.concatenate(after, axis=1)

    def measure(self, before: Array, after: Array, control: Array, torque: Array, morphology: Array) -> Measured:
        """See `Model`; of contacts where links are near, as elsewhere their networks have no effect."""
        scene = self.scene
        links = kinematics(scene, jnp.moveaxis(before, 0, -1), jnp.moveaxis(morphology, 0, -1))
        measured = Measured()
        for body in scene.bodies:
            rows, motors = scene.rows(body.name), scene.motor_rows(body.name)
            inputs, turn = self.body_inputs(body, links.of(scene, body.name), control[:, motors], torque[:, rows])
            velocities = _velocities(after[:, rows])
            if self.variant.outputs == "change":
                velocities -= _velocities(before[:, rows])
            outputs = rotation.about_z(velocities, rotation.opposite(turn)[:, None, None])
            measured[network_name("dynamics", body)] = (
                Statistics.of(inputs).beside(6 * len(body.links)), Statistics.of(side_by_side(outputs))
            )  # fmt: skip
        for pair, both in self._touching():
            links_of_pair = links.of(scene, pair.first), links.of(scene, pair.second)
            features = jnp.concatenate(contact_inputs(pair, both, links_of_pair), axis=1)
            states = links_of_pair[0].state, links_of_pair[1].state
            points = detection.detect(pair, both, links_of_pair, states, scene.dt)
            near = jnp.tile(points.near, (1, 2)).reshape(-1) + APART
            measured[network_name("contact", *both)] = (
                Statistics.of(features.reshape(-1, features.shape[-1]), near), None
            )  # fmt: skip
        return measured

    def body_inputs(self, body: Body, links: Kinematics, control: Array, torque: Array) -> tuple[Array, Array]:
        """Return the inputs of f_d (B, F), contacts apart, and the frame they are in, cosine and sine (B, 2).

        Root-relative position, rotation, velocities, displacement, torque; height, target quaternion, length and
        radius. control (B, j, 3) [rad], torque (B, n, 3) [N m].
        """
        variant, count = self.variant, torque.shape[0]
        matrices = jnp.swapaxes(links.matrices, 1, 2).reshape(-1, *links.position.shape[1:])
        vectors = [links.position - links.position[:1], links.velocity, links.angular_velocity]
        vectors += [matrices] if variant.rotation == "matrix" else []
        vectors += [links.displacement] if "displacement" not in variant.left_out else []
        features = jnp.moveaxis(jnp.concatenate(vectors), -1, 0)
        features = jnp.concatenate([features, *([torque] if "torque" not in variant.left_out else [])], axis=1)
        turn = jnp.broadcast_to(jnp.array([1.0, 0.0], features.dtype), (count, 2))
        if variant.root_frame:
            turn = rotation.course(links.orientation[0].T, body.links[0].axis)
            features = rotation.about_z(features, rotation.opposite(turn)[:, None])
        height, sizes = (jnp.moveaxis(array, -1, 0) for array in (links.position[:, 2], links.sizes[:, :2]))
        others = [jnp.moveaxis(links.orientation, -1, 0)] if variant.rotation == "quaternion" else []
        return side_by_side(features, height, rotation.from_rotation_vector(control), sizes, *others), turn


def _velocities(state: Array) -> Array:
    """Return velocity and angular velocity (B, 2, n, 3) of states (B, n, 13)."""
    return jnp.stack([packed.velocity(state), packed.angular_velocity(state)], axis=1)


def pairs_by_kind(scene: Scene) -> Iterator[tuple[Pair, tuple[Body, Body]]]:
    """Yield the scene's pairs with their bodies in the order of their kinds, whichever is named first."""
    for pair in scene.pairs:
        first, second = scene.body(pair.first), scene.body(pair.second)
        yield (pair, (first, second)) if first.kind <= second.kind else (pair.flipped(), (second, first))


def contact_inputs(pair: Pair, bodies: tuple[Body, Body], links: tuple[Kinematics, Kinematics]) -> tuple[Array, Array]:
    """Return the inputs of f_c (B, P, F) for the first link of each pair of links, and for the second.

    They are phi of both links and c(.).

    phi: position relative to the first body's root, quaternion, velocities, length, radius, mass. c(.): the contact
    point relative to the link, the normal and the distance, when the step begins.
    """
    rows = detection.link_pairs(pair, *bodies)
    points = closest(
        *(detection.capsules(body_links, link_rows) for body_links, link_rows in zip(links, rows, strict=True))
    )
    root = links[0].position[:1] * jnp.array([[1.0], [1.0], [0.0]], links[0].state.dtype)

    def phi(body_links: Kinematics, link_rows: np.ndarray) -> Array:
        features = [body_links.position - root, body_links.state[:, 3:], body_links.sizes]
        return jnp.concatenate(features, axis=1)[link_rows]

    first, second = (phi(*side) for side in zip(links, rows, strict=True))
    arms = [points.point - body_links.position[link_rows] for body_links, link_rows in zip(links, rows, strict=True)]
    by_first = jnp.concatenate([first, second, arms[0], points.normal, points.distance], axis=1)
    by_second = jnp.concatenate([second, first, arms[1], -points.normal, points.distance], axis=1)
    return jnp.moveaxis(by_first, -1, 0), jnp.moveaxis(by_second, -1, 0)

"""f_d and f_c of the paper, to the letter: both see the world's axes, and what contact means is learned.

M. Andriluka et al., "Learned neural physics simulation for articulated 3D human pose reconstruction" (2024).
"""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import contact, meeting, rotation
from larp_model import state as packed
from larp_model.kinematics import Kinematics
from larp_model.meeting import Velocities
from larp_model.networks import Measured, Perceptron, Size, Statistics, Weights, bounded, evaluate, side_by_side
from larp_model.parts.bases import paper_inputs
from larp_model.parts.part import Hits, Moving, name_of
from larp_model.parts.sphere import RARELY
from larp_model.scene import Body, Pair


@dataclass(frozen=True)
class PaperBody:
    """f_d: the next velocities of all links, x' = x + v' dt.

    bound: of outputs, in their standard deviations. scale: of the pooled features' two halves.
    """

    body: Body
    dt: float
    size: Size
    bound: float = 20.0
    scale: tuple[float, float] = (1.0, 0.1)

    invariant = False

    @property
    def name(self) -> str:
        """Of its network."""
        return f"dynamics/{name_of(self.body)}"

    def networks(self) -> dict[str, Perceptron]:
        """See `BodyPart`."""
        return {self.name: self.size.network(6 * len(self.body.links))}

    def move(self, weights: Weights, seen: Kinematics, control: Array, torque: Array) -> Moving:
        """See `BodyPart`: contact comes first, so nothing is known yet."""
        return Moving(Velocities.of(seen.state), self.inputs(seen, control, torque))

    def respond(self, weights: Weights, seen: Kinematics, moving: Moving, hits: Hits) -> Array:
        """See `BodyPart`."""
        size, links = seen.state.shape[0], len(self.body.links)
        inputs = side_by_side(moving.kept, hits.scaled(self.scale))
        outputs = evaluate(self.networks()[self.name], weights, self.name, inputs)
        outputs = weights.outputs[self.name].restore(bounded(outputs, self.bound))
        velocity, spin = jnp.moveaxis(outputs.reshape(size, 2, links, 3), 1, 0)
        place = packed.position(seen.state) + self.dt * velocity
        return packed.pack(place, rotation.integrate(packed.orientation(seen.state), self.dt * spin), velocity, spin)

    def measure(self, seen: Kinematics, after: Array, control: Array, torque: Array) -> tuple[Measured, Velocities]:
        """See `BodyPart`."""
        inputs = Statistics.of(self.inputs(seen, control, torque)).beside(6 * len(self.body.links))
        outputs = side_by_side(*Velocities.of(after))
        return {self.name: (inputs, Statistics.of(outputs))}, Velocities.of(seen.state)

    def inputs(self, seen: Kinematics, control: Array, torque: Array) -> Array:
        """What the network sees (B, F), contacts apart."""
        vectors, scalars = paper_inputs(self.body, seen, control, torque)
        return side_by_side(*vectors, *scalars)


@dataclass(frozen=True)
class PaperContact:
    """f_c: a feature vector for each of two links, from phi of both and c(.).

    phi: position relative to the first body's root, quaternion, velocities, length, radius, mass. c(.): the contact
    point relative to the link, the normal and the distance, when the step begins.
    """

    bodies: tuple[Body, Body]
    pair: Pair
    dt: float
    size: Size

    @property
    def name(self) -> str:
        """Of its network."""
        return f"contact/{name_of(*self.bodies)}"

    def networks(self) -> dict[str, Perceptron]:
        """See `PairPart`."""
        return {self.name: self.size.network(6)}

    def meet(
        self, weights: Weights, seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]
    ) -> tuple[Hits, Hits]:
        """See `PairPart`."""
        network, pooled = self.networks()[self.name], []
        rows = meeting.rows_of(self.pair, *self.bodies)
        for own, links, inputs in zip(seen, rows, self.inputs(seen), strict=True):
            onto = jax.nn.one_hot(links, own.state.shape[1], dtype=inputs.dtype)
            push = jnp.einsum("bpf,pl->blf", evaluate(network, weights, self.name, inputs), onto)
            pooled.append(Hits.none(own)._replace(push=push))
        return pooled[0], pooled[1]

    def measure(self, seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]) -> Measured:
        """See `PairPart`."""
        parties = meeting.parties(self.pair, self.bodies, seen, free)
        met = meeting.meet(self.pair, *parties, self.dt)
        inputs = jnp.concatenate(self.inputs(seen), axis=1)
        near = jnp.tile(met.near, (1, 2)).reshape(-1) + RARELY
        return {self.name: (Statistics.of(inputs.reshape(-1, inputs.shape[-1]), near), None)}

    def inputs(self, seen: tuple[Kinematics, Kinematics]) -> tuple[Array, Array]:
        """What the network sees (B, P, F) of the first link, and of the second."""
        rows = meeting.rows_of(self.pair, *self.bodies)
        found = contact.closest(*(own.segments(links) for own, links in zip(seen, rows, strict=True)))
        root = seen[0].state[:, :1, :3] * jnp.array([1.0, 1.0, 0.0], seen[0].state.dtype)

        def phi(own: Kinematics, links: np.ndarray) -> Array:
            sizes = jnp.broadcast_to(own.morphology[:, links], (own.state.shape[0], len(links), 3))
            state = own.state[:, links]
            return jnp.concatenate([packed.position(state) - root, state[..., 3:], sizes], axis=-1)

        (first, second), distance = (phi(*each) for each in zip(seen, rows, strict=True)), found.distance[..., None]
        arms = (found.point - packed.position(own.state)[:, links] for own, links in zip(seen, rows, strict=True))
        by_first = jnp.concatenate([first, second, next(arms), found.normal, distance], axis=-1)
        by_second = jnp.concatenate([second, first, next(arms), -found.normal, distance], axis=-1)
        return by_first, by_second

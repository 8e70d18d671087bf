"""Contact of two bodies: the free impact of their links, which a network scales, turns and delays."""

from __future__ import annotations

from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
from jax import Array

from larp_model import meeting
from larp_model.kinematics import Kinematics
from larp_model.meeting import Meeting, Party, Velocities
from larp_model.networks import Measured, Perceptron, Size, Statistics, Weights, bounded, evaluate
from larp_model.parts.part import Hits, name_of
from larp_model.parts.sphere import RARELY
from larp_model.scene import Body, Pair


@dataclass(frozen=True)
class Contact:
    """An impulse along the contact's own directions, none where links are further apart than a margin.

    bounds: what the network may add, so that no state, however odd, is thrown out of the world: share of the free
    impact, normal speed [m/s], slide, binormal, upward speed [m/s], lag [ms].
    """

    bodies: tuple[Body, Body]
    pair: Pair
    dt: float
    size: Size
    bounds: tuple[float, ...] = (1.0, 3.0, 1.0, 1.0, 3.0, 5.0)
    constants: meeting.Constants = field(default_factory=meeting.Constants)

    @property
    def name(self) -> str:
        """Of its network."""
        return f"contact/{name_of(*self.bodies)}"

    def networks(self) -> dict[str, Perceptron]:
        """See `PairPart`."""
        return {self.name: self.size.network(len(self.bounds))}

    def meet(
        self, weights: Weights, seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]
    ) -> tuple[Hits, Hits]:
        """See `PairPart`."""

        def touch() -> tuple[Hits, Hits]:
            first, second = meeting.parties(self.pair, self.bodies, seen, free)
            found = self.met(first, second)
            outputs = evaluate(self.networks()[self.name], weights, self.name, self.inputs(first, second, found))
            impulse, lag = self.impulse(found, bounded(outputs, self.bounds) * found.near[..., None])
            pushes = [jnp.concatenate([side * impulse, jnp.cross(arm, side * impulse)], axis=-1)
                      for side, arm in zip((-1.0, 1.0), found.arms, strict=True)]  # fmt: skip
            pooled = []
            for party, side, push in zip((first, second), (-1.0, 1.0), pushes, strict=True):
                own = jax.nn.one_hot(party.rows, len(party.body.links), dtype=impulse.dtype)
                travel = side * impulse * lag
                pooled.append(Hits(*(jnp.einsum("bpf,pl->blf", each, own) for each in (push, travel))))
            return pooled[0], pooled[1]

        # Steps without contact are by far the most.
        near = meeting.within_reach(*meeting.parties(self.pair, self.bodies, seen, free), self.dt, self.constants)
        one, two = jax.lax.cond(near, touch, lambda: (Hits.none(seen[0]), Hits.none(seen[1])))
        return one, two

    def measure(self, seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]) -> Measured:
        """See `PairPart`."""
        parties = meeting.parties(self.pair, self.bodies, seen, free)
        found = self.met(*parties)
        inputs = self.inputs(*parties, found)
        near = found.near.reshape(-1) + RARELY
        return {self.name: (Statistics.of(inputs.reshape(-1, inputs.shape[-1]), near), None)}

    def met(self, first: Party, second: Party) -> Meeting:
        """How the links meet."""
        return meeting.meet(self.pair, first, second, self.dt, self.constants)

    def inputs(self, first: Party, second: Party, met: Meeting) -> Array:
        """What the network sees (B, P, F), in the first link's frame."""
        (v1, w1), (dv1, dw1), (v2, w2) = first.before, first.gained, second.before
        up = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0], v1.dtype), v1.shape)
        vectors = [met.normal, met.arms[0], met.relative, v1, w1, w2, up, dv1, dw1, met.mass[..., None] * met.given]
        turn = first.seen.matrices[:, first.rows]
        local = jnp.sum(turn[..., None, :, :] * jnp.stack(vectors, axis=-2)[..., :, None], axis=-2)
        scalars = jnp.stack(
            [
                jnp.clip(met.gap, -0.1, 0.2),
                jnp.clip(met.lowest, -0.05, 0.05),
                met.remaining,
                met.approach,
                met.impact.change,
                met.impact.lag,
                met.impact.gap,
                met.centre[..., 2] - second.segment.radius,
                v2[..., 2],
                met.mass,
            ],
            axis=-1,
        )
        size = met.gap.shape
        which = jnp.broadcast_to(jnp.eye(size[1], dtype=scalars.dtype), (*size, size[1]))
        return jnp.concatenate([local.reshape(*size, -1), scalars, which], axis=-1)

    def impulse(self, met: Meeting, outputs: Array) -> tuple[Array, Array]:
        """Impulse (B, P, 3) [N s] on the second link and its lag (B, P, 1) [s], from gated outputs (B, P, 6).

        Along the normal: the free impact's, which the network scales and adds to; across it: along the slide, the
        binormal and, for the ground's reaction, up.
        """
        scale, add, along, across, up, late = jnp.split(outputs, len(self.bounds), axis=-1)
        normal = met.impact.change[..., None] * (1.0 + scale) + add
        vertical = jnp.array([0.0, 0.0, 1.0], outputs.dtype)
        velocity = normal * met.normal + along * met.slide + across * jnp.cross(met.normal, met.slide) + up * vertical
        return met.mass[..., None] * velocity, met.impact.lag[..., None] + 0.001 * late

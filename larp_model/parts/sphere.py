"""A ball: free flight, what contacts and torques do to it, and a learned bounce and slide on the ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
from jax import Array

from larp_model import contact, rotation
from larp_model import state as packed
from larp_model.kinematics import Kinematics
from larp_model.meeting import Velocities
from larp_model.networks import Measured, Perceptron, Size, Statistics, Weights, bounded, evaluate
from larp_model.parts.part import Hits, Moving, name_of
from larp_model.scene import Body

# Solid spheres: moment of inertia / (mass x radius^2).
SPHERE = 0.4
# How rarely contacts count that are none, where statistics are taken.
RARELY = 1e-3


class Ground(NamedTuple):
    """A ball and the ground within one step: scalars (B, F) for its network and what they are made of.

    slip (B, 3): of the ball's lowest point [m/s]. near (B,): 1 where the ball touches the ground within the step.
    touching (B,): for how long at most [s].
    """

    inputs: Array
    bounce: contact.Impact
    near: Array
    slip: Array
    touching: Array


@dataclass(frozen=True)
class Sphere:
    """Away from every contact it is exact free flight.

    sliding: what friction does on the ground is known, see `held`; else the network has to say it.
    bounds: what the network may add, so that no state, however odd, is thrown out of the world: share of the free
    bounce, speed [m/s], stick, drag, grip, roll, twist, lag [ms]. margin: above which the ground is not felt [m].
    """

    body: Body
    dt: float
    gravity: float
    size: Size
    bounds: tuple[float, ...] = (1.0, 1.0, 0.5, 0.5, 0.5, 0.5, 0.5, 3.0)
    margin: float = 0.01
    impedance: float = contact.IMPEDANCE
    sliding: bool = False

    invariant = True

    @property
    def name(self) -> str:
        """Of its network."""
        return f"dynamics/{name_of(self.body)}"

    def networks(self) -> dict[str, Perceptron]:
        """See `BodyPart`."""
        return {self.name: self.size.network(len(self.bounds))}

    def move(self, weights: Weights, seen: Kinematics, control: Array, torque: Array) -> Moving:
        """See `BodyPart`. What it gains within a step is left out: a contact's network was taught so."""
        return Moving(Velocities.of(seen.state), torque)

    def respond(self, weights: Weights, seen: Kinematics, moving: Moving, hits: Hits) -> Array:
        """See `BodyPart`."""
        dt, ball, impulse, torque = self.dt, seen.state[:, 0], hits.push[:, 0], moving.kept[:, 0]
        radius, mass = seen.morphology[:, 0, 1:2], seen.morphology[:, 0, 2:3]
        ground = self.ground(seen, impulse)
        outputs = evaluate(self.networks()[self.name], weights, self.name, ground.inputs)
        outputs = bounded(outputs, self.bounds) * ground.near[:, None]
        scale, add, stick, drag, grip, roll, twist, late = jnp.split(outputs, len(self.bounds), axis=-1)
        up = jnp.array([0.0, 0.0, 1.0], ball.dtype)
        velocity, spin = packed.velocity(ball), packed.angular_velocity(ball)
        along = velocity * (1.0 - up)
        kick = impulse[:, :3] / mass
        bounce = ground.bounce.change[:, None] * (1.0 + scale) + add
        lag = ground.bounce.lag[:, None] + 0.001 * late
        if self.sliding:
            held = self.held(ground, bounce)
            stick, grip = stick + held, grip + held
        slide = -stick * ground.slip - drag * along
        new_velocity = velocity - self.gravity * dt * up + kick + bounce * up + slide
        moment = (impulse[:, 3:] + dt * torque) / (SPHERE * mass * radius**2)
        rolling = (grip * jnp.cross(up, ground.slip) + roll * jnp.cross(up, along)) / (SPHERE * radius)
        # What a network does not know it must not drive: the ground may slow a spin about the vertical, no more.
        new_spin = spin + moment + rolling - jnp.maximum(twist, 0.0) * spin * up
        moved = (
            velocity * dt
            - 0.5 * self.gravity * dt**2 * up
            + hits.travel[:, 0] / mass
            + bounce * lag * up
            + 0.5 * dt * slide
        )
        turned = rotation.integrate(packed.orientation(ball), 0.5 * dt * (spin + new_spin))
        return packed.pack(packed.position(ball) + moved, turned, new_velocity, new_spin)[:, None]

    def held(self, ground: Ground, bounce: Array) -> Array:
        """Share (B, 1) of its slip that friction takes from the ball's velocity, pressed by a bounce (B, 1) [m/s].

        Without a limit its slip dies away at the surface's damping, in MuJoCo's law as in `soft_contact`; Coulomb's is
        the limit. Of what the lowest point loses a part goes into the spin.
        """
        surface, gives = self.body.surface, 1.0 + 1.0 / SPHERE
        slip = contact.norm(ground.slip)[:, None]
        dies = 1.0 - jnp.exp(-surface.damping * ground.touching[:, None])
        most = gives * surface.friction * jnp.maximum(bounce, 0.0) / jnp.maximum(slip, 1e-6)
        return jnp.minimum(dies, most) / gives

    def measure(self, seen: Kinematics, after: Array, control: Array, torque: Array) -> tuple[Measured, Velocities]:
        """See `BodyPart`."""
        ground = self.ground(seen, jnp.zeros((len(seen.state), 6), seen.state.dtype))
        return {self.name: (Statistics.of(ground.inputs, ground.near + RARELY), None)}, Velocities.of(seen.state)

    def ground(self, seen: Kinematics, push: Array) -> Ground:
        """The ball on the ground, pushed (B, 6): scalars only, so that turning the world about z changes nothing."""
        state, radius, dt = seen.state[:, 0], seen.morphology[:, 0, 1], self.dt
        velocity, spin = packed.velocity(state), packed.angular_velocity(state)
        gap, falling = state[..., 2] - radius, -velocity[..., 2]
        closing = falling + 0.5 * self.gravity * dt
        start = contact.time_of_impact(gap, closing, dt)
        bounce = contact.impact(
            jnp.maximum(-gap, 0.0), falling + self.gravity * start, self.gravity, self.body.surface, dt - start,
            self.impedance,
        )  # fmt: skip
        lowest = jnp.minimum(gap, gap - closing * dt)
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
                push[..., 2],
                contact.norm(push[..., :3]),
            ],
            axis=-1,
        )
        return Ground(inputs, bounce, contact.smooth_gate(lowest, self.margin), slip, dt - start)

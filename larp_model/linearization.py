"""Derivatives of a step: x' = f(x, u) near a state x and a control u is x' + A dx + B du.

dx are generalised coordinates of a small change of a state, which leave joints closed. Of a body of n links they are

    position [m] and rotation vector [rad] of its root, rotation vectors [rad] of its n - 1 joints,
    and their rates: velocity [m/s], angular velocity [rad/s], and angular velocities [rad/s] of its joints,

each in the world's axes, those of joints of the child relative to its parent. First come the positions of all bodies,
then all rates: 2 V coordinates, V = sum of 3 (n + 1). du (3 J,) are changes of joint targets [rad].

Arrays of `Coordinates` have the batch last, as in `linalg`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import rotation
from larp_model import state as packed
from larp_model.linalg import combined, cross, dot, rotation_matrices
from larp_model.physics.kinematics import Anchors, Kinematics, kinematics, turned_anchors
from larp_model.scene import Body, Scene

# States that are linearised at a time: links that touch in one of them cost time in all.
GROUP = 8

Step = Callable[[Array, Array, Array], Array]
"""(states (B, L, 13), controls (B, J, 3), sizes (B, L, 3)) -> states (B, L, 13)"""


@dataclass(frozen=True)
class Coordinates:
    """The coordinates of a scene: see the module."""

    scene: Scene

    @property
    def count(self) -> int:
        """Return V, half the number of coordinates."""
        return int(self.by_body()[-1][1].stop)

    def by_body(self) -> list[tuple[Body, slice]]:
        """Return each body with its part of the V positions, and of the V rates."""
        ends = np.cumsum([3 * (len(body.links) + 1) for body in self.scene.bodies]).tolist()
        return [
            (body, slice(begin, end)) for body, begin, end in zip(self.scene.bodies, [0, *ends], ends, strict=False)
        ]

    def change(self, state: Array, sizes: Array, coordinates: Array) -> Array:
        """Return the change (L, 13, B) of states (L, 13, B) of links of sizes (L, 3, B), by coordinates (2 V, B)."""
        changes = []
        for body, links, positions, rates in self._split(state, sizes, coordinates):
            anchors = turned_anchors(links.local_anchors, links.matrices, np.arange(1, len(body.links)), body.parents)
            changes.append(_body_change(body, links.state, anchors, positions, rates))
        return jnp.concatenate(changes)

    def moved(self, state: Array, sizes: Array, coordinates: Array) -> Array:
        """Return states (L, 13, B) moved by coordinates (2 V, B) that need not be small; all joints are then closed.

        `difference` to the states before gives the coordinates back, to the second order.
        """
        return jnp.concatenate([_body_moved(*parts) for parts in self._split(state, sizes, coordinates)])

    def _split(self, state: Array, sizes: Array, coordinates: Array) -> Iterator[tuple[Body, Kinematics, Array, Array]]:
        """Yield each body with its links, positions and rates (n + 1, 3, B)."""
        links = kinematics(self.scene, state, sizes)
        halves = jnp.split(coordinates, 2)
        for body, part in self.by_body():
            positions, rates = (half[part].reshape(-1, 3, half.shape[-1]) for half in halves)
            yield body, links.of(self.scene, body.name), positions, rates

    def of(self, state: Array, change: Array) -> Array:
        """Return the coordinates (2 V, B) of changes (L, 13, B) of states (L, 13, B), joints closed or not."""
        quaternion, rate = state[:, packed.ORIENTATION], change[:, packed.ORIENTATION]
        w, v, rate_w, rate_v = quaternion[:, :1], quaternion[:, 1:], rate[:, :1], rate[:, 1:]
        return self._joined(change, 2.0 * (w * rate_v - rate_w * v - cross(rate_v, v)))

    def difference(self, state: Array, reference: Array) -> Array:
        """Return the coordinates (2 V, B) of states (L, 13, B) near reference states (L, 13, B)."""
        quaternion, other = state[:, packed.ORIENTATION], reference[:, packed.ORIENTATION]
        w, v, other_w, other_v = quaternion[:, :1], quaternion[:, 1:], other[:, :1], other[:, 1:]
        real = w * other_w + dot(v, other_v)
        imaginary = other_w * v - w * other_v - cross(v, other_v)
        sign = jnp.where(real < 0.0, -1.0, 1.0)
        return self._joined(state - reference, 2.0 * sign * imaginary)

    def _joined(self, change: Array, rotation_vectors: Array) -> Array:
        """Return coordinates (2 V, B) of changes (L, 13, B) whose rotation vectors (L, 3, B) are these."""
        positions, rates = list[Array](), list[Array]()
        for body in self.scene.bodies:
            rows, parents = self.scene.rows(body.name), body.parents
            for parts, root, turns in (
                (positions, change[rows.start, packed.POSITION], rotation_vectors[rows]),
                (rates, change[rows.start, packed.VELOCITY], change[rows, packed.ANGULAR_VELOCITY]),
            ):
                parts += [root[None], turns[:1], turns[1:] - turns[parents]]
        return jnp.concatenate([*positions, *rates]).reshape(-1, change.shape[-1])


def _body_change(body: Body, state: Array, anchors: Anchors, positions: Array, rates: Array) -> Array:
    """Return the change (n, 13, B) of a body's states (n, 13, B), by positions and rates (n + 1, 3, B)."""
    parents, children = body.parents, np.arange(1, len(body.links))
    turns, turn_rates = (part[1] + combined(body.ancestors, part[2:]) for part in (positions, rates))
    velocity = state[:, packed.ANGULAR_VELOCITY]
    shifts, shift_rates = list[Array](), list[Array]()
    for links, arm in ((parents, anchors.parent), (children, -anchors.child)):
        turned = cross(turns[links], arm)
        shifts.append(turned)
        shift_rates.append(cross(turn_rates[links], arm) + cross(velocity[links], turned))
    position = positions[0] + combined(body.ancestors, shifts[0] + shifts[1])
    rate = rates[0] + combined(body.ancestors, shift_rates[0] + shift_rates[1])
    w, v = state[:, 3:4], state[:, 4:7]
    quaternion = 0.5 * jnp.concatenate([-dot(turns, v), w * turns + cross(turns, v)], axis=1)
    return jnp.concatenate([position, quaternion, rate, turn_rates], axis=1)


def _body_moved(body: Body, links: Kinematics, positions: Array, rates: Array) -> Array:
    """Return states (n, 13, B) of a body, moved by positions and rates (n + 1, 3, B)."""
    parents, children = body.parents, np.arange(1, len(body.links))
    turns, turn_rates = (part[1] + combined(body.ancestors, part[2:]) for part in (positions, rates))
    last = (jnp.moveaxis(array, 1, -1) for array in (links.orientation, turns))
    quaternion = jnp.moveaxis(rotation.integrate(*last), -1, 1)
    angular_velocity = links.angular_velocity + turn_rates
    anchors = turned_anchors(links.local_anchors, rotation_matrices(quaternion), children, parents)
    # Both points of a joint are at one place, and move together.
    steps = anchors.parent - anchors.child
    speeds = cross(angular_velocity[parents], anchors.parent) - cross(angular_velocity[children], anchors.child)
    position = links.position[:1] + positions[:1] + combined(body.ancestors, steps)
    velocity = links.velocity[:1] + rates[:1] + combined(body.ancestors, speeds)
    return jnp.concatenate([position, quaternion, velocity, angular_velocity], axis=1)


def linearized(scene: Scene, step: Step, state: Array, control: Array, sizes: Array) -> tuple[Array, Array]:
    """Return A (B, 2 V, 2 V) and B (B, 2 V, 3 J) of a step of states (B, L, 13) under controls (B, J, 3) [rad].

    sizes: (B, L, 3). Derivatives are taken forwards.
    """
    count = len(state)
    rows = np.minimum(np.arange(count + -count % GROUP), count - 1).reshape(-1, GROUP)
    groups = jax.tree.map(lambda array: array[rows], (state, control, sizes))
    results = jax.lax.map(lambda group: _of_group(scene, step, *group), groups)
    by_state, by_control = (result.reshape(-1, *result.shape[2:])[:count] for result in results)
    return by_state, by_control


def _of_group(scene: Scene, step: Step, state: Array, control: Array, sizes: Array) -> tuple[Array, Array]:
    coordinates = Coordinates(scene)
    size, inputs = 2 * coordinates.count, control.shape[1] * 3
    last, last_sizes = jnp.moveaxis(state, 0, -1), jnp.moveaxis(sizes, 0, -1)

    def change(direction: Array) -> Array:
        spread = jnp.broadcast_to(direction[:, None], (size, len(state)))
        return jnp.moveaxis(coordinates.change(last, last_sizes, spread), -1, 0)

    changes = jax.vmap(change)(jnp.eye(size, size + inputs, dtype=state.dtype).T)
    control_changes = jnp.eye(size + inputs, inputs, -size, dtype=state.dtype).reshape(-1, 1, *control.shape[1:])
    control_changes = jnp.broadcast_to(control_changes, (size + inputs, *control.shape))

    def derivative(state_change: Array, control_change: Array) -> tuple[Array, Array]:
        def after_step(state: Array, control: Array) -> Array:
            return step(state, control, sizes)

        return jax.jvp(after_step, (state, control), (state_change, control_change))

    after, after_changes = jax.vmap(derivative, out_axes=(None, 0))(changes, control_changes)
    columns = jax.vmap(lambda change: coordinates.of(jnp.moveaxis(after, 0, -1), jnp.moveaxis(change, 0, -1)))(
        after_changes
    )
    derivatives = jnp.moveaxis(columns, (0, 1, 2), (2, 1, 0))
    return derivatives[..., :size], derivatives[..., size:]

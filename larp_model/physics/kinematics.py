"""Kinematics of a state: rotations, axes, joint anchors and joint displacements.

World frame; arrays have the batch last, as in `linalg`. A step computes them once, and everything else takes them.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import state as packed
from larp_model.linalg import cross, mv, rotation_matrices, rows
from larp_model.scene import Body, Scene, Vector


class Anchors(NamedTuple):
    """Joints as seen from the centres of their children and of their parents, (J, 3, B) [m] each."""

    child: Array
    parent: Array


class Kinematics(NamedTuple):
    """Links of a scene, or of one body, in states (L, 13, B), and their joints.

    sizes: length [m], radius [m] and mass [kg], (L, 3, B). matrices: (L, 3, 3, B) from link to world. half: (L, 3, B)
    [m] from the links' centres to one end of their axes. local_anchors: in the links' frames. displacement: (J, 3, B)
    [m], the joint by the child, less by the parent.
    """

    state: Array
    sizes: Array
    matrices: Array
    half: Array
    local_anchors: Anchors
    displacement: Array

    @property
    def position(self) -> Array:
        """Return the links' centres (L, 3, B) [m]."""
        return self.state[:, packed.POSITION]

    @property
    def orientation(self) -> Array:
        """Return unit quaternions (L, 4, B), w first."""
        return self.state[:, packed.ORIENTATION]

    @property
    def velocity(self) -> Array:
        """Return velocities (L, 3, B) [m/s] of the links' centres."""
        return self.state[:, packed.VELOCITY]

    @property
    def angular_velocity(self) -> Array:
        """Return angular velocities (L, 3, B) [rad/s]."""
        return self.state[:, packed.ANGULAR_VELOCITY]

    def of(self, scene: Scene, body: str) -> Kinematics:
        """Return those of a body of the scene."""
        rows, joints = scene.rows(body), scene.joint_rows(body)
        local = Anchors(self.local_anchors.child[joints], self.local_anchors.parent[joints])
        return Kinematics(
            self.state[rows], self.sizes[rows], self.matrices[rows], self.half[rows], local, self.displacement[joints]
        )


def kinematics(scene: Scene, state: Array, sizes: Array) -> Kinematics:
    """Return the kinematics of states (L, 13, B) of links of sizes (L, 3, B or 1)."""
    sizes = jnp.broadcast_to(sizes, (*sizes.shape[:2], state.shape[-1]))
    matrices = rotation_matrices(state[:, packed.ORIENTATION])
    axes = jnp.array([link.axis for link in scene.links], state.dtype)[..., None]
    half = 0.5 * sizes[:, :1] * mv(matrices, axes)
    joints, position = list(scene.joints()), state[:, packed.POSITION]
    children, parents = (np.array([joint[end] for joint in joints], int) for end in (0, 1))
    local = Anchors(
        local_anchors(scene, children, [joint.child_anchor for *_, joint in joints], sizes),
        local_anchors(scene, parents, [joint.parent_anchor for *_, joint in joints], sizes),
    )
    anchors = turned_anchors(local, matrices, children, parents)
    displacement = rows(position, children) + anchors.child - (rows(position, parents) + anchors.parent)
    return Kinematics(state, sizes, matrices, half, local, displacement)


def turned_anchors(local: Anchors, matrices: Array, children: np.ndarray, parents: np.ndarray) -> Anchors:
    """Return joint anchors in the world's axes, of links turned by matrices (L, 3, 3, B); rows of both ends (J,)."""
    return Anchors(mv(rows(matrices, children), local.child), mv(rows(matrices, parents), local.parent))


def local_anchors(scene: Scene, links: np.ndarray, points: list[Vector], sizes: Array) -> Array:
    """Return joint anchors (J, 3, B) [m] in the frames of the links in these rows (`links`), of sizes (L, 3, B).

    points: in shares of half the length along the link's axis, and of the radius across it, see `Joint`.
    """
    axis = np.array([scene.links[row].axis for row in links], np.float32).reshape(-1, 3)
    point = np.array(points, np.float32).reshape(-1, 3)
    along = np.sum(axis * point, axis=-1, keepdims=True) * axis
    length, radius = rows(sizes[:, 0:1], links), rows(sizes[:, 1:2], links)
    anchors: Array = 0.5 * length * along[..., None] + radius * (point - along)[..., None]
    return anchors


def displacement(scene: Scene, state: Array, morphology: Array) -> Array:
    """Return joint displacements (*, J, 3) [m] of states (*, L, 13) and morphologies (*, L, 3): see `Kinematics`."""
    sizes = jnp.broadcast_to(jnp.asarray(morphology), (*state.shape[:-1], 3))
    count = math.prod(state.shape[:-2])  # which may be 0
    flat = (array.reshape(count, *array.shape[-2:]) for array in (state, sizes))
    apart = kinematics(scene, *(jnp.moveaxis(array, 0, -1) for array in flat)).displacement
    return jnp.moveaxis(apart, -1, 0).reshape(*state.shape[:-2], *apart.shape[:-1])


def morphology_of(scene: Scene) -> Array:
    """Return the morphology (L, 3) that the scene has by itself."""
    return jnp.asarray(scene.morphology)


def motor_scale(body: Body, sizes: Array) -> Array:
    """Return the factor (B,) of the motors of links of sizes (n, 3, B) over the body's own: see `Body.sized`."""
    return jnp.sum(sizes[:, 0], axis=0) * jnp.sum(sizes[:, 2], axis=0) / body.mass_length


def ends_on_ground(
    links: Kinematics, velocity: Array, angular_velocity: Array, dt: Array | float
) -> tuple[Array, Array]:
    """Return velocities (2 n, 3, B) of both ends of every link, times their nearness, and features (6 n, B).

    velocity, angular_velocity: of the links (n, 3, B). Features: clearance [m] over the ground, nearness (1 on the
    ground, falling off over 3 cm), and depth [m] after `dt`.
    """
    arms = jnp.concatenate([links.half, -links.half])
    position, velocity, angular_velocity, radius = (
        jnp.concatenate([values, values]) for values in (links.position, velocity, angular_velocity, links.sizes[:, 1])
    )
    velocity = velocity + cross(angular_velocity, arms)
    clearance = (position + arms)[:, 2] - radius
    nearness = jnp.exp(-jnp.maximum(clearance, 0.0) / 0.03)
    depth = jnp.minimum(clearance + dt * velocity[:, 2], 0.0)
    return nearness[:, None] * velocity, jnp.concatenate([jnp.minimum(clearance, 0.1), nearness, depth])

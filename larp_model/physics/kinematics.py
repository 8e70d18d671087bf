"""What follows from a state and is asked for more than once in a step: rotations, axes, how far joints are apart.

World frame, batch first.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import rotation
from larp_model import state as packed
from larp_model.contact import Segment
from larp_model.scene import Body, Scene, Vector


class Kinematics(NamedTuple):
    """Of the links of a scene, or of one body.

    state: (B, L, 13). matrices: (B, L, 3, 3) from link to world. halves: (B, L, 3) [m] from the links' centres to one
    end of their axes. displacement: (B, number of joints, 3) [m]. morphology: (B or 1, L, 3).
    """

    state: Array
    matrices: Array
    halves: Array
    displacement: Array
    morphology: Array

    def of(self, scene: Scene, body: str) -> Kinematics:
        """Those of a body of the scene."""
        rows, joints = scene.rows(body), scene.joint_rows(body)
        return Kinematics(
            self.state[:, rows], self.matrices[:, rows], self.halves[:, rows], self.displacement[:, joints],
            self.morphology[:, rows],
        )  # fmt: skip

    def segments(self, rows: np.ndarray) -> Segment:
        """Return the axes of links by their rows (P,)."""
        centre, radius = packed.position(self.state)[:, rows], self.morphology[:, rows, 1]
        return Segment(centre, self.halves[:, rows], jnp.broadcast_to(radius, centre.shape[:2]))


def kinematics(scene: Scene, state: Array, morphology: Array) -> Kinematics:
    """Of states (B, L, 13) and a morphology (B or 1, L, 3)."""
    matrices = rotation.matrix(packed.orientation(state))
    axes = np.array([link.axis for link in scene.links], np.float32)
    halves = apply(matrices, 0.5 * morphology[..., 0:1] * axes)
    return Kinematics(state, matrices, halves, _displacement(scene, state, matrices, morphology), morphology)


def apply(matrices: Array, vectors: Array) -> Array:
    """Vectors (*, 3) turned by matrices (*, 3, 3)."""
    return jnp.sum(matrices * vectors[..., None, :], axis=-1)


def morphology_of(scene: Scene) -> Array:
    """The morphology (L, 3) that the scene has by itself."""
    return jnp.asarray(scene.morphology)


def strength(body: Body, morphology: Array) -> Array:
    """How many times as strong (*,) the motors of a morphology (*, n, 3) are as the body's own: see `Body.sized`."""
    return jnp.sum(morphology[..., 0], axis=-1) * jnp.sum(morphology[..., 2], axis=-1) / body.weighed


def anchors(points: list[Vector], axes: list[Vector], morphology: Array) -> Array:
    """Joint anchors (*, J, 3) [m] in the frames of links of a morphology (*, J, 3)."""
    axis, point = (np.asarray(each, np.float32).reshape(-1, 3) for each in (axes, points))
    along = np.sum(axis * point, axis=-1, keepdims=True) * axis
    return 0.5 * morphology[..., 0:1] * along + morphology[..., 1:2] * (point - along)


def displacement(scene: Scene, state: Array, morphology: Array) -> Array:
    """Joint displacement (*, number of joints, 3) [m], world frame: the joint by the child, less by the parent.

    state (*, L, 13), morphology (*, L, 3).
    """
    return _displacement(scene, state, rotation.matrix(packed.orientation(state)), morphology)


def _displacement(scene: Scene, state: Array, matrices: Array, morphology: Array) -> Array:
    joints, links = list(scene.joints()), scene.links
    if not joints:
        return jnp.zeros((*state.shape[:-2], 0, 3), state.dtype)

    def places(rows: list[int], points: list[Vector]) -> Array:
        chosen = np.array(rows)
        offset = anchors(points, [links[row].axis for row in rows], morphology[..., chosen, :])
        return packed.position(state)[..., chosen, :] + apply(matrices[..., chosen, :, :], offset)

    by_child = places([child for child, _, _ in joints], [joint.child_anchor for _, _, joint in joints])
    by_parent = places([parent for _, parent, _ in joints], [joint.parent_anchor for _, _, joint in joints])
    return by_child - by_parent


def ends_on_ground(seen: Kinematics, velocity: Array, spin: Array, dt: float) -> tuple[Array, Array]:
    """How the two ends of every link are to the ground: velocities (B, 2 n, 3) where near it, and scalars (B, 6 n).

    velocity, spin: of the links (B, n, 3). The scalars are clearance [m], nearness (1 on the ground, falling off over
    3 cm), and depth [m] after `dt`.
    """
    arms = jnp.concatenate([seen.halves, -seen.halves], axis=-2)
    place, velocity, spin, radius = (
        jnp.concatenate([part, part], axis=-2)
        for part in (packed.position(seen.state), velocity, spin, seen.morphology[..., 1:2])
    )
    velocity = velocity + jnp.cross(spin, arms)
    clearance = (place + arms)[..., 2] - radius[..., 0]
    near = jnp.exp(-jnp.maximum(clearance, 0.0) / 0.03)
    deep = jnp.minimum(clearance + dt * velocity[..., 2], 0.0)
    return near[..., None] * velocity, jnp.concatenate([jnp.minimum(clearance, 0.1), near, deep], axis=-1)

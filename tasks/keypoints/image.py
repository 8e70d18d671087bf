"""The image of a figure, by a camera of which tilt and height may be unknown.

What all frames share (S,): the figure's proportions (11,), the camera's pitch and roll [rad] and by how much it is
higher, as a logarithm, and how high what a detector takes for heels and for toes is in a foot that stands [m].
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.rotation import from_rotation_vector, matrix
from tasks.keypoints.camera import Camera
from tasks.keypoints.figure import SHARED, Figure

COMMON = SHARED + 3 + 2
# Standard deviations of what is not known of a camera: pitch and roll [rad], and its height, as a share.
TILT, ROLL, HEIGHT = 0.3, 0.05, 0.3


def tilted(camera: Camera, unknown: Array) -> Camera:
    """The camera turned by pitch and roll [rad] and raised, (3,), see above."""
    turn = matrix(from_rotation_vector(jnp.stack([unknown[0], jnp.zeros(()), unknown[1]])))
    position = jnp.asarray(camera.position) * jnp.stack([1.0, 1.0, jnp.exp(unknown[2])])
    return Camera(camera.focal, jnp.asarray(camera.centre), turn @ jnp.asarray(camera.turn), position)


def seen_by(camera: Camera, shared: np.ndarray) -> Camera:
    """The camera as what is shared says that it is turned and raised."""
    turned = tilted(camera, jnp.asarray(shared[SHARED : SHARED + 3]))
    return Camera(camera.focal, camera.centre, np.asarray(turned.turn, float), np.asarray(turned.position, float))


def moved(body: Figure, camera: Camera, turn: Array, change: Array, shared: Array) -> tuple[Array, Array]:
    """Points (P, 3) [m] and their places (P, 2) [px]; change: place, turn, angles; shared: proportions, camera."""
    turned = matrix(from_rotation_vector(change[3:6])) @ turn
    points = body.points(change[:3], turned, change[6:].reshape(-1, 3), shared[:SHARED])
    return points, tilted(camera, shared[SHARED : SHARED + 3]).project(points)

"""Projection of a figure into the image of a camera whose tilt and height may be unknown.

Values shared by all frames (S,): the figure's proportions (11,), the camera's pitch and roll [rad], the logarithm of
its height relative to the assumed one, and the heights [m], above `figure.SOLE_HEIGHT`, of a detector's heel and toe
points in a foot that stands.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.rotation import from_rotation_vector, matrix
from tasks.pose.camera import Camera, places_in_all
from tasks.pose.figure import SHARED, Figure

SHARED_VALUES = SHARED + 3 + 2
# Standard deviations of a camera's unknown pitch and roll [rad], and of its height, as a share.
TILT_STD, ROLL_STD, HEIGHT_STD = 0.3, 0.05, 0.3


def tilted(camera: Camera, corrections: Array) -> Camera:
    """Return the camera with pitch, roll [rad] and height changed by `corrections` (3,), see the module."""
    turn = matrix(from_rotation_vector(jnp.stack([corrections[0], jnp.zeros(()), corrections[1]])))
    position = jnp.asarray(camera.position) * jnp.stack([1.0, 1.0, jnp.exp(corrections[2])])
    return Camera(camera.focal, jnp.asarray(camera.centre), turn @ jnp.asarray(camera.turn), position)


def estimated_camera(camera: Camera, shared: np.ndarray) -> Camera:
    """Return the camera with the pitch, roll and height of the shared values (S,)."""
    corrected = tilted(camera, jnp.asarray(shared[SHARED : SHARED + 3]))
    return Camera(camera.focal, camera.centre, np.asarray(corrected.turn, float), np.asarray(corrected.position, float))


def points_and_places(
    body: Figure, cameras: tuple[Camera, ...], turn: Array, change: Array, shared: Array
) -> tuple[Array, Array]:
    """Return points (P, 3) [m] and their places (C, P, 2) [px] in the images of C cameras.

    turn: rotation (3, 3) of the pelvis before the change. change: (D,) place [m], rotation vector [rad], joint angles
    [rad]. shared: (S,), see the module.
    """
    rotation = matrix(from_rotation_vector(change[3:6])) @ turn
    points = body.points(change[:3], rotation, change[6:].reshape(-1, 3), shared[:SHARED])
    corrections = shared[SHARED : SHARED + 3]
    return points, places_in_all([tilted(camera, corrections) for camera in cameras], points)

"""Projection of a figure into the image of a camera whose tilt and height may be unknown.

Values shared by all frames (S,): the figure's proportions (11,), the camera's pitch and roll [rad], the logarithm of
its height relative to the assumed one, and the heights [m], above `figure.SOLE_HEIGHT`, of a detector's heel and toe
points in a foot that stands.
"""

from __future__ import annotations

from jax import Array

from larp_model.rotation import from_rotation_vector, matrix
from tasks.pose.figure import SHARED, Figure
from tasks.pose.views import Viewpoint, places_in_all

SHARED_VALUES = SHARED + 3 + 2
# Standard deviations of a camera's unknown pitch and roll [rad], and of its height, as a share.
TILT_STD, ROLL_STD, HEIGHT_STD = 0.3, 0.05, 0.3


def points_and_places(
    body: Figure, cameras: tuple[Viewpoint, ...], turn: Array, change: Array, shared: Array
) -> tuple[Array, Array]:
    """Return points (P, 3) [m] and their places (C, P, 2) [px], or (C, P, 3) [m], as seen by C cameras.

    turn: rotation (3, 3) of the pelvis before the change. change: (D,) place [m], rotation vector [rad], joint angles
    [rad]. shared: (S,), see the module.
    """
    rotation = matrix(from_rotation_vector(change[3:6])) @ turn
    points = body.points(change[:3], rotation, change[6:].reshape(-1, 3), shared[:SHARED])
    corrections = shared[SHARED : SHARED + 3]
    return points, places_in_all([camera.tilted(corrections) for camera in cameras], points)

"""Camera placement: the nearest position from which all points are visible, along one of a few directions."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np

View = Literal["side", "behind", "goal", "above"]
VIEWS: tuple[View, ...] = get_args(View)
# Viewing direction of a camera: its bearing, from x to the left, and its downward tilt [rad]. From the side and
# slightly from behind; along the kick; against it; from above.
DIRECTIONS: dict[View, tuple[float, float]] = {
    "side": (0.85, 0.11),
    "behind": (0.21, 0.24),
    "goal": (2.93, 0.17),
    "above": (1.57, 1.22),
}
TANGENT = 0.32  # of half the horizontal angle of view
MARGIN = 0.4  # m around points that must be visible


class PictureCamera(NamedTuple):
    """Pinhole camera.

    position: (3,) [m]. axes: (3, 3), right, up and forwards in rows. tangent: of half its horizontal angle of view.
    """

    position: np.ndarray
    axes: np.ndarray
    tangent: float = TANGENT

    @classmethod
    def of(cls, points: np.ndarray, aspect: float, view: View = "side", tangent: float = TANGENT) -> PictureCamera:
        """Return the nearest camera with all points (P, 3) [m] in its picture, of height over width `aspect`."""
        bearing, down = DIRECTIONS[view]
        forwards = np.array([np.cos(bearing), np.sin(bearing), -np.tan(down)])
        forwards /= np.linalg.norm(forwards)
        right = np.cross(forwards, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(right, forwards), forwards])
        x, y, depth = (points @ axes.T).T
        position = np.zeros(3)
        back = np.inf
        # A point is in the picture where |x - position| <= tangent (depth - back): two bounds on each side.
        for axis, (across, half) in enumerate(((x, tangent), (y, tangent * aspect))):
            high, low = (across - half * depth).max(), (-across - half * depth).max()
            position[axis] = 0.5 * (high - low)
            back = min(back, -0.5 * (high + low) / half)
        position[2] = back
        return cls(position @ axes, axes, tangent)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """Return the depths [m] of points (*, 3) [m] along the viewing direction."""
        return np.asarray((points - self.position) @ self.axes[2])

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return the projections (*, 2) of points (*, 3) [m]; the width of the picture is from -1 to 1."""
        in_camera_frame = (points - self.position) @ self.axes.T
        return np.asarray(in_camera_frame[..., :2] / (self.tangent * in_camera_frame[..., 2:]))

    def sphere(self, centre: np.ndarray, radius: float) -> tuple[np.ndarray, float]:
        """Return centre (2,) and radius of a sphere in the picture, as a circle; that it is an ellipse is neglected."""
        return self(centre), radius / (self.tangent * float(self.depth(centre)))


def around(*points: np.ndarray) -> np.ndarray:
    """Return the corners (P, 3) [m] of a cube around each point, `MARGIN` away from it along each axis."""
    corners = MARGIN * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    centres = np.concatenate([np.reshape(point_array, (-1, 3)) for point_array in points])
    return np.asarray((centres[:, None] + corners).reshape(-1, 3))

"""Where to look from: the nearest place from which all that matters is seen, along one of a few directions."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

import numpy as np

View = Literal["side", "behind", "goal", "above"]
VIEWS: tuple[View, ...] = get_args(View)
# Which way a camera looks: its bearing, from x to the left, and how much it looks down [rad]. From the side, a little
# from behind; along with the kick; against it.
DIRECTIONS: dict[View, tuple[float, float]] = {
    "side": (1.13, 0.21),
    "behind": (0.21, 0.24),
    "goal": (2.93, 0.17),
    "above": (1.57, 1.22),
}
TANGENT = 0.32  # of half the angle of view, across
MARGIN = 0.4  # m around what must be seen


class PictureCamera(NamedTuple):
    """A pinhole. place: (3,) [m]. axes: (3, 3), right, up and forwards in rows. tangent: of half its angle across."""

    place: np.ndarray
    axes: np.ndarray
    tangent: float = TANGENT

    @classmethod
    def of(cls, points: np.ndarray, aspect: float, view: View = "side", tangent: float = TANGENT) -> PictureCamera:
        """The nearest one that has all of (P, 3) [m] in its picture. aspect: of the picture, height over width."""
        bearing, down = DIRECTIONS[view]
        forwards = np.array([np.cos(bearing), np.sin(bearing), -np.tan(down)])
        forwards /= np.linalg.norm(forwards)
        right = np.cross(forwards, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(right, forwards), forwards])
        x, y, depth = (points @ axes.T).T
        place = np.zeros(3)
        back = np.inf
        # A point is in the picture where |x - place| <= tangent (depth - back): two bounds on each side.
        for axis, (across, half) in enumerate(((x, tangent), (y, tangent * aspect))):
            high, low = (across - half * depth).max(), (-across - half * depth).max()
            place[axis] = 0.5 * (high - low)
            back = min(back, -0.5 * (high + low) / half)
        place[2] = back
        return cls(place @ axes, axes, tangent)

    def depth(self, points: np.ndarray) -> np.ndarray:
        """How far ahead points (*, 3) are [m]."""
        return np.asarray((points - self.place) @ self.axes[2])

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Where points (*, 3) [m] are in the picture, (*, 2), its width from -1 to 1."""
        seen = (points - self.place) @ self.axes.T
        return np.asarray(seen[..., :2] / (self.tangent * seen[..., 2:]))

    def sphere(self, centre: np.ndarray, radius: float) -> tuple[np.ndarray, float]:
        """Middle (2,) and radius of a sphere in the picture; that it is an ellipse there is not seen."""
        return self(centre), radius / (self.tangent * float(self.depth(centre)))


def around(*points: np.ndarray) -> np.ndarray:
    """Points (P, 3) [m], each with `MARGIN` on all sides."""
    corners = MARGIN * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    given = np.concatenate([np.reshape(each, (-1, 3)) for each in points])
    return np.asarray((given[:, None] + corners).reshape(-1, 3))

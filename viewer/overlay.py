"""HTML file of a motion reconstructed from a film: the human in 3D and, over it, the keypoints of the images.

A keypoint is drawn on its camera ray, a little in front of the reconstructed human: seen from the film's camera, the
initial view of the page, it lies where the image has it, and a line to its point on the human shows the reprojection
error.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from larp_model.errors import InputError
from larp_model.files import write_whole
from larp_model.scene import Scene
from larp_model.state import SIZE
from viewer.replay import animation_html, with_caption
from viewer.scene_view import REFERENCE, THIN, SceneView
from viewer.server import close_server, open_server
from viewer.stage import ground

KEYPOINT = (204, 51, 17)
LEGEND = "in colour: executed, white: kinematic start, red: keypoints, and how far off they are"


@dataclass(frozen=True, eq=False)
class Overlay:
    """Motions and keypoints that are drawn over each other, in the world frame.

    states, start: (T, L, 13) every `scene.dt`, the executed motion and the kinematic one before physics. keypoints,
    body_points: (F, P, 3) [m] at `rate` frames a second, keypoints on their rays, NaN if there are none, and the points
    of the human that they belong to. camera: its position (3,) and a point (3,) it looks at [m]. field_of_view: from
    top to bottom [rad].
    """

    scene: Scene
    states: np.ndarray
    start: np.ndarray
    keypoints: np.ndarray
    body_points: np.ndarray
    rate: float
    camera: tuple[np.ndarray, np.ndarray]
    field_of_view: float
    summary: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        links = len(self.scene.links)
        for name in ("states", "start"):
            value = getattr(self, name)
            if np.ndim(value) != 3 or value.shape[1:] != (links, SIZE) or not np.isfinite(value).all():
                raise InputError(f"{name} has shape {np.shape(value)}, but needs finite (T, {links}, {SIZE})")
        if (
            np.ndim(self.keypoints) != 3
            or np.shape(self.keypoints) != np.shape(self.body_points)
            or np.shape(self.keypoints)[2] != 3
        ):
            shapes = f"{np.shape(self.keypoints)} and {np.shape(self.body_points)}"
            raise InputError(f"keypoints and body_points have shapes {shapes}, not one")

    def at(self, row: int) -> np.ndarray:
        """Return keypoints and their points on the human (K, 2, 3) [m], of the frame nearest to a row of the states."""
        frame = min(round(row * self.scene.dt * self.rate), len(self.keypoints) - 1)
        pairs = np.stack([self.keypoints[frame], self.body_points[frame]], axis=1)
        existing: np.ndarray = pairs[np.isfinite(pairs).all(axis=(1, 2))]
        return existing.astype(np.float32)


def overlay_page(overlay: Overlay) -> str:
    """Return the page as HTML."""
    server, scene = open_server(port=0), overlay.scene
    try:
        with server.atomic():
            ground(server)
            human = SceneView(server, scene, "/human")
            start = SceneView(server, scene, "/start", REFERENCE, 0.4, THIN)
            first_pairs = overlay.at(0)
            points = server.scene.add_point_cloud(
                "/keypoints", first_pairs[:, 0], KEYPOINT, point_size=0.02, point_shape="circle", precision="float32"
            )
            lines = server.scene.add_line_segments("/apart", first_pairs, KEYPOINT, thickness=0.006)
        view = server.initial_camera
        view.fov, (view.position, view.look_at) = overlay.field_of_view, overlay.camera

        def show(row: int) -> None:
            pairs = overlay.at(row)
            with server.atomic():
                human.update(overlay.states[row])
                start.update(overlay.start[row])
                points.points, lines.points = pairs[:, 0], pairs

        page = animation_html(server, min(len(overlay.states), len(overlay.start)), scene.dt, show)
    finally:
        close_server(server)
    return with_caption(page, "Motion from keypoints", [*overlay.summary, LEGEND])


def write_overlay(overlay: Overlay, path: str | Path) -> None:
    """Write the page to an HTML file."""
    write_whole(path, overlay_page(overlay).encode())

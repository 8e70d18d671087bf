"""What stands around a scene: ground, light and camera; the target, both paths, and how far they miss it."""

from __future__ import annotations

import numpy as np
import viser

from larp_model.scene import Scene
from larp_model.state import POSITION
from viewer.recording import nearest_approach
from viewer.scene_view import PREDICTION, TARGET, TRUTH, Colour, SceneView

LEGEND = "orange: truth, blue: prediction, green: target"
GROUND, LINES = (238, 240, 242), (196, 202, 209)


class Stage:
    """Draws the truth and, as a ghost, what the model expected of it."""

    def __init__(self, server: viser.ViserServer, scene: Scene, target: np.ndarray, traced: int = -1) -> None:
        """target: (3,) [m]. traced: row in the state of the link whose path is drawn."""
        self._server, self._target, self._traced = server, np.asarray(target, float), traced
        with server.atomic():
            server.scene.reset()
            server.scene.set_up_direction("+z")
            server.scene.configure_environment_map("studio", environment_intensity=0.6)
            server.scene.add_grid(
                "/ground",
                60.0,
                60.0,
                cell_size=0.5,
                section_size=1.0,
                section_thickness=1.5,
                cell_color=LINES,
                section_color=LINES,
                plane_color=GROUND,
                plane_opacity=1.0,
                shadow_opacity=0.25,
                fade_distance=30.0,
            )
            radius = scene.links[traced].radius
            server.scene.add_icosphere(
                "/target", radius, TARGET, opacity=0.45, cast_shadow=False, position=self._target
            )
            top = self._target + np.array([0.0, 0.0, radius])
            self._label = server.scene.add_label("/nearest", "", position=top, anchor="bottom-center", visible=False)
            self._truth = SceneView(server, scene, "/truth")
            self._ghost = SceneView(server, scene, "/prediction", PREDICTION, opacity=0.4)
            self._ghost.update(None)
            reach = max(2.0, float(np.linalg.norm(self._target[:2])))
            server.initial_camera.fov = 0.7
            server.initial_camera.position = 0.5 * self._target + reach * np.array([-0.35, -1.1, 0.4])
            server.initial_camera.look_at = 0.5 * self._target + np.array([0.0, 0.0, 0.25])

    def show(self, state: np.ndarray, expected: np.ndarray | None = None) -> None:
        """Move the truth to `state` (L, 13) and the ghost to `expected` (L, 13), or hide it."""
        with self._server.atomic():
            self._truth.update(state)
            self._ghost.update(expected)

    def trace(self, path: np.ndarray, expected: np.ndarray | None = None) -> float:
        """Draw the paths (T, 3) of the truth and (T', 3) of the prediction [m].

        Returns how near the true one comes to the target [m], which the target's label says in cm.
        """
        approach = nearest_approach(path, self._target)
        with self._server.atomic():
            self._line("/path/truth", path, TRUTH, 0.02)
            self._line("/path/nearest", np.stack([approach.point, self._target]), TARGET, 0.01)
            if expected is not None:
                self._line("/path/prediction", expected, PREDICTION, 0.02)
            self._label.text, self._label.visible = f"{100.0 * approach.distance:.1f} cm", True
        return approach.distance

    def position(self, state: np.ndarray) -> np.ndarray:
        """(*, 3) [m] of the traced link in states (*, L, 13)."""
        return np.asarray(state)[..., self._traced, POSITION]

    def _line(self, name: str, points: np.ndarray, colour: Colour, thickness: float) -> None:
        segments = np.stack([points, np.roll(points, -1, axis=0)], axis=1)[: max(1, len(points) - 1)]
        self._server.scene.add_line_segments(name, segments.astype(np.float32), colour, thickness=thickness)

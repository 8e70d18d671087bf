"""Surroundings of a scene: pitch, light and goal; and lanes, in each of which a kick is drawn."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import viser
from matplotlib import colormaps

from larp_model.scene import Scene
from larp_model.state import POSITION
from viewer.camera import PictureCamera, View, around
from viewer.recording import Recording, nearest_approach
from viewer.scene_view import (
    ESTIMATE,
    GRID,
    GROUND_TRUTH,
    MARKINGS,
    PITCH,
    PREDICTION,
    REFERENCE,
    TARGET,
    THICK,
    THIN,
    Colour,
    SceneView,
    sky,
)

LEGEND = "orange: truth, blue: prediction, white: reference, yellow: estimate, magenta: target"
POSTS, NET = (255, 255, 255), (222, 230, 226)
GOAL = (6.0, 3.0, 2.0)  # m: how far ahead it stands, how wide and how high it is; for scale alone
GOAL_AREA = (1.5, 5.0)  # m: how far it reaches from the goal, how wide it is
GOAL_LINE, LINE_WIDTH = 20.0, 0.05  # m: its length; the width of all markings
FIELD_OF_VIEW = 0.7  # rad, from top to bottom
FAR = 5  # m, up to which the ground has distance labels
GOAL_CORNERS = np.array([(GOAL[0], y * GOAL[1], z * GOAL[2]) for y in (-0.5, 0.5) for z in (0.0, 1.0)])
SKY_SHARE = 0.35  # of the picture, in which the sky fades towards the horizon
# Colour map of candidates' paths, and the parts of it for the cheapest and the most expensive one.
FAN, CHEAP, DEAR = "plasma", 0.97, 0.05


class Lane:
    """Drawing of one kick: ground truth, prediction and reference as ghosts, both paths, target and miss."""

    def __init__(
        self, server: viser.ViserServer, scene: Scene, name: str, target: np.ndarray, traced: int, offset_y: float = 0.0
    ) -> None:
        """Add the lane to the scene.

        name: in Viser's tree. target: (3,) [m]. traced: row of the link whose path is drawn. offset_y: of the lane [m].
        """
        self._server, self._name, self._traced = server, name, traced
        self._radius = scene.links[traced].radius
        self._root = server.scene.add_frame(name, show_axes=False, position=(0.0, offset_y, 0.0))
        self._ball = server.scene.add_icosphere(
            f"{name}/target", self._radius, TARGET, opacity=0.7, cast_shadow=False, receive_shadow=False
        )
        self._label = server.scene.add_label(f"{name}/nearest", "target", anchor="bottom-center")
        self._ground_truth = SceneView(server, scene, f"{name}/truth")
        self._ghosts = {
            "prediction": SceneView(server, scene, f"{name}/prediction", PREDICTION, 0.45, THIN),
            "reference": SceneView(server, scene, f"{name}/reference", REFERENCE, 0.4, THIN),
            "estimate": SceneView(server, scene, f"{name}/estimate", ESTIMATE, 0.35, THICK),
        }
        for ghost in self._ghosts.values():
            ghost.update(None)
        self._lines = dict[str, viser.LineSegmentsHandle]()
        self.visible_ghosts = set(self._ghosts)
        self.aim(target)

    def aim(self, target: np.ndarray) -> None:
        """Move the target to (3,) [m]."""
        self.target = np.asarray(target, float)
        self._ball.position = self.target
        self._label.position = self.target + np.array([0.0, 0.0, self._radius])

    def show(self, state: np.ndarray, **ghosts: np.ndarray | None) -> None:
        """Move the ground truth to a state (L, 13) and each ghost to its own, or hide it; the reference has no ball."""
        if (reference := ghosts.get("reference")) is not None:
            ghosts["reference"] = without_ball = np.array(reference)
            without_ball[self._traced] = np.nan
        with self._server.atomic():
            self._ground_truth.update(state)
            for name, ghost in self._ghosts.items():
                ghost.update(ghosts.get(name) if name in self.visible_ghosts else None)

    def trace(self, path: np.ndarray | None, expected: np.ndarray | None = None, new: bool = True) -> float:
        """Draw the paths (T, 3) of the ground truth and (T', 3) of the prediction [m]; None: there is none.

        new: whether the prediction is new; otherwise it has already been drawn.

        Returns the least distance [m] of the true path from the target or, as long as that path still comes nearer, of
        the predicted one; inf without a path. A label at the target shows it in cm.
        """
        with self._server.atomic():
            self._line("truth", path, GROUND_TRUTH, 0.025)
            if new:
                self._line("expected", expected, PREDICTION, 0.015)
            paths = {
                kind: kind_path for kind, kind_path in (("", path), (" expected", expected)) if kind_path is not None
            }
            approaches = {kind: nearest_approach(kind_path, self.target) for kind, kind_path in paths.items()}
            if not approaches:
                self._label.text = "target"
                return float("inf")
            if len(approaches) > 1 and np.linalg.norm(approaches[""].point - paths[""][-1]) < self._radius:
                del approaches[""]  # the true path still approaches the target
            kind, approach = next(iter(approaches.items()))
            self._line("miss", np.stack([approach.point, self.target]), TARGET, 0.012)
            self._label.text = f"target: {100.0 * approach.distance:.1f} cm{kind}"
        return approach.distance

    def fan(self, paths: np.ndarray | None, costs: np.ndarray | None = None) -> None:
        """Draw candidates' paths (N, T, 3) [m], coloured by the rank of their costs (N,), if these are finite."""
        node = f"{self._name}/path/fan"
        if paths is None or costs is None or not (is_finite := np.isfinite(costs)).any():
            self._server.scene.remove_by_name(node)
            return
        paths, costs = paths[is_finite], costs[is_finite]
        rank = np.argsort(np.argsort(costs)) / max(1, len(costs) - 1)
        colours = (255.0 * colormaps[FAN](CHEAP + (DEAR - CHEAP) * rank)[:, :3]).astype(np.uint8)
        segments = np.stack([paths[:, :-1], paths[:, 1:]], axis=2).reshape(-1, 2, 3)
        segment_colours = np.broadcast_to(colours[:, None, None], (len(paths), paths.shape[1] - 1, 2, 3)).reshape(
            -1, 2, 3
        )
        self._server.scene.add_line_segments(node, segments.astype(np.float32), segment_colours, thickness=0.01)

    def position(self, state: np.ndarray) -> np.ndarray:
        """Return positions (*, 3) [m] of the traced link in states (*, L, 13)."""
        return np.asarray(state)[..., self._traced, POSITION]

    def remove(self) -> None:
        """Remove the lane from the scene."""
        self._root.remove()

    def _line(self, name: str, points: np.ndarray | None, colour: Colour, thickness: float) -> None:
        line = self._lines.get(name)
        if points is None or len(points) == 0:
            if line is not None:
                line.visible = False
            return
        segments = np.stack([points, np.roll(points, -1, axis=0)], axis=1)[: max(1, len(points) - 1)].astype(np.float32)
        if line is None:
            node = f"{self._name}/path/{name}"
            self._lines[name] = self._server.scene.add_line_segments(node, segments, colour, thickness=thickness)
        else:  # updating a line takes a fraction of the time of adding one
            line.points, line.visible = segments, True


class Stage:
    """Pitch with one kick on it, or two side by side."""

    def __init__(self, server: viser.ViserServer, scene: Scene, target: np.ndarray, traced: int = -1) -> None:
        """Draw the pitch and the scene.

        target: (3,) [m]. traced: row in the state of the link whose path is drawn.
        """
        self._server, self.scene, self._traced = server, scene, traced
        with server.atomic():
            server.scene.reset()
            _pitch(server)
            self.lane = Lane(server, scene, "/kick", target, traced)
        self.beside: Lane | None = None

    def compare(self, target: np.ndarray | None, offset_y: float = -2.5) -> Lane | None:
        """Replace the second lane, `offset_y` [m] beside the first, by one with this target, or by none; return it."""
        if self.beside is not None:
            self.beside.remove()
            self.beside = None
        if target is not None:
            with self._server.atomic():
                self.beside = Lane(self._server, self.scene, "/beside", target, self._traced, offset_y)
        return self.beside

    def frame(self, points: np.ndarray) -> None:
        """Set the points (P, 3) [m] that cameras must see, and the camera of newly opened pages and of a reset view."""
        self._visible_points = around(points, GOAL_CORNERS)
        camera = self.camera("side", 1.6)
        initial = self._server.initial_camera
        initial.fov, initial.position, initial.look_at = FIELD_OF_VIEW, camera.position, self.look_at_point(camera)

    def camera(self, view: View, aspect: float) -> PictureCamera:
        """Return the camera that sees all points set by `frame`. aspect: width over height of its picture."""
        return PictureCamera.of(self._visible_points, 1.0 / aspect, view, float(np.tan(0.5 * FIELD_OF_VIEW)) * aspect)

    def look_at_point(self, camera: PictureCamera) -> np.ndarray:
        """Return the point (3,) [m] that a camera orbits: on its axis, at the mean depth of the points of `frame`."""
        depth = float(camera.depth(self._visible_points).mean())
        return np.asarray(camera.position + depth * camera.axes[2])


def points_in_view(recording: Recording) -> np.ndarray:
    """Return the points (P, 3) [m] of a recording that a camera must see.

    They are the links of the first state, the path of the ball up to its target, and the target.
    """
    approach = nearest_approach(recording.path, recording.target)
    target = np.asarray(recording.target, float)
    return np.concatenate([recording.states[0, :, POSITION], recording.path[: approach.row + 2], target[None]])


def ground(server: viser.ViserServer) -> None:
    """Add the ground with a metre grid, the sky, the upward direction and the light."""
    server.scene.set_up_direction("+z")
    # Without Viser's environment map: it fades in over several frames, and a slow browser shows a pale scene meanwhile.
    server.scene.configure_environment_map(None)
    server.scene.add_light_hemisphere("/sky", ground_color=(225, 222, 205), intensity=1.6)
    server.scene.set_background_image(np.repeat(sky(SKY_SHARE), 2, axis=1), "png")
    server.scene.add_grid(
        "/ground",
        120.0,
        120.0,
        cell_size=1.0,
        section_size=5.0,
        section_thickness=1.0,
        cell_color=GRID,
        section_color=GRID,
        plane_color=PITCH,
        plane_opacity=1.0,
        shadow_opacity=0.45,
        fade_distance=60.0,
    )


def _pitch(server: viser.ViserServer) -> None:
    """Add the ground with a metre grid, markings and distance labels, and a goal."""
    ground(server)
    _goal(server)
    ahead, (reach, width) = GOAL[0], GOAL_AREA
    corners = [(ahead, -0.5 * width), (ahead - reach, -0.5 * width), (ahead - reach, 0.5 * width), (ahead, 0.5 * width)]
    ends = [((ahead, -0.5 * GOAL_LINE), (ahead, 0.5 * GOAL_LINE)), *pairwise(corners)]
    lines = np.pad(np.array(ends, np.float32), ((0, 0), (0, 0), (0, 1)), constant_values=0.005)
    server.scene.add_line_segments("/ground/markings", lines, MARKINGS, thickness=LINE_WIDTH)
    for metre in range(1, FAR + 1):
        server.scene.add_label(
            f"/ground/{metre}",
            f"{metre} m",
            position=(float(metre), -2.0, 0.0),
            font_screen_scale=0.7,
        )


def _goal(server: viser.ViserServer) -> None:
    """Add the goal: posts, a bar and a net."""
    ahead, width, height = GOAL
    for name, size, position in (
        ("left", (0.08, 0.08, height), (ahead, 0.5 * width, 0.5 * height)),
        ("right", (0.08, 0.08, height), (ahead, -0.5 * width, 0.5 * height)),
        ("bar", (0.08, width + 0.08, 0.08), (ahead, 0.0, height)),
    ):
        server.scene.add_box(f"/goal/{name}", POSTS, size, position=position)
    across = np.linspace(-0.5, 0.5, 13) * width
    slope = [(ahead + 0.8 * share, height * (1.0 - share)) for share in np.linspace(0.0, 1.0, 9)]
    net = [((ahead, y, height), (ahead + 0.8, y, 0.0)) for y in across]
    net += [((x, across[0], z), (x, across[-1], z)) for x, z in slope]
    server.scene.add_line_segments("/goal/net", np.array(net, np.float32), NET, thickness=0.01)

"""Meshes in Viser for the links of a scene, moved by packed states."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import combinations

import numpy as np
import viser
from scipy.spatial.transform import Rotation
from trimesh.creation import revolve, uv_sphere

from larp_model.errors import InputError
from larp_model.scene import Link, Scene
from larp_model.state import ORIENTATION, POSITION, SIZE

Colour = tuple[int, int, int]
Mesh = tuple[np.ndarray, np.ndarray]  # vertices (V, 3) [m], faces (F, 3)

TRUNK, LEFT, RIGHT = (38, 52, 110), (0, 104, 204), (236, 92, 0)
BALL_PATCHES = ((246, 246, 243), (38, 40, 46))  # hexagons, pentagons
# Distinct for all eyes, on the pitch and on white: after Okabe and Ito, but for a target that no lawn hides.
GROUND_TRUTH, PREDICTION, REFERENCE, TARGET = (213, 94, 0), (0, 114, 178), (250, 250, 250), (204, 20, 122)
ESTIMATE = (240, 228, 66)
PITCH, GRID, MARKINGS = (126, 163, 112), (147, 183, 133), (238, 244, 234)
# Radii of ghosts, as multiples of the links': a thin one shows only where it differs from the solid links and does not
# veil them; a thick one always shows.
THIN, THICK = 0.96, 1.2
ZENITH, HORIZON = (118, 166, 214), (230, 239, 246)  # of the sky


def link_colour(link: Link) -> Colour:
    """Return the colour of a link, by the side of the body that its name begins with."""
    return LEFT if link.name.startswith("left") else RIGHT if link.name.startswith("right") else TRUNK


def sky(share: float = 1.0, rows: int = 256) -> np.ndarray:
    """Return a picture (rows, 1, 3) of the sky, with values from 0 to 255.

    share: of its height in which it fades to the colour of the horizon, from above.
    """
    fade = np.clip(np.arange(rows) / (share * rows), 0.0, 1.0)[:, None, None]
    return np.asarray((1.0 - fade) * ZENITH + fade * HORIZON, np.uint8)


def weld(triangles: np.ndarray) -> Mesh:
    """Return the mesh of triangles (F, 3, 3) [m], with shared corners for smooth shading, without degenerate ones."""
    corners = np.round(triangles.reshape(-1, 3), 9) + 0.0
    vertices, faces = np.unique(corners, axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return vertices.astype(np.float32), faces[distinct].astype(np.uint32)


@cache
def unit_meshes(sides: int = 24) -> tuple[Mesh, Mesh]:
    """Return a ball of radius 1 m and an open tube along z of radius and length 1 m.

    Scaled and joined, they make up any capsule.
    """
    ball = uv_sphere(1.0, count=(sides // 2, sides))
    tube = revolve(np.array([(1.0, -0.5), (1.0, 0.5)]), sections=sides)
    as_mesh = [(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32)) for mesh in (ball, tube)]
    return as_mesh[0], as_mesh[1]


@cache
def football_meshes(radius: float, subdivisions: int = 3) -> tuple[Mesh, Mesh]:
    """Return meshes of the 20 hexagons and the 12 pentagons of a football. radius [m].

    It is a truncated icosahedron, its faces subdivided and projected on the sphere.
    """
    golden = 0.5 * (1.0 + 5.0**0.5)
    vertices = [np.roll((0.0, y, z), turn) for y in (-1.0, 1.0) for z in (-golden, golden) for turn in range(3)]
    hexagons, pentagons = [], []
    for a, b, c in combinations(vertices, 3):
        if max(np.linalg.norm(p - q) for p, q in combinations((a, b, c), 2)) > 2.1:
            continue  # no face of the icosahedron, whose edges have length 2
        if np.linalg.det([a, b, c]) < 0.0:
            b, c = c, b
        edge_points = [(2.0 * p + q) / 3.0 for p, q in ((a, b), (b, a), (b, c), (c, b), (c, a), (a, c))]
        centre = (a + b + c) / 3.0
        hexagons += [(centre, edge_points[i - 1], edge_points[i]) for i in range(6)]
        pentagons += [
            (a, edge_points[0], edge_points[5]),
            (b, edge_points[2], edge_points[1]),
            (c, edge_points[4], edge_points[3]),
        ]

    def sphere(triangles: Sequence[Sequence[np.ndarray]]) -> Mesh:
        pieces = np.array(triangles)
        for _ in range(subdivisions):
            a, b, c = pieces[:, 0], pieces[:, 1], pieces[:, 2]
            ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
            corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
            pieces = np.concatenate([np.stack(corner, axis=1) for corner in corners])
        return weld(radius * pieces / np.linalg.norm(pieces, axis=-1, keepdims=True))

    return sphere(hexagons), sphere(pentagons)


class Capsules:
    """Capsules of links, two balls and a tube each: all balls are one node of Viser's tree, all tubes another.

    With a node per link, each frame would take dozens of messages, and their time would be taken from the planner.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        links: Sequence[Link],
        name: str,
        colours: Sequence[Colour],
        opacity: float | None,
        thickness: float = 1.0,
    ) -> None:
        """Add the capsules to the scene.

        name: in Viser's tree. colours: of each link. opacity: in (0, 1), or None. thickness: multiplies their radii.
        """
        radii = thickness * np.array([link.radius for link in links])
        self._to_end = np.array([0.5 * link.length * np.array(link.axis) for link in links])
        self._along = Rotation.concatenate([Rotation.align_vectors(link.axis, (0.0, 0.0, 1.0))[0] for link in links])
        self._sizes = np.stack([radii, radii, [link.length for link in links]], axis=-1)

        def batch(kind: str, mesh: Mesh, sizes: np.ndarray, colours: np.ndarray) -> viser.BatchedMeshHandle:
            return server.scene.add_batched_meshes_simple(
                f"{name}/{kind}",
                *mesh,
                np.tile((1.0, 0.0, 0.0, 0.0), (len(sizes), 1)),
                np.zeros((len(sizes), 3)),
                batched_scales=sizes,
                batched_colors=colours,
                lod="off",
                opacity=opacity,
                cast_shadow=opacity is None,
            )

        (ball, tube), colour_array = unit_meshes(), np.array(colours, np.uint8)
        self.ends = batch("ends", ball, np.tile(radii, 2), np.tile(colour_array, (2, 1)))
        self.tubes = batch("tubes", tube, self._sizes, colour_array)
        self._is_known = np.ones(len(links), bool)

    def move(self, state: np.ndarray) -> None:
        """Move the links to a state (n, 13); those without a known state (NaN) shrink to nothing."""
        is_known = np.isfinite(state).all(axis=1)
        state = np.where(is_known[:, None], state, np.arange(SIZE) == ORIENTATION.start)
        position, rotation = state[:, POSITION], Rotation.from_quat(state[:, ORIENTATION], scalar_first=True)
        to_end = rotation.apply(self._to_end)
        self.ends.batched_positions = np.concatenate([position - to_end, position + to_end])
        self.tubes.batched_positions = position
        self.tubes.batched_wxyzs = (rotation * self._along).as_quat(scalar_first=True)
        if not np.array_equal(is_known, self._is_known):
            self.ends.batched_scales = np.tile(is_known * self._sizes[:, 0], 2)
            self.tubes.batched_scales = is_known[:, None] * self._sizes
            self._is_known = is_known


class SceneView:
    """Drawing of all links of a scene under one name."""

    def __init__(
        self,
        server: viser.ViserServer,
        scene: Scene,
        name: str,
        colour: Colour | None = None,
        opacity: float | None = None,
        thickness: float = 1.0,
    ) -> None:
        """Add the links to the scene.

        name: in Viser's tree. colour: of all links, instead of their own ones. opacity: in (0, 1), or None. thickness:
        multiplies their radii.
        """
        self._server, self._links = server, len(scene.links)
        self._root = server.scene.add_frame(name, show_axes=False)
        self._balls = {}
        for body in scene.bodies:
            if body.is_ball:
                node, radius = f"{name}/{body.name}", thickness * body.links[0].radius
                self._balls[scene.rows(body.name).start] = server.scene.add_frame(node, show_axes=False)
                vertices, faces = unit_meshes()[0]
                meshes = ((radius * vertices, faces),) if colour else football_meshes(radius)
                for part, (mesh, part_colour) in enumerate(
                    zip(meshes, (colour,) if colour else BALL_PATCHES, strict=True)
                ):
                    server.scene.add_mesh_simple(
                        f"{node}/{part}", *mesh, color=part_colour, opacity=opacity, cast_shadow=opacity is None
                    )
        self._rows = np.array([row for row in range(self._links) if row not in self._balls], int)
        links = [scene.links[row] for row in self._rows]
        colours = [colour or link_colour(link) for link in links]
        self.capsules = Capsules(server, links, f"{name}/capsules", colours, opacity, thickness) if links else None

    def update(self, state: np.ndarray | None) -> None:
        """Move the links to a state (L, 13); hide those without a known state (NaN), or all if it is None."""
        if state is not None and np.shape(state) != (self._links, SIZE):
            raise InputError(f"state has shape {np.shape(state)}, but needs ({self._links}, {SIZE})")
        with self._server.atomic():
            self._root.visible = state is not None
            if state is None:
                return
            state = np.asarray(state, float)
            for row, ball in self._balls.items():
                ball.visible = bool(np.isfinite(state[row]).all())
                if ball.visible:
                    ball.position, ball.wxyz = state[row, POSITION], state[row, ORIENTATION]
            if self.capsules:
                self.capsules.move(state[self._rows])

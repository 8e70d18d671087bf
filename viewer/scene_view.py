"""The links of a scene as meshes in Viser, moved by packed states."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from itertools import combinations

import numpy as np
import viser
from trimesh.creation import capsule
from trimesh.geometry import align_vectors

from larp_model.scene import Link, Scene, Vector
from larp_model.state import ORIENTATION, POSITION, SIZE

Colour = tuple[int, int, int]
Mesh = tuple[np.ndarray, np.ndarray]  # vertices (V, 3) [m], faces (F, 3)

TRUNK, LEFT, RIGHT = (92, 107, 133), (112, 178, 217), (233, 160, 60)
BALL_PATCHES = ((246, 246, 243), (38, 40, 46))  # hexagons, pentagons
# Okabe and Ito's, safe for all eyes.
TRUTH, PREDICTION, TARGET, REFERENCE = (213, 94, 0), (0, 114, 178), (0, 158, 115), (110, 116, 126)


def link_colour(link: Link) -> Colour:
    """The colour of a link by the side of the body that its name tells."""
    return LEFT if link.name.startswith("left") else RIGHT if link.name.startswith("right") else TRUNK


def weld(triangles: np.ndarray) -> Mesh:
    """The mesh of triangles (F, 3, 3) [m]: corners shared, so that it shades smoothly; no empty ones."""
    corners = np.round(triangles.reshape(-1, 3), 9) + 0.0
    vertices, faces = np.unique(corners, axis=0, return_inverse=True)
    faces = faces.reshape(-1, 3)
    distinct = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    return vertices.astype(np.float32), faces[distinct].astype(np.uint32)


def capsule_mesh(length: float, radius: float, axis: Vector = (0.0, 0.0, 1.0), sides: int = 32) -> Mesh:
    """A capsule at the origin; length [m] between its hemispheres' centres, 0 makes a ball; radius [m]."""
    upright = capsule(length, radius, count=(sides // 2, sides), transform=align_vectors((0.0, 0.0, 1.0), axis))
    return upright.vertices.astype(np.float32), upright.faces.astype(np.uint32)


@cache
def football_meshes(radius: float, subdivisions: int = 3) -> tuple[Mesh, Mesh]:
    """The 20 hexagons and the 12 pentagons of a football, a truncated icosahedron blown up. radius [m]."""
    golden = 0.5 * (1.0 + 5.0**0.5)
    tips = [np.roll((0.0, y, z), turn) for y in (-1.0, 1.0) for z in (-golden, golden) for turn in range(3)]
    hexagons, pentagons = [], []
    for a, b, c in combinations(tips, 3):
        if max(np.linalg.norm(p - q) for p, q in combinations((a, b, c), 2)) > 2.1:
            continue  # no face of the icosahedron, whose edges have length 2
        if np.linalg.det([a, b, c]) < 0.0:
            b, c = c, b
        rim = [(2.0 * p + q) / 3.0 for p, q in ((a, b), (b, a), (b, c), (c, b), (c, a), (a, c))]
        centre = (a + b + c) / 3.0
        hexagons += [(centre, rim[i - 1], rim[i]) for i in range(6)]
        pentagons += [(a, rim[0], rim[5]), (b, rim[2], rim[1]), (c, rim[4], rim[3])]

    def sphere(triangles: Sequence[Sequence[np.ndarray]]) -> Mesh:
        parts = np.array(triangles)
        for _ in range(subdivisions):
            a, b, c = parts[:, 0], parts[:, 1], parts[:, 2]
            ab, bc, ca = 0.5 * (a + b), 0.5 * (b + c), 0.5 * (c + a)
            corners = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
            parts = np.concatenate([np.stack(corner, axis=1) for corner in corners])
        return weld(radius * parts / np.linalg.norm(parts, axis=-1, keepdims=True))

    return sphere(hexagons), sphere(pentagons)


class SceneView:
    """All links of a scene, drawn under one name."""

    def __init__(
        self,
        server: viser.ViserServer,
        scene: Scene,
        name: str,
        colour: Colour | None = None,
        opacity: float | None = None,
    ) -> None:
        """name: in Viser's tree. colour: one for all links, not their own. opacity: in (0, 1), or None."""
        self._server = server
        self._root = server.scene.add_frame(name, show_axes=False)
        self._links = []
        for body in scene.bodies:
            for link in body.links:
                place = f"{name}/{body.name}/{link.name}"
                self._links.append(server.scene.add_frame(place, show_axes=False))
                meshes = [capsule_mesh(link.length, link.radius, link.axis)]
                colours = [colour or link_colour(link)]
                if body.is_ball and colour is None:
                    meshes, colours = list(football_meshes(link.radius)), list(BALL_PATCHES)
                for part, ((vertices, faces), own) in enumerate(zip(meshes, colours, strict=True)):
                    server.scene.add_mesh_simple(
                        f"{place}/{part}",
                        vertices,
                        faces,
                        color=own,
                        opacity=opacity,
                        cast_shadow=opacity is None,
                    )

    def update(self, state: np.ndarray | None) -> None:
        """Move the links to a state (L, 13); hide those whose state is not known (NaN), or all if it is None."""
        if state is not None and np.shape(state) != (len(self._links), SIZE):
            raise ValueError(f"state has shape {np.shape(state)}, but needs ({len(self._links)}, {SIZE})")
        with self._server.atomic():
            self._root.visible = state is not None
            if state is not None:
                for link, row in zip(self._links, np.asarray(state, float), strict=True):
                    link.visible = bool(np.isfinite(row).all())
                    if link.visible:
                        link.position, link.wxyz = row[POSITION], row[ORIENTATION]

"""Figure that is fitted to an image: our human's joints in a pose, with free size and proportions."""

from __future__ import annotations

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.bodies import human, segment_of
from larp_model.rotation import from_rotation_vector, matrix
from larp_model.scene import Body, Vector
from tasks.pose.points import FEET, POINTS, SIDES
from tasks.pose.rows import by_rows, single

# Sizes that may differ from the usual: links' lengths (0), and the torso's radius (1), which sets the shoulder width.
PROPORTIONS = (
    ("pelvis", 0), ("torso", 0), ("torso", 1), ("head", 0),
    ("upper_arm", 0), ("lower_arm", 0), ("thigh", 0), ("shin", 0), ("foot", 0),
)  # fmt: skip
# Points that are joints, and the link that each carries.
JOINTS = {"shoulder": "upper_arm", "elbow": "lower_arm", "hip": "thigh", "knee": "shin", "ankle": "foot"}
# Places of the other points on their links, in the units of joints' anchors: along the axis in half-lengths, across it
# in radii. A wrist is at the end of the forearm (0.146 of the height, D. Winter).
ON_LIMBS: dict[str, tuple[str, Vector]] = {
    "wrist": ("lower_arm", (0.0, 0.0, -0.7)),
    "heel": ("foot", (-1.3, 0.0, -0.6)),
    "toe": ("foot", (1.35, 0.0, -0.6)),
}
ON_HEAD: dict[str, Vector] = {"nose": (1.0, 0.0, 0.0), "left_ear": (0.0, 0.8, 0.2), "right_ear": (0.0, -0.8, 0.2)}
SHARED = 1 + len(PROPORTIONS) + 1
# Height of the usual human [m].
USUAL_HEIGHT = 1.75
# Height of heel and toe where the foot stands [m].
SOLE_HEIGHT = 0.017


class Pose(NamedTuple):
    """Pose of the figure in T frames: pelvis (T, 3) [m], its rotation (T, 3, 3), joint angles (T, J, 3) [rad]."""

    place: np.ndarray
    turn: np.ndarray
    angles: np.ndarray


class Figure:
    """Human whose points follow from its pose and proportions.

    Proportions (11,) are logarithms of ratios: first the size relative to the usual human, then each of `PROPORTIONS`
    relative to that size. The last one is no logarithm: the shift of the shoulder points ahead of the trunk, in lengths
    of the torso.
    """

    def __init__(self) -> None:
        self.body = human(height=USUAL_HEIGHT)
        self.sizes = self.body.sizes
        names = [link.name for link in self.body.links]
        self.anchors = {name: (names.index("head"), anchor) for name, anchor in ON_HEAD.items()}
        for side in SIDES:
            for limb, segment in JOINTS.items():
                link = names.index(f"{side}_{segment}")
                self.anchors[f"{side}_{limb}"] = link, self.body.joints[link - 1].child_anchor
            for limb, (segment, anchor) in ON_LIMBS.items():
                self.anchors[f"{side}_{limb}"] = names.index(f"{side}_{segment}"), anchor
        self.joints, self.torso = len(self.body.joints), names.index("torso")
        self.lower, self.upper = self.body.limits
        scale_map = np.zeros((len(PROPORTIONS), len(names), 2))
        for row, (segment, column) in enumerate(PROPORTIONS):
            scale_map[row, [segment_of(name) == segment for name in names], column] = 1.0
        self._scale_map = scale_map

    def scaled(self, proportions: Array) -> Array:
        """Return lengths and radii (n, 2) [m] of the links."""
        log_scale = proportions[0] + jnp.einsum("p,pnk->nk", proportions[1:-1], jnp.asarray(self._scale_map))
        return jnp.asarray(self.sizes[:, :2]) * jnp.exp(log_scale)

    def body_of(self, proportions: np.ndarray) -> Body:
        """Return the human of these proportions; its mass scales with the cube of the overall size."""
        sizes = np.array(self.sizes)
        sizes[:, :2] = np.asarray(self.scaled(jnp.asarray(proportions)), float)
        sizes[:, 2] *= np.exp(3.0 * float(proportions[0]))
        return self.body.sized(sizes)

    @partial(jax.jit, static_argnums=0)
    def height(self, proportions: Array) -> Array:
        """Return the standing height [m], in proportion to the nose's height above the heels."""

        def nose_height(proportions: Array) -> Array:
            points = self.points(jnp.zeros(3), jnp.eye(3), jnp.zeros((self.joints, 3)), proportions)
            return points[POINTS.index("nose"), 2] - points[FEET[0], 2]

        return USUAL_HEIGHT * nose_height(proportions) / nose_height(jnp.zeros(SHARED))

    def points(self, place: Array, turn: Array, angles: Array, proportions: Array) -> Array:
        """Return points (P, 3) [m] of one pose: pelvis (3,) [m], its rotation (3, 3), joint angles (J, 3) [rad]."""
        sizes = self.scaled(proportions)
        joint_rotations = matrix(from_rotation_vector(angles))
        positions, rotations = [place], [turn]

        def anchor_offset(link: int, anchor: Vector) -> Array:
            axis = np.asarray(self.body.links[link].axis)
            axial = np.asarray(anchor) @ axis * axis
            local: Array = 0.5 * sizes[link, 0] * axial + sizes[link, 1] * (np.asarray(anchor) - axial)
            return rotations[link] @ local

        for child, joint in enumerate(self.body.joints, start=1):
            rotations.append(rotations[joint.parent] @ joint_rotations[child - 1])
            joint_position = positions[joint.parent] + anchor_offset(joint.parent, joint.parent_anchor)
            positions.append(joint_position - anchor_offset(child, joint.child_anchor))
        anchored = {
            name: positions[link] + anchor_offset(link, anchor) for name, (link, anchor) in self.anchors.items()
        }
        shoulder_shift = proportions[-1] * sizes[self.torso, 0] * rotations[self.torso][:, 0]
        return jnp.stack([anchored[name] + shoulder_shift if "shoulder" in name else anchored[name] for name in POINTS])

    def all_points(self, pose: Pose, proportions: np.ndarray) -> np.ndarray:
        """Return the points (T, P, 3) [m] of all frames."""
        single_proportions = single(proportions)
        points: np.ndarray = by_rows(lambda *pose_rows: _all_points(self, *pose_rows, single_proportions), *pose)
        return points


@cache
def figure() -> Figure:
    """Return the figure that all films share, made once."""
    return Figure()


_all_points = jax.jit(lambda figure, *pose_rows: jax.vmap(figure.points, (0, 0, 0, None))(*pose_rows), static_argnums=0)

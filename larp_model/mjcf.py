"""A humanoid from an MJCF file, in the links and joints of our lean human.

Every body of the file is one of our links, by its name, or is fixed to the link above it; the hinges between two links
become one ball joint at their mean position, and welded links get a servo. Links keep their mass, the place of their
joints, and the length and volume of their geoms; the whole is turned to stand and face x, legs and arms to hang, as
ours do in rest, and servos and bounds of joints are ours, in proportion. What does not fit is refused by name.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from larp_model.bodies import human, segment_of
from larp_model.errors import InputError
from larp_model.names import require_file, require_known
from larp_model.scene import Body, Joint, Link, Vector

# Names of our segments in files, without sides.
SYNONYMS = {
    "pelvis": ("pelvis", "hips"),
    "torso": ("torso", "chest", "trunk", "spine"),
    "head": ("head",),
    "upper_arm": ("upperarm", "uarm", "arm", "shoulder"),
    "lower_arm": ("lowerarm", "larm", "forearm", "elbow"),
    "thigh": ("thigh", "upperleg", "upleg"),
    "shin": ("shin", "lowerleg", "calf", "knee"),
    "foot": ("foot", "ankle"),
}
# Segments that hang down in our rest pose, whatever the file's.
HANGING = ("upper_arm", "lower_arm", "thigh", "shin")
# Least length of a link, in its radius: anchors along a link are in units of its length.
ROUNDEST = 0.1
# Largest distance of a link's ends from the origin [m].
FARTHEST = 1000.0
# Share of a foot's extent by which its middle may be behind the ankle.
BEHIND = 0.1
DOWN = np.array([0.0, 0.0, -1.0])


class LinkGeometry(NamedTuple):
    """A link as the file has it: ends (G, 2, 3) and radii (G,) of its geoms [m], and its mass [kg]."""

    ends: np.ndarray
    radii: np.ndarray
    mass: float


class FileJoint(NamedTuple):
    """A link's joint with its parent: its place (3,) [m], in the middle of its hinges, and whether it is welded."""

    place: np.ndarray
    welded: bool


def humanoid(source: str | Path, names: Mapping[str, str] | None = None, name: str = "human") -> Body:
    """Return the humanoid of an MJCF file as a human of 13 links: see above. `bodies.kicking` gives it a ball.

    It stands and faces x, however it stands or lies in the file. names: those of our links in the file, {"left_shin":
    "calf_l", ...}; by default usual names are recognised. InputError where a link is missing, a joint is no hinge or
    ball, a geom is neither capsule nor sphere, bodies are tied by more than joints, or left and right are exchanged.
    """
    path = Path(source)
    require_file("source", path)
    try:
        path.read_bytes().decode()  # MuJoCo gives names back as such
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise InputError(
            f"source: {path.name} is no MJCF file that MuJoCo reads: {str(error).splitlines()[0]}"
        ) from None
    for element, count in (("equality constraints", model.neq), ("tendons", model.ntendon)):
        if count:
            raise InputError(f"source: {path.name} has {count} {element}, but only joints can tie links")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    usual = human(name)
    body_of_link = _named(path.name, model, [link.name for link in usual.links], dict(names or {}))
    owners = _owners(path.name, model, body_of_link)
    geometries = [_geometry(path.name, model, data, owners, link) for link in body_of_link]
    joints = _joints(path.name, model, data, body_of_link, usual)
    feet = {link: geometry for link, geometry in zip(body_of_link, geometries, strict=True) if link.endswith("_foot")}
    turn = _turn_to_ours(path.name, joints, feet)
    geometries = [geometry._replace(ends=_turned(turn, geometry.ends)) for geometry in geometries]
    joints = {link: joint._replace(place=turn.apply(joint.place)) for link, joint in joints.items()}
    return _assembled(usual, geometries, joints)


def _turned(turn: Rotation, points: np.ndarray) -> np.ndarray:
    turned: np.ndarray = turn.apply(points.reshape(-1, 3)).reshape(points.shape)
    return turned


def _turn_to_ours(file: str, joints: Mapping[str, FileJoint], feet: Mapping[str, LinkGeometry]) -> Rotation:
    """Return the rotation after which a humanoid stands along z and faces x: a right angle's multiple where it is near.

    Left is from the right hip to the left one, up from the hips to the neck. InputError where the feet then point back.
    """
    hips = np.array([joints[f"{side}_thigh"].place for side in ("left", "right")])
    left, up = hips[0] - hips[1], joints["head"].place - hips.mean(axis=0)
    if not min(np.linalg.norm(left), np.linalg.norm(np.cross(left, up))) > 1e-6:
        raise InputError(f"source: {file} has hips and neck at one place, or in a line, so that it faces nowhere")
    turn, _ = Rotation.align_vectors([(0.0, 1.0, 0.0), (0.0, 0.0, 1.0)], [left, up], [np.inf, 1.0])
    right_angles = np.round(turn.as_matrix())
    if np.isclose(np.linalg.det(right_angles), 1.0):
        turn = Rotation.from_matrix(right_angles)
    ahead, extents = 0.0, 0.0
    for link, geometry in feet.items():
        ends = _turned(turn, geometry.ends)[..., 0]
        ahead += float(ends.mean() - turn.apply(joints[link].place)[0])
        extents += float(np.ptp(ends) + 2.0 * geometry.radii.max())
    if ahead < -BEHIND * extents:
        raise InputError(f"source: {file} has feet that point backwards: its left and right are exchanged")
    return turn


def _named(file: str, model: mujoco.MjModel, links: Sequence[str], names: dict[str, str]) -> dict[str, int]:
    """Return the number of the file's body that each of our links is."""
    bodies = [model.body(row).name for row in range(1, model.nbody)]
    for link in names:
        require_known("names", link, links)
    body_of_link = {}
    for link in links:
        candidates = [names[link]] if link in names else [body for body in bodies if usual_name(body) == link]
        if len(candidates) != 1 or candidates[0] not in bodies:
            number = "several bodies" if len(candidates) > 1 else "no body"
            named = ", ".join(" ".join(body.split()) for body in bodies)
            raise InputError(f"source: {file} has {number} for {link!r}, but needs one; it has {named}")
        body_of_link[link] = int(model.body(candidates[0]).id)
    return body_of_link


def _owners(file: str, model: mujoco.MjModel, body_of_link: Mapping[str, int]) -> dict[int, str]:
    """Return the link of ours that each of the file's bodies is, or is fixed to."""
    owners = {body: link for link, body in body_of_link.items()}
    for body in range(1, model.nbody):  # parents come first
        parent = int(model.body_parentid[body])
        if body not in owners and parent not in owners:
            raise InputError(
                f"source: {file}: {model.body(body).name!r} is none of a human's links, and on none of them"
            )
        owners.setdefault(body, owners.get(parent, ""))
    return owners


def usual_name(body: str) -> str | None:
    """Return the link of ours that a body of this name usually is: "R_Thigh", "thigh_right" are the "right_thigh"."""
    parts = [part for part in re.split(r"[^a-z]+", re.sub(r"([a-z])([A-Z])", r"\1_\2", body).lower()) if part]
    sides = {"left": "left_", "l": "left_", "right": "right_", "r": "right_"}
    side = next((sides[part] for part in parts if part in sides), "")
    word = "".join(part for part in parts if part not in sides)
    segment = next((ours for ours, theirs in SYNONYMS.items() if word in theirs), None)
    paired = segment not in ("pelvis", "torso", "head")
    return None if segment is None or paired != bool(side) else side + segment


def _geometry(
    file: str, model: mujoco.MjModel, data: mujoco.MjData, owners: Mapping[int, str], link: str
) -> LinkGeometry:
    """Return the geoms and the mass of a link in the file."""
    rows = [body for body, owner in owners.items() if owner == link]
    ends, radii = [], []
    for geom in np.flatnonzero(np.isin(model.geom_bodyid, rows)):
        kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
        if kind not in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE):
            kind_name, body = kind.name.removeprefix("mjGEOM_").lower(), model.body(model.geom_bodyid[geom]).name
            raise InputError(f"source: {file}: a geom of {body!r} is a {kind_name}, but must be a capsule or a sphere")
        half = size[1] * data.geom_xmat[geom].reshape(3, 3)[:, 2] * (kind == mujoco.mjtGeom.mjGEOM_CAPSULE)
        ends.append((data.geom_xpos[geom] - half, data.geom_xpos[geom] + half))
        radii.append(size[0])
    if not ends:
        raise InputError(f"source: {file}: {link!r} has no geom, but needs a capsule or a sphere")
    if not (farthest := float(np.abs(ends).max() + max(radii))) <= FARTHEST:
        raise InputError(f"source: {file}: {link!r} reaches to {farthest:.3g} m, but must be within {FARTHEST:g} m")
    return LinkGeometry(np.array(ends), np.array(radii), float(model.body_mass[rows].sum()))


def _joints(
    file: str, model: mujoco.MjModel, data: mujoco.MjData, body_of_link: Mapping[str, int], usual: Body
) -> dict[str, FileJoint]:
    """Return the joint of each of our links, the root apart, with its parent."""
    link_of = {body: link for link, body in body_of_link.items()}
    file_joints: dict[frozenset[str], FileJoint] = {}
    for body in link_of:
        chain, parent = [body], int(model.body_parentid[body])
        while parent and parent not in link_of:
            chain, parent = [*chain, parent], int(model.body_parentid[parent])
        if not parent:
            continue
        hinges = np.flatnonzero(np.isin(model.jnt_bodyid, chain))
        for hinge in hinges:
            kind = mujoco.mjtJoint(model.jnt_type[hinge])
            if kind not in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL):
                kind_name = kind.name.removeprefix("mjJNT_").lower()
                raise InputError(
                    f"source: {file}: joint {model.joint(hinge).name!r} is a {kind_name}, but must be a hinge"
                )
        place = data.xanchor[hinges].mean(axis=0) if len(hinges) else data.xpos[body]
        file_joints[frozenset((link_of[body], link_of[parent]))] = FileJoint(place, not len(hinges))
    joints = {}
    for link, joint in zip(usual.links[1:], usual.joints, strict=True):
        parent_name = usual.links[joint.parent].name
        if (file_joint := file_joints.get(frozenset((link.name, parent_name)))) is None:
            raise InputError(f"source: {file} does not tie {link.name!r} to {parent_name!r}, as a human's are")
        joints[link.name] = file_joint
    return joints


def _assembled(usual: Body, geometries: Sequence[LinkGeometry], joints: Mapping[str, FileJoint]) -> Body:
    """Return the usual human with links and joints where the file has them, hanging limbs turned down first."""
    below = {
        usual.links[joint.parent].name: link.name for link, joint in zip(usual.links[1:], usual.joints, strict=True)
    }
    links, centres, turns = [], [], []
    for link, geometry in zip(usual.links, geometries, strict=True):
        turn = Rotation.identity()
        if segment_of(link.name) in HANGING:
            end = joints[below[link.name]].place if link.name in below else geometry.ends.mean(axis=(0, 1))
            turn = Rotation.align_vectors([DOWN], [end - joints[link.name].place])[0]
        fitted, centre = capsule(link, turn.apply(geometry.ends.reshape(-1, 3)).reshape(-1, 2, 3), geometry)
        links.append(fitted)
        centres.append(turn.inv().apply(centre))
        turns.append(turn)
    sized = usual.sized(np.array([(link.length, link.radius, link.mass) for link in links]))

    def anchor(row: int, place: np.ndarray) -> tuple[float, float, float]:
        return dimensionless_anchor(links[row], turns[row].apply(place - centres[row]))

    def fitted_joint(child: int, joint: Joint, file_joint: FileJoint) -> Joint:
        zero: Vector = (0.0, 0.0, 0.0)
        motor = replace(joint.motor, lower=zero, upper=zero) if file_joint.welded and joint.motor else joint.motor
        return Joint(joint.parent, anchor(joint.parent, file_joint.place), anchor(child, file_joint.place), motor)

    fitted_joints = (
        fitted_joint(child, *pair)
        for child, pair in enumerate(zip(sized.joints, joints.values(), strict=True), start=1)
    )
    return replace(sized, links=tuple(links), joints=tuple(fitted_joints))


def capsule(link: Link, ends: np.ndarray, geometry: LinkGeometry) -> tuple[Link, np.ndarray]:
    """Return the capsule along a link's axis that is as long and as voluminous as its geoms, and its centre (3,) [m].

    ends: (G, 2, 3) of the geoms [m]. Of extent E the volume is pi r^2 E - 2 pi r^3 / 3, and grows with r up to a ball.
    """
    axis = np.array(link.axis)
    along, radii = ends @ axis, geometry.radii
    low, high = (along.min(axis=1) - radii).min(), (along.max(axis=1) + radii).max()
    spans = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    volumes = np.pi * radii**2 * (spans + 4.0 / 3.0 * radii)
    extent, volume = high - low, volumes.sum()
    radius = 0.5 * extent
    if volume < np.pi * extent**3 / 6.0:
        radius = brentq(lambda r: np.pi * r**2 * (extent - 2.0 * r / 3.0) - volume, 0.0, radius)
    centre = volumes @ ends.mean(axis=1) / volume
    centre += (0.5 * (low + high) - centre @ axis) * axis
    return replace(
        link, length=max(extent - 2.0 * radius, ROUNDEST * radius), radius=radius, mass=geometry.mass
    ), centre


def dimensionless_anchor(link: Link, place: np.ndarray) -> tuple[float, float, float]:
    """Return a place on a link, (3,) from its centre [m], as a dimensionless anchor; see `scene.Joint`."""
    axis = np.array(link.axis)
    along = (place @ axis) * axis
    x, y, z = along / (0.5 * link.length) + (place - along) / link.radius
    return float(x), float(y), float(z)

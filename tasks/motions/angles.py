"""Motions given as joint angles of our own human, from Python or from an npz file."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model.bodies import human
from larp_model.errors import InputError
from larp_model.files import arrays_of
from larp_model.names import require_file
from larp_model.scene import Body, Vector, anchor
from tasks.motions.skeleton import LIMBS, SIDES, Motion

FIELDS = ("rate", "position", "orientation", "angles")
RATE_RANGE = (10.0, 1000.0)


class _ChildJoint(NamedTuple):
    """Joint with the link that it carries.

    parent: row of the parent joint. offset: from the parent's joint [m], in the parent link's frame. to_rest: rotation
    to the T-pose.
    """

    name: str
    link: int
    parent: int
    offset: np.ndarray
    to_rest: Rotation


def load(path: str | Path) -> Motion:
    """Return the motion of an npz file that names its arrays as `motion` its arguments; joints (J,) is optional."""
    path = Path(path)
    require_file("path", path)
    try:
        arrays = arrays_of(path)
    except Exception:  # numpy and zipfile raise many kinds for a damaged file
        raise InputError(f"{path.name} is no npz file of numbers and names") from None
    if missing := [name for name in FIELDS if name not in arrays]:
        raise InputError(f"{path.name} has no {', '.join(missing)}: it needs {', '.join(FIELDS)}")
    names = arrays.get("joints")
    joints = None if names is None else [str(name) for name in np.atleast_1d(names)]
    try:
        return motion(arrays["rate"], arrays["position"], arrays["orientation"], arrays["angles"], joints)
    except InputError as error:
        raise InputError(f"{path.name}: {error}") from None


def motion(
    rate: float | np.ndarray,
    position: np.ndarray,
    orientation: np.ndarray,
    angles: np.ndarray,
    joints: list[str] | None = None,
) -> Motion:
    """Return the motion of our human of 1.75 m by forward kinematics; `skeleton.retarget` recovers its angles.

    rate: frames a second. position: of the pelvis (T, 3) [m], world frame, z up. orientation: of the pelvis (T, 4), w,
    x, y, z. angles: (T, J, 3) rotation vectors [rad] of the child links' joints, from their parents, in the order of
    the human's motors or of `joints`, which names the child links. With all angles zero, the human stands upright with
    hanging arms. Raises a ValueError where an argument has another shape or value.
    """
    body = human()
    names = [body.links[child].name for child, _, _ in body.motors]
    rate, position, orientation, angles = (
        _numbers(name, value)
        for name, value in (("rate", rate), ("position", position), ("orientation", orientation), ("angles", angles))
    )
    frames, count = len(position) if position.ndim else 0, len(names)
    for name, value, shape in (
        ("rate", rate, ()),
        ("position", position, (frames, 3)),
        ("orientation", orientation, (frames, 4)),
        ("angles", angles, (frames, count, 3)),
    ):
        if value.shape != shape or not frames:
            needed = {"rate": "()", "position": "(T, 3)", "orientation": "(T, 4)", "angles": f"(T, {count}, 3)"}[name]
            raise InputError(f"{name} has shape {value.shape}, but needs {needed}, the same T in all")
        if not np.isfinite(value).all():
            raise InputError(f"{name} holds numbers that are not finite")
    if not RATE_RANGE[0] <= rate <= RATE_RANGE[1]:
        raise InputError(f"rate is {rate:g}, but must be from {RATE_RANGE[0]:g} to {RATE_RANGE[1]:g} frames a second")
    if abs(np.linalg.norm(orientation, axis=-1) - 1.0).max() > 1e-3:
        raise InputError("orientation holds quaternions that are not of length 1")
    if joints is not None:
        if sorted(joints) != sorted(names):
            raise InputError(f"joints are {', '.join(joints)}, but must be {', '.join(names)}, in any order")
        angles = angles[:, [joints.index(name) for name in names]]
    rotations = Rotation.from_quat(body.pose(orientation, angles).swapaxes(0, 1), scalar_first=True)
    return _motion_of_links(body, float(rate), position, rotations)


def _numbers(name: str, value: object) -> np.ndarray:
    try:
        numbers = np.array(value)
        return numbers.astype(float, casting="safe" if numbers.dtype.kind == "c" else "unsafe")
    except (TypeError, ValueError):
        raise InputError(f"{name} holds something that is not a number") from None


def _joint_anchor(body: Body, point: Vector, link: int) -> np.ndarray:
    """Return a joint's anchor (3,) [m] in the frame of a link of the body."""
    length, radius, _ = body.sizes[link]
    return anchor(point, np.array(length), np.array(radius), body.links[link].axis)


def _motion_of_links(body: Body, rate: float, position: np.ndarray, rotations: Rotation) -> Motion:
    """Return the motion with joints at the human's, their frames parallel to the world's in a T-pose."""
    joints = _child_joints(body)
    positions, offsets = [position], [np.zeros(3)]
    for joint in joints[1:]:
        parent = joints[joint.parent]
        positions.append(positions[joint.parent] + rotations[parent.link].apply(joint.offset))
        offsets.append(parent.to_rest.apply(joint.offset))
    orientations = [(rotations[joint.link] * joint.to_rest.inv()).as_quat(scalar_first=True) for joint in joints]
    return Motion(
        tuple(joint.name for joint in joints),
        np.array([joint.parent for joint in joints]),
        np.array(offsets),
        rate,
        np.stack(positions, axis=1),
        np.stack(orientations, axis=1),
    )


def _child_joints(body: Body) -> list[_ChildJoint]:
    """Return the joints of a captured motion on the links of our human, parents first."""
    to_t_pose = {  # rotation of hanging arms to a T-pose's
        side: Rotation.from_rotvec((0.5 * np.pi * (1.0 if side == "Left" else -1.0), 0.0, 0.0)) for side in SIDES
    }
    links = {link.name: row for row, link in enumerate(body.links)}
    unturned = Rotation.identity()
    joints = [_ChildJoint("Hips", 0, -1, np.zeros(3), unturned)]
    row_of = {"Hips": 0}

    def add(name: str, link: int, parent: str, offset: np.ndarray, to_rest: Rotation) -> None:
        row_of[name] = len(joints)
        joints.append(_ChildJoint(name, link, row_of[parent], offset, to_rest))

    add("Spine", links["torso"], "Hips", _joint_offset(body, links["torso"]), unturned)
    add("Head", links["head"], "Spine", _joint_offset(body, links["head"]), unturned)
    for side in SIDES:
        parents = {
            "Arm": "Spine",
            "ForeArm": f"{side}Arm",
            "UpLeg": "Hips",
            "Leg": f"{side}UpLeg",
            "Foot": f"{side}Leg",
        }
        for segment, name in LIMBS.items():
            link, to_rest = links[f"{side.lower()}_{segment}"], to_t_pose[side] if "arm" in segment else unturned
            add(side + name, link, parents[name], _joint_offset(body, link), to_rest)
            if name == "ForeArm":
                add(f"{side}Hand", link, side + name, _end_offset(body, link, np.array([0.0, 0.0, -1.0])), to_rest)
            if name == "Foot":
                add(f"{side}ToeBase", link, side + name, _end_offset(body, link, np.array([1.0, 0.0, 0.0])), to_rest)
    return joints


def _joint_offset(body: Body, link: int) -> np.ndarray:
    """Return the vector from the parent's joint to the link's own joint, in the parent link's frame."""
    joint = body.joints[link - 1]
    parent_joint = np.zeros(3)
    if joint.parent:
        parent_joint = _joint_anchor(body, body.joints[joint.parent - 1].child_anchor, joint.parent)
    offset: np.ndarray = _joint_anchor(body, joint.parent_anchor, joint.parent) - parent_joint
    return offset


def _end_offset(body: Body, link: int, direction: np.ndarray) -> np.ndarray:
    """Return the vector from the link's joint to one end of its axis, in the link's frame."""
    link_joint = _joint_anchor(body, body.joints[link - 1].child_anchor, link)
    offset: np.ndarray = 0.5 * body.links[link].length * direction - link_joint
    return offset

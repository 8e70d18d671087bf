"""Strict reader and writer of BVH files, as captured motions.

A BVH file is a tree of joints with offsets and, for every frame, the angles of all joints (M. Meredith and S. Maddock,
"Motion capture file formats explained", 2001). Here its joints have MotionBuilder's names, as in B. Hahne's conversion
of the Carnegie Mellon motion capture database; a table for each other skeleton gives the names in its files. Files have
y up and face z, or another axis up, as head and feet of the person tell; here z is up, x forward and y left.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from textwrap import shorten

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from larp_model.names import require_file
from tasks.motions.rest_pose import rest_orientations
from tasks.motions.skeleton import ENDS, NEEDED, SIDES, Motion, bone, facing, is_t_pose

# The bones of the Carnegie Mellon database's own ASF files, each named at the joint where it begins.
BONES = {
    "Arm": "humerus",
    "ForeArm": "radius",
    "Hand": "wrist",
    "UpLeg": "femur",
    "Leg": "tibia",
    "Foot": "foot",
    "ToeBase": "toes",
}
ASF = {"Head": "head", **{side + name: side[0].lower() + bone for side in SIDES for name, bone in BONES.items()}}
# Joints of Biovision's and Xsens' files.
_JOINTS = {
    "Arm": "Shoulder", "ForeArm": "Elbow", "Hand": "Wrist", "UpLeg": "Hip", "Leg": "Knee", "Foot": "Ankle",
    "ToeBase": "Toe",
}  # fmt: skip
# Names of the needed joints in the files of each known skeleton; Mixamo's names are MotionBuilder's, prefixed.
SKELETONS = {
    "MotionBuilder": {name: name for name in NEEDED},
    "LAFAN1": {name: name.replace("ToeBase", "Toe") for name in NEEDED},
    "ASF": {"Hips": "root", **ASF},
    "Biovision": {name: name for name in ("Hips", "Head")}
    | {side + name: side + own for side in SIDES for name, own in _JOINTS.items()},
}
# Metres in one unit of a file: the Carnegie Mellon conversions', a centimetre, a metre, an inch, a foot, a millimetre.
# The length of the legs decides.
UNITS = (0.0254 / 0.45, 0.01, 1.0, 0.0254, 0.3048, 0.001)
LEG_LENGTH = (0.6, 1.2)
_OURS = {"X": "Y", "Y": "Z", "Z": "X"}  # our axis for each of a file's axes; positions are reordered accordingly
_TO_OURS, _TO_FILE = [2, 0, 1], [1, 2, 0]
_ROTATION_CHANNELS = ("Zrotation", "Xrotation", "Yrotation")
_LARGEST = 1e6
_END = " (end)"
_PREFIX = re.compile(r"^(.*:|mixamorig\d*_)")  # of a whole skeleton, as in mixamorig:Hips
_FRAMES, _FRAME_TIME = re.compile(r"Frames:\s*(\d+)"), re.compile(r"Frame Time:\s*(\S+)")
# Largest angle of limbs that hang from vertical, and of their feet from straight ahead [rad].
HANGING = 0.3
# Share of the distance from feet to head that is along the axis that is up, at least.
UPRIGHT = 0.8
# Share of the feet's length that the toes are ahead of the heels, in the direction that the hips face, at least.
AHEAD = -0.3


def load(path: str | Path, names: Mapping[str, str] | None = None) -> Motion:
    """Read a BVH file; an InputError of one line names what is missing, damaged or not understood.

    names: the file's names of the joints of `NEEDED`, {"Hips": "pelvis", ...}; joints left out have our names. By
    default, the table of `SKELETONS` that fits the file best. Prefixes, as in mixamorig:Hips, are removed. Toes that a
    file does not have are at the end sites of the feet. The rest pose is the first frame if that is a T-pose, which is
    then left out, else the pose without rotations if that is one or if all limbs hang, else the estimate of `rest_pose`
    from the frames.
    """
    path = Path(path)
    require_file("path", path)
    tables = list(SKELETONS.values()) if names is None else [_table(names)]
    try:
        joints, duration, data = _parse(path.read_bytes().decode("utf-8-sig", "replace").splitlines())
        return _motion_in_metres(_renamed(joints, tables), duration, data)
    except InputError as error:
        raise InputError(f"{path.name} {error}") from None


def dumps(motion: Motion) -> str:
    """Return a motion as the text of a BVH file in centimetres, with its own joint names; `load` reads it back.

    Every joint rotates about z, x and y, in a file's axes; the root also has positions. Bones that carry no joint get
    an end site 5 cm away.
    """
    children = [np.flatnonzero(motion.parents == row) for row in range(len(motion.names))]
    order: list[int] = []
    lines = ["HIERARCHY"]

    def offset_line(offset: np.ndarray) -> str:
        return "OFFSET " + " ".join(f"{100.0 * value + 0.0:.6f}" for value in offset[_TO_FILE])

    def add_joint(row: int, depth: int) -> None:
        order.append(row)
        margin, root = "  " * depth, motion.parents[row] < 0
        channel_list = "6 Xposition Yposition Zposition" if root else "3"
        lines.extend((f"{margin}{'ROOT' if root else 'JOINT'} {motion.names[row]}", margin + "{"))
        lines.extend(
            (
                f"{margin}  {offset_line(motion.offsets[row])}",
                f"{margin}  CHANNELS {channel_list} {' '.join(_ROTATION_CHANNELS)}",
            )
        )
        for child in children[row]:
            add_joint(int(child), depth + 1)
        if not len(children[row]):
            direction = motion.offsets[row] / max(float(np.linalg.norm(motion.offsets[row])), 1e-9)
            lines.extend(
                (f"{margin}  End Site", margin + "  {", f"{margin}    {offset_line(0.05 * direction)}", margin + "  }")
            )
        lines.append(margin + "}")

    add_joint(0, 0)
    columns = [100.0 * motion.positions[:, 0, _TO_FILE]]
    for row in order:
        rotation, parent = motion.rotation(motion.names[row]), motion.parents[row]
        local = motion.rotation(motion.names[parent]).inv() * rotation if parent >= 0 else rotation
        columns.append(local.as_euler("".join(_OURS[channel[0]] for channel in _ROTATION_CHANNELS), degrees=True))
    lines += ["MOTION", f"Frames: {len(motion.positions)}", f"Frame Time: {1.0 / motion.rate:.8f}"]
    lines += [" ".join(f"{value + 0.0:.6f}" for value in frame) for frame in np.concatenate(columns, axis=1)]
    return "\n".join(lines) + "\n"


def names_in(path: Path) -> dict[str, str]:
    """Return the table of joint names in a JSON file, for `load`."""
    require_file("names", path)
    try:
        names = json.loads(path.read_bytes())
    except ValueError:
        raise InputError(f"names: {path.name} is no JSON file") from None
    if not (isinstance(names, dict) and all(isinstance(name, str) for name in names.values())):
        raise InputError(f'names: {path.name} needs an object such as {{"Hips": "pelvis", "LeftLeg": "l_knee"}}')
    return names


def _table(names: Mapping[str, str]) -> dict[str, str]:
    """Return a user's table completed with our names; InputError where it has unknown joints or one name twice."""
    if unknown := [str(name) for name in names if name not in NEEDED]:
        raise InputError(f"names has {', '.join(unknown)}, but needs a file's names of {', '.join(NEEDED)}")
    table = {name: _PREFIX.sub("", names.get(name, name)) for name in NEEDED}
    if len(set(table.values())) < len(table):
        repeated = next(file_name for file_name in table.values() if list(table.values()).count(file_name) > 1)
        our_names = " and ".join(name for name, file_name in table.items() if file_name == repeated)
        raise InputError(f"names has {repeated!r} for {our_names}, but needs another joint for each")
    return table


@dataclass(frozen=True)
class _FileJoint:
    """A joint, or the end site of one, which has no channels."""

    name: str
    parent: int
    offset: list[float]
    channels: list[str]


def _parse(lines: list[str]) -> tuple[list[_FileJoint], float, np.ndarray]:
    """Return the joints, seconds per frame and channels (T, C) of a file, in its own unit and axes."""
    rows = [(number, line.split()) for number, line in enumerate(lines, start=1) if line.strip()]
    start = next((index for index, (_, words) in enumerate(rows) if words == ["MOTION"]), None)
    if start is None or rows[0][1] != ["HIERARCHY"]:
        raise InputError("is no BVH file: it needs a line HIERARCHY first and a line MOTION later")
    joints = _hierarchy(word for _, words in rows[1:start] for word in words)
    head = [" ".join(words) for _, words in rows[start + 1 : start + 3]]
    matches = [pattern.fullmatch(line) for pattern, line in zip((_FRAMES, _FRAME_TIME), head, strict=False)]
    if len(matches) < 2 or matches[0] is None or matches[1] is None:
        raise InputError("has no frames: it needs lines 'Frames: N' and 'Frame Time: SECONDS' after MOTION")
    count, seconds = (match[1] for match in matches if match)
    (duration,) = _numbers([seconds], 1, "has a Frame Time that")
    if not 0.0 < duration <= 0.1:
        raise InputError(f"has a Frame Time of {duration:g} s, but needs one above 0 and up to 0.1 s")
    columns = sum(len(joint.channels) for joint in joints)
    data = [_numbers(words, columns, f"has a line, {number}, that") for number, words in rows[start + 3 :]]
    # Some writers count one frame too many or too few.
    if not data or abs(len(data) - int(count[:9])) > 1:
        raise InputError(f"has {len(data) or 'no'} frames, but announces {count[:9]}")
    return joints, duration, np.array(data)


def _numbers(words: list[str], count: int, place: str) -> list[float]:
    if len(words) != count:
        raise InputError(f"{place} has {len(words)} columns, but needs {count}")
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{place} holds something that is not a number") from None
    if not all(abs(value) < _LARGEST for value in values):
        raise InputError(f"{place} holds a number that is not finite, or not below {_LARGEST:g}")
    return values


def _hierarchy(words: Iterator[str]) -> list[_FileJoint]:
    """Return the tree of joints and end sites, parents first."""
    joints: list[_FileJoint] = []
    ancestors: list[int] = []

    def expect(*expected: str) -> None:
        for word in expected:
            if (actual := next(words, "its end")) != word:
                raise InputError(f"has {actual[:40]!r} in its HIERARCHY, but needs {word!r} there")

    for word in words:
        if word == "}" and ancestors:
            ancestors.pop()
        elif word == "End" and ancestors:
            expect("Site", "{", "OFFSET")
            offset = _numbers(list(islice(words, 3)), 3, "has an End Site that")
            expect("}")
            joints.append(_FileJoint(_end_name(joints, ancestors[-1]), ancestors[-1], offset, []))
        elif word == ("JOINT" if ancestors else "ROOT") and (ancestors or not joints):
            name = _PREFIX.sub("", next(words, ""))
            expect("{", "OFFSET")
            offset = _numbers(list(islice(words, 3)), 3, f"has a joint, {name}, that")
            expect("CHANNELS")
            count = next(words, "")
            kinds = ("rotation",) if ancestors and count != "6" else ("position", "rotation")
            expected = [axis + kind for kind in kinds for axis in "XYZ"]
            channels = list(islice(words, len(expected)))
            if count != str(len(expected)) or sorted(channels) != sorted(expected):
                raise InputError(f"has a joint, {name}, with other channels than {', '.join(expected)}, each once")
            joints.append(_FileJoint(name, ancestors[-1] if ancestors else -1, offset, channels))
            ancestors.append(len(joints) - 1)
        else:
            raise InputError(f"has {word[:40]!r} in its HIERARCHY, where it does not belong")
    names = [joint.name for joint in joints]
    if ancestors or len(set(names)) != len(names):
        raise InputError("has a HIERARCHY with " + ("braces left open" if ancestors else "two joints of one name"))
    return joints


def _end_name(joints: list[_FileJoint], parent: int) -> str:
    """Return a name for one more end site of a joint."""
    return joints[parent].name + _END * (1 + sum(joint.parent == parent and not joint.channels for joint in joints))


def _without_prefix(names: list[str]) -> list[str]:
    """Return names without what all of them begin with, up to an underscore, as in Character1_Hips."""
    first, last = min(names, default=""), max(names, default="")
    same = next((place for place, pair in enumerate(zip(first, last, strict=False)) if len({*pair}) > 1), 0)
    prefix = first[: first.rfind("_", 0, same) + 1]
    return [name.removeprefix(prefix) for name in names]


def _with_toes_at_ends(table: dict[str, str], file_names: set[str], sites: set[str]) -> dict[str, str]:
    """Return the table with the end sites of the feet in place of toes that a file does not have."""
    ends = {side + "ToeBase": table[side + "Foot"] + _END for side in SIDES}
    return table | {name: end for name, end in ends.items() if table[name] not in file_names and end in sites}


def _without(joints: list[_FileJoint], sites: set[str]) -> list[_FileJoint]:
    """Return the joints without these end sites."""
    rows = [row for row, joint in enumerate(joints) if joint.name not in sites]
    return [
        replace(joints[row], parent=rows.index(joints[row].parent) if joints[row].parent >= 0 else -1) for row in rows
    ]


def _renamed(joints: list[_FileJoint], tables: list[dict[str, str]]) -> list[_FileJoint]:
    """Return the joints, the needed ones renamed to ours by the first table with the fewest missing."""
    full_names = [joint.name for joint in joints]
    short_names = dict(zip(full_names, _without_prefix(full_names), strict=True))
    joints = [replace(joint, name=short_names[joint.name]) for joint in joints]
    tables = [{name: short_names.get(own, own) for name, own in table.items()} for table in tables]
    sites = {joint.name for joint in joints if not joint.channels}
    tables = [_with_toes_at_ends(table, {joint.name for joint in joints}, sites) for table in tables]
    joints = _without(joints, sites - {own for table in tables for own in table.values()})
    file_names = [joint.name for joint in joints]
    table = min(tables, key=lambda table: len(set(table.values()) - set(file_names)))
    if missing := {our_name: file_name for our_name, file_name in table.items() if file_name not in file_names}:
        raise InputError(
            f"has no joints {', '.join(missing.values())}, but needs them, or names that say what it calls"
            f" {', '.join(missing)}: it has {shorten(', '.join(file_names), 600)}"
        )
    our_name = {file_name: name for name, file_name in table.items()}
    # Another joint of the file may have a name that is one of ours.
    return [
        replace(joint, name=our_name.get(joint.name, f"{joint.name} (other)" if joint.name in NEEDED else joint.name))
        for joint in joints
    ]


def _motion_in_metres(joints: list[_FileJoint], duration: float, data: np.ndarray) -> Motion:
    """Return the motion of all frames, in metres, with joint frames made parallel in the rest pose."""
    channels = np.concatenate([_unrotated(joints)[None], data])
    unscaled = _upright(_forward_kinematics(joints, duration, channels))
    thighs, shins = ([bone(unscaled, side + joint)[0] for side in SIDES] for joint in ("UpLeg", "Leg"))
    leg_length = float(np.linalg.norm(thighs, axis=-1).mean() + np.linalg.norm(shins, axis=-1).mean())
    unit = next((unit for unit in UNITS if LEG_LENGTH[0] <= unit * leg_length <= LEG_LENGTH[1]), None)
    if unit is None:
        raise InputError(
            f"has legs {leg_length:.3g} units long, but needs 0.6 to 1.2 m in units of 0.0254/0.45 m, mm, cm, m, "
            "inches or feet"
        )
    if unscaled.chest == unscaled.names[0]:
        raise InputError("has no chest: its arms branch off the root")
    if _toes_ahead(unscaled.cut(1, len(channels))) < AHEAD:
        raise InputError(
            "has feet that point backwards: its axes are left-handed, or its sides exchanged; mirror x, or the names"
        )
    rest_frame = next((pose for pose in (1, 0) if is_t_pose(unscaled, pose)), None)
    if rest_frame is None and _hangs(unscaled):
        rest_frame = 0
    if rest_frame is None:
        rest, rest_frame = rest_orientations(unscaled.cut(1, len(channels))), 0
    else:
        rest = facing(unscaled, rest_frame) * Rotation.from_quat(unscaled.orientations[rest_frame], scalar_first=True)
    if len(channels) == 1 + rest_frame:
        raise InputError("has no frames but the T-pose")

    offsets = np.zeros_like(unscaled.offsets)
    offsets[1:] = rest[unscaled.parents[1:]].apply(unscaled.offsets[1:])
    rotations = Rotation.from_quat(unscaled.orientations[1 + rest_frame :].reshape(-1, 4), scalar_first=True)
    frames = len(channels) - 1 - rest_frame
    from_rest = Rotation.concatenate([rest.inv()] * frames)
    orientations = (rotations * from_rest).as_quat(scalar_first=True).reshape(frames, -1, 4)
    return replace(
        unscaled,
        offsets=unit * offsets,
        positions=unit * unscaled.positions[1 + rest_frame :],
        orientations=orientations,
    )


def _upright(motion: Motion) -> Motion:
    """Return a motion, whose first frame is the pose without rotations, turned so that z is up.

    The axis of the file is up along which the head is above the feet, in the mean over the frames; y where none is, as
    of people who lie and roll.
    """
    feet = 0.5 * (motion.path("LeftFoot") + motion.path("RightFoot"))
    spine = (motion.path("Head") - feet)[1:]
    up = np.mean(spine, axis=0) / max(float(np.mean(np.linalg.norm(spine, axis=-1))), 1e-9)
    axis = int(np.argmax(np.abs(up)))
    if (axis == 2 and up[axis] > 0.0) or abs(up[axis]) < UPRIGHT:
        return motion
    turn, _ = Rotation.align_vectors([(0.0, 0.0, 1.0)], [np.sign(up[axis]) * np.eye(3)[axis]])
    shape = motion.orientations.shape
    turned = turn * Rotation.from_quat(motion.orientations.reshape(-1, 4), scalar_first=True)
    return replace(
        motion,
        positions=turn.apply(motion.positions.reshape(-1, 3)).reshape(motion.positions.shape),
        orientations=turned.as_quat(scalar_first=True).reshape(shape),
    )


def _toes_ahead(motion: Motion) -> float:
    """Return how far the toes are ahead of the heels in the direction that the hips face, as a share of their distance.

    The mean over both feet and all frames, for one who stands.
    """
    across = motion.path("LeftUpLeg") - motion.path("RightUpLeg")
    ahead = np.stack([across[:, 1], -across[:, 0]], axis=-1)
    feet = sum(motion.path(f"{side}ToeBase") - motion.path(f"{side}Foot") for side in SIDES)[:, :2]
    lengths = np.linalg.norm(ahead, axis=-1) * np.linalg.norm(feet, axis=-1)
    return float(np.sum(ahead * feet) / max(float(np.sum(lengths)), 1e-9))


def _hangs(motion: Motion) -> bool:
    """Return whether in its first frame all limbs hang straight down and the toes are ahead, as in our rest pose."""
    bones = (bone(motion, side + joint)[0] for side in SIDES for joint in ENDS)
    hanging = all(-direction[2] > np.cos(HANGING) * np.linalg.norm(direction) for direction in bones)
    return hanging and _toes_ahead(motion.cut(0, 0)) > np.cos(HANGING)


def _unrotated(joints: list[_FileJoint]) -> np.ndarray:
    """Return the channels (C,) of the pose without rotations; joints that have positions are at their offsets."""
    values = []
    for joint in joints:
        offset = dict(zip("XYZ", joint.offset if joint.parent >= 0 else (0.0, 0.0, 0.0), strict=True))
        values += [offset[channel[0]] if channel.endswith("position") else 0.0 for channel in joint.channels]
    return np.array(values)


def _forward_kinematics(joints: list[_FileJoint], duration: float, poses: np.ndarray) -> Motion:
    """Return the motion of channels (P, C) by forward kinematics, in our axes but the file's unit and joint frames."""
    rotations: list[Rotation] = []
    positions: list[np.ndarray] = []
    column = 0
    for joint in joints:
        channels = dict(zip(joint.channels, poses.T[column : column + len(joint.channels)], strict=True))
        column += len(joint.channels)
        rotation_channels = [channel for channel in joint.channels if channel.endswith("rotation")]
        rotation = Rotation.identity(len(poses))
        if rotation_channels:
            angles = np.stack([channels[channel] for channel in rotation_channels], axis=-1)
            axes = "".join(_OURS[channel[0]] for channel in rotation_channels)
            rotation = Rotation.from_euler(axes, angles, degrees=True)
        offset = np.array(joint.offset)[_TO_OURS]
        position = np.stack([channels[f"{axis}position"] for axis in "ZXY"], axis=-1) if len(channels) > 3 else offset
        if joint.parent < 0:
            positions.append(offset + position)
            rotations.append(rotation)
        else:
            positions.append(positions[joint.parent] + rotations[joint.parent].apply(position))
            rotations.append(rotations[joint.parent] * rotation)
    return Motion(
        tuple(joint.name for joint in joints),
        np.array([joint.parent for joint in joints]),
        np.array([joint.offset for joint in joints])[:, _TO_OURS],
        1.0 / duration,
        np.stack(positions, axis=1),
        np.stack([rotation.as_quat(scalar_first=True) for rotation in rotations], axis=1),
    )

"""Strict reader and writer of BVH files, as captured motions.

A BVH file is a tree of joints with offsets and, for every frame, the angles of all joints (M. Meredith and S. Maddock,
"Motion capture file formats explained", 2001). Here its joints have MotionBuilder's names, as in B. Hahne's conversion
of the Carnegie Mellon motion capture database; `joint_names` has a table for each other skeleton. Files have y up and
face z, or another axis up; here z is up, x forward and y left. What a file does not say of itself, `Conventions` are
found from the person in it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from larp_model.names import require_file, require_known
from tasks.motions.bvh_file import BvhJoint, parse
from tasks.motions.joint_names import SKELETONS, renamed, table_of
from tasks.motions.rest_pose import rest_orientations, with_level_soles
from tasks.motions.skeleton import ENDS, SIDES, Motion, bone, facing, is_t_pose

# Metres in one unit of a file, in the order in which they are tried: the length of the legs decides.
UNITS = {"0.0254/0.45 m": 0.0254 / 0.45, "cm": 0.01, "m": 1.0, "inches": 0.0254, "feet": 0.3048, "mm": 0.001}
LEG_LENGTH = (0.6, 1.2)
# Rest poses, in the order in which they are looked for.
RESTS = ("T-pose first", "T-pose", "arms down", "estimated")
_OURS = {"X": "Y", "Y": "Z", "Z": "X"}  # our axis for each of a file's axes; positions are reordered accordingly
_TO_OURS, _TO_FILE = [2, 0, 1], [1, 2, 0]
# Our directions of those of a file that may be up.
_DIRECTIONS = {sign + axis: value * np.eye(3)[_TO_FILE["xyz".index(axis)]]
               for axis in "yzx" for sign, value in (("", 1.0), ("-", -1.0))}  # fmt: skip
_ROTATION_CHANNELS = ("Zrotation", "Xrotation", "Yrotation")
# Largest angle of limbs that hang from vertical, and of their feet from straight ahead [rad].
HANGING = 0.3
# Share of the distance from feet to head that is along the axis that is up, at least.
UPRIGHT = 0.8
# Share of the feet's length that the toes are ahead of the heels, in the direction that the hips face, at least.
AHEAD = -0.3


@dataclass(frozen=True)
class Conventions:
    """Choices that a file does not state; None: found from the person in it.

    up: axis of the file that is up, "y" or "-z", say. unit: one of `UNITS`. rest: one of `RESTS`, the pose from which
    joints turn: the first frame, which is then left out; the pose without rotations, with level or hanging arms; or one
    that is estimated from the motion.
    """

    up: str | None = None
    unit: str | None = None
    rest: str | None = None

    def __post_init__(self) -> None:
        for name, options in {"up": _DIRECTIONS, "unit": UNITS, "rest": RESTS}.items():
            if (value := getattr(self, name)) is not None:
                require_known(f"names: {name}", value, options)


def load(path: str | Path, names: Mapping[str, str] | None = None) -> Motion:
    """Read a BVH file; an InputError of one line names what is missing, damaged or not understood.

    names: the file's names of the joints of `NEEDED`, {"Hips": "pelvis", ...}; joints left out have our names. By
    default, the table of `SKELETONS` that fits the file best. They may say `Conventions` too: {"up": "z"}. Prefixes, as
    in mixamorig:Hips, are removed. Toes that a file does not have are at the end sites of the feet.

    Where it is not said, the axis is up along which the head is above the feet, the unit the one in which legs are
    human, and the rest pose the first frame if that is a T-pose, else the pose without rotations if that is one or if
    all limbs hang, else the estimate of `rest_pose` from the frames. Feet are level in a T-pose, or slanted with its
    legs, whichever makes them level as they stand. An offset of the root counts if feet are nearer the ground then.
    """
    path = Path(path)
    require_file("path", path)
    said = {name: value for name, value in (names or {}).items() if name in ("up", "unit", "rest")}
    joint_names = {name: value for name, value in (names or {}).items() if name not in said}
    conventions = Conventions(**said)
    tables = [table_of(joint_names)] if joint_names else list(SKELETONS.values())
    try:
        joints, duration, data = parse(path.read_bytes().decode("utf-8-sig", "replace").splitlines())
        return _motion_in_metres(renamed(joints, tables), duration, data, conventions)
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


def _motion_in_metres(joints: list[BvhJoint], duration: float, data: np.ndarray, said: Conventions) -> Motion:
    """Return the motion of all frames, in metres, with joint frames made parallel in the rest pose."""
    channels = np.concatenate([_unrotated(joints)[None], data])
    unscaled, up = _upright(_forward_kinematics(joints, duration, channels), said.up)
    unit = _unit(unscaled, said.unit)
    if unscaled.chest == unscaled.names[0]:
        raise InputError("has no chest: its arms branch off the root")
    if _toes_ahead(unscaled.cut(1, len(channels))) < AHEAD:
        raise InputError(
            "has feet that point backwards: its axes are left-handed, or its sides exchanged; mirror x, or the names"
        )
    rest_name = said.rest or _rest(unscaled)
    first = 2 if rest_name == "T-pose first" else 1
    if len(channels) == first:
        raise InputError("has no frames but the T-pose")
    moving = unscaled.cut(first, len(channels))
    if rest_name == "estimated":
        rest = rest_orientations(moving)
    else:
        pose = unscaled.cut(first - 1, first - 1)
        rest = facing(pose, 0) * Rotation.from_quat(pose.orientations[0], scalar_first=True)
        rest = rest if rest_name == "arms down" else with_level_soles(pose, moving, rest)
    offsets = np.zeros_like(unscaled.offsets)
    offsets[1:] = rest[unscaled.parents[1:]].apply(unscaled.offsets[1:])
    frames = len(moving.positions)
    rotations = Rotation.from_quat(moving.orientations.reshape(-1, 4), scalar_first=True)
    from_rest = Rotation.concatenate([rest.inv()] * frames)
    orientations = (rotations * from_rest).as_quat(scalar_first=True).reshape(frames, -1, 4)
    return replace(
        moving,
        offsets=UNITS[unit] * offsets,
        positions=UNITS[unit] * moving.positions,
        orientations=orientations,
        read=f"{up} up, in {unit}, rest pose: {rest_name}",
    )


def _unit(motion: Motion, said: str | None) -> str:
    """Return the unit in which the legs are human."""
    thighs, shins = ([bone(motion, side + joint)[0] for side in SIDES] for joint in ("UpLeg", "Leg"))
    length = float(np.linalg.norm(thighs, axis=-1).mean() + np.linalg.norm(shins, axis=-1).mean())
    units = [unit for unit in (UNITS if said is None else [said])
             if LEG_LENGTH[0] <= UNITS[unit] * length <= LEG_LENGTH[1]]  # fmt: skip
    if not units:
        least, most = LEG_LENGTH
        raise InputError(f"has legs {length:.3g} units long, but needs {least:g} to {most:g} m in "
                         f"{', '.join(UNITS) if said is None else said}")  # fmt: skip
    return units[0]


def _rest(motion: Motion) -> str:
    """Return which rest pose a motion has, whose first frame is the pose without rotations."""
    for pose, name in ((1, "T-pose first"), (0, "T-pose")):
        if is_t_pose(motion, pose):
            return name
    return "arms down" if _hangs(motion) else "estimated"


def _upright(motion: Motion, said: str | None) -> tuple[Motion, str]:
    """Return a motion, whose first frame is the pose without rotations, turned so that z is up, and the file's axis.

    The axis of the file is up along which the head is above the feet, in the mean over the frames; y where none is, as
    of people who lie and roll.
    """
    feet = 0.5 * (motion.path("LeftFoot") + motion.path("RightFoot"))
    spine = (motion.path("Head") - feet)[1:]
    mean = np.mean(spine, axis=0) / max(float(np.mean(np.linalg.norm(spine, axis=-1))), 1e-9)
    heights = {name: float(direction @ mean) for name, direction in _DIRECTIONS.items()}
    found = max(heights, key=lambda name: heights[name])
    up = said or (found if heights[found] >= UPRIGHT else "y")
    turn = Rotation.identity()
    if up != "y":
        turn, _ = Rotation.align_vectors([(0.0, 0.0, 1.0)], [_DIRECTIONS[up]])
    positions = turn.apply(motion.positions.reshape(-1, 3)).reshape(motion.positions.shape)
    # Some files count the root's positions from its offset, others repeat the offset in them.
    without = positions - turn.apply(motion.offsets[0])
    lowest, lowest_without = (
        np.min(places[1:, [motion.names.index(f"{side}Foot") for side in SIDES], 2]) for places in (positions, without)
    )
    orientations = turn * Rotation.from_quat(motion.orientations.reshape(-1, 4), scalar_first=True)
    turned = replace(
        motion,
        positions=without if abs(lowest_without) < abs(lowest) else positions,
        orientations=orientations.as_quat(scalar_first=True).reshape(motion.orientations.shape),
    )
    return turned, up


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


def _unrotated(joints: list[BvhJoint]) -> np.ndarray:
    """Return the channels (C,) of the pose without rotations; joints that have positions are at their offsets."""
    values = []
    for joint in joints:
        offset = dict(zip("XYZ", joint.offset if joint.parent >= 0 else (0.0, 0.0, 0.0), strict=True))
        values += [offset[channel[0]] if channel.endswith("position") else 0.0 for channel in joint.channels]
    return np.array(values)


def _forward_kinematics(joints: list[BvhJoint], duration: float, poses: np.ndarray) -> Motion:
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

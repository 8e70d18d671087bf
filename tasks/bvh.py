"""Captured motions: BVH files read strictly, mirrored, and retargeted to the human of 13 links.

A BVH file is a tree of joints with offsets and, for every frame, the angles of all joints (M. Meredith and S. Maddock,
"Motion capture file formats explained", 2001). Its joints must go by MotionBuilder's names, as in B. Hahne's conversion
of the Carnegie Mellon motion capture database. Files have y up and face z; here z is up, x forward and y left.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, Slerp

from larp_model.scene import Body

SIDES = ("Left", "Right")
# The joint that carries each segment; the torso's is where the arms branch off the spine.
JOINTS = {"pelvis": "Hips", "head": "Head"}
LIMBS = {"upper_arm": "Arm", "lower_arm": "ForeArm", "thigh": "UpLeg", "shin": "Leg", "foot": "Foot"}
# Where a limb's bone ends; in the human's rest pose these bones hang straight down.
ENDS = {"Arm": "ForeArm", "ForeArm": "Hand", "UpLeg": "Leg", "Leg": "Foot"}
NEEDED = [*JOINTS.values(), *(side + name for side in SIDES for name in (*LIMBS.values(), "Hand", "ToeBase"))]
# Metres in one unit of a file: the Carnegie Mellon conversions', a centimetre, a metre. The length of the legs decides.
UNITS = (0.0254 / 0.45, 0.01, 1.0)
LEG_LENGTH = (0.6, 1.2)
# How far the arms and legs of a T-pose may be from level and upright [rad].
T_POSE = 0.6
# Frames over which a speed is fitted.
SMOOTHING = 5
# The toes of captured kicks reach 11 m/s and more, those of people who walk 4 or 5 m/s.
SLOWEST_KICK = 6.0

_OURS = {"X": "Y", "Y": "Z", "Z": "X"}  # a file's axes in our words; positions are reordered accordingly
_TO_OURS = [2, 0, 1]
_LARGEST = 1e6


@dataclass(frozen=True, eq=False)
class Motion:
    """A captured motion of n joints over T frames, in the world frame.

    As in a `Body`, all joint frames are parallel to the world's in the rest pose, in which the person faces x.
    names: of the joints, parents first. parents: (n,), -1 for the root. offsets: (n, 3) from the parent's joint, in
    the parent's frame [m], the root's being zero. rate: frames per second. positions: (T, n, 3) [m]. orientations:
    (T, n, 4), w, x, y, z.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    rate: float
    positions: np.ndarray
    orientations: np.ndarray

    def path(self, name: str) -> np.ndarray:
        """Where a joint is (T, 3) [m]."""
        return self.positions[:, self.names.index(name)]

    def rotation(self, name: str) -> Rotation:
        """How a joint's frame is turned in each of the T frames."""
        return Rotation.from_quat(self.orientations[:, self.names.index(name)], scalar_first=True)

    def cut(self, first: int, last: int) -> Motion:
        """The frames from `first` to `last`, both included, or what there is of them."""
        frames = slice(max(first, 0), last + 1)
        return replace(self, positions=self.positions[frames], orientations=self.orientations[frames])

    @property
    def hip_height(self) -> float:
        """Of the hips above the toes' base in the rest pose [m]."""
        hips, toes = (self.offsets[self._lineage(joint), 2].sum() for joint in ("Hips", "LeftToeBase"))
        return float(hips - toes)

    @property
    def chest(self) -> str:
        """The joint at which the arms branch off the spine."""
        left, right = self._lineage("LeftArm"), self._lineage("RightArm")
        return self.names[next(joint for joint in left if joint in right)]

    def _lineage(self, name: str) -> list[int]:
        """A joint, its parent and so on, up to the root."""
        line = [self.names.index(name)]
        while line[-1] > 0:
            line.append(int(self.parents[line[-1]]))
        return line


def load(path: str | Path) -> Motion:
    """Read a BVH file; ValueError, in one line, says what is missing, damaged or not understood.

    The rest pose is the first frame if that is a T-pose, which is then left out, else the pose without rotations.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"path is {str(path)!r}, but no such file exists")
    try:
        return _motion(*_parse(path.read_bytes().decode("ascii", "replace").splitlines()))
    except ValueError as error:
        raise ValueError(f"{path.name} {error}") from None


@dataclass(frozen=True)
class _Joint:
    name: str
    parent: int
    offset: list[float]
    channels: list[str]


def _parse(lines: list[str]) -> tuple[list[_Joint], float, np.ndarray]:
    """Joints, seconds a frame and channels (T, C) of a file, in its own unit and axes."""
    rows = [(number, line.split()) for number, line in enumerate(lines, start=1) if line.strip()]
    start = next((index for index, (_, words) in enumerate(rows) if words == ["MOTION"]), None)
    if start is None or rows[0][1] != ["HIERARCHY"]:
        raise ValueError("is no BVH file: it needs a line HIERARCHY first and a line MOTION later")
    joints = _hierarchy(word for _, words in rows[1:start] for word in words)
    match [words for _, words in rows[start + 1 : start + 3]]:
        case [["Frames:", count], ["Frame", "Time:", seconds]] if count.isdecimal():
            (duration,) = _numbers([seconds], 1, "has a Frame Time that")
        case _:
            raise ValueError("has no frames: it needs lines 'Frames: N' and 'Frame Time: SECONDS' after MOTION")
    if not 0.0 < duration <= 0.1:
        raise ValueError(f"has a Frame Time of {duration:g} s, but needs one above 0 and up to 0.1 s")
    columns = sum(len(joint.channels) for joint in joints)
    data = [_numbers(words, columns, f"has a line, {number}, that") for number, words in rows[start + 3 :]]
    if not data or len(data) != int(count):
        raise ValueError(f"has {len(data) or 'no'} frames, but announces {count[:9]}")
    return joints, duration, np.array(data)


def _numbers(words: list[str], count: int, place: str) -> list[float]:
    if len(words) != count:
        raise ValueError(f"{place} has {len(words)} columns, but needs {count}")
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise ValueError(f"{place} holds something that is not a number") from None
    if not all(abs(value) < _LARGEST for value in values):
        raise ValueError(f"{place} holds a number that is not finite, or not below {_LARGEST:g}")
    return values


def _hierarchy(words: Iterator[str]) -> list[_Joint]:
    """The tree of joints, parents first. The ends of bones that carry no joint are read and left out."""
    joints: list[_Joint] = []
    line: list[int] = []

    def need(*wanted: str) -> None:
        for word in wanted:
            if (found := next(words, "its end")) != word:
                raise ValueError(f"has {found[:40]!r} in its HIERARCHY, but needs {word!r} there")

    for word in words:
        if word == "}" and line:
            line.pop()
        elif word == "End" and line:
            need("Site", "{", "OFFSET")
            _numbers(list(islice(words, 3)), 3, "has an End Site that")
            need("}")
        elif word == ("JOINT" if line else "ROOT") and (line or not joints):
            name = next(words, "").rpartition(":")[2]
            need("{", "OFFSET")
            offset = _numbers(list(islice(words, 3)), 3, f"has a joint, {name}, that")
            need("CHANNELS")
            kinds = ("rotation",) if line else ("position", "rotation")
            wanted = [axis + kind for kind in kinds for axis in "XYZ"]
            count, channels = next(words, ""), list(islice(words, len(wanted)))
            if count != str(len(wanted)) or sorted(channels) != sorted(wanted):
                raise ValueError(f"has a joint, {name}, with other channels than {', '.join(wanted)}, each once")
            joints.append(_Joint(name, line[-1] if line else -1, offset, channels))
            line.append(len(joints) - 1)
        else:
            raise ValueError(f"has {word[:40]!r} in its HIERARCHY, where it does not belong")
    names = [joint.name for joint in joints]
    if line or len(set(names)) != len(names):
        raise ValueError("has a HIERARCHY with " + ("braces left open" if line else "two joints of one name"))
    if missing := [name for name in NEEDED if name not in names]:
        raise ValueError(f"has no joints {', '.join(missing)}, but needs them")
    return joints


def _motion(joints: list[_Joint], duration: float, data: np.ndarray) -> Motion:
    """The motion of all frames, in metres, the joints' frames made parallel in the rest pose."""
    poses = np.concatenate([np.zeros((1, data.shape[1])), data])  # first of all, the pose without rotations
    raw = _posed(joints, duration, poses)
    thighs, shins = ([_bone(raw, side + joint)[0] for side in SIDES] for joint in ("UpLeg", "Leg"))
    legs = float(np.linalg.norm(thighs, axis=-1).mean() + np.linalg.norm(shins, axis=-1).mean())
    unit = next((unit for unit in UNITS if LEG_LENGTH[0] <= unit * legs <= LEG_LENGTH[1]), None)
    if unit is None:
        raise ValueError(f"has legs {legs:.3g} units long, but needs 0.6 to 1.2 m in units of 0.0254/0.45 m, cm or m")
    if raw.chest == raw.names[0]:
        raise ValueError("has no chest: its arms branch off the root")
    rest = next((pose for pose in (1, 0) if _is_t_pose(raw, pose)), None)
    if rest is None:
        raise ValueError("has no rest pose: neither its first frame nor its pose without rotations is a T-pose")
    if len(poses) == 1 + rest:
        raise ValueError("has no frames but the T-pose")

    straight = _facing(raw, rest)
    turns = Rotation.from_quat(raw.orientations[rest], scalar_first=True)
    offsets = np.zeros_like(raw.offsets)
    offsets[1:] = (straight * turns[raw.parents[1:]]).apply(raw.offsets[1:])
    moved = Rotation.from_quat(raw.orientations[1 + rest :].reshape(-1, 4), scalar_first=True)
    frames = len(poses) - 1 - rest
    back = Rotation.concatenate([(straight * turns).inv()] * frames)
    orientations = (moved * back).as_quat(scalar_first=True).reshape(frames, -1, 4)
    return replace(raw, offsets=unit * offsets, positions=unit * raw.positions[1 + rest :], orientations=orientations)


def _posed(joints: list[_Joint], duration: float, poses: np.ndarray) -> Motion:
    """Forward kinematics of the channels (P, C), in our axes but the file's unit and joint frames."""
    turns: list[Rotation] = []
    places: list[np.ndarray] = []
    column = 0
    for joint in joints:
        channels = dict(zip(joint.channels, poses.T[column:], strict=False))
        column += len(joint.channels)
        order = [channel for channel in joint.channels if channel.endswith("rotation")]
        angles = np.stack([channels[channel] for channel in order], axis=-1)
        turn = Rotation.from_euler("".join(_OURS[channel[0]] for channel in order), angles, degrees=True)
        offset = np.array(joint.offset)[_TO_OURS]
        if joint.parent < 0:
            places.append(offset + np.stack([channels[f"{axis}position"] for axis in "ZXY"], axis=-1))
            turns.append(turn)
        else:
            places.append(places[joint.parent] + turns[joint.parent].apply(offset))
            turns.append(turns[joint.parent] * turn)
    return Motion(
        tuple(joint.name for joint in joints),
        np.array([joint.parent for joint in joints]),
        np.array([joint.offset for joint in joints])[:, _TO_OURS],
        1.0 / duration,
        np.stack(places, axis=1),
        np.stack([turn.as_quat(scalar_first=True) for turn in turns], axis=1),
    )


def _bone(motion: Motion, joint: str) -> np.ndarray:
    """From a limb's joint to the end of its bone (T, 3) [m]."""
    side = next(side for side in SIDES if joint.startswith(side))
    return motion.path(side + ENDS[joint.removeprefix(side)]) - motion.path(joint)


def _facing(motion: Motion, frame: int) -> Rotation:
    """The turn about z that makes the person face x."""
    x, y, _ = (motion.path("LeftUpLeg") - motion.path("RightUpLeg"))[frame]
    return Rotation.from_rotvec((0.0, 0.0, np.arctan2(x, y)))


def _is_t_pose(motion: Motion, frame: int) -> bool:
    straight = _facing(motion, frame)
    for side, outwards in zip(SIDES, (1.0, -1.0), strict=True):
        for joint in ENDS:
            bone = straight.apply(_bone(motion, side + joint)[frame])
            wanted = np.array((0.0, 0.0, -1.0) if "Leg" in joint else (0.0, outwards, 0.0))
            if not bone @ wanted > np.cos(T_POSE) * np.linalg.norm(bone):
                return False
    return True


def mirrored(motion: Motion) -> Motion:
    """The motion in a mirror, the plane y = 0: left and right change places."""
    other = {"L": "R", "R": "L", "Left": "Right", "Right": "Left"}
    names = tuple(re.sub("^(Left|Right|[LR])(?=[A-Z])", lambda side: other[side[1]], name) for name in motion.names)
    return replace(
        motion,
        names=names,
        offsets=motion.offsets * (1.0, -1.0, 1.0),
        positions=motion.positions * (1.0, -1.0, 1.0),
        orientations=motion.orientations * (1.0, -1.0, 1.0, -1.0),
    )


def retarget(motion: Motion, body: Body, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """The motion as poses of our human, every `dt` [s].

    Every link takes its joint's turn from the rest pose, on top of the turn that brings its bone from where it points
    in the human's rest pose (limbs hang straight down) to where it points in the clip's (arms level). So limbs point
    as the clip's do, whatever the proportions, and twist as its joints do. Feet are flat in both rest poses.

    Returns the root's orientation (T', 4), w, x, y, z, and the joints' rotation vectors (T', J, 3) [rad], within the
    motors' bounds.
    """
    if not dt > 0.0 or len(motion.positions) < 2:
        raise ValueError(
            f"dt is {dt!r}, the motion has {len(motion.positions)} frames; needs dt above 0 and two frames"
        )
    times = np.arange(len(motion.positions)) / motion.rate
    at = np.arange(int(times[-1] / dt + 1e-6) + 1) * dt
    rotations = [Slerp(times, _link_rotation(motion, link.name))(np.minimum(at, times[-1])) for link in body.links]
    controls = np.stack(
        [(rotations[joint.parent].inv() * rotations[child]).as_rotvec() for child, joint, _ in body.motors], axis=1
    )
    lower, upper = (np.array([getattr(motor, bound) for _, _, motor in body.motors]) for bound in ("lower", "upper"))
    return rotations[0].as_quat(scalar_first=True), np.clip(controls, lower, upper)


def _link_rotation(motion: Motion, link: str) -> Rotation:
    """World orientations of the link in all frames."""
    side, _, segment = link.partition("_")
    if segment not in LIMBS:
        if link != "torso" and link not in JOINTS:
            raise ValueError(f"body has a link {link!r}, but captured motions move a human's links alone")
        return motion.rotation(JOINTS.get(link, motion.chest))
    joint = side.capitalize() + LIMBS[segment]
    turned = motion.rotation(joint)
    if LIMBS[segment] not in ENDS:
        return turned
    bone = turned[0].inv().apply(_bone(motion, joint)[0])
    aligned, _ = Rotation.align_vectors([bone], [(0.0, 0.0, -1.0)])
    return turned * aligned


def toe_velocity(motion: Motion, side: str) -> np.ndarray:
    """Velocity (T, 3) [m/s] of the toes' base of one side, "Left" or "Right".

    The slope of a parabola fitted to 5 frames (Savitzky and Golay), which evens out a marker that jumps in one frame.
    """
    if len(motion.positions) < SMOOTHING:
        raise ValueError(f"motion has {len(motion.positions)} frames, but speeds need {SMOOTHING}")
    return savgol_filter(motion.path(f"{side}ToeBase"), SMOOTHING, 2, deriv=1, delta=1.0 / motion.rate, axis=0)


def kicking_side(motion: Motion) -> str:
    """The side, "Left" or "Right", whose toes become faster."""
    return max(reversed(SIDES), key=lambda side: np.linalg.norm(toe_velocity(motion, side), axis=-1).max())


def toe_speed(motion: Motion) -> np.ndarray:
    """Speed (T,) [m/s] of the kicking foot's toes' base, smoothed as in `toe_velocity`."""
    return np.linalg.norm(toe_velocity(motion, kicking_side(motion)), axis=-1)


def strike(motion: Motion) -> int:
    """The frame in which the kicking toe is fastest."""
    return int(toe_speed(motion).argmax())

"""Captured motions: joint trajectories, with mirroring, kick analysis, and retargeting to the human of 13 links."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from larp_model.errors import InputError
from larp_model.scene import Body

SIDES = ("Left", "Right")
# The joint that carries each segment; the torso's is where the arms branch off the spine.
JOINTS = {"pelvis": "Hips", "head": "Head"}
LIMBS = {"upper_arm": "Arm", "lower_arm": "ForeArm", "thigh": "UpLeg", "shin": "Leg", "foot": "Foot"}
# Where a limb's bone ends; in the human's rest pose these bones hang straight down.
ENDS = {"Arm": "ForeArm", "ForeArm": "Hand", "UpLeg": "Leg", "Leg": "Foot"}
NEEDED = [*JOINTS.values(), *(side + name for side in SIDES for name in (*LIMBS.values(), "Hand", "ToeBase"))]
# Largest angle of the arms of a T-pose from level, and of its legs from vertical [rad].
T_POSE = 0.6
# Frames over which a speed is fitted.
SMOOTHING = 5
# The toes of captured kicks reach 11 m/s and more, those of people who walk 4 or 5 m/s.
SLOWEST_KICK = 6.0


@dataclass(frozen=True, eq=False)
class Motion:
    """Captured motion of n joints over T frames, in the world frame.

    As in a `Body`, all joint frames are parallel to the world's in the rest pose, in which the person faces x.
    names: of the joints, parents first. parents: (n,), -1 for the root. offsets: (n, 3) from the parent's joint, in
    the parent's frame [m], the root's being zero. rate: frames per second. positions: (T, n, 3) [m]. orientations:
    (T, n, 4), w, x, y, z. read: what a file was taken for that does not say it of itself.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    rate: float
    positions: np.ndarray
    orientations: np.ndarray
    read: str = ""

    def path(self, name: str) -> np.ndarray:
        """Return the positions (T, 3) [m] of a joint."""
        return self.positions[:, self.names.index(name)]

    def rotation(self, name: str) -> Rotation:
        """Return the orientations of a joint's frame in all T frames."""
        return Rotation.from_quat(self.orientations[:, self.names.index(name)], scalar_first=True)

    def cut(self, first: int, last: int) -> Motion:
        """Return the motion of the frames from `first` to `last`, both included, as far as they exist."""
        frames = slice(max(first, 0), last + 1)
        return replace(self, positions=self.positions[frames], orientations=self.orientations[frames])

    @property
    def hip_height(self) -> float:
        """Return the height [m] of the hips above the toes' base in the rest pose."""
        hips, toes = (self.offsets[self._lineage(joint), 2].sum() for joint in ("Hips", "LeftToeBase"))
        return float(hips - toes)

    @property
    def chest(self) -> str:
        """Return the name of the joint at which the arms branch off the spine."""
        left, right = self._lineage("LeftArm"), self._lineage("RightArm")
        return self.names[next(joint for joint in left if joint in right)]

    def _lineage(self, name: str) -> list[int]:
        """Return the indices of a joint, its parent and so on, up to the root."""
        lineage = [self.names.index(name)]
        while lineage[-1] > 0:
            lineage.append(int(self.parents[lineage[-1]]))
        return lineage


def bone(motion: Motion, joint: str) -> np.ndarray:
    """Return the vector (T, 3) [m] from a limb's joint to the end of its bone."""
    side = next(side for side in SIDES if joint.startswith(side))
    vectors: np.ndarray = motion.path(side + ENDS[joint.removeprefix(side)]) - motion.path(joint)
    return vectors


def facing(motion: Motion, frame: int) -> Rotation:
    """Return the rotation about z that makes the person face x."""
    x, y, _ = (motion.path("LeftUpLeg") - motion.path("RightUpLeg"))[frame]
    return Rotation.from_rotvec((0.0, 0.0, np.arctan2(x, y)))


def is_t_pose(motion: Motion, frame: int) -> bool:
    """Return whether the arms point outwards and the legs down in a frame, each within `T_POSE` [rad]."""
    to_forwards = facing(motion, frame)
    for side, outwards in zip(SIDES, (1.0, -1.0), strict=True):
        for joint in ENDS:
            direction = to_forwards.apply(bone(motion, side + joint)[frame])
            expected = np.array((0.0, 0.0, -1.0) if "Leg" in joint else (0.0, outwards, 0.0))
            if not direction @ expected > np.cos(T_POSE) * np.linalg.norm(direction):
                return False
    return True


def mirrored(motion: Motion) -> Motion:
    """Return the motion mirrored in the plane y = 0, with left and right exchanged."""
    opposite_side = {"Left": "Right", "Right": "Left", "L": "R", "R": "L", "l": "r", "r": "l"}
    opposite_names = [
        re.sub("^(Left|Right|[LRlr])", lambda side: opposite_side[side[1]], name) for name in motion.names
    ]
    return replace(
        motion,
        names=tuple(
            opposite_name if opposite_name in motion.names else name
            for name, opposite_name in zip(motion.names, opposite_names, strict=True)
        ),
        offsets=motion.offsets * (1.0, -1.0, 1.0),
        positions=motion.positions * (1.0, -1.0, 1.0),
        orientations=motion.orientations * (1.0, -1.0, 1.0, -1.0),
    )


def sampled_times(frames: int, rate: float, dt: float) -> np.ndarray:
    """Return times [s] of steps of `dt` [s] from the first of some frames of a rate [1/s] on, none after the last."""
    last = (frames - 1) / rate
    times: np.ndarray = np.minimum(np.arange(int(last / dt + 1e-6) + 1) * dt, last)
    return times


def retarget(motion: Motion, body: Body, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the motion as poses of our human, every `dt` [s].

    Every link takes its joint's rotation from the rest pose, after the rotation that takes its bone from its direction
    in the human's rest pose (limbs hang straight down) to that in the clip's (arms level). So limbs point as the clip's
    do, whatever the proportions, and twist as its joints do. Feet are flat in both rest poses.

    Returns the root's orientation (T', 4), w, x, y, z, and the joints' rotation vectors (T', J, 3) [rad], within the
    motors' bounds.
    """
    root, vectors = _unbounded(motion, body, dt)
    return root, np.clip(vectors, *body.limits)


def beyond_bounds(motion: Motion, body: Body, dt: float) -> dict[str, float]:
    """Return by how much joints bend beyond a human's bounds [rad], by child link: the mean over the motion."""
    _, vectors = _unbounded(motion, body, dt)
    excess = np.linalg.norm(vectors - np.clip(vectors, *body.limits), axis=-1).mean(axis=0)
    return {body.links[child].name: float(mean) for (child, _, _), mean in zip(body.motors, excess, strict=True)}


def _unbounded(motion: Motion, body: Body, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the results of `retarget`, with joints as far beyond the motors' bounds as the motion takes them."""
    if not dt > 0.0 or len(motion.positions) < 2:
        raise InputError(
            f"dt is {dt!r}, the motion has {len(motion.positions)} frames; needs dt above 0 and two frames"
        )
    frames = len(motion.positions)
    times, step_times = np.arange(frames) / motion.rate, sampled_times(frames, motion.rate, dt)
    rotations = [Slerp(times, _link_rotation(motion, link.name))(step_times) for link in body.links]
    vectors = np.stack(
        [(rotations[joint.parent].inv() * rotations[child]).as_rotvec() for child, joint, _ in body.motors], axis=1
    )
    return rotations[0].as_quat(scalar_first=True), vectors


def _link_rotation(motion: Motion, link: str) -> Rotation:
    """Return the world orientations of the link in all frames."""
    side, _, segment = link.partition("_")
    if segment not in LIMBS:
        if link != "torso" and link not in JOINTS:
            raise InputError(f"body has a link {link!r}, but captured motions move a human's links alone")
        return motion.rotation(JOINTS.get(link, motion.chest))
    joint = side.capitalize() + LIMBS[segment]
    rotations = motion.rotation(joint)
    if LIMBS[segment] not in ENDS:
        return rotations
    bone_direction = rotations[0].inv().apply(bone(motion, joint)[0])
    bone_to_link, _ = Rotation.align_vectors([bone_direction], [(0.0, 0.0, -1.0)])
    return rotations * bone_to_link


def toe_velocity(motion: Motion, side: str) -> np.ndarray:
    """Return the velocity (T, 3) [m/s] of the toes' base of one side, "Left" or "Right".

    It is the slope of a parabola fitted to 5 frames (Savitzky and Golay), which damps a marker that jumps in one frame.
    """
    from scipy.signal import savgol_filter  # half a second to import; the embedded kick has no need of it

    if len(motion.positions) < SMOOTHING:
        raise InputError(f"motion has {len(motion.positions)} frames, but speeds need {SMOOTHING}")
    path = motion.path(f"{side}ToeBase")
    velocity: np.ndarray = savgol_filter(path, SMOOTHING, 2, deriv=1, delta=1.0 / motion.rate, axis=0)
    return velocity


def kicking_side(motion: Motion) -> str:
    """Return the side, "Left" or "Right", whose toes reach the higher speed."""
    return max(reversed(SIDES), key=lambda side: np.linalg.norm(toe_velocity(motion, side), axis=-1).max())


def toe_speed(motion: Motion) -> np.ndarray:
    """Return the speed (T,) [m/s] of the toes' base of the kicking foot, smoothed as in `toe_velocity`."""
    speed: np.ndarray = np.linalg.norm(toe_velocity(motion, kicking_side(motion)), axis=-1)
    return speed


def strike(motion: Motion) -> int:
    """Return the frame in which the kicking toe is fastest."""
    return int(toe_speed(motion).argmax())

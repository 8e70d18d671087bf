"""Rest pose of a skeleton whose file has none: orientations of its joint frames in a T-pose, estimated from its motion.

A T-pose fixes two things of a limb: the direction of its bone and the axis about which the next bone bends. Knees bend
shins backwards, elbows bend forearms forwards, palms down. Both are constant in the limb's own frame, and can be
measured in any motion.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from tasks.motions.skeleton import ENDS, SIDES, Motion, bone, facing

FORWARDS, LEFT, UP = np.eye(3)
# Fewest frames for an estimate. A limb with a smaller mean bend [rad] gives no hinge axis.
MIN_FRAMES, MIN_BEND = 10, 0.05
# Legs of a T-pose are taken for upright within this angle [rad].
MAX_SLANT = 0.1


def rest_orientations(motion: Motion) -> Rotation:
    """Return orientations of the n joint frames in a T-pose, the person facing x; `motion` is in its file's frames.

    Torso and pelvis have the mean lean of the motion, feet are as steep as with the ankle lowest, and all other joints
    (neck, hands, ...) have their mean orientation relative to the parent. Raises an InputError where there are too few
    frames.
    """
    if len(motion.positions) < MIN_FRAMES:
        raise InputError(
            "has no rest pose: neither its first frame nor its pose without rotations is a T-pose, and"
            f" {len(motion.positions)} frames are too few to make one of, it needs {MIN_FRAMES}"
        )
    chest = motion.chest
    rests: list[Rotation] = []
    hips = branching_frame(motion, "Hips", "UpLeg", motion.path(chest) - motion.path("Hips"))
    shoulders = branching_frame(motion, chest, "Arm", motion.path("Head") - motion.path(chest))
    for name, parent in zip(motion.names, motion.parents, strict=True):
        rotations = motion.rotation(name)
        usual = (
            rotations.mean()
            if parent < 0
            else rests[parent] * (motion.rotation(motion.names[parent]).inv() * rotations).mean()
        )
        side = next((side for side in SIDES if name.startswith(side)), "")
        part = name.removeprefix(side)
        if name == "Hips":
            rests.append(hips)
        elif name == chest:
            rests.append(shoulders)
        elif side and part in ENDS:
            rests.append(limb_frame(motion, side, part, usual))
        elif side and part == "Foot":
            rests.append(foot_frame(motion, side, usual))
        else:
            rests.append(usual)
    return Rotation.concatenate(rests)


def with_level_soles(pose: Motion, motion: Motion, rest: Rotation) -> Rotation:
    """Return the orientations of a T-pose's n joint frames with feet that are level where they stand in a motion.

    pose: the T-pose, one frame. rest: its joint frames, the person facing x. Where its legs are apart, the feet are
    level in it, or slanted with the legs: that is taken which makes them roll less in the motion, with the ankle low.
    """
    to_forwards, quaternions, rolls = facing(pose, 0), rest.as_quat(), np.zeros(2)
    for side in SIDES:
        thigh = to_forwards.apply(bone(pose, f"{side}UpLeg")[0])
        straightening = aligned((thigh * (0.0, 1.0, 1.0), -UP))
        if straightening.magnitude() < MAX_SLANT:
            return rest
        foot, toe = (motion.names.index(side + name) for name in ("Foot", "ToeBase"))
        height = motion.path(f"{side}Foot")[:, 2]
        stance = motion.rotation(f"{side}Foot")[height <= np.quantile(height, 0.25)]
        for number, frame in enumerate((rest[foot], straightening * rest[foot])):
            rolls[number] += np.mean(abs((stance * frame.inv()).apply(LEFT)[:, 2]))
        quaternions[[foot, toe]] = (straightening * rest[[foot, toe]]).as_quat()
    return Rotation.from_quat(quaternions) if rolls[1] < rolls[0] else rest


def branching_frame(motion: Motion, name: str, limbs: str, upwards: np.ndarray) -> Rotation:
    """Return the frame of a joint from which limbs branch off to left and right.

    upwards: (T, 3) vectors that the frame makes point up as far as it can.
    """
    to_joint_frame = motion.rotation(name).inv()
    sideways = motion.path(f"Left{limbs}") - motion.path(f"Right{limbs}")
    return aligned(
        (mean_in_joint_frame(to_joint_frame, sideways), LEFT), (mean_in_joint_frame(to_joint_frame, upwards), UP)
    )


def limb_frame(motion: Motion, side: str, part: str, usual: Rotation) -> Rotation:
    """Return the frame of a limb's joint whose bone points down, or to its side if it is an arm's."""
    outwards = LEFT if side == "Left" else -LEFT
    arm = "Arm" in part
    bone_pair = (
        mean_in_joint_frame(motion.rotation(side + part).inv(), bone(motion, side + part)),
        outwards if arm else -UP,
    )
    axis = hinge_axis(motion, side, part, arm)
    if np.linalg.norm(axis) < MIN_BEND:
        return aligned((usual.apply(bone_pair[0]), bone_pair[1])) * usual
    return aligned(bone_pair, (axis, np.cross(outwards, FORWARDS) if arm else LEFT))


def foot_frame(motion: Motion, side: str, usual: Rotation) -> Rotation:
    """Return the frame of a foot's joint, the foot as steep as with the ankle lowest.

    The toes are lowest at another time, when they push off.
    """
    ankle = motion.path(f"{side}Foot")
    ankle_to_toe, height = motion.path(f"{side}ToeBase") - ankle, ankle[:, 2]
    descent = np.median(
        (-ankle_to_toe[:, 2] / np.linalg.norm(ankle_to_toe, axis=-1))[height <= np.quantile(height, 0.25)]
    )
    descent = float(np.clip(descent, -0.9, 0.9))
    bone_pair = (
        mean_in_joint_frame(motion.rotation(f"{side}Foot").inv(), ankle_to_toe),
        np.sqrt(1.0 - descent**2) * FORWARDS - descent * UP,
    )
    axis = hinge_axis(motion, side, "Foot", arm=False)
    if np.linalg.norm(axis) < MIN_BEND:
        return aligned((usual.apply(bone_pair[0]), bone_pair[1])) * usual
    return aligned(bone_pair, (axis, LEFT))


def hinge_axis(motion: Motion, side: str, part: str, arm: bool) -> np.ndarray:
    """Return the axis (3,) of knee or elbow in the frame of a limb's joint; its length is the mean bend [rad]."""
    upper, lower = (bone(motion, side + name) for name in (("Arm", "ForeArm") if arm else ("UpLeg", "Leg")))
    bend = np.cross(upper, lower) / (np.linalg.norm(upper, axis=-1) * np.linalg.norm(lower, axis=-1))[:, None]
    return mean_in_joint_frame(motion.rotation(side + part).inv(), bend)


def mean_in_joint_frame(to_joint_frame: Rotation, vectors: np.ndarray) -> np.ndarray:
    """Return the mean (3,) in a joint's frame of world vectors (T, 3); to_joint_frame: T rotations from the world."""
    vector: np.ndarray = to_joint_frame.apply(vectors).mean(axis=0)
    return vector


def aligned(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray] | None = None) -> Rotation:
    """Return the rotation that takes a vector to the direction of another, and a second pair as near as it then can.

    first, second: (vector, direction that it is to have).
    """
    pairs = [first] if second is None else [first, second]
    vectors, directions = (
        np.array([vector / np.linalg.norm(vector) for vector in column]) for column in zip(*pairs, strict=True)
    )
    rotation, _ = Rotation.align_vectors(directions, vectors, None if second is None else [np.inf, 1.0])
    return rotation

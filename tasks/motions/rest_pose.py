"""Rest pose of a skeleton whose file has none: orientations of its joint frames in a T-pose, estimated from its motion.

A T-pose fixes two things of a limb: the direction of its bone and the axis about which the next bone bends. Knees bend
shins backwards, elbows bend forearms forwards, palms down. Both are constant in the limb's own frame, and can be
measured in any motion.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from tasks.motions.skeleton import ENDS, SIDES, Motion, bone

FORWARDS, LEFT, UP = np.eye(3)
# Fewest frames for an estimate. A limb with a smaller mean bend [rad] gives no hinge axis.
FRAMES, STRAIGHT = 10, 0.05


def resting(motion: Motion) -> Rotation:
    """Return orientations of the n joint frames in a T-pose, the person facing x; `motion` is in its file's frames.

    Torso and pelvis have the mean lean of the motion, feet are as steep as with the ankle lowest, and all other joints
    (neck, hands, ...) have their mean orientation relative to the parent. Raises an InputError where there are too few
    frames.
    """
    if len(motion.positions) < FRAMES:
        raise InputError(
            "has no rest pose: neither its first frame nor its pose without rotations is a T-pose, and"
            f" {len(motion.positions)} frames are too few to make one of, it needs {FRAMES}"
        )
    chest = motion.chest
    rests: list[Rotation] = []
    hips = across(motion, "Hips", "UpLeg", motion.path(chest) - motion.path("Hips"))
    shoulders = across(motion, chest, "Arm", motion.path("Head") - motion.path(chest))
    for name, parent in zip(motion.names, motion.parents, strict=True):
        own = motion.rotation(name)
        usual = own.mean() if parent < 0 else rests[parent] * (motion.rotation(motion.names[parent]).inv() * own).mean()
        side = next((side for side in SIDES if name.startswith(side)), "")
        part = name.removeprefix(side)
        if name == "Hips":
            rests.append(hips)
        elif name == chest:
            rests.append(shoulders)
        elif side and part in ENDS:
            rests.append(limb(motion, side, part, usual))
        elif side and part == "Foot":
            rests.append(foot(motion, side, usual))
        else:
            rests.append(usual)
    return Rotation.concatenate(rests)


def across(motion: Motion, name: str, limbs: str, upwards: np.ndarray) -> Rotation:
    """Return the frame of a joint from which limbs branch off to left and right.

    upwards: (T, 3) vectors that the frame makes point up as far as it can.
    """
    back = motion.rotation(name).inv()
    sideways = motion.path(f"Left{limbs}") - motion.path(f"Right{limbs}")
    return turned((mean(back, sideways), LEFT), (mean(back, upwards), UP))


def limb(motion: Motion, side: str, part: str, usual: Rotation) -> Rotation:
    """Return the frame of a limb's joint whose bone points down, or to its side if it is an arm's."""
    outwards = LEFT if side == "Left" else -LEFT
    arm = "Arm" in part
    along = mean(motion.rotation(side + part).inv(), bone(motion, side + part)), outwards if arm else -UP
    axis = hinge(motion, side, part, arm)
    if np.linalg.norm(axis) < STRAIGHT:
        return turned((usual.apply(along[0]), along[1])) * usual
    return turned(along, (axis, np.cross(outwards, FORWARDS) if arm else LEFT))


def foot(motion: Motion, side: str, usual: Rotation) -> Rotation:
    """Return the frame of a foot's joint, the foot as steep as with the ankle lowest.

    The toes are lowest at another time, when they push off.
    """
    ankle = motion.path(f"{side}Foot")
    way, height = motion.path(f"{side}ToeBase") - ankle, ankle[:, 2]
    fall = np.median((-way[:, 2] / np.linalg.norm(way, axis=-1))[height <= np.quantile(height, 0.25)])
    fall = float(np.clip(fall, -0.9, 0.9))
    along = mean(motion.rotation(f"{side}Foot").inv(), way), np.sqrt(1.0 - fall**2) * FORWARDS - fall * UP
    axis = hinge(motion, side, "Foot", arm=False)
    if np.linalg.norm(axis) < STRAIGHT:
        return turned((usual.apply(along[0]), along[1])) * usual
    return turned(along, (axis, LEFT))


def hinge(motion: Motion, side: str, part: str, arm: bool) -> np.ndarray:
    """Return the axis (3,) of knee or elbow in the frame of a limb's joint; its length is the mean bend [rad]."""
    upper, lower = (bone(motion, side + name) for name in (("Arm", "ForeArm") if arm else ("UpLeg", "Leg")))
    bent = np.cross(upper, lower) / (np.linalg.norm(upper, axis=-1) * np.linalg.norm(lower, axis=-1))[:, None]
    return mean(motion.rotation(side + part).inv(), bent)


def mean(back: Rotation, vectors: np.ndarray) -> np.ndarray:
    """Return the mean (3,) of world vectors (T, 3) in a joint's frame; back: rotations from world to joint frame."""
    return back.apply(vectors).mean(axis=0)


def turned(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray] | None = None) -> Rotation:
    """Return the rotation that takes a vector to the direction of another, and a second pair as near as it then can.

    first, second: (vector, direction that it is to have).
    """
    pairs = [first] if second is None else [first, second]
    given, wanted = (np.array([each / np.linalg.norm(each) for each in side]) for side in zip(*pairs, strict=True))
    found, _ = Rotation.align_vectors(wanted, given, None if second is None else [np.inf, 1.0])
    return found

"""The rest pose of a skeleton that shows none: how its joints' frames are turned in a T-pose, told by how it moves.

What a T-pose fixes of a limb is where its bone points and about which axis the next one bends: knees bend shins
backwards, elbows bend forearms forwards, palms down. Both are constant in the limb's own frame, and seen in any motion.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from tasks.motions.skeleton import ENDS, SIDES, Motion, bone

FORWARDS, LEFT, UP = np.eye(3)
# Fewest frames to tell from. A limb whose bones are never further from parallel, on average, shows no hinge [rad].
FRAMES, STRAIGHT = 10, 0.05


def resting(motion: Motion) -> Rotation:
    """Orientations of the n joints' frames in a T-pose, the person facing x; `motion` in its file's joint frames.

    Torso and pelvis have the mean lean of the motion, feet are as steep as with the ankle lowest, and all else (neck,
    hands, ...) is turned to its parent as it is on average. InputError where there are too few frames.
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
    """The frame of a joint from which limbs branch off to left and right; upwards (T, 3) points up as far as it can."""
    back = motion.rotation(name).inv()
    sideways = motion.path(f"Left{limbs}") - motion.path(f"Right{limbs}")
    return turned((mean(back, sideways), LEFT), (mean(back, upwards), UP))


def limb(motion: Motion, side: str, part: str, usual: Rotation) -> Rotation:
    """The frame of a limb's joint whose bone points down, or to its side if it is an arm's."""
    outwards = LEFT if side == "Left" else -LEFT
    arm = "Arm" in part
    along = mean(motion.rotation(side + part).inv(), bone(motion, side + part)), outwards if arm else -UP
    axis = hinge(motion, side, part, arm)
    if np.linalg.norm(axis) < STRAIGHT:
        return turned((usual.apply(along[0]), along[1])) * usual
    return turned(along, (axis, np.cross(outwards, FORWARDS) if arm else LEFT))


def foot(motion: Motion, side: str, usual: Rotation) -> Rotation:
    """The frame of a foot's joint, the foot as steep as it is when the ankle is lowest: toes are when they push off."""
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
    """The axis (3,) of knee or elbow in the frame of a limb's joint, as long as the limb is bent [rad] on average."""
    upper, lower = (bone(motion, side + name) for name in (("Arm", "ForeArm") if arm else ("UpLeg", "Leg")))
    bent = np.cross(upper, lower) / (np.linalg.norm(upper, axis=-1) * np.linalg.norm(lower, axis=-1))[:, None]
    return mean(motion.rotation(side + part).inv(), bent)


def mean(back: Rotation, vectors: np.ndarray) -> np.ndarray:
    """Vectors (T, 3) of the world as a joint's frame sees them, on average (3,)."""
    return back.apply(vectors).mean(axis=0)


def turned(first: tuple[np.ndarray, np.ndarray], second: tuple[np.ndarray, np.ndarray] | None = None) -> Rotation:
    """The turn that brings a vector to where another points, and a second one as near to its own as it then can."""
    pairs = [first] if second is None else [first, second]
    given, wanted = (np.array([each / np.linalg.norm(each) for each in side]) for side in zip(*pairs, strict=True))
    found, _ = Rotation.align_vectors(wanted, given, None if second is None else [np.inf, 1.0])
    return found

"""The segments of a human of 1.75 m and 70 kg, in two levels of detail: 13 links, or 26.

Masses are the male means of P. de Leva, "Adjustments to Zatsiorsky-Seluyanov's segment inertia parameters",
J. Biomechanics 29 (1996), table 4; lengths are fractions of height after R. Drillis and R. Contini, "Body segment
parameters" (1966), as in D. Winter, "Biomechanics and motor control of human movement": joints are at their heights to
1 cm. The full human has the lean one's joints at the same places, and what the lean one has not: a spine and a neck of
several joints, collar bones, hands like mittens, toes.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, NamedTuple

from larp_model.scene import Motor, Vector

Detail = Literal["lean", "full"]
# The kinds of bodies that are humans; each has its own weights.
KINDS: dict[Detail, str] = {"lean": "human", "full": "full_human"}
# Which joints of the full human do together what one of the lean human's does, in equal shares.
CHAINS = {"torso": ("abdomen", "torso", "chest"), "head": ("neck", "head")}

# Inertia of the motors [kg m^2]: light feet on stiff servos would ask for three times as many engine steps.
ARMATURE = 0.01

_ACROSS: Vector = (0.0, 1.0, 0.0)
_AHEAD: Vector = (1.0, 0.0, 0.0)


class BodySegment(NamedTuple):
    """A link and the joint that ties it to its parent; of a pair, the left one.

    share: of the body's mass. length, radius [m]. above: the parent; none for the root. parent_anchor, child_anchor:
    see `scene.Joint`. motor: bounds are those of roll about x, pitch about y and yaw about z.
    """

    name: str
    share: float
    length: float
    radius: float
    axis: Vector = (0.0, 0.0, 1.0)
    above: str = ""
    parent_anchor: Vector = (0.0, 0.0, 0.0)
    child_anchor: Vector = (0.0, 0.0, 0.0)
    motor: Motor | None = None


class Anatomy(NamedTuple):
    """Segments, each after its parent: those in the middle, then those of the left side, mirrored for the right."""

    middle: tuple[BodySegment, ...]
    left: tuple[BodySegment, ...]


def _shared(motor: Motor, joints: int) -> Motor:
    """Return the motor of each of some joints in a row that together act as one joint with this motor."""
    x, y, z = motor.lower
    lower = x / joints, y / joints, z / joints
    x, y, z = motor.upper
    upper = x / joints, y / joints, z / joints
    stiffness, damping = joints * motor.stiffness, joints * motor.damping
    return replace(motor, stiffness=stiffness, damping=damping, lower=lower, upper=upper)


_TRUNK = Motor(900.0, 60.0, 400.0, (-0.5, -0.6, -0.7), (0.5, 0.9, 0.7), ARMATURE)
_HEAD = Motor(60.0, 4.0, 40.0, (-0.5, -0.6, -0.8), (0.5, 0.6, 0.8), ARMATURE)

_PELVIS = BodySegment("pelvis", 0.1117, 0.14, 0.10, _ACROSS)
_UPPER_ARM = BodySegment(
    "upper_arm", 0.0271, 0.295, 0.045, above="torso", parent_anchor=(0.0, 1.6, 1.3), child_anchor=(0.0, 0.0, 1.1),
    motor=Motor(120.0, 6.0, 100.0, (-0.5, -2.5, -1.0), (1.8, 1.2, 1.0), ARMATURE),
)  # fmt: skip
_LOWER_ARM = BodySegment(  # which the hand rides on
    "lower_arm", 0.0162 + 0.0061, 0.30, 0.038,
    above="upper_arm", parent_anchor=(0.0, 0.0, -1.1), child_anchor=(0.0, 0.0, 1.0),
    motor=Motor(60.0, 3.0, 60.0, (-0.3, -2.4, -0.5), (0.3, 0.1, 0.5), ARMATURE),
)  # fmt: skip
_THIGH = BodySegment(
    "thigh", 0.1416, 0.306, 0.075, above="pelvis", parent_anchor=(0.0, 1.25, -0.3), child_anchor=(0.0, 0.0, 1.35),
    motor=Motor(900.0, 25.0, 400.0, (-0.5, -2.0, -0.8), (0.9, 0.9, 0.8), ARMATURE),
)  # fmt: skip
_SHIN = BodySegment(
    "shin", 0.0433, 0.325, 0.050, above="thigh", parent_anchor=(0.0, 0.0, -1.45), child_anchor=(0.0, 0.0, 1.35),
    motor=Motor(600.0, 12.0, 300.0, (-0.1, -0.1, -0.2), (0.1, 2.4, 0.2), ARMATURE),
)  # fmt: skip
_FOOT = BodySegment(
    "foot", 0.0137, 0.18, 0.042, _AHEAD, "shin", (0.0, 0.0, -1.3), (-0.7, 0.0, 0.6),
    Motor(400.0, 8.0, 200.0, (-0.5, -0.6, -0.5), (0.5, 1.0, 0.5), ARMATURE),
)  # fmt: skip

# The pelvis is the lower trunk, the torso the middle and upper trunk.
LEAN = Anatomy(
    (
        _PELVIS,
        BodySegment(
            "torso", 0.3229, 0.315, 0.12, (0.0, 0.0, 1.0), "pelvis", (0.0, 0.0, 0.9), (0.0, 0.0, -1.15), _TRUNK
        ),
        BodySegment("head", 0.0694, 0.08, 0.095, (0.0, 0.0, 1.0), "torso", (0.0, 0.0, 1.85), (0.0, 0.0, -2.5), _HEAD),
    ),
    (_UPPER_ARM, _LOWER_ARM, _THIGH, _SHIN, _FOOT),
)  # fmt: skip

# Abdomen and torso are halves of the middle trunk, the chest with the collars is the upper trunk.
FULL = Anatomy(
    (
        _PELVIS,
        BodySegment(
            "abdomen", 0.0816, 0.11, 0.10, _ACROSS, "pelvis", (0.0, 0.0, 0.9), (0.0, 0.0, -0.6), _shared(_TRUNK, 3)
        ),
        BodySegment(
            "torso", 0.0817, 0.12, 0.11, _ACROSS, "abdomen", (0.0, 0.0, 0.65), (0.0, 0.0, -0.6), _shared(_TRUNK, 3)
        ),
        BodySegment(
            "chest", 0.1356, 0.16, 0.115, _ACROSS, "torso", (0.0, 0.0, 0.7), (0.0, 0.0, -0.75), _shared(_TRUNK, 3)
        ),
        BodySegment(
            "neck", 0.012, 0.05, 0.055, above="chest", parent_anchor=(0.0, 0.0, 1.025), child_anchor=(0.0, 0.0, -1.0),
            motor=_shared(_HEAD, 2),
        ),
        BodySegment(
            "head", 0.0574, 0.08, 0.095, above="neck", parent_anchor=(0.0, 0.0, 1.4), child_anchor=(0.0, 0.0, -1.0),
            motor=_shared(_HEAD, 2),
        ),
    ),
    (
        BodySegment(
            "collar", 0.012, 0.09, 0.04, _ACROSS, "chest", (0.0, 0.75, 0.45), (0.0, -1.333, 0.0),
            Motor(300.0, 12.0, 150.0, (-0.2, -0.2, -0.3), (0.4, 0.2, 0.3), ARMATURE),
        ),
        _UPPER_ARM._replace(above="collar", parent_anchor=(0.0, 1.6, -0.5)),
        _LOWER_ARM._replace(share=0.0162, length=0.22, radius=0.036),
        BodySegment(
            "hand", 0.0036, 0.05, 0.030, above="lower_arm", parent_anchor=(0.0, 0.0, -1.3),
            child_anchor=(0.0, 0.0, 1.6),
            motor=Motor(12.0, 0.4, 15.0, (-0.8, -0.5, -0.3), (0.8, 0.5, 0.3), 0.1 * ARMATURE),
        ),
        BodySegment(
            "fingers", 0.0018, 0.06, 0.018, above="hand", parent_anchor=(0.0, 0.0, -1.8), child_anchor=(0.0, 0.0, 1.5),
            motor=Motor(4.0, 0.1, 5.0, (-1.4, -0.1, -0.1), (0.3, 0.1, 0.1), 0.05 * ARMATURE),
        ),
        BodySegment(
            "thumb", 0.0007, 0.03, 0.013, above="hand", parent_anchor=(0.9, 0.0, 0.4), child_anchor=(0.0, 0.0, 1.6),
            motor=Motor(2.0, 0.05, 3.0, (-0.6, -0.8, -0.1), (0.6, 0.2, 0.1), 0.05 * ARMATURE),
        ),
        _THIGH,
        _SHIN,
        _FOOT._replace(share=0.0112, length=0.135, child_anchor=(-0.6, 0.0, 0.6)),
        BodySegment(
            "toes", 0.0025, 0.047, 0.030, _AHEAD, "foot", (1.0, 0.0, -0.286), (-1.43, 0.0, 0.0),
            Motor(60.0, 1.5, 60.0, (-0.1, -1.0, -0.1), (0.1, 0.5, 0.1), 0.5 * ARMATURE),
        ),
    ),
)  # fmt: skip

ANATOMIES: dict[Detail, Anatomy] = {"lean": LEAN, "full": FULL}

"""Parametric builders: a ball, a capsule, a chain of capsules, a human; and the scenes they are used in.

Segment masses of the human are the male means of P. de Leva, "Adjustments to Zatsiorsky-Seluyanov's segment inertia
parameters", J. Biomechanics 29 (1996), table 4; segment lengths as fractions of height follow R. Drillis and
R. Contini, "Body segment parameters" (1966), as in D. Winter, "Biomechanics and motor control of human movement".
"""

from __future__ import annotations

import math

import numpy as np

from larp_model.scene import Body, Joint, Link, Motor, Pair, Scene, Surface, Vector

# A kicked football stays on the foot for about 10 ms and rebounds to 1.35-1.55 m when dropped from 2 m.
BALL_SURFACE = Surface.bouncing(contact_time=0.010, restitution=0.86, friction=0.6)

# Fractions of body mass (de Leva 1996, males). The pelvis is the lower trunk, the torso the middle and upper trunk;
# the hand rides on the lower arm.
_MASS = {
    "pelvis": 0.1117,
    "torso": 0.3229,
    "head": 0.0694,
    "upper_arm": 0.0271,
    "lower_arm": 0.0162 + 0.0061,
    "thigh": 0.1416,
    "shin": 0.0433,
    "foot": 0.0137,
}

# Motors: stiffness [N m/rad], damping [N m s/rad], torque limit [N m], bounds of the target (x roll, y pitch, z yaw)
# [rad], given for the left side and mirrored for the right.
_MOTOR = {
    "torso": (900.0, 60.0, 400.0, (-0.5, -0.6, -0.7), (0.5, 0.9, 0.7)),
    "head": (60.0, 4.0, 40.0, (-0.5, -0.6, -0.8), (0.5, 0.6, 0.8)),
    "upper_arm": (120.0, 6.0, 100.0, (-0.5, -2.5, -1.0), (1.8, 1.2, 1.0)),
    "lower_arm": (60.0, 3.0, 60.0, (-0.3, -2.4, -0.5), (0.3, 0.1, 0.5)),
    "thigh": (900.0, 25.0, 400.0, (-0.5, -2.0, -0.8), (0.9, 0.9, 0.8)),
    "shin": (600.0, 12.0, 300.0, (-0.1, -0.1, -0.2), (0.1, 2.4, 0.2)),
    "foot": (400.0, 8.0, 200.0, (-0.5, -0.6, -0.5), (0.5, 1.0, 0.5)),
}

# Inertia of the motors [kg m^2]: light feet on stiff servos would ask for three times as many engine steps.
ARMATURE = 0.01

KICKING_LINKS = ("left_thigh", "left_shin", "left_foot", "right_thigh", "right_shin", "right_foot")


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(f"{name} is {value!r}, but must be a positive finite number")


def ball(name: str = "ball", radius: float = 0.11, mass: float = 0.43, surface: Surface = BALL_SURFACE) -> Body:
    """A ball; by default a FIFA size 5 football. radius [m], mass [kg]."""
    _positive(radius=radius, mass=mass)
    return Body(name, "ball", (Link("ball", 0.0, radius, mass),), surface=surface)


def capsule(
    name: str = "capsule", length: float = 0.4, radius: float = 0.08, mass: float = 1.0, surface: Surface = BALL_SURFACE
) -> Body:
    """A single free capsule. length (between the hemispheres' centres), radius [m], mass [kg]."""
    _positive(length=length, radius=radius, mass=mass)
    return Body(name, "capsule", (Link("capsule", length, radius, mass),), surface=surface)


def chain(name: str = "chain", links: int = 4, length: float = 0.3, radius: float = 0.06, mass: float = 1.0) -> Body:
    """Capsules in a row, tied end to end by ball joints without motors. length, radius [m], mass of each [kg]."""
    if not isinstance(links, int) or links < 1:
        raise ValueError(f"links is {links!r}, but must be an integer of at least 1")
    _positive(length=length, radius=radius, mass=mass)
    parts = tuple(Link(f"link{i}", length, radius, mass) for i in range(links))
    reach = (0.0, 0.0, 1.0 + 2.0 * radius / length)
    down = (0.0, 0.0, -reach[2])
    joints = tuple(Joint(i, down, reach, damping=0.1) for i in range(links - 1))
    return Body(name, f"chain{links}", parts, joints)


def human(
    name: str = "human",
    height: float = 1.75,
    mass: float = 70.0,
    lengths: dict[str, float] | None = None,
    radii: dict[str, float] | None = None,
) -> Body:
    """A human of 13 links, standing upright in its rest pose, facing x, left towards y.

    height [m] and mass [kg] scale every segment. `lengths` and `radii` multiply single segments, by segment name
    without its side ("thigh", "foot", ...). Motors are in proportion: see `Body.sized`.
    """
    _positive(height=height, mass=mass)
    lengths, radii = dict(lengths or {}), dict(radii or {})
    for argument, factors in (("lengths", lengths), ("radii", radii)):
        for segment, factor in factors.items():
            if segment not in _MASS:
                raise ValueError(f"{argument} names {segment!r}, but the segments are {sorted(_MASS)}")
            _positive(**{f"{argument}[{segment!r}]": factor})
    usual, size = _usual_human(name), height / 1.75
    sizes = [
        (
            size * lengths.get(segment, 1.0) * link.length,
            size * radii.get(segment, 1.0) * link.radius,
            mass * _MASS[segment],
        )
        for link in usual.links
        for segment in [segment_of(link.name)]
    ]
    return usual.sized(np.array(sizes))


def segment_of(link: str) -> str:
    """The name of a human's link without its side."""
    return link.removeprefix("left_").removeprefix("right_")


def _usual_human(name: str) -> Body:
    """A human of 1.75 m and 70 kg; its joints are at the heights that Winter gives, to 1 cm."""

    def link(name: str, length: float, radius: float, axis: Vector = (0.0, 0.0, 1.0)) -> Link:
        return Link(name, length, radius, 70.0 * _MASS[segment_of(name)], axis)

    def joint(child: str, parent: int, parent_anchor: Vector, child_anchor: Vector) -> Joint:
        stiffness, damping, limit, lower, upper = _MOTOR[segment_of(child)]
        if child.startswith("right_"):  # mirroring y turns roll and yaw round
            lower, upper = (-upper[0], lower[1], -upper[2]), (-lower[0], upper[1], -lower[2])
        return Joint(parent, parent_anchor, child_anchor, Motor(stiffness, damping, limit, lower, upper, ARMATURE))

    links = [
        link("pelvis", 0.14, 0.10, (0.0, 1.0, 0.0)),
        link("torso", 0.315, 0.12),
        link("head", 0.08, 0.095),
    ]
    joints = [
        joint("torso", 0, (0.0, 0.0, 0.9), (0.0, 0.0, -1.15)),
        joint("head", 1, (0.0, 0.0, 1.85), (0.0, 0.0, -2.5)),
    ]
    for side, y in (("left", 1.0), ("right", -1.0)):
        arm, leg = len(links), len(links) + 2
        links += [
            link(f"{side}_upper_arm", 0.295, 0.045),
            link(f"{side}_lower_arm", 0.30, 0.038),
            link(f"{side}_thigh", 0.306, 0.075),
            link(f"{side}_shin", 0.325, 0.050),
            link(f"{side}_foot", 0.18, 0.042, (1.0, 0.0, 0.0)),
        ]
        joints += [
            joint(f"{side}_upper_arm", 1, (0.0, 1.6 * y, 1.3), (0.0, 0.0, 1.1)),
            joint(f"{side}_lower_arm", arm, (0.0, 0.0, -1.1), (0.0, 0.0, 1.0)),
            joint(f"{side}_thigh", 0, (0.0, 1.25 * y, -0.3), (0.0, 0.0, 1.35)),
            joint(f"{side}_shin", leg, (0.0, 0.0, -1.45), (0.0, 0.0, 1.35)),
            joint(f"{side}_foot", leg + 1, (0.0, 0.0, -1.3), (-0.7, 0.0, 0.6)),
        ]
    return Body(name, "human", tuple(links), tuple(joints))


def human_and_ball(height: float = 1.75, mass: float = 70.0, dt: float = 0.01) -> Scene:
    """The kick's scene: a human and a football; thighs, shins and feet can touch the ball."""
    return _kicking(human(height=height, mass=mass), ball(), dt)


def human_and_capsule(height: float = 1.75, mass: float = 70.0, dt: float = 0.01) -> Scene:
    """A human who can kick a capsule with thighs, shins and feet."""
    return _kicking(human(height=height, mass=mass), capsule(), dt)


def _kicking(person: Body, struck: Body, dt: float) -> Scene:
    pair = Pair(person.name, struck.name, KICKING_LINKS, tuple(link.name for link in struck.links), struck.surface)
    return Scene((person, struck), (pair,), dt)


def two_chains(links: int = 2, dt: float = 0.01) -> Scene:
    """Two chains of so many links each, all of which can touch the other chain's."""
    return _colliding(chain("first", links), chain("second", links), dt)


def two_balls(dt: float = 0.01) -> Scene:
    """Two footballs that can touch."""
    return _colliding(ball("first"), ball("second"), dt)


def _colliding(first: Body, second: Body, dt: float) -> Scene:
    """Two bodies with the same links."""
    links = tuple(link.name for link in first.links)
    return Scene((first, second), (Pair(first.name, second.name, links, links, first.surface),), dt)


def standing_height(body: Body) -> float:
    """Height of a human's pelvis above the ground in its rest pose [m]."""
    height, index = 0.0, body.link("left_foot")
    while index:
        joint = body.joints[index - 1]
        child, parent = body.links[index], body.links[joint.parent]
        height += _anchor_height(parent, joint.parent_anchor) - _anchor_height(child, joint.child_anchor)
        index = joint.parent
    return body.links[body.link("left_foot")].radius - height


def _anchor_height(link: Link, point: Vector) -> float:
    along = sum(a * p for a, p in zip(link.axis, point, strict=True)) * link.axis[2]
    return 0.5 * link.length * along + link.radius * (point[2] - along)

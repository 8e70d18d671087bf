"""Parametric builders: a ball, a capsule, a chain of capsules, a human; and the scenes they are used in."""

from __future__ import annotations

import math
from dataclasses import astuple, replace

import numpy as np

from larp_model.anatomy import ANATOMIES, KINDS, BodySegment, Detail
from larp_model.errors import InputError
from larp_model.names import require_known
from larp_model.scene import Body, Joint, Link, Pair, Scene, Surface, Vector

# A kicked football stays on the foot for about 10 ms and rebounds to 1.35-1.55 m when dropped from 2 m. This one stays
# for 9.7 ms and keeps 0.864 of its speed: it rebounds to 1.49 m.
BALL_SURFACE = Surface(stiffness=98_923.5195, damping=30.1645779, friction=0.6)
# One leg on the other: flesh has a longer contact time and less restitution than a ball. Chosen, not measured.
LEG_SURFACE = Surface.bouncing(contact_time=0.020, restitution=0.4, friction=0.5)


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not (math.isfinite(value) and value > 0.0):
            raise InputError(f"{name} is {value!r}, but must be a positive finite number")


def ball(name: str = "ball", radius: float = 0.11, mass: float = 0.43, surface: Surface = BALL_SURFACE) -> Body:
    """Return a ball; by default a FIFA size 5 football. radius [m], mass [kg]."""
    _positive(radius=radius, mass=mass)
    return Body(name, "ball", (Link("ball", 0.0, radius, mass),), surface=surface)


def capsule(
    name: str = "capsule", length: float = 0.4, radius: float = 0.08, mass: float = 1.0, surface: Surface = BALL_SURFACE
) -> Body:
    """Return a single free capsule. length (between the hemispheres' centres), radius [m], mass [kg]."""
    _positive(length=length, radius=radius, mass=mass)
    return Body(name, "capsule", (Link("capsule", length, radius, mass),), surface=surface)


def chain(name: str = "chain", links: int = 4, length: float = 0.3, radius: float = 0.06, mass: float = 1.0) -> Body:
    """Return capsules in a row, tied by ball joints without motors. length, radius [m] and mass [kg] of each."""
    if not isinstance(links, int) or links < 1:
        raise InputError(f"links is {links!r}, but must be an integer of at least 1")
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
    detail: Detail = "lean",
    motors: dict[str, float] | None = None,
) -> Body:
    """Return a human, standing upright in its rest pose, arms hanging, facing x, left towards y.

    height [m] and mass [kg] scale every segment. `lengths` and `radii` multiply single segments, by segment name
    without its side ("thigh", "foot", ...). detail: 13 links, or the full 26; see `anatomy`. Motors are in proportion,
    see `Body.sized`, and `motors` multiplies those of single segments' joints.
    """
    _positive(height=height, mass=mass)
    require_known("detail", detail, ANATOMIES)
    usual, size = _usual_human(name, detail), height / 1.75
    segments = [segment_of(link.name) for link in usual.links]
    lengths, radii, motors = dict(lengths or {}), dict(radii or {}), dict(motors or {})
    for argument, factors in (("lengths", lengths), ("radii", radii), ("motors", motors)):
        for segment, factor in factors.items():
            require_known(argument, segment, sorted(set(segments)))
            _positive(**{f"{argument}[{segment!r}]": factor})
    sizes = [
        (size * lengths.get(segment, 1.0) * link.length, size * radii.get(segment, 1.0) * link.radius, share)
        for segment, link, share in zip(segments, usual.links, mass / 70.0 * usual.sizes[:, 2], strict=True)
    ]
    larger = usual.sized(np.array(sizes))
    joints = (
        joint if joint.motor is None else replace(joint, motor=joint.motor.times(motors.get(segment, 1.0)))
        for joint, segment in zip(larger.joints, segments[1:], strict=True)
    )
    return replace(larger, joints=tuple(joints))


def segment_of(link: str) -> str:
    """Return the name of a human's link without its side."""
    return link.removeprefix("left_").removeprefix("right_")


def detail_of(body: Body) -> Detail:
    """Return the level of detail of a human; raise InputError for other bodies."""
    for detail, kind in KINDS.items():
        if body.kind == kind:
            return detail
    raise InputError(f"body {body.name!r} is a {body.kind}, but must be one of {', '.join(KINDS.values())}")


def usual(body: Body) -> Body:
    """Return the human of usual size of which this one is another size (see `Body.sized`); other bodies as they are."""
    if body.kind not in KINDS.values():
        return body
    same = replace(_usual_human(body.name, detail_of(body)), surface=body.surface)
    resized = same.sized(body.sizes)
    if resized.links != body.links or _without_motors(resized) != _without_motors(body):
        return body
    one, other = _motor_values(resized), _motor_values(body)
    return same if one.shape == other.shape and np.allclose(one, other, rtol=1e-9, atol=0.0) else body


def _motor_values(body: Body) -> np.ndarray:
    return np.array([np.concatenate([np.ravel(part) for part in astuple(motor)]) for _, _, motor in body.motors])


def _without_motors(body: Body) -> tuple[Joint, ...]:
    return tuple(replace(joint, motor=None) for joint in body.joints)


def _usual_human(name: str, detail: Detail) -> Body:
    """Return a human of 1.75 m and 70 kg."""
    anatomy = ANATOMIES[detail]
    rows = [
        *((segment, "") for segment in anatomy.middle),
        *((segment, side) for side in ("left_", "right_") for segment in anatomy.left),
    ]
    names = [side + segment.name for segment, side in rows]

    def joint(segment: BodySegment, side: str) -> Joint:
        parent = names.index(segment.above if segment.above in names else side + segment.above)
        motor, (sign, at, own) = segment.motor, (1.0, segment.parent_anchor, segment.child_anchor)
        if side == "right_":  # mirroring y turns roll and yaw round
            sign = -1.0
            if motor is not None:
                (x, y, z), (roll, pitch, yaw) = motor.lower, motor.upper
                motor = replace(motor, lower=(-roll, y, -yaw), upper=(-x, pitch, -z))
        return Joint(parent, (at[0], sign * at[1], at[2]), (own[0], sign * own[1], own[2]), motor)

    links = (
        Link(link_name, part.length, part.radius, 70.0 * part.share, part.axis)
        for link_name, (part, _) in zip(names, rows, strict=True)
    )
    return Body(name, KINDS[detail], tuple(links), tuple(joint(*row) for row in rows[1:]))


def human_and_ball(
    height: float = 1.75, mass: float = 70.0, dt: float = 0.01, detail: Detail = "lean", self_contact: bool = False
) -> Scene:
    """Return the kick's scene: a human and a football, which its `kicking_links` can touch; detail: see `human`.

    self_contact: whether one leg can touch the other, below the knee; else they pass through each other.
    """
    scene = kicking(human(height=height, mass=mass, detail=detail), ball(), dt)
    return replace(scene, pairs=(*scene.pairs, _legs(scene.human))) if self_contact else scene


def human_and_capsule(height: float = 1.75, mass: float = 70.0, dt: float = 0.01) -> Scene:
    """Return the scene of a human who can kick a capsule with thighs, shins and feet."""
    return kicking(human(height=height, mass=mass), capsule(), dt)


def kicking_links(person: Body) -> tuple[str, ...]:
    """Return the names of a human's links that can touch what it kicks: thighs, shins, feet, and toes if any."""
    return tuple(link.name for link in person.links if segment_of(link.name) in ("thigh", "shin", "foot", "toes"))


def _legs(person: Body) -> Pair:
    """Return the pair of both legs below the knee: above it they touch in any standing pose, and flesh is soft."""
    below = [name for name in kicking_links(person) if segment_of(name) != "thigh"]
    left, right = (tuple(name for name in below if name.startswith(side)) for side in ("left_", "right_"))
    return Pair(person.name, person.name, left, right, LEG_SURFACE)


def kicking(person: Body, struck: Body, dt: float = 0.01) -> Scene:
    """Return the scene of a human and what it kicks, of one link or more, with its `kicking_links`."""
    touching = tuple(link.name for link in struck.links)
    return Scene(
        (person, struck), (Pair(person.name, struck.name, kicking_links(person), touching, struck.surface),), dt
    )


def two_chains(links: int = 2, dt: float = 0.01) -> Scene:
    """Return the scene of two chains of so many links each, all of which can touch the other chain's."""
    return _colliding(chain("first", links), chain("second", links), dt)


def two_balls(dt: float = 0.01) -> Scene:
    """Return the scene of two footballs that can touch."""
    return _colliding(ball("first"), ball("second"), dt)


def _colliding(first: Body, second: Body, dt: float) -> Scene:
    """Return the scene of two bodies with the same links."""
    links = tuple(link.name for link in first.links)
    return Scene((first, second), (Pair(first.name, second.name, links, links, first.surface),), dt)


def standing_height(body: Body) -> float:
    """Return the height of a human's pelvis above the ground in its rest pose [m]."""
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

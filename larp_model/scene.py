"""Frozen, hashable descriptions of articulated bodies and of the scene they share.

A `Body` is a tree of capsule links. Every link frame sits at the link's centre of mass, and in the rest pose all
link frames of a body are parallel, so that a joint target of zero means the rest pose. Nothing here knows JAX or an
engine: the ground truth, the learned model, the planner and the viewer all read the same description.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError

Vector = tuple[float, float, float]


def _check(owner: str, name: str, value: float, minimum: float, *, strict: bool) -> None:
    if not (math.isfinite(value) and (value > minimum if strict else value >= minimum)):
        relation = ">" if strict else ">="
        raise InputError(f"{owner}.{name} is {value!r}, but must be a finite number {relation} {minimum:g}")


def _check_vector(owner: str, name: str, value: Vector) -> None:
    if len(value) != 3 or not all(math.isfinite(v) for v in value):
        raise InputError(f"{owner}.{name} is {value!r}, but must be three finite numbers")


@dataclass(frozen=True)
class Link:
    """A capsule of uniform density.

    length: distance between the centres of its two hemispheres [m]; 0 makes it a ball.
    radius: [m]. mass: [kg]. axis: unit vector along the capsule, in the link frame.
    """

    name: str
    length: float
    radius: float
    mass: float
    axis: Vector = (0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        owner = f"link {self.name!r}"
        _check(owner, "length", self.length, 0.0, strict=False)
        _check(owner, "radius", self.radius, 0.0, strict=True)
        _check(owner, "mass", self.mass, 0.0, strict=True)
        _check_vector(owner, "axis", self.axis)
        if abs(math.hypot(*self.axis) - 1.0) > 1e-6:
            raise InputError(f"{owner}.axis is {self.axis!r}, but must have unit length")


@dataclass(frozen=True)
class Motor:
    """A PD servo on the rotation vector of a ball joint.

    stiffness: [N m/rad]. damping: [N m s/rad]. torque_limit: per axis [N m].
    lower, upper: bounds of the joint target, a rotation vector relative to the parent [rad].
    armature: inertia that the motor itself adds to the joint [kg m^2].
    """

    stiffness: float
    damping: float
    torque_limit: float
    lower: Vector
    upper: Vector
    armature: float = 0.0

    def __post_init__(self) -> None:
        _check("motor", "armature", self.armature, 0.0, strict=False)
        _check("motor", "stiffness", self.stiffness, 0.0, strict=True)
        _check("motor", "damping", self.damping, 0.0, strict=False)
        _check("motor", "torque_limit", self.torque_limit, 0.0, strict=True)
        _check_vector("motor", "lower", self.lower)
        _check_vector("motor", "upper", self.upper)
        if any(low > high for low, high in zip(self.lower, self.upper, strict=True)):
            raise InputError(f"motor.lower is {self.lower!r}, but must not exceed motor.upper {self.upper!r}")

    def times(self, factor: float) -> Motor:
        """Return a motor of `factor` times the stiffness, damping, torque limit and armature."""
        changed = {name: factor * getattr(self, name) for name in ("stiffness", "damping", "torque_limit", "armature")}
        return replace(self, **changed)


@dataclass(frozen=True)
class Joint:
    """A ball joint that ties a link to its parent.

    The anchors are dimensionless, so that they follow the link's size: along the link's axis in units of half its
    length, across it in units of its radius. damping: passive [N m s/rad], for joints without a motor.
    """

    parent: int
    parent_anchor: Vector
    child_anchor: Vector
    motor: Motor | None = None
    damping: float = 0.0

    def __post_init__(self) -> None:
        _check_vector("joint", "parent_anchor", self.parent_anchor)
        _check_vector("joint", "child_anchor", self.child_anchor)
        _check("joint", "damping", self.damping, 0.0, strict=False)


# Of a critically damped spring.
LEAST_RESTITUTION = math.exp(-2.0)


@dataclass(frozen=True)
class Surface:
    """The contact law of two bodies: a damped spring on their penetration r, r'' = -stiffness r - damping r'.

    stiffness: [1/s^2]. damping: [1/s]; both are per unit of effective mass, as in MuJoCo. friction: Coulomb's.
    """

    stiffness: float
    damping: float
    friction: float

    def __post_init__(self) -> None:
        _check("surface", "stiffness", self.stiffness, 0.0, strict=True)
        _check("surface", "damping", self.damping, 0.0, strict=False)
        _check("surface", "friction", self.friction, 0.0, strict=False)

    @staticmethod
    def bouncing(contact_time: float, restitution: float, friction: float) -> Surface:
        """Return the surface whose free impact lasts `contact_time` [s] and restores `restitution` of the speed.

        An impact ends where the damped spring no longer pushes (T. Schwager and T. Pöschel, Granular Matter 9 (2007),
        "Coefficient of restitution and linear-dashpot model revisited").
        """
        _check("surface", "contact_time", contact_time, 0.0, strict=True)
        if not LEAST_RESTITUTION < restitution <= 1.0:
            raise InputError(
                f"surface.restitution is {restitution!r}, but must be in ({LEAST_RESTITUTION:.3g}, 1]: with less, the "
                "spring does not swing"
            )

        def phase(ratio: float) -> float:
            return math.pi - 2.0 * math.atan(ratio)

        # Ratio of the spring's decay [1/s] to its angular frequency [rad/s].
        ratio = brentq(lambda ratio: ratio * phase(ratio) + math.log(restitution), 0.0, 1e4, xtol=1e-12)
        frequency = phase(ratio) / contact_time
        decay = ratio * frequency
        return Surface(frequency**2 + decay**2, 2.0 * decay, friction)


@dataclass(frozen=True)
class Body:
    """A tree of links. `joints[i]` ties `links[i + 1]` to a link before it; `links[0]` is the free root.

    kind: bodies of one kind share one dynamics network. surface: contact with the ground.
    """

    name: str
    kind: str
    links: tuple[Link, ...]
    joints: tuple[Joint, ...] = ()
    surface: Surface = field(default_factory=lambda: Surface(4000.0, 120.0, 1.0))

    def __post_init__(self) -> None:
        if not self.links:
            raise InputError(f"body {self.name!r} has no links, but needs at least one")
        if len(self.joints) != len(self.links) - 1:
            raise InputError(
                f"body {self.name!r} has {len(self.joints)} joints, but its {len(self.links)} links need "
                f"{len(self.links) - 1}"
            )
        for child, joint in enumerate(self.joints, start=1):
            if not 0 <= joint.parent < child:
                raise InputError(
                    f"body {self.name!r}: the parent of link {child} is {joint.parent}, but must be in [0, {child})"
                )
        names = [link.name for link in self.links]
        if len(set(names)) != len(names):
            raise InputError(f"body {self.name!r} has link names {names}, but they must differ")

    @property
    def is_ball(self) -> bool:
        """Return whether the body is one sphere, so that no direction of its frame matters."""
        return len(self.links) == 1 and self.links[0].length == 0.0

    @property
    def parents(self) -> np.ndarray:
        """Return the rows (n - 1,) of the parents of all links but the root; joint j is that of link j + 1."""
        return np.array([joint.parent for joint in self.joints], int)

    @property
    def ancestors(self) -> np.ndarray:
        """Return (n, n - 1) 1 where a joint is between a link and the root, else 0."""
        matrix = np.zeros((len(self.links), len(self.joints)))
        for joint, parent in enumerate(self.parents):
            matrix[joint + 1] = matrix[parent]
            matrix[joint + 1, joint] = 1.0
        return matrix

    @property
    def motors(self) -> tuple[tuple[int, Joint, Motor], ...]:
        """Return (child link, joint, motor) of each motorised joint."""
        return tuple((i, j, j.motor) for i, j in enumerate(self.joints, start=1) if j.motor is not None)

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds of the joint targets, both (J, 3) [rad]."""
        bounds = np.array([(motor.lower, motor.upper) for _, _, motor in self.motors]).reshape(-1, 2, 3)
        return bounds[:, 0], bounds[:, 1]

    def angles(self, orientations: np.ndarray) -> np.ndarray:
        """Return the angles (T, J, 3) [rad] of motorised joints: rotation vectors of children in their parents' frames.

        orientations: (T, n, 4) of the links, w, x, y, z.
        """
        rotations = [Rotation.from_quat(orientations[:, row], scalar_first=True) for row in range(len(self.links))]
        angles = [(rotations[joint.parent].inv() * rotations[child]).as_rotvec() for child, joint, _ in self.motors]
        return np.stack(angles, axis=1)

    def pose(self, root: np.ndarray, angles: np.ndarray) -> np.ndarray:
        """Return the orientations (T, n, 4) of the links, w, x, y, z: see `angles`, of which it is the inverse.

        root: orientations (T, 4) of the root. angles: (T, J, 3) [rad]; joints without a motor are in their rest pose.
        """
        rotations = [Rotation.from_quat(root, scalar_first=True)]
        motor_rows = {child: row for row, (child, _, _) in enumerate(self.motors)}
        for child, joint in enumerate(self.joints, start=1):
            parent = rotations[joint.parent]
            row = motor_rows.get(child)
            rotations.append(parent if row is None else parent * Rotation.from_rotvec(angles[:, row]))
        return np.stack([rotation.as_quat(scalar_first=True) for rotation in rotations], axis=1)

    @property
    def sizes(self) -> np.ndarray:
        """Return length [m], radius [m] and mass [kg] of every link, (n, 3)."""
        return np.array([(link.length, link.radius, link.mass) for link in self.links])

    @property
    def mass_length(self) -> float:
        """Return the mass [kg] of all links times their length [m], to which motors are in proportion."""
        return sum(link.mass for link in self.links) * sum(link.length for link in self.links)

    def sized(self, sizes: np.ndarray) -> Body:
        """Return the body with links of these lengths [m], radii [m], masses [kg], (n, 3), and motors in proportion."""
        links = tuple(
            replace(link, length=length, radius=radius, mass=mass)
            for link, (length, radius, mass) in zip(self.links, np.asarray(sizes, float).tolist(), strict=True)
        )
        larger = replace(self, links=links)
        if not self.motors:
            return larger
        factor = larger.mass_length / self.mass_length
        joints = (
            joint if joint.motor is None else replace(joint, motor=joint.motor.times(factor)) for joint in self.joints
        )
        return replace(larger, joints=tuple(joints))

    def link(self, name: str) -> int:
        """Return the index of a link by name."""
        for index, link in enumerate(self.links):
            if link.name == name:
                return index
        raise InputError(f"body {self.name!r} has no link {name!r}; it has {[link.name for link in self.links]}")

    def adjacent(self, one: str, other: str) -> bool:
        """Return whether two links are the same, or one is the other's parent."""
        near, far = sorted((self.link(one), self.link(other)))
        return near == far or self.joints[far - 1].parent == near


@dataclass(frozen=True)
class Pair:
    """Two bodies that can touch, with the links of each that can; what is not named is not simulated.

    Where both are one body, links of it can touch others of it.
    """

    first: str
    second: str
    first_links: tuple[str, ...]
    second_links: tuple[str, ...]
    surface: Surface

    @property
    def of_itself(self) -> bool:
        """Return whether a body touches itself."""
        return self.first == self.second

    def flipped(self) -> Pair:
        """Return the same pair with its bodies in the other order."""
        return Pair(self.second, self.first, self.second_links, self.first_links, self.surface)


@dataclass(frozen=True)
class Scene:
    """Bodies, which of them can touch, the time step [s] of states and controls, and gravity [m/s^2]."""

    bodies: tuple[Body, ...]
    pairs: tuple[Pair, ...] = ()
    dt: float = 0.01
    gravity: float = 9.81

    def __post_init__(self) -> None:
        _check("scene", "dt", self.dt, 0.0, strict=True)
        _check("scene", "gravity", self.gravity, 0.0, strict=False)
        names = [body.name for body in self.bodies]
        if not names or len(set(names)) != len(names):
            raise InputError(f"scene.bodies are named {names}, but need one or more different names")
        paired_bodies = [tuple(sorted((pair.first, pair.second))) for pair in self.pairs]
        if len(set(paired_bodies)) != len(paired_bodies):
            raise InputError(f"scene.pairs are of {paired_bodies}, but two bodies may be named together once")
        for pair in self.pairs:
            for name, links in ((pair.first, pair.first_links), (pair.second, pair.second_links)):
                if not links or len(set(links)) != len(links):
                    raise InputError(f"scene.pairs names the links {links} of {name!r}, but needs some, each once")
                for link in links:
                    self.body(name).link(link)
            for one, other in product(pair.first_links, pair.second_links):
                if pair.of_itself and self.body(pair.first).adjacent(one, other):
                    raise InputError(
                        f"scene.pairs lets {one!r} and {other!r} of {pair.first!r} touch, but they are one link, or "
                        "tied by a joint"
                    )

    @property
    def human(self) -> Body:
        """Return the first body, which must have motors."""
        if not self.bodies[0].motors:
            raise InputError(f"scene.bodies begin with {self.bodies[0].name!r}, but a human with motors must be first")
        return self.bodies[0]

    @property
    def ball(self) -> Body:
        """Return the last body, which must be one sphere."""
        if not self.bodies[-1].is_ball:
            raise InputError(f"scene.bodies end with {self.bodies[-1].name!r}, but a ball must be last")
        return self.bodies[-1]

    def body(self, name: str) -> Body:
        """Return the body of that name."""
        for body in self.bodies:
            if body.name == name:
                return body
        raise InputError(f"scene has no body {name!r}; it has {[body.name for body in self.bodies]}")

    def rows(self, name: str) -> slice:
        """Return the rows of a body in the state."""
        return self._slice(name, lambda body: len(body.links))

    def joint_rows(self, name: str) -> slice:
        """Return the rows of a body's joints among all joints."""
        return self._slice(name, lambda body: len(body.joints))

    def motor_rows(self, name: str) -> slice:
        """Return the rows of a body in the control."""
        return self._slice(name, lambda body: len(body.motors))

    def _slice(self, name: str, count: Callable[[Body], int]) -> slice:
        start, body = 0, self.body(name)
        for earlier in self.bodies[: self.bodies.index(body)]:
            start += count(earlier)
        return slice(start, start + count(body))

    def index(self, body: str, link: str) -> int:
        """Return the row of a link in the state."""
        start: int = self.rows(body).start
        return start + self.body(body).link(link)

    @property
    def links(self) -> tuple[Link, ...]:
        """Return all links, in the order of the state."""
        return tuple(link for body in self.bodies for link in body.links)

    @property
    def morphology(self) -> np.ndarray:
        """Return length [m], radius [m] and mass [kg] of every link, (L, 3)."""
        return np.array([(link.length, link.radius, link.mass) for link in self.links], np.float32)

    @property
    def motors(self) -> tuple[Motor, ...]:
        """Return all motors, in the order of the control."""
        return tuple(motor for body in self.bodies for _, _, motor in body.motors)

    @property
    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds of all joint targets, both (J, 3) [rad]."""
        lower, upper = zip(*(body.limits for body in self.bodies), strict=True)
        return np.concatenate(lower), np.concatenate(upper)

    def joints(self) -> Iterator[tuple[int, int, Joint]]:
        """Yield (row of the child, row of the parent, joint) for every joint."""
        for body in self.bodies:
            start = self.rows(body.name).start
            for child, joint in enumerate(body.joints, start=1):
                yield start + child, start + joint.parent, joint

    def sized(self, morphology: np.ndarray) -> Scene:
        """Return the scene with links of these lengths [m], radii [m] and masses [kg], (L, 3): see `Body.sized`."""
        sizes = np.asarray(morphology, float)
        if sizes.shape != (len(self.links), 3):
            raise InputError(f"morphology has shape {sizes.shape}, but needs ({len(self.links)}, 3)")
        return replace(self, bodies=tuple(body.sized(sizes[self.rows(body.name)]) for body in self.bodies))

    @property
    def between(self) -> Scene:
        """Return the scene with contacts of different bodies alone."""
        return replace(self, pairs=tuple(pair for pair in self.pairs if not pair.of_itself))

    @property
    def within(self) -> Scene:
        """Return the scene with contacts of bodies with themselves alone."""
        return replace(self, pairs=tuple(pair for pair in self.pairs if pair.of_itself))

    def only(self, *names: str) -> Scene:
        """Return the scene with these bodies alone."""
        pairs = tuple(p for p in self.pairs if p.first in names and p.second in names)
        return Scene(tuple(self.body(name) for name in names), pairs, self.dt, self.gravity)


def anchor(point: Vector, length: np.ndarray, radius: np.ndarray, axis: Vector) -> np.ndarray:
    """Return a joint anchor in its link's frame [m], (*, 3), for links of `length` and `radius` (*,) [m]."""
    direction, offset = np.asarray(axis), np.asarray(point)
    along = offset @ direction * direction
    place: np.ndarray = 0.5 * length[..., None] * along + radius[..., None] * (offset - along)
    return place

"""What a part is: all that the simulator knows of one kind of body, or of two kinds that touch.

A part is frozen, and everything that its weights depend on is a field of it: a body, the time step, constants, the
sizes of its networks. A model is a scene with a part for every body and every pair, and no other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
from jax import Array

from larp_model.errors import InputError
from larp_model.kinematics import Kinematics, kinematics, morphology_of
from larp_model.meeting import Velocities
from larp_model.networks import Measured, Perceptron, Weights
from larp_model.scene import Body, Pair, Scene


class Moving(NamedTuple):
    """A body on its way through a step.

    free: its velocities at the end, as far as they are known, if nothing touches. kept: whatever its part wants to know
    again when it responds.
    """

    free: Velocities
    kept: Any


class Hits(NamedTuple):
    """What all contacts do to the links of a body in a step.

    push: impulse [N s] and its moment about the links' centres [N m s], (B, n, 6), or what was learned in their stead.
    travel: impulse times the share of the step for which it acts on the position, (B, n, 3) [N s^2].
    """

    push: Array
    travel: Array

    def plus(self, more: Hits) -> Hits:
        """Both together."""
        return Hits(self.push + more.push, self.travel + more.travel)

    def scaled(self, scale: tuple[float, float]) -> Array:
        """The two halves of the push (B, 2 n, 3) in these units, as a network sees them."""
        return jnp.concatenate([self.push[..., :3] / scale[0], self.push[..., 3:] / scale[1]], axis=1)

    @staticmethod
    def none(seen: Kinematics) -> Hits:
        """Where nothing touches."""
        size, dtype = seen.state.shape[:2], seen.state.dtype
        return Hits(jnp.zeros((*size, 6), dtype), jnp.zeros((*size, 3), dtype))


class ModelledBody(Protocol):
    """The part of a model for one body."""

    @property
    def body(self) -> Body: ...

    @property
    def invariant(self) -> bool:
        """Whether turning the world about z turns what it does; else training has to teach it."""

    def networks(self) -> dict[str, Perceptron]:
        """Its networks by name."""

    def measure(self, seen: Kinematics, after: Array, control: Array, torque: Array) -> tuple[Measured, Velocities]:
        """Statistics of its networks, from true steps to states (B, n, 13).

        And the velocities with which the statistics of contacts are taken: see `Moving.free`.
        """


class BodyPart(ModelledBody, Protocol):
    """f_d of a body, whose contacts are parts of their own."""

    def move(self, weights: Weights, seen: Kinematics, control: Array, torque: Array) -> Moving:
        """The body in a step if nothing touches it; control (B, j, 3) [rad], torque (B, n, 3) [N m]."""

    def respond(self, weights: Weights, seen: Kinematics, moving: Moving, hits: Hits) -> Array:
        """Its next states (B, n, 13)."""


class ModelledPair(Protocol):
    """The part of a model for two bodies that can touch."""

    @property
    def bodies(self) -> tuple[Body, Body]: ...

    def networks(self) -> dict[str, Perceptron]:
        """Its networks by name."""

    def measure(self, seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]) -> Measured:
        """Statistics of its networks; where links are near, for elsewhere they are not heard."""


class PairPart(ModelledPair, Protocol):
    """f_c of two bodies."""

    def meet(
        self, weights: Weights, seen: tuple[Kinematics, Kinematics], free: tuple[Velocities, Velocities]
    ) -> tuple[Hits, Hits]:
        """What the two bodies do to each other."""


@dataclass(frozen=True)
class Model:
    """A scene and its parts, in the order of its bodies and pairs. Static under jit."""

    scene: Scene
    bodies: tuple[ModelledBody, ...]
    pairs: tuple[ModelledPair, ...]

    @property
    def parts(self) -> tuple[ModelledBody | ModelledPair, ...]:
        """All parts."""
        return (*self.bodies, *self.pairs)

    @property
    def invariant(self) -> bool:
        """Whether turning the world about z turns what it does."""
        return all(part.invariant for part in self.bodies)

    def networks(self) -> dict[str, Perceptron]:
        """The networks of all parts, by name; bodies of one kind share theirs."""
        return {name: network for part in self.parts for name, network in part.networks().items()}

    def each(self, seen: Kinematics) -> list[Kinematics]:
        """The kinematics of every body."""
        return [seen.of(self.scene, part.body.name) for part in self.bodies]

    def on(self, scene: Scene) -> Model:
        """The same parts in a scene of bodies of the same kinds, or of some of them."""
        return assemble(scene, self.parts)

    def of(self, pair: ModelledPair) -> tuple[int, int]:
        """Which bodies a pair is of."""
        first, second = (self.scene.bodies.index(body) for body in pair.bodies)
        return first, second


def measure(
    model: Model, before: Array, after: Array, control: Array, torque: Array, morphology: Array | None = None
) -> Measured:
    """Statistics of inputs and outputs by network, from true steps (B, L, 13) -> (B, L, 13).

    morphology (B or 1, L, 3); the scene's by default. The true step stands for the one without contact.
    """
    scene = model.scene
    sizes = morphology_of(scene)[None] if morphology is None else morphology
    seen = model.each(kinematics(scene, before, sizes))
    found: Measured = {}
    free = []
    for part, own in zip(model.bodies, seen, strict=True):
        rows, motors = scene.rows(part.body.name), scene.motor_rows(part.body.name)
        measured, foreseen = part.measure(own, after[:, rows], control[:, motors], torque[:, rows])
        found |= measured
        free.append(foreseen)
    for pair in model.pairs:
        first, second = model.of(pair)
        found |= pair.measure((seen[first], seen[second]), (free[first], free[second]))
    return found


def initial_weights(model: Model, key: Array, statistics: Measured) -> Weights:
    """Fresh networks; `statistics` as `measure` gives them."""
    networks: dict[str, Any] = {}
    for index, (name, module) in enumerate(sorted(model.networks().items())):
        size = statistics[name][0].mean.shape[0]
        networks[name] = module.init(jax.random.fold_in(key, index), jnp.zeros((1, size)))
    inputs = {name: statistics[name][0].floored for name in networks}
    outputs = {name: found.floored for name in networks if (found := statistics[name][1]) is not None}
    return Weights(networks, inputs, outputs)


def name_of(*bodies: Body) -> str:
    """How the kinds of these bodies are called in the names of networks; one with itself is no two of a kind."""
    if len(bodies) == 2 and bodies[0] == bodies[1]:
        return f"{bodies[0].kind}-itself"
    return "-".join(body.kind for body in bodies)


def bodies_of(part: ModelledBody | ModelledPair) -> tuple[Body, ...]:
    """The body or the two bodies that a part is of."""
    return part.bodies if hasattr(part, "bodies") else (part.body,)


def ordered(scene: Scene) -> Iterator[tuple[Pair, tuple[Body, Body]]]:
    """The scene's pairs with their bodies in the order of their kinds, whichever is named first."""
    for pair in scene.pairs:
        first, second = scene.body(pair.first), scene.body(pair.second)
        yield (pair, (first, second)) if first.kind <= second.kind else (pair.flipped(), (second, first))


def assemble(scene: Scene, parts: Sequence[ModelledBody | ModelledPair]) -> Model:
    """The model of a scene from those parts that it needs, found by the kinds of their bodies."""
    known = {name_of(*bodies_of(part)): part for part in parts}

    def found(*bodies: Body) -> Any:
        if name_of(*bodies) not in known:
            raise InputError(f"there is no part {name_of(*bodies)!r} for this scene, but {', '.join(known)}")
        return known[name_of(*bodies)]

    own = tuple(replace(found(body), body=body) for body in scene.bodies)
    pairs = []
    for pair, bodies in ordered(scene):
        pairs.append(replace(found(*bodies), bodies=bodies, pair=pair))
    return Model(scene, own, tuple(pairs))

"""Which parts a simulator is made of, and how large their networks are.

compact   everything that a body does is learned; the kick's
hybrid    bodies move and press on each other as mechanics says, and networks correct that; all else's
paper     the networks and sizes of the paper
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from larp_model.mechanics import Constants
from larp_model.networks import Size
from larp_model.parts.articulated import Articulated, BodyBase, Response
from larp_model.parts.bases import FromNothing, OverMechanics
from larp_model.parts.contact import Contact, ContactBase
from larp_model.parts.impacts import FreeImpact, SoftContacts
from larp_model.parts.paper import PaperBody, PaperContact
from larp_model.parts.part import Model, ModelledBody, ModelledPair, ordered
from larp_model.parts.residual import FreeBall, ResidualBody, SoftContact
from larp_model.parts.sphere import Sphere
from larp_model.scene import Body, Pair, Scene
from larp_model.soft_contact import Rule


@dataclass(frozen=True)
class Sizes:
    """Of the networks of articulated bodies, of balls, and of contacts with the responses to them."""

    body: Size
    ball: Size
    contact: Size


COMPACT = Sizes(Size(6, 256), Size(2, 32), Size(4, 128))
LEAST = Sizes(Size(2, 16), Size(2, 16), Size(2, 16))  # that have all parts
PAPER = Sizes(Size(12, 512, skip=False), Size(12, 128, skip=False), Size(6, 128, skip=False))

SizeName = Literal["tiny", "small", "base"]
# Of the hybrid design. Of what is measured in any human, it is launches that a larger network improves.
SIZES: dict[SizeName, Sizes] = {
    "tiny": Sizes(Size(3, 64), Size(2, 32), Size(3, 64)),
    "small": Sizes(Size(5, 128), Size(2, 32), Size(4, 128)),
    "base": Sizes(Size(5, 128), Size(2, 32), Size(6, 256)),
}


# By which joints resist an impact of 10 ms [s]: an ankle's takes 2 ms, a knee's 10.
FADES = (0.002, 0.01)


def compact(scene: Scene, sizes: Sizes = COMPACT) -> Model:
    """The model that the kick is planned with."""
    impact = FreeImpact(), sizes.contact
    return _impulsive(scene, sizes, FromNothing(), impact, impact)


def hybrid(scene: Scene, sizes: Sizes = SIZES["small"]) -> Model:
    """The model over mechanics."""
    # A body's own links press on each other for longer than an impact: with fading, legs slip further through. What a
    # network learned there was no better than mechanics for the lean human, and worse for the full one.
    between, within = (SoftContacts(Rule(fades=FADES)), sizes.contact), (SoftContacts(), None)
    return _impulsive(scene, sizes, OverMechanics(Constants(rounds=3), lasting=True), between, within, sliding=True)


def physical(scene: Scene, size: Size | None = None) -> Model:
    """Return the model over physics of bodies and contacts; size: of the networks of bodies, None for none."""

    def body_part(body: Body) -> ModelledBody:
        if body.is_ball:
            return FreeBall(body, scene.dt, scene.gravity)
        return ResidualBody(body, scene.dt, scene.gravity, size)

    return _made(scene, body_part, lambda bodies, pair: SoftContact(bodies, pair, scene.dt, scene.gravity))


def paper(scene: Scene, sizes: Sizes = PAPER) -> Model:
    """The paper's model."""

    def body_part(body: Body) -> ModelledBody:
        return PaperBody(body, scene.dt, sizes.ball if body.is_ball else sizes.body)

    return _made(scene, body_part, lambda bodies, pair: PaperContact(bodies, pair, scene.dt, sizes.contact))


DesignName = Literal["compact", "hybrid", "paper"]
DESIGNS: dict[DesignName, Callable[[Scene], Model]] = {"compact": compact, "hybrid": hybrid, "paper": paper}


_Contacts = tuple[ContactBase, Size | None]


def _impulsive(
    scene: Scene, sizes: Sizes, base: BodyBase, between: _Contacts, within: _Contacts, sliding: bool = False
) -> Model:
    """Bodies and contacts that are impulses, on these bases, with networks of these sizes: of two, within one."""

    def body_part(body: Body) -> ModelledBody:
        if body.is_ball:
            return Sphere(body, scene.dt, scene.gravity, sizes.ball, sliding=sliding)
        touched = any(body.name in (pair.first, pair.second) for pair in scene.pairs)
        response = Response(sizes.contact) if touched else None
        return Articulated(body, scene.dt, scene.gravity, base, sizes.body, response)

    def pair_part(bodies: tuple[Body, Body], pair: Pair) -> ModelledPair:
        return Contact(bodies, pair, scene.dt, scene.gravity, *(within if pair.first == pair.second else between))

    return _made(scene, body_part, pair_part)


def _made(
    scene: Scene,
    body_part: Callable[[Body], ModelledBody],
    pair_part: Callable[[tuple[Body, Body], Pair], ModelledPair],
) -> Model:
    pairs = (pair_part(bodies, pair) for pair, bodies in ordered(scene))
    return Model(scene, tuple(body_part(body) for body in scene.bodies), tuple(pairs))

"""Weights on disk: tensors as safetensors, and a manifest that says of which parts they are and how they came to be."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load as parse
from safetensors.numpy import save as serialise

from larp_model import mechanics, meeting
from larp_model import state as packed
from larp_model.errors import InputError
from larp_model.files import write_whole
from larp_model.names import require_file
from larp_model.networks import Size, Statistics, Weights
from larp_model.parts.articulated import Articulated, Response
from larp_model.parts.bases import FromNothing, OverMechanics
from larp_model.parts.contact import Contact
from larp_model.parts.impacts import FreeImpact, SoftContacts
from larp_model.parts.paper import PaperBody, PaperContact
from larp_model.parts.part import (
    Model,
    ModelledBody,
    ModelledPair,
    assemble,
    bodies_of,
    initial_weights,
    measure,
    name_of,
    ordered,
)
from larp_model.parts.residual import FreeBall, ResidualBody, SoftContact
from larp_model.parts.sphere import Sphere
from larp_model.physics.collision import ContactSettings
from larp_model.scene import Body, Joint, Link, Motor, Pair, Scene, Surface
from larp_model.soft_contact import Rule

VERSION = 3
SHIPPED = Path(__file__).parent / "weights"
# Motors may be so much stronger or weaker than those of the training where mechanics is what says what they do: with
# motors of 0.8 and 1.2 times the strength a human is predicted as well as with its own (tests/test_shipped.py).
MOTORS = 0.2
# What a manifest may speak of, by the name that it gives it.
KINDS: dict[str, Any] = {
    "articulated": Articulated,
    "body": Body,
    "contact": Contact,
    "contact settings": ContactSettings,
    "free ball": FreeBall,
    "free impact": FreeImpact,
    "from nothing": FromNothing,
    "joint": Joint,
    "link": Link,
    "mechanics": mechanics.Constants,
    "meeting": meeting.MeetingConstants,
    "motor": Motor,
    "over mechanics": OverMechanics,
    "pair": Pair,
    "paper's body": PaperBody,
    "paper's contact": PaperContact,
    "residual body": ResidualBody,
    "response": Response,
    "rule": Rule,
    "soft contact": SoftContact,
    "soft contacts": SoftContacts,
    "size": Size,
    "sphere": Sphere,
    "surface": Surface,
}
NAMES = {kind: name for name, kind in KINDS.items()}


class Trained(NamedTuple):
    """The sizes of links that a body's part has learned from, by rows of (length, radius, mass), (n, 3) each."""

    lowest: np.ndarray
    highest: np.ndarray


def trained_on(scene: Scene, morphology: np.ndarray) -> dict[str, Trained]:
    """What episodes of a morphology (E, L, 3) teach of every kind of body."""
    found: dict[str, list[np.ndarray]] = {}
    for body in scene.bodies:
        found.setdefault(body.kind, []).append(morphology[:, scene.rows(body.name)])
    return {
        kind: Trained(np.concatenate(sizes).min(axis=0), np.concatenate(sizes).max(axis=0))
        for kind, sizes in found.items()
    }


def encode(value: Any) -> Any:
    """A part, and all that it is made of, as JSON holds it."""
    if dataclasses.is_dataclass(value):
        fields = {field.name: encode(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"type": NAMES[type(value)], **fields}
    return [encode(each) for each in value] if isinstance(value, tuple) else value


def decode(value: Any) -> Any:
    """What `encode` made this of."""
    if isinstance(value, dict):
        fields = {name: decode(each) for name, each in value.items() if name != "type"}
        return KINDS[value["type"]](**fields)
    return tuple(decode(each) for each in value) if isinstance(value, list) else value


def flatten(weights: Weights) -> dict[str, Any]:
    """Weights as named arrays."""
    tree = weights._asdict()
    for group in ("inputs", "outputs"):
        tree[group] = {name: each._asdict() for name, each in tree[group].items()}
    return dict(flatten_dict(tree, sep=":"))


def unflatten(arrays: Mapping[str, np.ndarray]) -> Weights:
    """Weights from named arrays."""
    tree = unflatten_dict({name: jnp.asarray(array) for name, array in arrays.items()}, sep=":")
    seen = ({name: Statistics(**each) for name, each in tree.get(group, {}).items()} for group in ("inputs", "outputs"))
    return Weights(tree.get("networks", {}), *seen)


def save(
    folder: Path, name: str, model: Model, weights: Weights, recipe: Mapping[str, Any],
    morphology: np.ndarray | None = None,
) -> Path:  # fmt: skip
    """Write `name`.safetensors and `name`.json into the folder, each whole or not at all; returns the manifest's path.

    recipe: how and on what the weights were trained, and their scores; anything JSON holds. morphology: (E, L, 3) of
    what they were trained on; the scene's by default.
    """
    arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in flatten(weights).items()}
    tensors = serialise(arrays)
    sizes = np.asarray(model.scene.morphology[None] if morphology is None else morphology, np.float64)
    trained = {
        kind: {name: np.round(each, 6).tolist() for name, each in found._asdict().items()}
        for kind, found in trained_on(model.scene, sizes).items()
    }
    manifest = {
        "version": VERSION,
        "parts": [encode(part) for part in model.parts],
        "trained on": trained,
        "sha256": hashlib.sha256(tensors).hexdigest(),
        "recipe": recipe,
    }
    # Tensors first: a crash between the two leaves a manifest whose hash refuses them, not a silent mixture.
    write_whole(folder / f"{name}.safetensors", tensors)
    write_whole(folder / f"{name}.json", (json.dumps(manifest, indent=1) + "\n").encode())
    return folder / f"{name}.json"


def load(manifest: Path, scene: Scene | None, partly: bool = False) -> tuple[Model, Weights, dict[str, Any]]:
    """The scene's model, its weights and the whole manifest; refuses what is missing, damaged or does not fit.

    scene: None for that which the parts were made for. partly: contacts of which the weights know nothing are left out
    of the model, instead of refused.
    """
    tensors_path = manifest.with_suffix(".safetensors")
    for path in (manifest, tensors_path):
        require_file("weights", path)
    try:
        content = dict(json.loads(manifest.read_text()))
        version, expected = content["version"], content["sha256"]
        known = version == VERSION
        parts = [decode(part) for part in content["parts"]] if known else []
        trained = trained_sizes(content) if known else {}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"weights manifest {manifest} cannot be read: {type(error).__name__}: {error}") from None
    if not known:
        raise InputError(f"weights {manifest} are of version {version!r}, but {VERSION} is needed")
    scene = scene or scene_of(parts)
    if partly:
        names = {name_of(*bodies_of(part)) for part in parts}
        both = zip(scene.pairs, ordered(scene), strict=True)
        kept = tuple(pair for pair, (_, bodies) in both if name_of(*bodies) in names)
        scene = dataclasses.replace(scene, pairs=kept)
    try:
        model = assemble(scene, parts)
    except InputError as error:
        train = "train some with `python -m tasks.train --scene NAME`, or FILE.py:NAME for a scene of your own"
        raise InputError(f"weights {manifest}: {error}; {train}") from None
    for part in parts:
        for difference in differences(part, scene, trained):
            raise InputError(f"weights {manifest} do not fit the scene: {difference}")
    raw = tensors_path.read_bytes()
    if hashlib.sha256(raw).hexdigest() != expected:
        raise InputError(f"weights file {tensors_path} is damaged: its sha256 is not the one in {manifest.name}")
    wanted = model.networks()
    arrays = {name: array for name, array in parse(raw).items() if name.split(":")[1] in wanted}
    _check_shapes(tensors_path, arrays, shapes(model))
    return model, unflatten(arrays), content


def scene_of(parts: Sequence[ModelledBody | ModelledPair]) -> Scene:
    """The scene that parts were made for."""
    bodies = tuple(body for part in parts if not hasattr(part, "pair") for body in bodies_of(part))
    order = [body.name for body in bodies]
    pairs = (part.pair for part in parts if hasattr(part, "pair"))
    named = (pair if order.index(pair.first) <= order.index(pair.second) else pair.flipped() for pair in pairs)
    said = {name: value for part in parts for name in ("dt", "gravity") if (value := getattr(part, name, None))}
    return Scene(bodies, tuple(named), **said)


def differences(part: ModelledBody | ModelledPair, scene: Scene, trained: Mapping[str, Trained]) -> Iterator[str]:
    """In what the scene, where it needs the part, is not what that was trained for, each in a few words."""
    if isinstance(part, ResidualBody | FreeBall | SoftContact) and not part.networks():
        return  # physics alone, of any body
    for own in bodies_of(part):
        for body in scene.bodies:
            if body.kind == own.kind:
                mechanical = isinstance(getattr(part, "base", None), OverMechanics | SoftContacts)
                yield from _bodies_differ(body, own, trained[own.kind], MOTORS if mechanical else 0.0)
    for name in ("dt", "gravity"):
        was, now = getattr(part, name, None), getattr(scene, name)
        if was is not None and was != now:
            yield f"its {name} is {now}, but they were trained with {was}"
    for pair, bodies in ordered(scene):
        if hasattr(part, "pair") and name_of(*bodies) == name_of(*bodies_of(part)):
            one, two = (body.name for body in bodies)
            for owner, other, name in ((one, two, "first_links"), (two, one, "second_links")):
                yield from _differ(f"what {other} can touch of {owner}", getattr(pair, name), getattr(part.pair, name))
            yield from _differ(f"the surface of {one} and {two}", pair.surface, part.pair.surface)


def _bodies_differ(body: Body, own: Body, trained: Trained, slack: float) -> Iterator[str]:
    """Links' sizes may be any between those trained on, motors stronger or weaker by a share of `slack`."""
    yield from _differ(f"{body.name}.links", len(body.links), len(own.links))
    for link, was in zip(body.links, own.links, strict=True):
        yield from _differ(f"{body.name}.{link.name}.axis", link.axis, was.axis)
        yield from _differ(f"the name of {body.name}.{link.name}", link.name, was.name)
    yield from beyond(body, trained)
    for joint, before, link in zip(body.joints, own.sized(body.sizes).joints, body.links[1:], strict=True):
        if joint.motor and before.motor and _as_strong(joint.motor, before.motor, slack):
            joint = dataclasses.replace(joint, motor=before.motor)
        yield from _differ(f"the joint of {body.name}.{link.name}", joint, before)
    yield from _differ(f"{body.name}.surface", body.surface, own.surface)


def _as_strong(motor: Motor, was: Motor, slack: float) -> bool:
    """Whether a motor is `Motor.times` of another by at most that share more or less."""
    factor = motor.stiffness / was.stiffness
    return abs(factor - 1.0) <= slack + 1e-6 and not list(_differ("", motor, was.times(factor)))


def beyond(body: Body, trained: Trained) -> Iterator[str]:
    """Which sizes of a body's links are none that its part has learned from, each in a few words."""
    for link, lowest, highest in zip(body.links, *trained, strict=True):
        for name, low, high in zip(("length", "radius", "mass"), lowest, highest, strict=True):
            value = getattr(link, name)
            if not low * (1.0 - 1e-5) - 1e-6 <= value <= high * (1.0 + 1e-5) + 1e-6:
                span = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
                yield f"{body.name}.{link.name}.{name} is {value:.6g}, but they were trained on {span}"


def trained_sizes(content: Mapping[str, Any]) -> dict[str, Trained]:
    """The sizes that a manifest's weights were trained on, by kind of body."""
    return {
        kind: Trained(*(np.array(sizes[name], float).reshape(-1, 3) for name in Trained._fields))
        for kind, sizes in content["trained on"].items()
    }


def extremes(content: Mapping[str, Any], scene: Scene) -> np.ndarray:
    """Morphologies (2, L, 3) of a scene: the smallest and the largest links that a manifest's weights know."""
    known = trained_sizes(content)
    return np.stack(
        [np.concatenate([getattr(known[body.kind], end) for body in scene.bodies]) for end in Trained._fields]
    )


def _differ(what: str, now: Any, was: Any) -> Iterator[str]:
    """The fields in which two things differ, or the things where they have none; rounding apart."""
    if now == was or (isinstance(now, float) and math.isclose(now, was, rel_tol=1e-5)):
        return
    if dataclasses.is_dataclass(now) and dataclasses.is_dataclass(was):
        for field in dataclasses.fields(now):
            yield from _differ(f"{what}.{field.name}", getattr(now, field.name), getattr(was, field.name))
    else:
        yield f"{what} is {now}, but they were trained with {was}"


def untrained(model: Model) -> Weights:
    """Return weights whose networks add nothing: what remains is the physics of the parts."""
    weights = _blank(model)
    zeros, ones = (lambda each, value=value: jnp.full(each.shape, value, each.dtype) for value in (0.0, 1.0))

    def statistics(each: Statistics) -> Statistics:
        return Statistics(zeros(each.mean), ones(each.spread))

    return Weights(
        jax.tree.map(zeros, weights.networks),
        *({name: statistics(each) for name, each in group.items()} for group in weights[1:]),
    )


def shapes(model: Model) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors of a model's weights."""
    return {name: tensor.shape for name, tensor in flatten(_blank(model)).items()}


def _blank(model: Model) -> Weights:
    """The shapes and types of a model's weights."""
    scene = model.scene

    def make() -> Weights:
        state = jnp.zeros((1, len(scene.links), packed.SIZE))
        control, torque = jnp.zeros((1, len(scene.motors), 3)), jnp.zeros((1, len(scene.links), 3))
        return initial_weights(model, jax.random.key(0), measure(model, state, state, control, torque))

    blank = jax.eval_shape(make)
    assert isinstance(blank, Weights)
    return blank


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray], needed: Mapping[str, tuple[int, ...]]) -> None:
    if set(arrays) != set(needed):
        odd = sorted(set(arrays) ^ set(needed))
        raise InputError(f"weights file {path} and its manifest differ in the tensors {odd}")
    for name, shape in needed.items():
        found = arrays[name].shape
        if found != shape:
            raise InputError(f"weights file {path}: {name} has shape {found}, but its part needs {shape}")

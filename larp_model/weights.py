"""Weights on disk: tensors as safetensors, and a manifest that describes their model and their training."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from flax.traverse_util import flatten_dict, unflatten_dict
from safetensors.numpy import load as parse
from safetensors.numpy import save as serialise

from larp_model.errors import InputError
from larp_model.files import write_whole
from larp_model.learned.model import Model, blank_weights
from larp_model.learned.paper import PaperModel, Sizes, Variant, pairs_by_kind
from larp_model.learned.residual import ResidualModel
from larp_model.names import require_file
from larp_model.networks import Size, Statistics, Weights
from larp_model.physics.collision import ContactSettings
from larp_model.physics.motion import Constants
from larp_model.scene import Body, Joint, Link, Motor, Pair, Scene, Surface

VERSION = 4
# Where physics computes motors, their scale may differ by this share from that of the training.
MOTOR_SCALE_SLACK = 0.2
# Types that a manifest may contain, by their names in it.
KINDS: dict[str, Any] = {
    "body": Body,
    "contact settings": ContactSettings,
    "joint": Joint,
    "link": Link,
    "mechanics": Constants,
    "motor": Motor,
    "pair": Pair,
    "paper": PaperModel,
    "paper's sizes": Sizes,
    "paper's variant": Variant,
    "residual": ResidualModel,
    "scene": Scene,
    "size": Size,
    "surface": Surface,
}
NAMES = {kind: name for name, kind in KINDS.items()}
TRAIN = "train some with `python -m tasks.train --scene NAME`, or FILE.py:NAME for a scene of your own"


class Trained(NamedTuple):
    """Smallest and largest links in the training data of a body's network: length, radius, mass, (n, 3) each."""

    lowest: np.ndarray
    highest: np.ndarray


def trained_on(scene: Scene, morphology: np.ndarray) -> dict[str, Trained]:
    """Return the smallest and largest links of every kind of body in morphologies (E, L, 3) of episodes."""
    sizes_by_kind: dict[str, list[np.ndarray]] = {}
    for body in scene.bodies:
        sizes_by_kind.setdefault(body.kind, []).append(morphology[:, scene.rows(body.name)])
    return {
        kind: Trained(np.concatenate(sizes).min(axis=0), np.concatenate(sizes).max(axis=0))
        for kind, sizes in sizes_by_kind.items()
    }


def encode(value: Any) -> Any:
    """Return a model and all its parts in types of JSON."""
    if dataclasses.is_dataclass(value):
        fields = {field.name: encode(getattr(value, field.name)) for field in dataclasses.fields(value)}
        return {"type": NAMES[type(value)], **fields}
    return [encode(item) for item in value] if isinstance(value, tuple) else value


def decode(value: Any) -> Any:
    """Return the inverse of `encode`; every field is required."""
    if isinstance(value, dict):
        kind = KINDS[value["type"]]
        present, needed = set(value) - {"type"}, {field.name for field in dataclasses.fields(kind)}
        if present != needed:
            raise ValueError(f"{value['type']} has the fields {sorted(present)}, but needs {sorted(needed)}")
        return kind(**{name: decode(value[name]) for name in needed})
    return tuple(decode(item) for item in value) if isinstance(value, list) else value


def flatten(weights: Weights) -> dict[str, Any]:
    """Return weights as named arrays."""
    tree = weights._asdict()
    for group in ("inputs", "outputs"):
        tree[group] = {name: statistics._asdict() for name, statistics in tree[group].items()}
    return dict(flatten_dict(tree, sep=":"))  # type: ignore[no-untyped-call]


def unflatten(arrays: Mapping[str, np.ndarray]) -> Weights:
    """Return weights from named arrays."""
    tensors = {name: jnp.asarray(array) for name, array in arrays.items()}
    tree = unflatten_dict(tensors, sep=":")  # type: ignore[no-untyped-call]
    statistics = (
        {name: Statistics(**fields) for name, fields in tree.get(group, {}).items()} for group in ("inputs", "outputs")
    )
    return Weights(tree.get("networks", {}), *statistics)


def save(
    folder: Path, name: str, model: Model, weights: Weights, recipe: Mapping[str, Any],
    morphology: np.ndarray | None = None,
) -> Path:  # fmt: skip
    """Write `name`.safetensors and `name`.json into the folder, each whole or not at all; return the manifest's path.

    recipe: how and on what the weights were trained, and their scores; anything JSON holds. morphology: (E, L, 3) of
    what they were trained on; the scene's by default.
    """
    arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in flatten(weights).items()}
    tensors = serialise(arrays)
    sizes = np.asarray(model.scene.morphology[None] if morphology is None else morphology, np.float64)
    trained = {
        kind: {name: np.round(values, 6).tolist() for name, values in extremes_of_kind._asdict().items()}
        for kind, extremes_of_kind in trained_on(model.scene, sizes).items()
    }
    manifest = {"version": VERSION, "model": encode(model), "trained on": trained, "recipe": recipe}
    manifest["sha256"] = digest(manifest, tensors)
    # Tensors first: a crash between the two leaves a manifest whose hash refuses them, not a silent mixture.
    write_whole(folder / f"{name}.safetensors", tensors)
    write_whole(folder / f"{name}.json", (json.dumps(manifest, indent=1) + "\n").encode())
    return folder / f"{name}.json"


def digest(manifest: Mapping[str, Any], tensors: bytes) -> str:
    """Return the sha256 of a manifest, that hash apart, and its tensors."""
    content = json.dumps({name: value for name, value in manifest.items() if name != "sha256"}, sort_keys=True)
    return hashlib.sha256(content.encode() + tensors).hexdigest()


def load(manifest: Path, scene: Scene | None = None) -> tuple[Model, Weights, dict[str, Any]]:
    """Return the scene's model, its weights and the whole manifest; refuse what is missing, damaged or does not fit.

    scene: that of the training by default.
    """
    tensors_path = manifest.with_suffix(".safetensors")
    for path in (manifest, tensors_path):
        require_file("weights", path)
    try:
        content = dict(json.loads(manifest.read_text()))
        version, expected = content["version"], content["sha256"]
        is_current = version == VERSION
        trained_model = decode(content["model"]) if is_current else None
        trained = trained_sizes(content) if is_current else {}
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"weights manifest {manifest} cannot be read: {type(error).__name__}: {error}") from None
    if trained_model is None:
        raise InputError(f"weights {manifest} are of version {version!r}, but {VERSION} is needed: {TRAIN}")
    raw = tensors_path.read_bytes()
    if digest(content, raw) != expected:
        raise InputError(
            f"weights file {tensors_path} or {manifest.name} is damaged: their sha256 is not the one given"
        )
    model = trained_model if scene is None else trained_model.on(scene)
    needed, networks = model.networks(), trained_model.networks()
    for name in needed.keys() - networks.keys():
        names = ", ".join(networks) or "none"
        raise InputError(f"weights {manifest}: there is no network {name!r} for this scene, but {names}; {TRAIN}")
    for difference in differences(trained_model, model, trained):
        raise InputError(f"weights {manifest} do not fit the scene: {difference}")
    arrays = {name: array for name, array in parse(raw).items() if name.split(":")[1] in needed}
    _check_shapes(tensors_path, arrays, shapes(model))
    return model, unflatten(arrays), content


def differences(trained_model: Model, model: Model, trained: Mapping[str, Trained]) -> Iterator[str]:
    """Yield the differences of a model's scene from that of the training that affect networks, in a few words."""
    names = model.networks()
    if not names:
        return  # physics alone, of any scene
    trained_scene, scene = trained_model.scene, model.scene
    for name in ("dt", "gravity"):
        yield from _differ(f"its {name}", getattr(scene, name), getattr(trained_scene, name))
    physical = isinstance(model, ResidualModel)
    for body in scene.bodies:
        trained_body = next((candidate for candidate in trained_scene.bodies if candidate.kind == body.kind), None)
        if trained_body is not None and f"dynamics/{body.kind}" in names:
            yield from _bodies_differ(
                body, trained_body, trained[trained_body.kind], MOTOR_SCALE_SLACK if physical else 0.0
            )
    if physical:
        return
    trained_pairs = {(one.kind, other.kind): pair for pair, (one, other) in pairs_by_kind(trained_scene)}
    for pair, (one, other) in pairs_by_kind(scene):
        trained_pair = trained_pairs[one.kind, other.kind]
        for owner, beside, name in ((one, other, "first_links"), (other, one, "second_links")):
            yield from _differ(
                f"what {beside.name} can touch of {owner.name}", getattr(pair, name), getattr(trained_pair, name)
            )
        yield from _differ(f"the surface of {one.name} and {other.name}", pair.surface, trained_pair.surface)


def _bodies_differ(body: Body, trained_body: Body, trained: Trained, slack: float) -> Iterator[str]:
    """Yield differences of a body; links may have any size between those trained on, motors a scale within `slack`."""
    yield from _differ(f"{body.name}.links", len(body.links), len(trained_body.links))
    for link, trained_link in zip(body.links, trained_body.links, strict=True):
        yield from _differ(f"{body.name}.{link.name}.axis", link.axis, trained_link.axis)
        yield from _differ(f"the name of {body.name}.{link.name}", link.name, trained_link.name)
    yield from beyond(body, trained)
    for joint, trained_joint, link in zip(
        body.joints, trained_body.sized(body.sizes).joints, body.links[1:], strict=True
    ):
        if joint.motor and trained_joint.motor and _is_scaled(joint.motor, trained_joint.motor, slack):
            joint = dataclasses.replace(joint, motor=trained_joint.motor)
        yield from _differ(f"the joint of {body.name}.{link.name}", joint, trained_joint)
    yield from _differ(f"{body.name}.surface", body.surface, trained_body.surface)


def _is_scaled(motor: Motor, trained: Motor, slack: float) -> bool:
    """Return whether a motor is `Motor.times` of the trained one, by a factor within `slack` of 1."""
    factor = motor.stiffness / trained.stiffness
    return abs(factor - 1.0) <= slack + 1e-6 and not list(_differ("", motor, trained.times(factor)))


def beyond(body: Body, trained: Trained) -> Iterator[str]:
    """Yield the sizes of a body's links that are outside its network's training data, in a few words each."""
    for link, lowest, highest in zip(body.links, *trained, strict=True):
        for name, low, high in zip(("length", "radius", "mass"), lowest, highest, strict=True):
            value = getattr(link, name)
            if not low * (1.0 - 1e-5) - 1e-6 <= value <= high * (1.0 + 1e-5) + 1e-6:
                span = f"{low:.6g}" if low == high else f"{low:.6g} to {high:.6g}"
                yield f"{body.name}.{link.name}.{name} is {value:.6g}, but they were trained on {span}"


def trained_sizes(content: Mapping[str, Any]) -> dict[str, Trained]:
    """Return the sizes that a manifest's weights were trained on, by kind of body."""
    return {
        kind: Trained(*(np.array(sizes[name], float).reshape(-1, 3) for name in Trained._fields))
        for kind, sizes in content["trained on"].items()
    }


def extremes(content: Mapping[str, Any], scene: Scene) -> np.ndarray:
    """Return morphologies (2, L, 3) of a scene: the smallest and the largest links of a manifest's training data."""
    trained = trained_sizes(content)
    return np.stack(
        [np.concatenate([getattr(trained[body.kind], end) for body in scene.bodies]) for end in Trained._fields]
    )


def _differ(what: str, now: Any, was: Any) -> Iterator[str]:
    """Yield the fields in which two values differ, or the values where they have no fields; rounding apart."""
    if now == was or (isinstance(now, float) and math.isclose(now, was, rel_tol=1e-5)):
        return
    if dataclasses.is_dataclass(now) and dataclasses.is_dataclass(was):
        for field in dataclasses.fields(now):
            yield from _differ(f"{what}.{field.name}", getattr(now, field.name), getattr(was, field.name))
    else:
        yield f"{what} is {now}, but they were trained with {was}"


def shapes(model: Model) -> dict[str, tuple[int, ...]]:
    """Return names and shapes of the tensors of a model's weights."""
    return {name: tensor.shape for name, tensor in flatten(blank_weights(model)).items()}


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray], needed: Mapping[str, tuple[int, ...]]) -> None:
    if set(arrays) != set(needed):
        unmatched = sorted(set(arrays) ^ set(needed))
        raise InputError(f"weights file {path} and its manifest differ in the tensors {unmatched}")
    for name, shape in needed.items():
        actual = arrays[name].shape
        if actual != shape:
            raise InputError(f"weights file {path}: {name} has shape {actual}, but its model needs {shape}")

"""Weights on disk: tensors as safetensors, and a manifest that says what they are and how they came to be."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from safetensors.numpy import load as parse
from safetensors.numpy import save as serialise

from larp_model import state as packed
from larp_model.features import Statistics
from larp_model.files import write_whole
from larp_model.networks import Config
from larp_model.scene import Scene
from larp_model.simulator import Weights, initial_weights, measure

VERSION = 1
SHIPPED = Path(__file__).parent / "weights"


def signature(scene: Scene) -> str:
    """A digest of everything in the scene that the weights depend on."""
    return hashlib.sha256(json.dumps(dataclasses.asdict(scene), sort_keys=True).encode()).hexdigest()[:16]


def flatten(weights: Weights) -> dict[str, Any]:
    """Weights as named arrays."""
    arrays: dict[str, Any] = {}

    def visit(prefix: str, node: Any) -> None:
        if isinstance(node, Mapping):
            for name, child in node.items():
                visit(f"{prefix}:{name}", child)
        elif isinstance(node, Statistics):
            visit(prefix, node._asdict())
        else:
            arrays[prefix.removeprefix(":")] = node

    visit("", weights._asdict())
    return arrays


def unflatten(arrays: Mapping[str, np.ndarray]) -> Weights:
    """Weights from named arrays."""
    tree: dict[str, Any] = {}
    for name, array in arrays.items():
        *path, leaf = name.split(":")
        node = tree
        for part in path:
            node = node.setdefault(part, {})
        node[leaf] = jnp.asarray(array)
    return Weights(
        tree["networks"],
        {name: Statistics(**value) for name, value in tree["inputs"].items()},
        {name: Statistics(**value) for name, value in tree.get("outputs", {}).items()},
    )


def save(folder: Path, name: str, scene: Scene, config: Config, weights: Weights, recipe: Mapping[str, Any]) -> Path:
    """Write `name`.safetensors and `name`.json into the folder, each whole or not at all; returns the manifest's path.

    recipe: how and on what the weights were trained, and their scores; anything JSON holds.
    """
    arrays = {name: np.ascontiguousarray(array, np.float32) for name, array in flatten(weights).items()}
    tensors = serialise(arrays)
    manifest = {
        "version": VERSION,
        "config": dataclasses.asdict(config),
        "scene": signature(scene),
        "sha256": hashlib.sha256(tensors).hexdigest(),
        "recipe": recipe,
    }
    # Tensors first: a crash between the two leaves a manifest whose hash refuses them, not a silent mixture.
    write_whole(folder / f"{name}.safetensors", tensors)
    write_whole(folder / f"{name}.json", (json.dumps(manifest, indent=2) + "\n").encode())
    return folder / f"{name}.json"


def load(manifest: Path, scene: Scene) -> tuple[Config, Weights, dict[str, Any]]:
    """Config, weights and the whole manifest; refuses what is missing, damaged or made for another scene."""
    tensors_path = manifest.with_suffix(".safetensors")
    for path in (manifest, tensors_path):
        if not path.is_file():
            raise ValueError(f"weights file {path} does not exist")
    try:
        content = dict(json.loads(manifest.read_text()))
        version = content["version"]
        config = Config(**content["config"]) if version == VERSION else None
        expected, made_for = content["sha256"], content["scene"]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"weights manifest {manifest} cannot be read: {type(error).__name__}: {error}") from None
    if config is None:
        raise ValueError(f"weights {manifest} are of version {version!r}, but {VERSION} is needed")
    if made_for != signature(scene):
        raise ValueError(f"weights {manifest} were made for scene {made_for!r}, but this scene is {signature(scene)!r}")
    raw = tensors_path.read_bytes()
    if hashlib.sha256(raw).hexdigest() != expected:
        raise ValueError(f"weights file {tensors_path} is damaged: its sha256 is not the one in {manifest.name}")
    arrays = parse(raw)
    _check_shapes(tensors_path, arrays, shapes(scene, config))
    return config, unflatten(arrays), content


def shapes(scene: Scene, config: Config) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors of a scene's weights."""

    def make() -> Weights:
        state = jnp.zeros((1, len(scene.links), packed.SIZE))
        control, torque = jnp.zeros((1, len(scene.motors), 3)), jnp.zeros((1, len(scene.links), 3))
        return initial_weights(scene, config, jax.random.key(0), measure(scene, config, state, state, control, torque))

    return {name: tensor.shape for name, tensor in flatten(jax.eval_shape(make)).items()}


def _check_shapes(path: Path, arrays: Mapping[str, np.ndarray], needed: Mapping[str, tuple[int, ...]]) -> None:
    if set(arrays) != set(needed):
        odd = sorted(set(arrays) ^ set(needed))
        raise ValueError(f"weights file {path} and its config differ in the tensors {odd}")
    for name, shape in needed.items():
        found = arrays[name].shape
        if found != shape:
            raise ValueError(f"weights file {path}: {name} has shape {found}, but its config needs {shape}")

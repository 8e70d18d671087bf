"""Weights on disk: tensors as safetensors, and a manifest that says what they are and how they came to be."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from safetensors.numpy import load as parse
from safetensors.numpy import save as serialise

from larp_model.features import Statistics
from larp_model.networks import Config
from larp_model.scene import Scene
from larp_model.simulator import Weights

VERSION = 1
SHIPPED = Path(__file__).parent / "weights"


def signature(scene: Scene) -> str:
    """A digest of everything in the scene that the weights depend on."""
    return hashlib.sha256(json.dumps(dataclasses.asdict(scene), sort_keys=True).encode()).hexdigest()[:16]


def flatten(weights: Weights) -> dict[str, np.ndarray]:
    """Weights as named arrays."""
    arrays: dict[str, np.ndarray] = {}

    def visit(prefix: str, node: Any) -> None:
        if isinstance(node, Mapping):
            for name, child in node.items():
                visit(f"{prefix}:{name}", child)
        elif isinstance(node, Statistics):
            visit(prefix, node._asdict())
        else:
            arrays[prefix.removeprefix(":")] = np.ascontiguousarray(node, np.float32)

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
    tensors = serialise(flatten(weights))
    manifest = {
        "version": VERSION,
        "config": dataclasses.asdict(config),
        "scene": signature(scene),
        "sha256": hashlib.sha256(tensors).hexdigest(),
        "recipe": recipe,
    }
    folder.mkdir(parents=True, exist_ok=True)
    # Tensors first: a crash between the two leaves a manifest whose hash refuses them, not a silent mixture.
    _write(folder / f"{name}.safetensors", tensors)
    _write(folder / f"{name}.json", (json.dumps(manifest, indent=2) + "\n").encode())
    return folder / f"{name}.json"


def _write(path: Path, content: bytes) -> None:
    temporary = path.with_name(f".{path.name}.partial")
    temporary.write_bytes(content)
    os.replace(temporary, path)


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
    return config, unflatten(parse(raw)), content

"""Weights on disk: what is saved is what is loaded, and what does not fit is refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model.bodies import ball, human_and_ball
from larp_model.networks import Config
from larp_model.scene import Scene
from larp_model.simulator import Weights, initial_weights, measure
from larp_model.weights import VERSION, load, save, signature


@pytest.fixture
def stored(tmp_path: Path, scene: Scene, compact: Config, compact_weights: Weights) -> Path:
    """The manifest of weights on disk."""
    return save(tmp_path / "deep", "tiny", scene, compact, compact_weights, {"updates": 7, "seed": 0})


def equal(first: Weights, second: Weights) -> bool:
    """Whether two sets of weights are equal bit for bit."""
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, first, second)))


@pytest.mark.parametrize("kind", ["compact", "paper"])
def test_what_is_saved_is_what_is_loaded(
    kind: str, request: pytest.FixtureRequest, scene: Scene, tmp_path: Path
) -> None:
    config, weights = request.getfixturevalue(kind), request.getfixturevalue(f"{kind}_weights")
    manifest = save(tmp_path, "model", scene, config, weights, {})
    found_config, found, _ = load(manifest, scene)
    assert found_config == config and equal(found, weights)


def test_weights_of_a_ball_alone_survive(compact: Config, tmp_path: Path) -> None:
    scene = Scene((ball(),))
    state = jnp.zeros((2, 1, 13)).at[..., 3].set(1.0)
    statistics = measure(scene, compact, state, state, jnp.zeros((2, 0, 3)), jnp.zeros((2, 1, 3)))
    weights = initial_weights(scene, compact, jax.random.key(0), statistics)
    assert equal(load(save(tmp_path, "ball", scene, compact, weights, {}), scene)[1], weights)


def test_the_manifest_says_what_the_weights_are(stored: Path, scene: Scene, compact: Config) -> None:
    content = json.loads(stored.read_text())
    assert content.keys() == {"version", "config", "scene", "sha256", "recipe"}
    assert content["version"] == VERSION and content["scene"] == signature(scene)
    assert Config(**content["config"]) == compact and content["recipe"] == {"updates": 7, "seed": 0}
    assert load(stored, scene)[2] == content
    assert {file.name for file in stored.parent.iterdir()} == {"tiny.json", "tiny.safetensors"}


def test_saving_twice_writes_the_same_bytes(
    stored: Path, scene: Scene, compact: Config, compact_weights: Weights
) -> None:
    before = [file.read_bytes() for file in sorted(stored.parent.iterdir())]
    save(stored.parent, "tiny", scene, compact, compact_weights, {"updates": 7, "seed": 0})
    assert [file.read_bytes() for file in sorted(stored.parent.iterdir())] == before


def refusal(stored: Path, scene: Scene) -> str:
    """What `load` says when it refuses; one line that names a file."""
    with pytest.raises(ValueError) as caught:
        load(stored, scene)
    assert "\n" not in str(caught.value) and str(stored.with_suffix("")) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    "other", [human_and_ball(height=1.8), human_and_ball(dt=0.005), human_and_ball().only("human")]
)
def test_weights_of_another_scene_are_refused(stored: Path, other: Scene) -> None:
    assert "were made for scene" in refusal(stored, other)


def flip(content: bytes, place: float) -> bytes:
    """The content with one bit flipped."""
    index = int(place * (len(content) - 1))
    return content[:index] + bytes([content[index] ^ 1]) + content[index + 1 :]


@pytest.mark.parametrize(
    "damage",
    [lambda raw: flip(raw, 0.0), lambda raw: flip(raw, 0.5), lambda raw: flip(raw, 1.0), lambda raw: raw[:-4],
     lambda raw: b"", lambda raw: raw + b"\0"],
)  # fmt: skip
def test_damaged_weights_are_refused(stored: Path, scene: Scene, damage: Callable[[bytes], bytes]) -> None:
    tensors = stored.with_suffix(".safetensors")
    tensors.write_bytes(damage(tensors.read_bytes()))
    assert "is damaged" in refusal(stored, scene)


def test_missing_files_are_refused(stored: Path, scene: Scene) -> None:
    stored.with_suffix(".safetensors").unlink()
    assert "tiny.safetensors does not exist" in refusal(stored, scene)
    stored.unlink()
    assert "tiny.json does not exist" in refusal(stored, scene)


def test_a_newer_version_is_refused_as_such(stored: Path, scene: Scene) -> None:
    content = json.loads(stored.read_text())
    content["version"] = VERSION + 1
    content["config"]["attention"] = 4
    stored.write_text(json.dumps(content))
    assert f"are of version {VERSION + 1}, but {VERSION} is needed" in refusal(stored, scene)


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"config": 3}', "\udcff"])
def test_a_manifest_that_cannot_be_read_is_refused(stored: Path, scene: Scene, text: str) -> None:
    stored.write_text(text, errors="surrogateescape")
    assert "cannot be read" in refusal(stored, scene)


@pytest.mark.parametrize(("field", "value"), [("width", 0), ("frame", "sideways"), ("depth", 3), ("width", "wide")])
def test_a_configuration_that_makes_no_sense_is_refused(stored: Path, scene: Scene, field: str, value: object) -> None:
    content = json.loads(stored.read_text())
    content["config"][field] = value
    stored.write_text(json.dumps(content))
    assert field in refusal(stored, scene)


@pytest.mark.parametrize(("change", "says"), [({"width": 32}, "has shape"), ({"layers": 3}, "differ in the tensors")])
def test_tensors_that_do_not_fit_their_config_are_refused(
    change: dict[str, int], says: str, stored: Path, scene: Scene
) -> None:
    content = json.loads(stored.read_text())
    content["config"] |= change
    stored.write_text(json.dumps(content))
    assert says in refusal(stored, scene)

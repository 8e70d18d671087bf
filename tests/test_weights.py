"""Weights on disk: what is saved is what is loaded, and what does not fit is refused in one line."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from larp_model.bodies import capsule, human, human_and_ball, human_and_capsule
from larp_model.errors import InputError
from larp_model.learned.model import Model
from larp_model.learned.residual import ResidualModel
from larp_model.networks import Size, Weights
from larp_model.scene import Body, Scene
from larp_model.weights import VERSION, digest, load, save

LEAST = Size(2, 16)


@pytest.fixture
def stored(tmp_path: Path, paper: Model, paper_weights: Weights) -> Path:
    """The manifest of weights on disk."""
    return save(tmp_path / "deep", "tiny", paper, paper_weights, {"updates": 7, "seed": 0})


def equal(first: Weights, second: Weights) -> bool:
    """Return whether two sets of weights are equal bit for bit."""
    return all(jax.tree.leaves(jax.tree.map(np.array_equal, first, second)))


@pytest.mark.parametrize("kind", ["residual", "paper"])
def test_what_is_saved_is_what_is_loaded(
    kind: str, request: pytest.FixtureRequest, scene: Scene, tmp_path: Path
) -> None:
    model, weights = request.getfixturevalue(kind), request.getfixturevalue(f"{kind}_weights")
    manifest = save(tmp_path, "model", model, weights, {})
    found_model, found, _ = load(manifest, scene)
    assert found_model == model and equal(found, weights)


def test_physics_alone_survives_and_takes_any_scene(tmp_path: Path, scene: Scene) -> None:
    manifest = save(tmp_path, "nothing", ResidualModel(scene), Weights({}, {}, {}), {})
    assert load(manifest, scene)[:2] == (ResidualModel(scene), Weights({}, {}, {}))
    assert load(manifest, human_and_capsule())[0] == ResidualModel(human_and_capsule())


def test_a_human_learned_alone_kicks_any_ball(tmp_path: Path, scene: Scene, residual_weights: Weights) -> None:
    manifest = save(tmp_path, "alone", ResidualModel(scene.only("human"), LEAST), residual_weights, {})
    assert load(manifest, other_ball(radius=0.2))[0].networks().keys() == {"dynamics/human"}


def test_a_scene_loads_the_networks_that_it_needs_and_no_other(
    stored: Path, scene: Scene, paper_weights: Weights
) -> None:
    model, weights, _ = load(stored, scene.only("ball"))
    assert model.scene == scene.only("ball")
    assert weights.networks.keys() == {"dynamics/ball"} == weights.inputs.keys()
    same = jax.tree.map(np.array_equal, weights.networks["dynamics/ball"], paper_weights.networks["dynamics/ball"])
    assert all(jax.tree.leaves(same))


def test_the_manifest_says_what_the_weights_are_each_body_once(stored: Path, scene: Scene) -> None:
    content = json.loads(stored.read_text())
    assert content.keys() == {"version", "model", "trained on", "sha256", "recipe"}
    assert content["version"] == VERSION and content["recipe"] == {"updates": 7, "seed": 0}
    assert content["model"]["type"] == "paper" and content["model"]["bound"] == 20.0
    assert [body["name"] for body in content["model"]["scene"]["bodies"]] == ["human", "ball"]
    assert stored.read_text().count('"left_thigh"') == 2, "as a link, and in the pair"
    assert content["trained on"]["ball"]["lowest"] == content["trained on"]["ball"]["highest"]
    assert load(stored, scene)[2] == content
    assert {file.name for file in stored.parent.iterdir()} == {"tiny.json", "tiny.safetensors"}


def fields(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield where every field of an object in JSON is."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for name, each in items:
        if isinstance(value, dict):
            yield (*path, name)
        yield from fields(each, (*path, name))


def test_every_field_of_the_manifest_is_required_and_none_may_change(stored: Path, scene: Scene) -> None:
    text = stored.read_text()
    places = [*fields(json.loads(text))]
    assert len(places) > 300
    for place in places[:: len(places) // 60]:
        content = json.loads(text)
        owner = content
        for name in place[:-1]:
            owner = owner[name]
        del owner[place[-1]]
        stored.write_text(json.dumps(content))
        refusal(stored, scene)
    content = json.loads(text)
    content["model"]["bound"] = 10.0
    stored.write_text(json.dumps(content))
    assert "is damaged" in refusal(stored, scene)


def test_saving_twice_writes_the_same_bytes(stored: Path, paper: Model, paper_weights: Weights) -> None:
    before = [file.read_bytes() for file in sorted(stored.parent.iterdir())]
    save(stored.parent, "tiny", paper, paper_weights, {"updates": 7, "seed": 0})
    assert [file.read_bytes() for file in sorted(stored.parent.iterdir())] == before


def refusal(stored: Path, scene: Scene) -> str:
    """Return the message with which `load` refuses; one line that names a file."""
    with pytest.raises(InputError) as caught:
        load(stored, scene)
    assert "\n" not in str(caught.value) and str(stored.with_suffix("")) in str(caught.value)
    return str(caught.value)


def other_human(**changes: Any) -> Scene:
    """The kick's scene with another human."""
    scene = human_and_ball()
    return replace(scene, bodies=(replace(scene.human, **changes), scene.bodies[1]))


def other_ball(radius: float) -> Scene:
    """The kick's scene with another ball."""
    scene = human_and_ball()
    own = scene.bodies[1]
    return replace(scene, bodies=(scene.human, replace(own, links=(replace(own.links[0], radius=radius),))))


HUMAN: Body = human_and_ball().bodies[0]
STRONG = replace(HUMAN.joints[0], motor=replace(HUMAN.joints[0].motor, stiffness=7.0))  # type: ignore[type-var]


@pytest.mark.parametrize(
    ("other", "says"),
    [
        (human_and_ball(dt=0.005), "its dt is 0.005, but they were trained with 0.01"),
        (replace(human_and_ball(), gravity=1.6), "its gravity is 1.6, but they were trained with 9.81"),
        (human_and_ball(height=1.8), "human.pelvis.length is "),
        (other_ball(radius=0.2), "ball.ball.radius is 0.2, but they were trained on 0.11"),
        (other_human(joints=(STRONG, *HUMAN.joints[1:])), "motor.stiffness is 7.0, but they were trained with"),
        (other_human(surface=replace(HUMAN.surface, friction=0.3)), "human.surface.friction is 0.3, but they"),
        (replace(human_and_ball(), pairs=(replace(human_and_ball().pairs[0], first_links=("head",)),)),
         "what ball can touch of human is ('head',), but they were trained with"),
        (human_and_capsule(), "there is no network '"),
        (Scene((capsule(),)), "there is no network 'dynamics/capsule' for this scene, but dynamics/"),
    ],
)  # fmt: skip
def test_what_the_weights_were_not_made_for_is_refused_by_name(stored: Path, other: Scene, says: str) -> None:
    assert says in refusal(stored, other)


def test_links_of_any_size_that_was_trained_on_are_taken(
    tmp_path: Path, scene: Scene, paper: Model, paper_weights: Weights
) -> None:
    sizes = np.stack([scene.morphology, 1.5 * scene.morphology])
    manifest = save(tmp_path, "sizes", paper, paper_weights, {}, sizes)
    larger = load(manifest, scene.sized(1.2 * scene.morphology))[0]
    assert larger.scene.links[0].length == pytest.approx(1.2 * scene.links[0].length)
    assert "but they were trained on" in refusal(manifest, scene.sized(1.6 * scene.morphology))


def test_motors_may_differ_where_physics_says_what_they_do_and_not_where_it_is_learned(
    stored: Path, tmp_path: Path, residual: Model, residual_weights: Weights
) -> None:
    def strong(factor: float) -> Scene:
        return replace(human_and_ball(), bodies=(human(motors={"thigh": factor}), human_and_ball().bodies[1]))

    over_physics = save(tmp_path, "residual", residual, residual_weights, {})
    for factor in (0.8, 1.2):
        assert load(over_physics, strong(factor))[0].scene == strong(factor)
    assert "left_thigh.motor.stiffness is 1170" in refusal(over_physics, strong(1.3))
    assert "left_thigh.motor.stiffness is 990" in refusal(stored, strong(1.1))


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
    assert "tiny.safetensors', but no such file exists" in refusal(stored, scene)
    stored.unlink()
    assert "tiny.json', but no such file exists" in refusal(stored, scene)


@pytest.mark.parametrize("version", [3, VERSION + 1])
def test_another_version_is_refused_with_the_way_to_this_one(stored: Path, scene: Scene, version: int) -> None:
    content = json.loads(stored.read_text())
    del content["model"]
    stored.write_text(json.dumps(content | {"version": version, "parts": []}))
    said = refusal(stored, scene)
    assert f"are of version {version}, but {VERSION} is needed" in said and "python -m tasks.train" in said


@pytest.mark.parametrize("text", ["", "{", "[]", "{}", '{"model": 3}', "\udcff"])
def test_a_manifest_that_cannot_be_read_is_refused(stored: Path, scene: Scene, text: str) -> None:
    stored.write_text(text, errors="surrogateescape")
    assert "cannot be read" in refusal(stored, scene)


@pytest.mark.parametrize(("field", "value"), [("width", 0), ("type", "turbulence"), ("depth", 3), ("width", "wide")])
def test_a_model_that_makes_no_sense_is_refused(stored: Path, scene: Scene, field: str, value: object) -> None:
    content = json.loads(stored.read_text())
    content["model"]["sizes"]["body"][field] = value
    stored.write_text(json.dumps(content))
    assert str(value if field == "type" else field) in refusal(stored, scene)


@pytest.mark.parametrize(("change", "says"), [({"width": 32}, "has shape"), ({"layers": 3}, "differ in the tensors")])
def test_tensors_that_do_not_fit_their_model_are_refused(
    change: dict[str, int], says: str, stored: Path, scene: Scene
) -> None:
    content = json.loads(stored.read_text())
    content["model"]["sizes"]["body"] |= change
    content["sha256"] = digest(content, stored.with_suffix(".safetensors").read_bytes())
    stored.write_text(json.dumps(content))
    assert says in refusal(stored, scene)

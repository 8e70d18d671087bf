"""The scenes to learn and judge on: what their truth promises, and the one way from a name to weights and scores."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from larp_model import designs, training
from larp_model import state as packed
from larp_model import weights as stored
from larp_model.designs import DesignName
from larp_model.detection import first_contacts
from larp_model.engines.episodes import Episodes
from larp_model.errors import InputError
from larp_model.learned.model import initial_weights
from larp_model.learned.residual import ResidualModel
from larp_model.networks import Size, Weights
from larp_model.physics import kinematics
from larp_model.step_examples import examples_of
from larp_model.training import Windows
from tasks import train
from tasks.benchmarks import model
from tasks.episodes.around_kick import overlaps
from tasks.motions.references import clearance, resting_height
from tasks.scenarios import SCENARIOS, around, scenario

COUNT = 32


@pytest.fixture(scope="module", params=list(SCENARIOS))
def drawn(request: pytest.FixtureRequest) -> tuple[str, Episodes]:
    """A scene's name and some of its episodes."""
    name = str(request.param)
    episodes, dropped = SCENARIOS[name].draw(COUNT, 5)
    assert len(episodes.states) == COUNT - dropped
    return name, episodes


def test_episodes_are_sound_and_reach_the_longest_window(drawn: tuple[str, Episodes]) -> None:
    name, episodes = drawn
    assert packed.healthy(episodes.states).all() and len(episodes.states) > 0.9 * COUNT
    assert episodes.steps >= max(SCENARIOS[name].windows)
    assert episodes.states.shape[2] == len(SCENARIOS[name].scene.links)


@pytest.mark.parametrize("name", ["chain4", "human_ball", "any_human_alone"])
def test_episodes_are_as_long_as_is_asked_for(name: str) -> None:
    episodes, _ = SCENARIOS[name].draw(4, 5, steps=320)  # longer than the reference kick
    assert episodes.steps == 320 and len(episodes.states) >= 3


def test_joints_hold_in_the_truth(drawn: tuple[str, Episodes]) -> None:
    scene = SCENARIOS[drawn[0]].scene
    apart = kinematics.displacement(scene, jnp.asarray(drawn[1].states), jnp.asarray(drawn[1].morphology[:, None]))
    assert np.abs(apart).max(initial=0.0) < 2e-6


def test_nothing_starts_in_the_ground_or_in_another_body(drawn: tuple[str, Episodes]) -> None:
    scene, start, sizes = SCENARIOS[drawn[0]].scene, drawn[1].states[:, 0], drawn[1].morphology
    human = scene.rows("human") if drawn[0].startswith("human") else slice(0, 0)  # who stands on it, or leans
    above = [
        start[:, row, 2] - resting_height(link, start[:, row], sizes[:, row]) for row, link in enumerate(scene.links)
    ]
    free = [row for row in range(len(scene.links)) if not human.start <= row < human.stop]
    assert all(above[row].min() > -1e-5 for row in free)
    assert not overlaps(scene, start, sizes).any()


def test_bodies_that_can_meet_often_do(drawn: tuple[str, Episodes]) -> None:
    scene = SCENARIOS[drawn[0]].scene
    met = (first_contacts(scene.between, drawn[1], chunk=COUNT) >= 0).mean()
    assert met > 0.3 if scene.pairs else met == 0.0


def test_a_seed_draws_the_same_again_and_another_does_not() -> None:
    draw = SCENARIOS["chain4"].draw
    first, again, other = draw(4, 1)[0], draw(4, 1)[0], draw(4, 2)[0]
    np.testing.assert_array_equal(first.states, again.states)
    assert not np.array_equal(first.states, other.states)


def test_links_of_chains_differ_in_size_and_balls_do_not() -> None:
    chains, balls = (SCENARIOS[name].draw(8, 1)[0].morphology for name in ("chain4", "two_balls"))
    assert (np.ptp(chains, axis=0) > 0.0).all() and not np.ptp(balls, axis=0).any()
    density = chains[..., 2] / (chains[..., 1] ** 2 * (chains[..., 0] + 4.0 / 3.0 * chains[..., 1]))
    np.testing.assert_allclose(density, density[0, 0], rtol=1e-5)


def test_chains_are_turned_at_first_and_then_left_alone() -> None:
    torques = SCENARIOS["chain4"].draw(4, 1)[0].torques
    assert (torques[:, :10, 0] != 0.0).all() and not torques[:, 10:].any() and not torques[:, :, 1:].any()


def test_an_unknown_scene_is_refused_by_name() -> None:
    with pytest.raises(InputError, match=r"scene is 'robot', but must be one of human_ball, .*chains2"):
        scenario("robot")


def test_a_design_that_was_not_trained_is_refused_with_the_way_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"beside is paper, .*python -m tasks.train --scene chain4 --design paper"):
        model.main(scene="chain4", beside="paper", json=tmp_path / "model.json")


def test_other_weights_and_the_second_truth_are_rows_beside() -> None:
    windows = {str(n): {"chain": 0.001 * n} for n in SCENARIOS["chain4"].windows}
    found = {"windows": windows, "rotation_rad": {"chain": 0.1}, "displacement_m": 0.0, "diverged": 0, "launch": {}}
    found |= {"sequences": 16, "us_per_step": {"1": 50.0, "64": 3.0, "512": 2.0}, "bullet": windows}
    table = model.table_of(found | {"beside": {"design": "paper", **found}}, SCENARIOS["chain4"])
    rows = list(table.columns[0].cells)
    assert "chain, the paper design trained here" in rows and "chain, Bullet" in rows
    assert "a step of a scene, the paper design" in rows


@pytest.mark.parametrize("design", get_args(DesignName))
@pytest.mark.slow
def test_a_scene_becomes_weights_and_scores(
    design: DesignName, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(model, "BATCHES", (2,))  # every other size is compiled once more
    train.main(scene="chain4", design=design, folder=tmp_path / "run", episodes=64, effort=1e-4)
    manifest = tmp_path / "run/weights/chain4.json"
    made, _, content = stored.load(manifest, SCENARIOS["chain4"].scene)
    assert made == designs.design(SCENARIOS["chain4"].scene, design)
    assert [each["stage"] for each in content["recipe"]["rounds"]] == [stage.name for stage in train.STAGES[design]]
    model.main(scene="chain4", sequences=16, weights=manifest, json=tmp_path / "model.json")
    found = json.loads((tmp_path / "model.json").read_text())
    assert found["windows"].keys() == {"10", "40", "80", "190"}
    assert found["sequences"] == 16 and set(found["windows"]["10"]) == {"chain"}
    assert found["launch"] == {}
    assert found["us_per_step"]["2"] > 0.0
    assert (tmp_path / "model.png").stat().st_size > 1000
    if design == "residual":
        train.main("chain4", folder=tmp_path / "on", episodes=64, effort=1e-4, seed=7, start=manifest)
        on = stored.load(tmp_path / "on/weights/chain4.json")
        assert [each["stage"] for each in on[2]["recipe"]["rounds"]] == ["steps", "steps"], "it was trained again"


def test_training_goes_on_from_weights_of_the_same_model_alone(tmp_path: Path) -> None:
    scene = SCENARIOS["chain4"].scene
    other = stored.save(tmp_path, "chain4", ResidualModel(scene), Weights({}, {}, {}), {"rounds": []})
    with pytest.raises(InputError, match=r"from is .*, but holds weights of another model"):
        train.main(scene="chain4", folder=tmp_path / "run", episodes=16, start=other)


def test_only_residual_networks_come_in_sizes(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="size is 'tiny', but only the residual design comes in sizes"):
        train.main(scene="chain4", design="paper", size="tiny", folder=tmp_path / "run")


def test_other_bodies_than_a_human_are_not_asked_for_another_kick(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="reference is asked for, but the scene chains1 has no human"):
        model.main(scene="chains1", reference=Path("kick.bvh"), json=tmp_path / "model.json")
    with pytest.raises(InputError, match="bodies varied is asked for, but the scene two_balls has no human"):
        model.main(scene="two_balls", bodies="varied", json=tmp_path / "model.json")


def test_varied_humans_around_the_kick_are_all_others_and_as_high_above_the_ground() -> None:
    chosen = around(scenario("human_ball"), None, varied=True)
    episodes, _ = chosen.draw(12, 3)
    rows = chosen.scene.rows("human")
    assert len(np.unique(episodes.morphology[:, rows, 2].sum(axis=1))) == len(episodes.states)
    above = clearance(chosen.scene.body("human"), episodes.states[:, 0, rows], episodes.morphology[:, rows])
    assert (np.abs(above) < 0.1).all()


@pytest.mark.parametrize("name", list(SCENARIOS))
def test_every_scene_can_be_trained(name: str) -> None:
    """One update with gradients, of every network, down to shapes and types: compiling all of them takes too long."""
    chosen, (stage,) = SCENARIOS[name], train.STAGES["residual"]
    episodes, _ = chosen.draw(4, 1)
    made, recipe = ResidualModel(chosen.scene, Size(2, 16)), replace(stage.recipe, batch=4)
    drawn = Windows(chosen.scene, [(episodes, 1.0)], recipe).draw(np.random.default_rng(0), 1)

    def update(key: Array) -> Any:
        before, after = jnp.asarray(drawn.states[:, 0]), jnp.asarray(drawn.states[:, 1])
        rest = drawn.controls[:, 0], drawn.torques[:, 0], drawn.morphology
        weights = initial_weights(made, key, made.measure(before, after, *map(jnp.asarray, rest)))
        state = training.optimiser(recipe).init(weights.networks)
        examples = examples_of(made, before, after, *map(jnp.asarray, rest))
        return training.update_of(made, recipe, weights)(weights.networks, state, key, examples, 1e-3)

    networks, _, terms = jax.eval_shape(update, jax.random.key(0))
    assert networks.keys() == made.networks().keys() and terms["loss"].shape == ()


def test_a_run_goes_on_only_with_the_settings_that_it_was_begun_with(tmp_path: Path) -> None:
    settings = {"episodes": 40, "seed": 100, "effort": 0.5, "size": None}
    train.claim(tmp_path, settings)
    train.claim(tmp_path, settings)
    for name, value in (("episodes", 400), ("seed", 7), ("effort", 1.0), ("size", "tiny")):
        other = f"{name} is {value!r}, but the run in .* was begun with {settings[name]!r}"
        with pytest.raises(InputError, match=other):
            train.claim(tmp_path, settings | {name: value})
    (tmp_path / "settings.json").write_text("{")
    with pytest.raises(InputError, match=r"its settings\.json is damaged"):
        train.claim(tmp_path, settings)
    (tmp_path / "settings.json").unlink()
    (tmp_path / "random.npz").touch()
    with pytest.raises(InputError, match="holds a run of unknown settings"):
        train.claim(tmp_path, settings)


def test_a_scene_of_ones_own_is_found_in_its_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.py"
    path.write_text(
        "from larp_model import Scene, chain, human\n"
        "from tasks.scenarios import SCENARIOS\n"
        "ROPE, PERSON, DRAWN, OTHER = Scene((chain(links=3),)), Scene((human(),)), SCENARIOS['human'], 3\n"
    )
    rope = scenario(f"{path}:ROPE")
    assert rope.name == "rope" and rope.draw(2, 0)[0].states.shape[2] == 3
    assert scenario(f"{path}:DRAWN").name == "human"
    for name, message in (
        (f"{path}:ROPES", "did you mean 'ROPE'"),
        (f"{path}:OTHER", "must be one of ROPE, PERSON, DRAWN"),
        (f"{path}:PERSON", "has motors: make it a tasks.scenarios.Scenario"),
        (f"{tmp_path}/mined.py:ROPE", "no such file exists; did you mean 'mine.py'"),
    ):
        with pytest.raises(InputError, match=message):
            scenario(name)

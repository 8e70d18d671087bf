"""Physics with nothing learned, as it ships, against the truth: of any scene, for short and for long."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from larp_model import evaluation
from larp_model import state as packed
from larp_model.bodies import human_and_ball
from larp_model.engines.episodes import Episodes
from larp_model.launches import launches_of
from larp_model.learned.residual import ResidualModel
from larp_model.networks import Size
from larp_model.physics.kinematics import displacement, morphology_of
from larp_model.simulator import Simulator
from larp_model.training import Recipe, Windows, statistics_of
from tasks.live import NOVEL
from tasks.motions.references import Reference
from tasks.scenarios import scenario


@pytest.mark.parametrize(("name", "bar"), [("chains2", 0.004), ("chain4", 0.004), ("two_balls", 0.002)])
def test_what_is_thrown_stays_near_the_truth_for_40_steps(name: str, bar: float) -> None:
    chosen = scenario(name)
    given, _ = chosen.draw(32, 3)
    windows = evaluation.evaluate(Simulator.of_physics(chosen.scene), given, (40,))["windows"]["40"]
    assert all(error < bar for error in windows.values())


@pytest.mark.parametrize(
    ("name", "bars", "launched"),
    [("any_human", (0.0025, 0.012), (0.04, 0.25)), ("full_human", (0.0025, 0.012), (0.05, 0.4))],
)
def test_any_human_and_what_it_strikes_stay_near_the_truth(
    name: str, bars: tuple[float, float], launched: tuple[float, float]
) -> None:
    chosen = scenario(name)
    given, _ = chosen.draw(64, 3)
    simulator = Simulator.of_physics(chosen.scene)
    found = evaluation.evaluate(simulator, given, (10, 38))
    for steps, bar in zip(("10", "38"), bars, strict=True):
        assert found["windows"][steps]["human"] < bar
    launch = launches_of(simulator, given, 0).summary
    assert launch["count"] > 10
    assert launch["relative_error"]["median"] < launched[0] and launch["relative_error"]["p90"] < launched[1]


def test_a_human_who_falls_lies_still_with_its_joints_closed(reference: Reference) -> None:
    scene = human_and_ball()
    random = np.random.default_rng(0)
    states = np.repeat(reference.states[-1:].astype(np.float32), 4, axis=0)
    states[:, 0, packed.VELOCITY] += random.normal(0.0, 1.0, (4, 3))
    controls = np.broadcast_to(reference.controls[-1], (4, 100, len(scene.motors), 3))
    simulator = Simulator.of_physics(scene)
    for _ in range(6):
        states = np.asarray(simulator.rollout(states, controls)[:, -1])
    assert np.isfinite(states).all() and states[:, :-1, 2].max() < 0.5
    assert np.abs(states[:, :-1, packed.VELOCITY]).max() < 0.05
    apart = displacement(scene, jnp.asarray(states), morphology_of(scene))
    assert np.linalg.norm(apart, axis=-1).max() < 0.01


def test_what_is_like_the_training_data_has_a_novelty_of_about_one(episodes: Episodes) -> None:
    model = ResidualModel(human_and_ball(), Size(2, 16))
    windows = Windows(model.scene, [(episodes, 1.0)], Recipe(batch=256, contact_share=0.0))
    simulator = Simulator.of(model, statistics_of(model, windows, np.random.default_rng(0), batches=8))
    usual = [evaluation.novelty(simulator, *each) for each in zip(episodes.states[:8], episodes.controls, strict=False)]
    assert 0.5 < np.median(usual) < 1.5 and max(usual) < NOVEL
    shaken = episodes.states[0].copy()
    shaken[:, :-1, packed.VELOCITY] += np.random.default_rng(0).normal(0.0, 10.0, shaken[:, :-1, packed.VELOCITY].shape)
    assert evaluation.novelty(simulator, shaken, episodes.controls[0]) > NOVEL

"""The shipped weights against the truth, on seeds they were not trained on: weights that are finite garbage fail."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import jax
import numpy as np
import pytest

from larp_model import evaluation
from larp_model import state as packed
from larp_model import weights as stored
from larp_model.bodies import human, human_and_ball, segment_of
from larp_model.launches import launches_of
from larp_model.prediction import predict
from larp_model.simulator import Simulator, step
from tasks.data import random_episodes
from tasks.live import NOVEL
from tasks.motions.references import Reference
from tasks.scenarios import scenario


@pytest.mark.parametrize(
    ("name", "bars"), [("chains1", (0.0015, 0.012)), ("chains2", (0.002, 0.018)), ("chain4", (0.002, 0.018))]
)
def test_the_shipped_chains_err_no_more_than_they_did(name: str, bars: tuple[float, float]) -> None:
    chosen = scenario(name)
    model, learned, _ = stored.load(stored.SHIPPED / f"{name}.json", chosen.scene)
    given, _ = chosen.draw(32, 3)
    simulator = Simulator(model, learned)
    found = predict(simulator, given.states[:, 0], given.controls[:, :40], given.torques[:, :40], given.morphology)
    usual = np.broadcast_to(chosen.scene.morphology, given.morphology.shape)
    blind = predict(simulator, given.states[:, 0], given.controls[:, :40], given.torques[:, :40], usual)
    error, unseen = (
        np.linalg.norm((each - given.states[:, 1:41])[..., packed.POSITION], axis=-1) for each in (found, blind)
    )
    assert error.mean() < 0.8 * unseen.mean(), "the sizes of the links are minded"
    assert error[:, :10].mean() < bars[0] and error.mean() < bars[1]


@pytest.mark.parametrize(
    ("name", "bars", "launched"),
    [
        ("human_ball", {"10": (0.006, 0.003), "38": (0.024, 0.04)}, (0.16, 5.0)),
        ("human_capsule", {"10": (0.004, 0.005), "38": (0.018, 0.04)}, (0.3, 12.0)),
        ("any_human", {"10": (0.004, 0.005), "38": (0.028, 0.07)}, (0.15, 6.0)),
        ("full_human", {"10": (0.004, 0.006), "38": (0.028, 0.08)}, (0.2, 7.0)),
    ],
)
def test_the_shipped_human_and_what_it_strikes_err_no_more_than_they_did(
    name: str, bars: dict[str, tuple[float, float]], launched: tuple[float, float]
) -> None:
    chosen = scenario(name)
    model, learned, _ = stored.load(stored.SHIPPED / f"{name}.json", chosen.scene)
    given, _ = chosen.draw(64, 3)
    simulator = Simulator(model, learned)
    predicted = evaluation.predict(
        simulator, given.states[:, 0], given.controls[:, :38], given.torques[:, :38], given.morphology
    )
    distance, kept = evaluation.distances(predicted, given, 38)
    windows = evaluation.by_window(chosen.scene, distance, (10, 38))
    assert kept.all()
    for steps, limits in bars.items():
        for body, bar in zip(chosen.scene.bodies, limits, strict=True):
            error = windows[steps][body.name]
            assert error is not None and error < bar, f"{body.name} after {steps} steps"
    launch = launches_of(simulator, given, 3).summary
    assert launch["count"] > 10
    assert launch["relative_error"]["median"] < launched[0] and launch["angle_deg"]["median"] < launched[1]


def test_the_shipped_human_alone_errs_no_more_than_it_did_and_soon_half_as_much_as_the_one_that_kicks() -> None:
    chosen = scenario("any_human_alone")
    given, _ = chosen.draw(128, 3)

    def errors(name: str) -> tuple[float, float]:
        model, learned, _ = stored.load(stored.SHIPPED / f"{name}.json", chosen.scene)
        windows = evaluation.evaluate(Simulator(model, learned), given, (10, 38))["windows"]
        return windows["10"]["human"], windows["38"]["human"]

    found, kicking = errors("any_human_alone"), errors("any_human")
    assert found[0] < 0.002 and found[1] < 0.01
    assert found[1] < 0.5 * kicking[1]


def test_what_is_like_the_training_data_has_a_novelty_of_about_one(
    reference: Reference,
) -> None:
    simulator = Simulator.load("human_ball")
    found = random_episodes(simulator.scene, reference, count=16, seed=3, steps=60)[0]
    usual = [evaluation.novelty(simulator, *each) for each in zip(found.states, found.controls, strict=True)]
    assert 0.5 < np.median(usual) < 1.5 and max(usual) < NOVEL
    shaken, faster = found.states[0].copy(), found.states[0].copy()
    shaken[:, :-1, packed.VELOCITY] += np.random.default_rng(0).normal(0.0, 10.0, shaken[:, :-1, packed.VELOCITY].shape)
    faster[:, -1, packed.VELOCITY] += 30.0
    for states, controls in (
        (shaken, found.controls[0]),
        (faster, found.controls[0]),
        (found.states[0], found.controls[0] + 1.0),
    ):
        assert evaluation.novelty(simulator, states, controls) > NOVEL


def test_a_step_of_a_human_whose_motors_are_stronger_and_weaker_is_foreseen_as_well(reference: Reference) -> None:
    usual, random, errors = human_and_ball(), np.random.default_rng(2), []
    names = sorted({segment_of(link.name) for link in usual.body("human").links})
    factors = dict(zip(names, random.choice([0.8, 1.2], len(names)).tolist(), strict=True))
    for body in (human(), human(motors=factors)):
        scene = replace(usual, bodies=(body, usual.body("ball"))).only("human")
        model, learned, _ = stored.load(stored.SHIPPED / "any_human.json", scene)
        given, _ = random_episodes(scene, reference, 64, 3, steps=8)
        after = jax.jit(partial(step, model), compiler_options={"xla_backend_optimization_level": 0})(
            learned, given.states[:, 7], given.controls[:, 7]
        )
        errors.append(np.linalg.norm((after - given.states[:, 8])[..., packed.VELOCITY], axis=-1).mean())
    assert errors[1] < 1.2 * errors[0] < 0.2

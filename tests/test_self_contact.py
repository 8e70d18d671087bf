"""One leg on the other: a scene's option, in the truth and in the model."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model import designs
from larp_model import state as packed
from larp_model import weights as stored
from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from larp_model.meeting import first_contacts, meetings
from larp_model.networks import Weights
from larp_model.parts.part import Model, initial_weights, measure
from larp_model.scene import Scene
from larp_model.simulator import step
from larp_model.truth.episodes import Episodes, record
from larp_model.truth.mujoco import Truth, closed
from tasks.data import overlaps
from tasks.motions.generator import any_episodes
from tasks.motions.references import Reference

SCENE = human_and_ball(self_contact=True)
COUNT, STEPS = 32, 16
SOON = {"xla_backend_optimization_level": 0}
FEET = (SCENE.index("human", "left_foot"), SCENE.index("human", "right_foot"))


@pytest.fixture(scope="module")
def crossing() -> tuple[np.ndarray, np.ndarray]:
    """States (32, L, 13) of humans who fall freely, and targets (32, 16, J, 3) that bring their legs together."""
    random, human = np.random.default_rng(0), SCENE.body("human")
    states = np.zeros((COUNT, len(SCENE.links), packed.SIZE))
    states[..., 3], states[..., 2], states[:, -1, 0] = 1.0, 3.0, 9.0
    targets = np.zeros((COUNT, STEPS, len(SCENE.motors), 3))
    names = [human.links[child].name for child, _, _ in human.motors]
    for name, inwards in (("left_thigh", -1.0), ("right_thigh", 1.0)):
        targets[:, :, names.index(name), 0] = inwards * random.uniform(0.2, 0.5, (COUNT, 1))
    return closed(SCENE, states), targets


@pytest.fixture(scope="module")
def truth(crossing: tuple[np.ndarray, np.ndarray]) -> Episodes:
    return record(Truth(SCENE, COUNT), *crossing)[0]


@pytest.fixture(scope="module")
def untrained(truth: Episodes) -> tuple[Model, Weights]:
    """What is known of bodies and contacts before anything is learned: networks that answer nothing."""
    model = designs.hybrid(SCENE, designs.LEAST)
    flat = truth.states[:, :-1].reshape(-1, *truth.states.shape[2:])
    after = truth.states[:, 1:].reshape(flat.shape)
    controls, torques = (each.reshape(-1, *each.shape[2:]) for each in (truth.controls, truth.torques))
    found = jax.jit(partial(measure, model), compiler_options=SOON)(flat, after, controls, torques)
    begun = initial_weights(model, jax.random.key(0), found)
    outputs = {name: each._replace(mean=jnp.zeros_like(each.mean)) for name, each in begun.outputs.items()}
    return model, begun._replace(networks=jax.tree.map(jnp.zeros_like, begun.networks), outputs=outputs)


def gaps(scene: Scene, states: np.ndarray) -> np.ndarray:
    """Smallest gap (E, T) [m] of one leg to the other, in states (E, T, L, 13)."""
    flat = jnp.asarray(states).reshape(-1, *states.shape[2:])
    [(_, met)] = meetings(scene.within, flat, jnp.asarray(scene.morphology)[None])
    return np.asarray(met.gap.min(axis=1)).reshape(states.shape[:2])


def test_legs_stop_each_other_only_where_they_can_touch(
    crossing: tuple[np.ndarray, np.ndarray], truth: Episodes
) -> None:
    through, _ = record(Truth(SCENE.between, COUNT), *crossing)
    deepest, held = (gaps(SCENE, states).min(axis=1) for states in (through.states, truth.states))
    assert (deepest < -0.04).mean() > 0.8 and held.min() > -0.03


def test_a_body_that_touches_itself_does_not_move_its_own_centre(truth: Episodes) -> None:
    rows, mass = SCENE.rows("human"), SCENE.morphology[SCENE.rows("human"), 2]
    velocity = np.einsum("etnk,n->etk", truth.states[:, :, rows, packed.VELOCITY], mass / mass.sum())
    falling = -SCENE.gravity * SCENE.dt * np.arange(STEPS + 1)
    np.testing.assert_allclose(velocity[..., 2], np.broadcast_to(falling, velocity.shape[:2]), atol=1e-3)
    np.testing.assert_allclose(velocity[..., :2], 0.0, atol=1e-3)


def test_the_model_knows_before_training_that_legs_stop_each_other(
    truth: Episodes, untrained: tuple[Model, Weights]
) -> None:
    model, weights = untrained
    touching = np.argwhere(gaps(SCENE, truth.states[:, :-1]) < -0.005)
    before, after = (truth.states[touching[:, 0], touching[:, 1] + later] for later in (0, 1))
    apart = {}
    for name, scene in (("touching", SCENE), ("passing", SCENE.between)):
        found = jax.jit(partial(step, model.on(scene)), compiler_options=SOON)(
            weights, before, truth.controls[tuple(touching.T)]
        )
        apart[name] = np.linalg.norm((found - after)[:, FEET, packed.VELOCITY], axis=-1).mean()
    assert apart["touching"] < 0.5 * apart["passing"]


def test_first_contacts_are_of_the_pairs_that_are_asked_for(truth: Episodes) -> None:
    assert (first_contacts(SCENE.within, truth, COUNT) > 0).mean() > 0.8
    assert (first_contacts(SCENE.between, truth, COUNT) == -1).all()


def test_weights_that_know_nothing_of_it_are_refused_and_can_be_had_without(
    untrained: tuple[Model, Weights], tmp_path: Path
) -> None:
    model, weights = untrained
    manifest = stored.save(tmp_path, "passing", model.on(SCENE.between), weights, {})
    with pytest.raises(InputError, match="no part 'human-itself'"):
        stored.load(manifest, SCENE)
    known, learned, _ = stored.load(manifest, SCENE, partly=True)
    assert known.scene == SCENE.between
    assert learned.networks.keys() == weights.networks.keys(), "of legs nothing is learned"


def test_no_episode_begins_with_one_leg_in_the_other(reference: Reference) -> None:
    episodes, dropped = any_episodes(SCENE, reference, 64, 3, 4)
    assert len(episodes.states) + dropped == 64 and dropped > 0
    assert not overlaps(SCENE, episodes.states[:, 0], episodes.morphology).any()

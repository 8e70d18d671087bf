"""One leg on the other: a scene's option, in the truth and in the model."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from larp_model import state as packed
from larp_model.bodies import human_and_ball
from larp_model.detection import contact_points, first_contacts
from larp_model.engines.episodes import Episodes, record
from larp_model.engines.mujoco import Truth, closed
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from tasks.episodes.any_motion import any_episodes
from tasks.episodes.around_kick import overlaps
from tasks.motions.references import Reference

SCENE = human_and_ball(self_contact=True)
COUNT, STEPS = 32, 16
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


def gaps(scene: Scene, states: np.ndarray) -> np.ndarray:
    """Smallest gap (E, T) [m] of one leg to the other, in states (E, T, L, 13)."""
    flat = jnp.asarray(states).reshape(-1, *states.shape[2:])
    [(_, points)] = contact_points(scene.within, flat, jnp.asarray(scene.morphology)[None])
    return np.asarray(points.gap.min(axis=1)).reshape(states.shape[:2])


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


def test_the_model_knows_that_legs_stop_each_other(truth: Episodes) -> None:
    touching = np.argwhere(gaps(SCENE, truth.states[:, :-1]) < -0.005)
    before, after = (truth.states[touching[:, 0], touching[:, 1] + later] for later in (0, 1))
    apart = {}
    for name, scene in (("touching", SCENE), ("passing", SCENE.between)):
        found = np.asarray(Simulator.of_physics(scene).step(before, truth.controls[tuple(touching.T)]))
        apart[name] = np.linalg.norm((found - after)[:, FEET, packed.VELOCITY], axis=-1).mean()
    assert apart["touching"] < 0.2 * apart["passing"]


def test_first_contacts_are_of_the_pairs_that_are_asked_for(truth: Episodes) -> None:
    assert (first_contacts(SCENE.within, truth, COUNT) > 0).mean() > 0.8
    assert (first_contacts(SCENE.between, truth, COUNT) == -1).all()


def test_no_episode_begins_with_one_leg_in_the_other(reference: Reference) -> None:
    episodes, dropped = any_episodes(SCENE, reference, 64, 3, 4)
    assert len(episodes.states) + dropped == 64 and dropped > 0
    assert not overlaps(SCENE, episodes.states[:, 0], episodes.morphology).any()

"""The simulator over mechanics: symmetries, what it sees of a capsule, and the errors of the shipped chains."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model import designs, rotation
from larp_model import state as packed
from larp_model import weights as stored
from larp_model.bodies import capsule, two_chains
from larp_model.kinematics import kinematics, morphology_of
from larp_model.mechanics import Constants
from larp_model.meeting import first_contacts
from larp_model.parts.articulated import Articulated
from larp_model.parts.bases import OverMechanics
from larp_model.parts.part import Hits, initial_weights, measure
from larp_model.scene import Scene
from larp_model.simulator import Simulator, rollout
from tasks.scenarios import scenario

STEPS = 5
SCENE = two_chains(2)
MODEL = designs.hybrid(SCENE, designs.LEAST)
SOON = {"xla_backend_optimization_level": 0}
ROLL = jax.jit(rollout, static_argnums=0, compiler_options=SOON)


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def meetings() -> np.ndarray:
    """Eight states (8, L, 13) two steps before two chains meet."""
    with jax.enable_x64(False):
        episodes, _ = scenario("chains2").draw(32, 1)
        contacts = first_contacts(SCENE, episodes, chunk=32)
    rows = np.flatnonzero(contacts >= 2)[:8]
    states = episodes.states[rows, contacts[rows] - 2].astype(float)
    states[..., packed.ORIENTATION] /= np.linalg.norm(states[..., packed.ORIENTATION], axis=-1, keepdims=True)
    return states


@pytest.fixture(scope="module")
def simulator(meetings: np.ndarray) -> Simulator:
    """Two chains with random weights."""
    with jax.enable_x64(False):
        after = meetings + 0.1 * np.random.default_rng(0).standard_normal(meetings.shape)
        step = (each.astype(np.float32) for each in (meetings, after, np.zeros((8, 0, 3)), np.zeros((8, 4, 3))))
        found = jax.jit(measure, static_argnums=0, compiler_options=SOON)(MODEL, *step)
        return Simulator(MODEL, initial_weights(MODEL, jax.random.key(0), found))


def roll(simulator: Simulator, states: np.ndarray) -> np.ndarray:
    """Predicted states (N, STEPS, L, 13)."""
    controls = np.zeros((len(states), STEPS, 0, 3))
    return np.asarray(ROLL(simulator.model, simulator.weights, states, controls))


def apart(first: np.ndarray, second: np.ndarray) -> float:
    """Largest difference of places and velocities, orientations left out."""
    return float(np.abs(np.delete(first - second, np.s_[packed.ORIENTATION], axis=-1)).max())


def test_chains_push_each_other(simulator: Simulator, meetings: np.ndarray) -> None:
    alone = Simulator(MODEL.on(SCENE.only("first")), simulator.weights)
    assert apart(roll(simulator, meetings)[:, :, :2], roll(alone, meetings[:, :2])) > 0.1, (
        "else there is little to test"
    )


def test_turning_the_world_turns_the_prediction(simulator: Simulator, meetings: np.ndarray) -> None:
    angle = np.linspace(-3.0, 3.0, len(meetings))
    turn = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    turned = np.asarray(rotation.turn_states(jnp.asarray(meetings), turn))
    expected = rotation.turn_states(jnp.asarray(roll(simulator, meetings)), turn[:, None])
    assert apart(roll(simulator, turned), np.asarray(expected)) < 1e-7


def test_shifting_the_world_shifts_the_prediction(simulator: Simulator, meetings: np.ndarray) -> None:
    shift = np.zeros(packed.SIZE)
    shift[:2] = 3.0, -7.0
    assert apart(roll(simulator, meetings + shift), roll(simulator, meetings) + shift) < 1e-7


def test_how_a_capsule_has_rolled_about_its_axis_changes_nothing(simulator: Simulator, meetings: np.ndarray) -> None:
    angle = np.linspace(-2.0, 2.0, 4 * len(meetings)).reshape(len(meetings), 4, 1)
    about = rotation.from_rotation_vector(jnp.asarray(angle * np.array(SCENE.links[0].axis)))
    rolled = meetings.copy()
    rolled[..., packed.ORIENTATION] = rotation.multiply(jnp.asarray(meetings[..., packed.ORIENTATION]), about)
    assert apart(roll(simulator, rolled), roll(simulator, meetings)) < 1e-7


def test_a_batch_equals_single_runs(simulator: Simulator, meetings: np.ndarray) -> None:
    alone = np.concatenate([roll(simulator, each[None]) for each in meetings[:3]])
    np.testing.assert_allclose(alone, roll(simulator, meetings)[:3], atol=1e-9)


def test_what_the_base_is_survives_on_disk(simulator: Simulator, tmp_path: Path) -> None:
    manifest = stored.save(tmp_path, "tiny", MODEL, simulator.weights, {})
    part = stored.load(manifest, SCENE)[0].bodies[0]
    assert isinstance(part, Articulated) and part.base == OverMechanics(Constants(rounds=3), lasting=True)


def test_a_push_changes_a_capsule_by_its_mass_from_when_it_acts() -> None:
    body = capsule()
    scene, upright = Scene((body,)), np.zeros((1, 1, packed.SIZE))
    upright[..., 2], upright[..., 3] = 2.0, 1.0
    seen = kinematics(scene, jnp.asarray(upright), morphology_of(scene)[None].astype(float))
    impulse = jnp.array((0.3, 0.0, -0.2))
    hits = Hits(jnp.zeros((1, 1, 6)).at[..., :3].set(impulse), 0.007 * jnp.ones((1, 1, 3)) * impulse)
    faster, _, moved, _ = OverMechanics().answer(body, seen, hits, 0.01)[0, :, 0]
    np.testing.assert_allclose(faster, impulse / body.links[0].mass, atol=1e-6)
    # Half the step is what the trapezoidal step has already.
    np.testing.assert_allclose(moved, 0.002 * impulse / body.links[0].mass, atol=1e-9)

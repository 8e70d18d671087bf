"""The truth: MuJoCo's physics, its convergence at contact, and the episodes recorded from it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.bodies import ball, capsule, chain, human, standing_height
from larp_model.detection import first_contacts
from larp_model.engines.episodes import VERSION, Episodes, join, load, record, save
from larp_model.engines.mujoco import SUBSTEPS, Truth, compile_model
from larp_model.errors import InputError
from larp_model.physics import kinematics
from larp_model.scene import Scene
from tasks.exploration import exploration_std, smooth_noise
from tasks.motions.references import Reference, standing_on_ground


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The engine logs a divergence into the working directory."""
    monkeypatch.chdir(tmp_path)
    yield


def at_rest(*positions: tuple[float, float, float]) -> np.ndarray:
    """A state (L, 13) of upright links at rest."""
    state = np.zeros((len(positions), packed.SIZE))
    state[:, packed.POSITION], state[:, 3] = positions, 1.0
    return state


def kicks(scene: Scene, reference: Reference, count: int, steps: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Starts (count, L, 13) and joint targets (count, steps, J, 3) of kicks around the reference."""
    random = np.random.default_rng(seed)
    states = np.tile(reference.states[0], (count, 1, 1))
    states[:, -1, :2] += random.uniform(-0.03, 0.03, (count, 2))
    controls = reference.window(0, steps)[1]
    return states, controls + 0.4 * smooth_noise(random, count, steps, 6, exploration_std(scene))


def test_free_fall_is_exact() -> None:
    start = at_rest((0.0, 0.0, 20.0))
    start[0, packed.VELOCITY], start[0, packed.ANGULAR_VELOCITY] = (3.0, -1.0, 2.0), (5.0, 1.0, -2.0)
    after, _ = Truth(Scene((ball(),))).rollout(start[None], np.zeros((1, 100, 0, 3)))
    time = 0.01 * np.arange(1, 101)[:, None]
    gravity = np.array([0.0, 0.0, -9.81])
    np.testing.assert_allclose(after[0, :, 0, packed.VELOCITY], start[0, packed.VELOCITY] + gravity * time, atol=1e-9)
    path = start[0, packed.POSITION] + start[0, packed.VELOCITY] * time + 0.5 * gravity * time**2
    # Semi-implicit steps h fall g h t / 2 too far.
    np.testing.assert_allclose(after[0, :, 0, packed.POSITION], path, atol=0.5 * 9.81 * 0.01 / SUBSTEPS + 1e-9)
    np.testing.assert_allclose(after[0, :, 0, packed.ANGULAR_VELOCITY], np.tile([5.0, 1.0, -2.0], (100, 1)))


def test_momentum_is_kept_without_gravity() -> None:
    scene = Scene((human(),), gravity=0.0)
    random = np.random.default_rng(0)
    truth = Truth(scene, batch=4)
    start = standing_on_ground(scene, np.zeros((1, 12, 3)), Rotation.identity(1))[0] + np.eye(13)[2] * 5.0
    start = np.tile(start, (4, 1, 1))
    start[..., packed.VELOCITY] = random.standard_normal((4, 1, 3))
    start[..., packed.ANGULAR_VELOCITY] = random.standard_normal((4, 13, 3))
    truth.reset(start)
    controls = smooth_noise(random, 4, 30, 4, np.full((12, 3), 0.3))
    after, _ = truth.rollout(start, controls)
    bodies = [truth.model.body(f"human/{link.name}").id for link in scene.links]
    mass, inertia = truth.model.body_mass[bodies, None], truth.model.body_inertia[bodies]
    frame = Rotation.from_quat(np.tile(truth.model.body_iquat[bodies], (120, 1)), scalar_first=True)
    position, velocity = after[..., packed.POSITION], after[..., packed.VELOCITY]
    linear = (mass * velocity).sum(axis=-2)
    principal = Rotation.from_quat(after[..., packed.ORIENTATION].reshape(-1, 4), scalar_first=True) * frame
    spin = principal.inv().apply(after[..., packed.ANGULAR_VELOCITY].reshape(-1, 3))
    own = principal.apply(np.tile(inertia, (120, 1)) * spin).reshape(velocity.shape)
    angular = (own + mass * np.cross(position, velocity)).sum(axis=-2)
    moved = np.abs(mass * velocity).sum(axis=-2).max()
    assert np.abs(linear - linear[:, :1]).max() < 0.01 * moved
    assert np.abs(angular - angular[:, :1]).max() < 0.01 * np.abs(angular).max()


def test_a_standing_human_stays_up() -> None:
    scene = Scene((human(),))
    start = standing_on_ground(scene, np.zeros((1, 12, 3)), Rotation.identity(1))[0]
    assert start[0, 2] == pytest.approx(standing_height(human()), abs=1e-9)
    after, finite = Truth(scene).rollout(start[None], np.zeros((1, 100, 12, 3)))
    assert finite.all() and after[0, :, 0, 2].min() > 0.9 * start[0, 2]


def test_a_football_rebounds_as_the_rules_ask() -> None:
    radius = ball().links[0].radius
    start = at_rest((0.0, 0.0, 2.0 + radius))
    after, _ = Truth(Scene((ball(),))).rollout(start[None], np.zeros((1, 150, 0, 3)))
    height = after[0, :, 0, 2] - radius
    bounce = int(np.argmax(after[0, :, 0, 9] > 0.0))
    assert height[:bounce].min() < 0.1
    assert 1.35 < height[bounce:].max() < 1.55


def test_a_state_survives_a_reset(scene: Scene, episodes: Episodes) -> None:
    truth = Truth(scene, batch=len(episodes.states))
    truth.reset(episodes.states[:, -1].astype(float))
    once = truth.state()
    truth.reset(once)
    np.testing.assert_allclose(truth.state(), once, atol=1e-10)
    np.testing.assert_allclose(once, episodes.states[:, -1], atol=5e-5)


def test_recorded_joints_do_not_come_apart(scene: Scene, reference: Reference) -> None:
    chains = Scene((chain("first"), chain("second", links=3, length=0.2)))
    truth = Truth(chains)
    truth.reset(at_rest(*[(0.0, 0.0, 1.0)] * 7) + np.eye(13)[11] * 3.0)
    falling = np.concatenate([truth.state(), *(truth.step(np.zeros((1, 0, 3))) for _ in range(30))])
    with jax.enable_x64(True):
        for described, states in ((scene, reference.states), (chains, falling)):
            apart = kinematics.displacement(described, jnp.asarray(states), kinematics.morphology_of(described))
            assert np.linalg.norm(apart, axis=-1).max() < 1e-6


def test_a_batch_equals_single_runs_bit_for_bit(scene: Scene, reference: Reference) -> None:
    states, controls = kicks(scene, reference, 5, 40, seed=1)
    together, _ = Truth(scene, batch=5).rollout(states, controls)
    alone = Truth(scene)
    for row in range(5):
        np.testing.assert_array_equal(alone.rollout(states[row][None], controls[row][None])[0][0], together[row])
    uneven, dropped = record(Truth(scene, batch=3), states, controls)
    assert dropped == 0
    np.testing.assert_array_equal(uneven.states[:, 1:], together.astype(np.float32))


def test_targets_and_torques_reach_the_links_they_name(scene: Scene) -> None:
    human, links = scene.human, len(scene.links)
    floating = np.zeros((links, packed.SIZE))
    floating[:, packed.POSITION], floating[:, 3] = (0.0, 0.0, 5.0), 1.0
    truth = Truth(scene, batch=12)
    still, _ = truth.rollout(np.tile(floating, (12, 1, 1)), np.zeros((12, 1, 12, 3)))
    children = [child for child, _, _ in human.motors]
    targets, torques = np.zeros((12, 1, 12, 3)), np.zeros((12, 1, links, 3))
    targets[np.arange(12), 0, np.arange(12), 1] = 0.1
    torques[np.arange(12), 0, children, 1] = 1.0
    turned, _ = truth.rollout(np.tile(floating, (12, 1, 1)), targets)
    pushed, _ = truth.rollout(np.tile(floating, (12, 1, 1)), np.zeros((12, 1, 12, 3)), torques)
    spin = (turned - still)[:, 0, :, 11]
    relative = spin[:, children] - spin[:, [joint.parent for joint in human.joints]]
    np.testing.assert_array_equal(relative.argmax(axis=1), np.arange(12))
    np.testing.assert_array_equal((pushed - still)[:, 0, :, 11].argmax(axis=1), children)


def test_torques_of_one_rollout_do_not_reach_the_next(scene: Scene, reference: Reference) -> None:
    truth, (states, controls) = Truth(scene), kicks(scene, reference, 1, 5, seed=2)
    before, _ = truth.rollout(states, controls)
    pushed, _ = truth.rollout(states, controls, np.full((1, 5, len(scene.links), 3), 20.0))
    after, _ = truth.rollout(states, controls)
    assert np.abs(pushed - before).max() > 1e-3
    np.testing.assert_array_equal(after, before)


def test_diverged_trajectories_are_dropped_and_counted(scene: Scene, reference: Reference) -> None:
    states, controls = kicks(scene, reference, 5, 10, seed=3)
    torques = np.zeros((5, 10, len(scene.links), 3))
    healthy, none = record(Truth(scene, batch=3), np.delete(states, [1, 4], 0), np.delete(controls, [1, 4], 0))
    torques[[1, 4], 3:, 5] = 1e9
    kept, dropped = record(Truth(scene, batch=3), states, controls, torques)
    assert (none, dropped) == (0, 2)
    for name in ("states", "controls", "torques"):
        np.testing.assert_array_equal(getattr(kept, name), getattr(healthy, name))


def test_halving_the_engine_step_does_not_move_the_launch(scene: Scene, reference: Reference) -> None:
    before, after = 3, 8  # steps of 10 ms around first contact
    steps = reference.strike + 12
    states, controls = kicks(scene, reference, 360, steps, seed=4)
    episodes, _ = record(Truth(scene, batch=360), states, controls)
    contacts = first_contacts(scene, episodes, 360)
    rows = np.flatnonzero((contacts >= before) & (contacts + after <= steps))
    launches = []
    for substeps in (SUBSTEPS, 2 * SUBSTEPS):
        columns = contacts[rows, None] - before + np.arange(before + after)
        starts = episodes.states[rows, columns[:, 0]].astype(float)
        truth = Truth(scene, len(rows), substeps)
        launches.append(truth.rollout(starts, episodes.controls[rows[:, None], columns])[0][:, -1, -1, packed.VELOCITY])
    speed = np.linalg.norm(launches[0], axis=-1)
    moved = np.linalg.norm(launches[1] - launches[0], axis=-1) / speed
    kicked = speed > 1.5
    assert kicked.sum() >= 200 and np.ptp(speed[kicked]) > 3.0, "the kicks must be many and differ"
    assert np.median(moved[kicked]) < 0.01


def test_contacts_that_a_scene_leaves_out_do_not_happen(scene: Scene) -> None:
    bare = Scene((capsule(), ball()))
    through = at_rest((0.0, 0.0, 3.0), (0.0, 0.4, 3.0))
    through[1, packed.VELOCITY] = 0.0, -8.0, 0.0
    after, _ = Truth(bare).rollout(through[None], np.zeros((1, 10, 0, 3)))
    assert after[0, -1, 1, 1] == pytest.approx(-0.4) and after[0, -1, 0, 1] == 0.0
    pairs = compile_model(scene).npair
    assert pairs == len(scene.links) + len(scene.pairs[0].first_links)


def test_a_batch_of_bodies_equals_simulations_of_each_alone() -> None:
    scene, random = Scene((chain(links=3),)), np.random.default_rng(0)
    usual = np.array([(link.length, link.radius, link.mass) for link in scene.links])
    morphology = usual * random.uniform(0.7, 1.3, (4, 3, 3))
    states = np.zeros((4, 3, 13))
    states[..., 2], states[..., 3] = 1.0, 1.0
    states[..., 10:] = random.standard_normal((4, 3, 3))
    controls = np.zeros((4, 60, 0, 3))
    truth = Truth(scene, 4)
    truth.resize(morphology)
    together, _ = truth.rollout(states, controls)
    for index in range(4):
        alone, _ = Truth(scene.sized(morphology[index])).rollout(states[[index]], controls[[index]])
        np.testing.assert_array_equal(together[[index]], alone)
    truth.resize(np.broadcast_to(usual, morphology.shape))
    np.testing.assert_array_equal(truth.rollout(states, controls)[0], Truth(scene, 4).rollout(states, controls)[0])


def test_sizes_that_are_none_are_refused_by_link(scene: Scene) -> None:
    truth = Truth(scene, 2)
    morphology = np.tile([(link.length, link.radius, link.mass) for link in scene.links], (2, 1, 1))
    morphology[1, 2, 1] = -0.1
    with pytest.raises(InputError, match=r"link 'head'.radius is -0.1"):
        truth.resize(morphology)
    with pytest.raises(InputError, match=r"morphology has shape \(1, 14, 3\), but needs \(2, 14, 3\)"):
        truth.resize(morphology[:1])


def test_substeps_must_be_positive(scene: Scene) -> None:
    with pytest.raises(InputError, match="substeps is 0"):
        Truth(scene, substeps=0)


@pytest.fixture
def stored(tmp_path: Path, scene: Scene, episodes: Episodes) -> Path:
    """A file of three episodes."""
    path = tmp_path / "deep" / "episodes.npz"
    save(path, scene, Episodes(*(part[:3] for part in episodes)))
    return path


def test_what_is_saved_is_what_is_loaded(stored: Path, scene: Scene, episodes: Episodes) -> None:
    loaded = load(stored, scene)
    assert len(loaded.states) == 3 and loaded.steps == 30
    for name in Episodes._fields:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(episodes, name)[:3])
    assert [file.name for file in stored.parent.iterdir()] == ["episodes.npz"]
    twice = join([loaded, loaded])
    assert len(twice.states) == 6 and twice.steps == 30


def rewrite(path: Path, **changes: np.ndarray) -> None:
    """Change or, with an empty array of size 0, remove arrays of an .npz file."""
    with np.load(path, allow_pickle=False) as file:
        content = {name: file[name] for name in file.files} | changes
    np.savez(path, **{name: array for name, array in content.items() if array.size})


def header(**changes: object) -> np.ndarray:
    names = [link.name for link in Scene((human(), ball())).links]
    return np.array(json.dumps({"version": VERSION, "dt": 0.01, "links": names} | changes))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"header": header(version=1)}, "version 1"),
        ({"header": header(dt=0.02)}, "another scene"),
        ({"header": header(links=["a"])}, "another scene"),
        ({"header": np.array("{")}, "cannot be read"),
        ({"header": np.array("[1]")}, "cannot be read"),
        ({"torques": np.zeros(0)}, "cannot be read"),
        ({"states": np.zeros((3, 31, 13, 13))}, r"states has shape \(3, 31, 13, 13\)"),
        ({"controls": np.zeros((3, 29, 12, 3))}, "states has shape"),
        ({"controls": np.zeros(3)}, "has shape"),
        ({"torques": np.full((3, 30, 14, 3), np.nan)}, "torques holds values that are not finite"),
        ({"morphology": np.ones((3, 13, 3))}, r"morphology has shape \(3, 13, 3\)"),
        ({"states": np.array([[None]])}, "cannot be read"),
    ],
)
def test_episodes_that_do_not_fit_are_refused(
    stored: Path, scene: Scene, changes: dict[str, np.ndarray], message: str
) -> None:
    rewrite(stored, **changes)
    with pytest.raises(InputError, match=message) as caught:
        load(stored, scene)
    assert str(stored) in str(caught.value) and "\n" not in str(caught.value)


def test_damaged_or_missing_episodes_are_refused(stored: Path, scene: Scene) -> None:
    stored.write_bytes(stored.read_bytes()[:-1000])
    with pytest.raises(InputError, match="cannot be read"):
        load(stored, scene)
    with pytest.raises(InputError, match="does not exist"):
        load(stored.with_name("none.npz"), scene)

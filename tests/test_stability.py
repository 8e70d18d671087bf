"""Limits are reported: precision, diverging worlds, great gradients, odd scenes; and the benchmark of them."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model import state as packed
from larp_model.bodies import ball, capsule
from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from larp_model.learned.model import Model
from larp_model.networks import Weights
from larp_model.scene import Scene, Surface
from larp_model.simulator import Simulator
from mpc import CEM, Gradient, Window
from mpc.loop import DivergenceError, Phase, execute
from tasks.benchmarks import gradients, laws, promises, random_scenes, stability, stress
from tasks.motions.references import Reference


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The engine logs a divergence into the working directory."""
    monkeypatch.chdir(tmp_path)
    yield


@pytest.fixture(scope="module")
def ball_model() -> Simulator:
    """A ball alone."""
    return Simulator.of_physics(Scene((ball(),)))


def lying_ball(count: int = 1) -> np.ndarray:
    """States (count, 1, 13) of a ball 1 m above the ground."""
    states = np.zeros((count, 1, packed.SIZE), np.float32)
    states[:, 0, 2], states[:, 0, 3] = 1.11, 1.0
    return states


@pytest.mark.parametrize("kind", [jnp.bfloat16, jnp.float16, jnp.int32])
def test_numbers_that_are_too_coarse_are_refused_by_name(ball_model: Simulator, kind: jnp.dtype) -> None:
    state = jnp.asarray(lying_ball(), kind)
    with pytest.raises(InputError, match="state has numbers of type"):
        ball_model.step(state, jnp.zeros((1, 0, 3)))
    with pytest.raises(InputError, match="state has numbers of type"):
        ball_model.rollout(state, jnp.zeros((1, 4, 0, 3)))


def test_a_prediction_is_flagged_from_where_it_diverges_and_no_other_row_with_it(ball_model: Simulator) -> None:
    states = np.repeat(lying_ball(), 3, axis=0)
    states[1, 0, 2], states[1, 0, 9] = 50.0, -99.95  # falls past 100 m/s in its first step
    states[2, 0, packed.POSITION] = 1e6, 0.0, 1e6
    after = np.asarray(ball_model.rollout(jnp.asarray(states), jnp.zeros((3, 4, 0, 3))))
    assert np.isfinite(after[[0, 2]]).all()
    assert np.isnan(after[1]).all()


def test_a_ball_moves_alike_wherever_it_is(ball_model: Simulator) -> None:
    near = np.repeat(lying_ball(), 2, axis=0)
    near[:, 0, packed.VELOCITY] = 3.0, 1.0, -4.0
    far = near.copy()
    far[0, 0, :2] += 16_000.0, -1_600.0
    controls = jnp.zeros((2, 60, 0, 3))
    moved = np.asarray(ball_model.rollout(far, controls), float)
    moved[0, :, 0, :2] -= 16_000.0, -1_600.0
    # 1 mm is the distance of neighbouring numbers at 16 km.
    np.testing.assert_allclose(moved[0], moved[1], atol=1e-3)


def test_a_capsule_that_tumbles_keeps_its_energy_and_its_angular_momentum() -> None:
    scene = Scene((capsule(),), gravity=0.0)
    for rate in (1.0, 3.0):
        starts = laws.turning(laws.straight(capsule()), rate)
        after = Simulator.of_physics(scene).rollout(starts.astype(np.float32), np.zeros((len(starts), 200, 0, 3)))
        before, now = laws.mechanics(scene, starts), laws.mechanics(scene, np.asarray(after[:, -1], float))
        np.testing.assert_allclose(now.energy, before.energy, rtol=laws.ENERGY)
        apart = np.linalg.norm(now.angular_momentum - before.angular_momentum, axis=-1)
        assert (apart <= laws.MOMENTUM * np.linalg.norm(before.angular_momentum, axis=-1)).all()


def test_a_surface_restores_what_it_says_as_mujocos_does() -> None:
    for restitution in (0.6, 0.9):
        ours, engines = laws.rebounds(Surface.bouncing(0.02, restitution, 0.5), 5.0)
        np.testing.assert_allclose(ours, engines, atol=1e-3)
        assert ours.mean() == pytest.approx(restitution, rel=0.01)


def test_a_ball_with_spin_gains_no_energy_on_the_ground() -> None:
    assert all(row["held"] for row in laws.spinning_balls())


def test_the_derivative_of_a_bounce_is_its_slope_over_all_moments_of_contact() -> None:
    assert all(row["held"] for row in laws.bounce_slopes())


@pytest.mark.parametrize(
    ("name", "value"),
    [("torques", jnp.zeros((1, 3, 1, 3))), ("morphology", jnp.zeros((2, 1, 3))), ("morphology", jnp.zeros(3))],
)
def test_arguments_that_do_not_fit_are_refused_by_name(ball_model: Simulator, name: str, value: jax.Array) -> None:
    with pytest.raises(InputError, match=f"{name} ha"):
        ball_model.rollout(jnp.asarray(lying_ball()), jnp.zeros((1, 4, 0, 3)), **{name: value})


def test_the_state_decides_the_precision_also_where_jax_holds_64_bits(
    scene: Scene, residual: Model, residual_weights: Weights, reference: Reference
) -> None:
    model = Simulator.of(residual, residual_weights)
    with jax.enable_x64(True):
        for kind in (jnp.float32, jnp.float64):
            state = jnp.asarray(reference.states[None, 0], kind)
            after = jax.eval_shape(model.rollout, state, jnp.zeros((1, 2, len(scene.motors), 3)))
            assert after.dtype == kind


def test_a_torque_turns_a_ball_as_its_inertia_says(ball_model: Simulator) -> None:
    torque = np.zeros((1, 1, 3), np.float32)
    torque[0, 0] = 0.01, -0.02, 0.03
    after = ball_model.step(jnp.asarray(lying_ball()), jnp.zeros((1, 0, 3)), jnp.asarray(torque))
    true = Truth(Scene((ball(),)), 1, threads=1)
    true.reset(lying_ball())
    expected = true.step(np.zeros((1, 0, 3)), torque)
    np.testing.assert_allclose(after[0, 0, packed.ANGULAR_VELOCITY], expected[0, 0, packed.ANGULAR_VELOCITY], rtol=1e-4)


@pytest.mark.parametrize("size", [1e-30, 1.0, 1e15, 1e25, 3e38])
def test_a_step_follows_the_direction_of_any_finite_gradient(size: float) -> None:
    scale = np.full((2, 3), 0.1, np.float32)
    gradient = np.full((1, 4, 2, 3), np.float32(size) * np.float32(0.1))
    moved = gradients.update_of(gradient, scale)
    assert np.isfinite(moved).all() and (moved < 0.0).all() and np.abs(moved).max() <= 2.0 * Gradient().learning_rate


class Lost:
    """A world of one link that is lost in its third step."""

    def __init__(self) -> None:
        self.steps = 0

    def reset(self, states: np.ndarray) -> None:
        pass

    def step(self, control: np.ndarray) -> np.ndarray:
        self.steps += 1
        return np.full((1, 1, 13), np.nan if self.steps == 3 else 0.0)


@pytest.mark.parametrize("every", [3, 10])
def test_a_world_that_diverges_ends_the_execution_and_names_the_step(every: int) -> None:
    planner = stability.toy(stability.Shaky(np.inf), CEM(samples=4, rounds=1, elites=2))
    phase = Phase(planner, planner, every, lambda step: Window(0.01 * step, np.zeros((6, 1, 3))))
    with pytest.raises(DivergenceError, match="diverged in step 2"):
        execute(Lost(), np.zeros((1, 13)), (phase,), 5, jax.random.key(0))


def test_what_the_engine_lost_is_nan_and_its_neighbours_are_not() -> None:
    truth = Truth(Scene((ball(),)), 2, threads=1)
    truth.reset(lying_ball(2))
    torque = np.zeros((2, 1, 3))
    torque[1] = 1e9
    after = truth.step(np.zeros((2, 0, 3)), torque)
    assert np.isfinite(after[0]).all() and np.isnan(after[1]).all()


def test_a_reference_of_bfloat16_becomes_targets_of_32_bits() -> None:
    planner = stability.toy(stability.Shaky(np.inf), CEM(samples=4, rounds=1, elites=2))
    controls = planner.controls(planner.init(jax.random.key(0)), jnp.zeros((6, 1, 3), jnp.bfloat16))
    assert controls.dtype == jnp.float32


@pytest.mark.parametrize("kind", ["ball", "chain"])
def test_random_scenes_neither_crash_nor_hide_what_is_not_finite(kind: str) -> None:
    model = Simulator.of_physics(random_scenes.scene_of_kind(kind, None))
    found = random_scenes.random_scenes(kind, model, scenes=3, states_per_scene=4, steps=3, seed=0)
    assert (found.states, found.crashes, found.silent) == (12, [], 0)


def test_what_is_hidden_would_be_found() -> None:
    lost, resting = np.full((4, 1, packed.SIZE), np.nan), np.zeros((4, 1, packed.SIZE))
    resting[..., 3] = 1.0
    assert promises.bounded("axis", "value", resting)["held"]
    assert "flagged after 2 steps" in promises.bounded("axis", "value", np.concatenate([resting[:2], lost]))["seen"]
    for column, value in ((0, np.nan), (3, 1.1), (7, 200.0)):
        odd = resting.copy()
        odd[2, 0, column] = value
        assert not promises.bounded("axis", "value", odd)["held"]
    assert not promises.flagged("axis", "value", lost, True)["held"]
    assert promises.flagged("axis", "value", lost, False)["held"]
    assert promises.refusal(partial(int, "3"), "")[1] is False
    assert promises.refusal(partial(int, "x"), "weight")[1] is False


def test_closest_points_keep_their_promises_where_capsules_are_degenerate() -> None:
    assert all(row["held"] for row in stress.geometry())


def test_every_case_has_a_place_in_the_picture() -> None:
    rows = [promises.row(axis, 1, "promise", "seen", held) for axis in ("a", "b", "c") for held in (True, False)]
    drawn = stability.picture(rows, "title")
    assert sum(np.shape(each.get_offsets())[0] for axes in drawn.axes for each in axes.collections) == len(rows)


def test_too_few_scenes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="scenes is 3"):
        stability.main(scenes=3, json=tmp_path / "stability.json")

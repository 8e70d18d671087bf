"""Errors that the model expects of its own steps grow with the forces in them, and rank steps as the truth does."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model import state as packed
from larp_model.bodies import ball
from larp_model.expected_error import SHARE, expected_errors
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from tasks import residuals
from tasks.benchmarks import step_errors
from tasks.run import USUAL_ERROR, described_errors

SCENE = Scene((ball(),))


def moving(*velocities: tuple[float, float, float]) -> np.ndarray:
    """States (T + 1, 1, 13) of a ball with these velocities [m/s]."""
    states = np.zeros((len(velocities), 1, packed.SIZE))
    states[:, 0, packed.VELOCITY] = velocities
    return states


def test_free_fall_is_expected_to_be_exact_and_a_push_to_cost_in_proportion() -> None:
    fall = SCENE.gravity * SCENE.dt
    states = moving((1.0, 0.0, 0.0), (1.0, 0.0, -fall), (2.0, 0.0, -2.0 * fall), (2.0, 3.0, -3.0 * fall))
    errors = expected_errors(SCENE, states, SCENE.morphology)
    np.testing.assert_allclose(errors, SHARE * SCENE.dt * np.array([0.0, 1.0, 3.0]), atol=1e-8)


def test_a_turn_counts_as_the_motion_of_the_tip_that_it_causes() -> None:
    states = moving((0.0, 0.0, 0.0), (0.0, 0.0, -SCENE.gravity * SCENE.dt))
    states[1, 0, packed.ANGULAR_VELOCITY] = 0.0, 10.0, 0.0
    length, radius, _ = SCENE.morphology[0]
    errors = expected_errors(SCENE, states, SCENE.morphology)
    np.testing.assert_allclose(errors, SHARE * SCENE.dt * 10.0 * (0.5 * length + radius), rtol=1e-4)


def test_sizes_may_differ_from_row_to_row_and_jax_agrees_with_numpy() -> None:
    states = np.random.default_rng(0).standard_normal((3, 5, 1, packed.SIZE)).astype(np.float32)
    sizes = np.stack([SCENE.morphology * factor for factor in (0.5, 1.0, 2.0)]).astype(np.float32)
    together = expected_errors(SCENE, states, sizes)
    alone = [expected_errors(SCENE, *row) for row in zip(states, sizes, strict=True)]
    np.testing.assert_allclose(together, alone, rtol=1e-6)
    in_jax = jax.jit(lambda *arrays: expected_errors(SCENE, *arrays))(states, sizes)
    np.testing.assert_allclose(together, in_jax, rtol=1e-5)


def test_as_a_cost_it_has_finite_slopes_where_nothing_moves() -> None:
    states = jnp.asarray(moving(*[(0.0, 0.0, -SCENE.gravity * SCENE.dt * step) for step in range(4)]))
    cost = jax.grad(lambda s: residuals.expected_errors(s, jnp.zeros((4, 0, 3)), None, SCENE).sum())
    assert residuals.expected_errors(states, jnp.zeros((4, 0, 3)), None, SCENE).shape == (3, 1)
    assert np.isfinite(cost(states)).all()


def test_steps_of_a_human_rank_as_their_true_errors_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step_errors, "EPISODES", {"human": 12})
    errors, together = step_errors.expected(seed=3, drawn=256)
    assert errors["held"] and together["held"], (errors["seen"], together["seen"])


def test_the_largest_error_is_named_with_its_time_and_judged() -> None:
    text = described_errors([1e-4, 5e-4, 1e-4], begin=0.1, dt=0.01)
    assert text == "0.10 mm, at most 0.50 mm at 0.12 s"
    assert "trust the plan less" in described_errors([1e-4, 1.01 * USUAL_ERROR], 0.0, 0.01)
    assert described_errors([], 0.0, 0.01) == described_errors([np.nan], 0.0, 0.01) == ""


def test_a_simulator_expects_errors_of_its_own_rollouts() -> None:
    simulator = Simulator.of_physics(SCENE)
    start = moving((0.0, 0.0, 0.0)).astype(np.float32)[0]
    start[0, :4] = 0.0, 0.0, 0.5, 1.0  # falls from 0.4 m above the ground and bounces
    states = np.asarray(simulator.rollout(start[None], np.zeros((1, 40, 0, 3))))
    errors = simulator.expected_errors(np.concatenate([start[None, None], states], axis=1))[0]
    bounce = int(np.argmax(states[0, :, 0, 9] > 0.0))
    assert errors.shape == (40,) and errors[: bounce - 1].max() < 0.01 * errors.max()
    assert abs(int(errors.argmax()) - bounce) <= 1

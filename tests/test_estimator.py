"""Promises of estimation: what filters know, how sure they say to be, and what they refuse."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model.errors import InputError
from larp_model.linearization import Coordinates
from larp_model.physics.kinematics import displacement, morphology_of
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from mpc.estimator import Estimate, Estimator, KalmanFilter, LastSample, Observation, moved
from tasks import sensing
from tasks.motions.references import Reference

DT, UNKNOWN = 0.01, np.inf
STATE = np.eye(1, 13, 3)
ONES = np.ones(6)


@dataclass(frozen=True)
class Sled:
    """A point that the control accelerates; its coordinates are its place and its velocity."""

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        velocity = state[:, None, :, 7:10] + DT * jnp.cumsum(controls, axis=1)
        place = state[:, None, :, :3] + DT * jnp.cumsum(velocity, axis=1)
        states = jnp.repeat(state[:, None], controls.shape[1], axis=1)
        return states.at[..., :3].set(place).at[..., 7:10].set(velocity)

    def difference(self, states: jax.Array, references: jax.Array) -> jax.Array:
        change = (states - references)[..., 0, :]
        return jnp.concatenate([change[..., :3], change[..., 7:10]], axis=-1)

    def moved(self, states: jax.Array, coordinates: jax.Array) -> jax.Array:
        states = states.at[..., 0, :3].add(coordinates[..., :3])
        return states.at[..., 0, 7:10].add(coordinates[..., 3:])

    def basis(self, states: jax.Array) -> jax.Array:
        rows = jnp.zeros((13, 6)).at[jnp.array([0, 1, 2, 7, 8, 9]), jnp.arange(6)].set(1.0)
        return jnp.broadcast_to(rows, (*states.shape, 6))


def sled_filter(noise: float = 0.0) -> KalmanFilter:
    return KalmanFilter(Sled(), DT, np.r_[np.zeros(3), np.full(3, noise**2)])


def seen(place: np.ndarray, error: float, age: float = 0.0) -> Observation:
    """A measured place with errors of this size, and no velocity."""
    state = STATE.copy()
    state[0, :3] = place
    return Observation(state, np.r_[np.full(3, error**2), np.full(3, UNKNOWN)], age)


def paths(random: np.random.Generator, kicks: float, steps: int) -> tuple[np.ndarray, np.ndarray]:
    """True states (T + 1, 1, 13) of a sled that is also pushed at random, and its controls (T, 1, 3)."""
    controls = random.standard_normal((steps, 1, 3))
    states = [STATE.copy()]
    for control in controls:
        state = np.array(Sled().rollout(jnp.asarray(states[-1][None]), control[None, None])[0, 0], float)
        state[0, 7:10] += kicks * random.standard_normal(3)
        states.append(state)
    return np.stack(states), controls


def followed(estimator: Estimator, states: np.ndarray, controls: np.ndarray, error: float, seed: int) -> list[Estimate]:
    random = np.random.default_rng((1, seed))
    estimates = [estimator.init(STATE, np.r_[np.full(3, error**2), np.full(3, 0.05**2)], 0.0)]
    for step, control in enumerate(controls, start=1):
        observation = seen(states[step, 0, :3] + error * random.standard_normal(3), error)
        estimates.append(estimator.update(estimates[-1], observation, control, step * DT))
    return estimates


def test_the_filter_knows_more_than_the_last_sample_and_says_how_much() -> None:
    kicks, error, steps = 0.02, 0.01, 40
    filtered, raw, normalised = list[np.ndarray](), list[np.ndarray](), list[float]()
    for seed in range(60):
        states, controls = paths(np.random.default_rng(seed), kicks, steps)
        of_filter = followed(sled_filter(kicks), states, controls, error, seed)[-1]
        of_sample = followed(LastSample(Sled()), states, controls, error, seed)[-1]
        filtered.append(deviation(states[-1], of_filter))
        raw.append(deviation(states[-1], of_sample))
        normalised.append(float(filtered[-1] @ np.linalg.inv(of_filter.covariance) @ filtered[-1]) / 6)
    errors, raw_errors = (
        np.sqrt(np.mean(np.square(each), axis=0)).reshape(2, 3).mean(axis=1) for each in (filtered, raw)
    )
    assert errors[0] < 0.6 * raw_errors[0] and errors[1] < 0.1 * raw_errors[1]
    # The mean over 360 normalised squares is 1, give or take 7 %.
    assert np.mean(normalised) == pytest.approx(1.0, abs=0.2)


def deviation(state: np.ndarray, estimate: Estimate) -> np.ndarray:
    """The coordinates (6,) of a true state against its estimate."""
    return np.asarray(Sled().difference(jnp.asarray(state), jnp.asarray(estimate.state)), float)


def test_the_last_sample_is_what_was_measured_and_its_rates_are_differences() -> None:
    estimator = LastSample(Sled())
    first = estimator.init(STATE, ONES, 0.0)
    then = estimator.update(first, seen(np.array([0.02, 0.0, -0.01]), 0.001), None, 0.02)
    np.testing.assert_allclose(then.state[0, :3], (0.02, 0.0, -0.01), atol=1e-7)
    np.testing.assert_allclose(then.state[0, 7:10], (1.0, 0.0, -0.5), atol=1e-5)


def test_what_is_lost_is_predicted_and_the_filter_becomes_less_sure() -> None:
    estimator = sled_filter(0.1)
    state = STATE.copy()
    state[0, 7] = 2.0
    estimates = [estimator.init(state, 1e-4 * ONES, 0.0)]
    for step in range(1, 6):
        estimates.append(estimator.update(estimates[-1], None, np.zeros((1, 3)), step * DT))
    np.testing.assert_allclose([each.state[0, 0] for each in estimates], 2.0 * DT * np.arange(6), atol=1e-6)
    sizes = [np.trace(each.covariance) for each in estimates]
    assert np.all(np.diff(sizes) > 0.0)


def test_an_old_measurement_counts_for_where_the_body_was() -> None:
    state, estimator = STATE.copy(), sled_filter()
    state[0, 7] = 2.0
    certain = estimator.init(state, np.r_[np.ones(3), np.full(3, 1e-8)], 0.0)
    old = estimator.update(certain, seen(np.array([-0.08, 0.0, 0.0]), 1e-4, age=0.04), None, 0.0)
    np.testing.assert_allclose(old.state[0, :3], 0.0, atol=1e-4)


def test_places_of_links_are_measurements_of_their_own() -> None:
    estimator, unmeasured = sled_filter(), np.full(6, UNKNOWN)
    observation = Observation(STATE, unmeasured, 0.0, np.array([[0.3, 0.0, 0.1]]), np.array([1e-6]))
    estimate = estimator.update(estimator.init(STATE, ONES, 0.0), observation, None, 0.0)
    np.testing.assert_allclose(estimate.state[0, :3], (0.3, 0.0, 0.1), atol=1e-5)
    np.testing.assert_allclose(np.diag(estimate.covariance)[:3], 1e-6, rtol=1e-2)


def test_clocks_and_measurements_that_mean_nothing_are_refused() -> None:
    estimator = sled_filter()
    now = estimator.init(STATE, ONES, 1.0)
    control = np.zeros((1, 3))
    with pytest.raises(InputError, match=r"time: got 0.99 s, needs a time from that of the estimate, 1.0 s, on"):
        estimator.update(now, None, control, 0.99)
    with pytest.raises(InputError, match=r"time: got 1.004 s after 1.0 s, needs steps of 0.01 s under control"):
        estimator.update(now, None, control, 1.004)
    with pytest.raises(InputError, match=r"time: got 1.01 s after 1.0 s, needs steps of 0.01 s under control"):
        estimator.update(now, None, None, 1.01)
    with pytest.raises(InputError, match=r"observation: got an age below 0, needs measurements of the past"):
        estimator.update(now, seen(np.zeros(3), 0.01, age=-0.01), None, 1.0)
    with pytest.raises(InputError, match=r"variance: needs 6 finite numbers >= 0"):
        estimator.init(STATE, np.full(6, UNKNOWN), 0.0)
    with pytest.raises(InputError, match=r"process_noise: got numbers that are not finite or negative"):
        KalmanFilter(Sled(), DT, -ONES)
    with pytest.raises(InputError, match=r"dt: got 0.0, needs a finite number > 0"):
        KalmanFilter(Sled(), 0.0, ONES)


def test_a_moved_state_has_its_joints_closed_and_gives_the_coordinates_back(scene: Scene, reference: Reference) -> None:
    simulator = Simulator.of_physics(scene)
    state = np.asarray(reference.states[20], float)
    coordinates = 0.02 * np.random.default_rng(0).standard_normal(2 * Coordinates(scene).count)
    other = moved(simulator, state, coordinates)
    apart = displacement(scene, jnp.asarray(other[None]), morphology_of(scene)[None])
    assert float(jnp.abs(apart).max()) < 2e-6
    back = np.asarray(simulator.difference(*(jnp.asarray(each, jnp.float32)[None] for each in (other, state))))[0]
    # Rotations add up to the second order; a chain of four joints is turned by 0.04 rad.
    np.testing.assert_allclose(back, coordinates, atol=2e-3)


def test_perfect_sensors_need_no_perception(scene: Scene, reference: Reference) -> None:
    estimator, random = LastSample(Simulator.of_physics(scene)), np.random.default_rng(0)
    assert sensing.perception(scene, reference.states[0], "perfect", estimator, random) is None
    for name, arguments in {"sensors": ("blurred", estimator), "estimator": None}.items():
        with pytest.raises(InputError, match=f"{name}"):
            if arguments:
                sensing.perception(scene, reference.states[0], *arguments, random)  # type: ignore[arg-type]
            else:
                sensing.estimator_of(scene, "crystal ball")  # type: ignore[arg-type]

"""Promises of estimation: what filters know, how sure they say to be, and what they refuse."""

from __future__ import annotations

import dataclasses
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
from mpc.timeline import Sample, Timeline
from tasks import sensing, sensors
from tasks.benchmarks.estimation import estimate_errors, least_covariance, mean_errors
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


def seen(place: np.ndarray, error: float) -> Observation:
    """A measured place with errors of this size, and no velocity."""
    state = STATE.copy()
    state[0, :3] = place
    return Observation(state, np.r_[np.full(3, error**2), np.full(3, UNKNOWN)])


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
    timeline = Timeline(estimator, estimator.init(state, np.r_[np.ones(3), np.full(3, 1e-8)], 0.0))
    for step in range(5):
        timeline.update([], np.zeros((1, 3)) if step else None, step * DT)
    late = timeline.update([Sample(0.0, seen(np.array([-0.08, 0.0, 0.0]), 1e-4))], None, 4 * DT)
    np.testing.assert_allclose(late.state[0, :3], 0.0, atol=1e-4)


def test_late_samples_change_nothing_of_the_estimate_in_whatever_order_they_come() -> None:
    random = np.random.default_rng(0)
    states, controls = paths(random, 0.02, 12)
    samples = [
        Sample(step * DT, seen(states[step, 0, :3] + 0.01 * random.standard_normal(3), 0.01)) for step in range(13)
    ]
    deliveries = {
        "at once": {step: [sample] for step, sample in enumerate(samples)},
        "late": {step + 4: [sample] for step, sample in enumerate(samples[:9])} | {12: samples[8:]},
        "in one": {12: [samples[number] for number in random.permutation(13)]},
    }
    estimates = []
    for delivered in deliveries.values():
        timeline = Timeline(sled_filter(0.02), sled_filter().init(STATE, 0.01 * ONES, 0.0))
        for step in range(13):
            estimate = timeline.update(delivered.get(step, []), controls[step - 1] if step else None, step * DT)
        estimates.append(estimate)
    for other in estimates[1:]:
        np.testing.assert_allclose(other.state, estimates[0].state, atol=1e-6)
        np.testing.assert_allclose(other.covariance, estimates[0].covariance, rtol=1e-6, atol=1e-12)


def test_samples_of_the_future_and_of_a_past_that_is_forgotten_are_refused() -> None:
    estimator = sled_filter()
    timeline = Timeline(estimator, estimator.init(STATE, ONES, 0.0))
    for step in range(40):
        timeline.update([], np.zeros((1, 3)) if step else None, step * DT)
    before = timeline.estimate
    with pytest.raises(InputError, match=r"sample: is of 0.41 s, but it is 0.4 s: needs one of the past"):
        timeline.update([Sample(0.41, seen(np.zeros(3), 0.01))], np.zeros((1, 3)), 0.4)
    with pytest.raises(InputError, match=r"sample: is of 0.1 s, but it is 0.4 s: needs one of the last 0.2 s"):
        timeline.update([Sample(0.1, seen(np.zeros(3), 0.01))], np.zeros((1, 3)), 0.4)
    with pytest.raises(InputError, match=r"time: got 0.3 s, needs a time from that of the estimate"):
        timeline.update([], np.zeros((1, 3)), 0.3)
    assert timeline.estimate is before


def test_a_bias_is_the_mean_difference_from_a_sensor_without_one() -> None:
    random, bias = np.random.default_rng(0), np.array([0.05, -0.03, 0.02])
    estimator = KalmanFilter(Sled(), DT, np.zeros(6), biased=range(3))
    estimate, differences = estimator.init(STATE, np.full(9, 0.01), 0.0), []
    for step in range(1, 101):
        place, unbiased = bias + 0.01 * random.standard_normal(3), 0.01 * random.standard_normal((1, 3))
        differences.append(place - unbiased[0])
        observation = seen(place, 0.01)._replace(places=unbiased, place_variance=np.array([1e-4]))
        estimate = estimator.update(estimate, observation, np.zeros((1, 3)), step * DT)
    np.testing.assert_allclose(estimate.bias, np.mean(differences, axis=0), atol=1e-4)
    np.testing.assert_allclose(np.diag(estimate.covariance)[6:], 2e-6, rtol=0.05)


def test_places_of_links_are_measurements_of_their_own() -> None:
    estimator, unmeasured = sled_filter(), np.full(6, UNKNOWN)
    observation = Observation(STATE, unmeasured, np.array([[0.3, 0.0, 0.1]]), np.array([1e-6]))
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
    with pytest.raises(InputError, match=r"change_error: got nan, needs a finite number >= 0"):
        KalmanFilter(Sled(), DT, ONES, np.nan)
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


@pytest.mark.parametrize("kind", ["places", "ground"])
def test_an_estimate_agrees_with_what_was_measured_exactly(scene: Scene, reference: Reference, kind: str) -> None:
    simulator, random = Simulator.of_physics(scene), np.random.default_rng(0)
    state, count = np.asarray(reference.states[20], float), 2 * Coordinates(scene).count
    other = moved(simulator, state, 0.01 * random.standard_normal(count))
    links, ball = len(scene.links), scene.rows(scene.ball.name).start

    arms = np.zeros((links, 3))
    arms[:, 2] = -scene.links[ball].radius

    def measured(states: np.ndarray) -> np.ndarray:
        if kind == "places":
            arm = states[ball, :3] - states[0, :3]
            return np.array(sensors.rotations(states[0]).inv().apply(arm))
        speed = states[ball, 7:10] + np.cross(states[ball, 10:], arms[ball])
        return np.array([states[ball, 2] + arms[ball, 2], *speed])

    only_ball = np.where(np.arange(links) == ball, 1e-8, UNKNOWN)
    observation = Observation(state, np.full(count, UNKNOWN))
    if kind == "places":
        expected = measured(other)
        observation = observation._replace(places=np.tile(expected, (links, 1)), place_variance=only_ball, origin=0)
    else:
        observation = observation._replace(ground_arms=arms, ground_variance=np.repeat(only_ball[:, None], 2, axis=1))
        state, expected = other, np.zeros(4)
    estimator = KalmanFilter(simulator, scene.dt, np.zeros(count))
    estimate = estimator.update(estimator.init(state, np.full(count, 0.01), 0.0), observation, None, 0.0)
    estimate = estimator.update(estimate, observation, None, 0.0)
    before, after = (measured(each) - expected for each in (state, estimate.state))
    assert np.abs(before).max() > 5e-3 and np.abs(after).max() < 5e-4


def test_perfect_sensors_need_no_perception(scene: Scene, reference: Reference) -> None:
    random = np.random.default_rng(0)
    assert sensing.Sensing(scene, "perfect", "none").perception(reference.states[0], random) is None


def test_sensors_that_see_too_little_are_refused_by_name(scene: Scene) -> None:
    for arguments, message in (
        (("blurred",), "sensors"),
        (("noisy", "crystal ball"), "estimator"),
        (
            (sensors.Sensors(ball=np.inf),),
            r"sensors: got none that measures the ball, needs its place \(ball\) or a camera",
        ),
        (("onboard", "none"), "estimator: got 'none', but not all places are measured at once: needs 'filter'"),
    ):
        with pytest.raises(InputError, match=message):
            sensing.Sensing(scene, *arguments)


def test_pictures_arrive_late_at_their_rate_and_show_the_ball_from_the_root(scene: Scene, reference: Reference) -> None:
    camera = sensors.BallCamera(noise=0.0, bounds=(0.0, 0.0), rate=25.0, delay=0.04, lost=0.0)
    own = dataclasses.replace(sensors.SENSORS["onboard"], camera=camera, lost=0.0)
    model = sensors.SensorModel(scene, Simulator.of_physics(scene), own, np.random.default_rng(0))
    state = np.asarray(reference.states[10], float)
    pictures = [
        (step, sample)
        for step in range(20)
        for sample in model.measure(state, step * DT)
        if sample.observation.origin is not None
    ]
    assert [step for step, _ in pictures] == [4, 8, 12, 16]
    np.testing.assert_allclose([sample.time for _, sample in pictures], [0.0, 0.04, 0.08, 0.12], atol=1e-9)
    ball, seen_ball = scene.rows(scene.ball.name).start, pictures[0][1].observation
    in_world = sensors.rotations(state[0]).apply(seen_ball.places[ball]) + state[0, :3]
    np.testing.assert_allclose(in_world, state[ball, :3], atol=1e-6)


@pytest.fixture(scope="module")
def lab(scene: Scene) -> sensing.Sensing:
    return sensing.Sensing(scene, "lab")


def test_a_ball_that_rests_does_not_bounce_in_the_estimate(lab: sensing.Sensing, reference: Reference) -> None:
    perceived = lab.perception(reference.states[0], np.random.default_rng(0))
    assert perceived is not None
    for step in range(20):
        perceived(step, reference.states[step], None if not step else np.zeros((len(lab.scene.motors), 3)))
    velocities = [estimate.state[lab.scene.rows(lab.scene.ball.name).start, 7:10] for estimate in perceived.estimates]
    assert np.abs(velocities).max() < 0.02


def test_filters_of_the_same_scene_share_what_is_compiled(
    scene: Scene, lab: sensing.Sensing, reference: Reference
) -> None:
    events, count = list[str](), 2 * Coordinates(scene).count

    def listen(event: str, duration_secs: float, **details: str | int) -> None:
        events.append(event)

    def update(dynamics: Simulator) -> None:
        own = KalmanFilter(dynamics, scene.dt, np.zeros(count))
        start = own.init(reference.states[5], np.full(count, 1e-4), 0.0)
        measured = Observation(reference.states[6], np.full(count, 1e-4))
        own.update(start, measured, np.zeros((len(scene.motors), 3)), scene.dt)

    update(lab.dynamics)
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        update(Simulator.of_physics(scene))
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert not events


def test_where_all_measurements_are_lost_the_estimate_is_a_prediction_and_says_so(
    scene: Scene, lab: sensing.Sensing, reference: Reference
) -> None:
    blind = dataclasses.replace(sensors.SENSORS["lab"], lost=1.0)
    perceived = lab.perception(reference.states[0], np.random.default_rng(0))
    assert perceived is not None
    perceived.sensors = sensors.SensorModel(scene, Simulator.of_physics(scene), blind, np.random.default_rng(0))
    for step in range(3):
        perceived(step, reference.states[step], None if not step else np.zeros((len(scene.motors), 3)))
    assert perceived.lost == 3
    assert np.all(np.diff([np.trace(estimate.covariance) for estimate in perceived.estimates]) > 0.0)


def test_numbers_of_sensors_that_mean_nothing_are_refused() -> None:
    for kind, arguments, message in (
        (sensors.Sensors, {"joints": -0.1}, "joints: got -0.1, needs a number >= 0"),
        (sensors.Sensors, {"lost": 1.5}, "lost: got 1.5, needs a number from 0 to 1"),
        (sensors.BallCamera, {"rate": 0.0}, "camera.rate: got 0.0, needs a finite number > 0"),
        (sensors.BallCamera, {"delay": np.nan}, "camera.delay: got nan, needs a number >= 0"),
        (sensors.BallCamera, {"bounds": (0.03, 0.01)}, r"camera.bounds: got \(0.03, 0.01\), needs the lower one first"),
    ):
        with pytest.raises(InputError, match=message):
            kind(**arguments)


class LinearSled(Sled):
    """The sled, with the derivatives of its steps."""

    def linearize(self, states: jax.Array, controls: jax.Array) -> tuple[jax.Array, jax.Array]:
        by_state = jnp.eye(6).at[:3, 3:].set(DT * jnp.eye(3))
        return jnp.tile(by_state, (len(states), 1, 1)), jnp.zeros((len(states), 6, 3))


def test_for_a_linear_model_the_filter_knows_as_much_as_the_cramer_rao_bound() -> None:
    random, model = np.random.default_rng(0), LinearSled()
    truth, controls = paths(random, 0.02, 20)
    sled = KalmanFilter(model, DT, np.r_[np.zeros(3), np.full(3, 0.02**2)])
    both = sensing.TwoPhaseFilter(sled, sled)
    start = both.init(STATE, 0.01 * ONES, -0.05)
    perceived = sensing.Perception(None, Timeline(both, start), DT, start)  # type: ignore[arg-type]
    for step in range(-5, 21):
        arrived = [Sample(step * DT, seen(STATE[0, :3], 0.01))] if step % 3 == 0 else []
        perceived.samples.append(arrived)
        control = None if step == -5 else controls[max(step - 1, 0)]
        estimate = perceived.timeline.update(arrived, control, step * DT)
    least = least_covariance(perceived, model, truth, controls, 20)  # type: ignore[arg-type]
    np.testing.assert_allclose(least, estimate.covariance, rtol=1e-3, atol=1e-9)


def test_errors_of_the_last_sample_are_those_of_the_sensors(scene: Scene, reference: Reference) -> None:
    states, no_control = np.asarray(reference.states[:4], float), np.zeros((4, len(scene.motors), 3))
    errors, noisy = [], sensing.Sensing(scene, "noisy", "none")
    for seed in range(6):
        perceived = noisy.perception(states[0], np.random.default_rng(seed))
        assert perceived is not None
        for step, state in enumerate(states):
            perceived(step, state, no_control[0] if step else None)
        errors.append(estimate_errors(scene, perceived, states, no_control, 3))
    mean = mean_errors(errors)
    assert mean["joint_angles"]["raw"] == pytest.approx(np.radians(0.5), rel=0.15)
    assert mean["ball_position"]["raw"] == pytest.approx(0.005, rel=0.5)
    for values in mean.values():
        assert values["estimate"] == pytest.approx(values["raw"], abs=1e-4) and np.isnan(values["bound"])
        assert np.isfinite(values["normalised"])

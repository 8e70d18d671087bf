"""Staying up, sensing, rolling balls, and the report of what differs between prediction and truth."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.engines.mujoco import Truth
from larp_model.physics import kinematics
from larp_model.simulator import Simulator
from mpc import evaluate
from tasks import kick, sensing, sensors
from tasks.gap import events, gap
from tasks.motions.references import standing_on_ground
from tasks.standing import HORIZON, SWING_END, Standing
from tasks.strike import strike_step
from tasks.targets import random_roll


@pytest.fixture(scope="module")
def task() -> kick.Kick:
    return kick.Kick.standard()


def at_rest(task: kick.Kick, count: int) -> np.ndarray:
    """States (count, 13) of the ball at rest where the reference begins."""
    return np.repeat(task.reference.states[:1, task.ball], count, axis=0)


def stood(task: kick.Kick, standing: Standing) -> jax.Array:
    """States (HORIZON, n, 13) of the human at rest in the stance."""
    upright = standing_on_ground(task.scene, standing.stance[None], Rotation.identity(1))
    return jnp.repeat(jnp.asarray(upright[:, task.human]), HORIZON, axis=0)


@pytest.mark.parametrize(
    ("term", "column", "links", "by"),
    [
        ("balance", 7, slice(None), 0.5),
        ("upright", 2, slice(None), -0.2),
        ("feet", 2, slice(12, 13), 0.1),
        ("lean", 4, slice(0, 1), 0.2),
    ],
)
def test_standing_still_costs_next_to_nothing_and_what_leads_to_a_fall_costs(
    task: kick.Kick, term: str, column: int, links: slice, by: float
) -> None:
    standing = Standing(task.scene, task.reference)
    window = standing.window(task.reference.strike + 60)
    human, controls = stood(task, standing), jnp.asarray(window.reference)
    np.testing.assert_allclose(window.reference, np.broadcast_to(standing.stance, window.reference.shape))
    total, _ = evaluate(standing.terms, human, controls, window.context)
    assert float(total) < 0.5
    worse = human.at[:, links, column].add(by)
    assert evaluate(standing.terms, worse, controls, window.context)[1][term] > 0.2


def test_the_targets_go_from_the_kick_to_the_stance_without_a_jump(task: kick.Kick) -> None:
    standing = Standing(task.scene, task.reference)
    controls = np.stack([standing.window(step).reference[0] for step in range(task.reference.strike, 200)])
    last = task.reference.window(task.reference.strike + SWING_END // 2, 1)[1]
    np.testing.assert_array_equal(controls[0], last[0])
    assert np.abs(np.diff(controls, axis=0)).max() < 0.1
    np.testing.assert_array_equal(controls[-1], standing.stance)


def test_the_capture_point_at_rest_is_below_the_centre_of_mass_and_moves_ahead_with_speed(task: kick.Kick) -> None:
    standing = Standing(task.scene, task.reference)
    human = jnp.asarray(task.reference.states[0, task.human]).at[:, packed.VELOCITY].set(0.0)
    mass = np.array([link.mass for link in task.scene.human.links])
    centre = mass @ np.asarray(human[:, packed.POSITION]) / mass.sum()
    middle = np.asarray(human[standing.feet, :2]).mean(axis=0)
    np.testing.assert_allclose(standing.capture_point(human), centre[:2] - middle, atol=1e-6)
    moving = human.at[:, 7].set(1.0)
    ahead = standing.capture_point(moving) - standing.capture_point(human)
    np.testing.assert_allclose(ahead, [np.sqrt(centre[2] / task.scene.gravity), 0.0], rtol=1e-5, atol=1e-6)


def test_a_kick_that_happens_as_predicted_has_no_gap(task: kick.Kick) -> None:
    states = task.reference.states[:160]
    found = gap(task.scene, states, states[20:], 20, at_rest(task, len(states)))
    assert found["launch_error"] == 0.0 and found["links_m"] == 0.0
    assert found["launch_angle_deg"] == pytest.approx(0.0, abs=0.01)
    assert found["joints_deg"] == pytest.approx(0.0, abs=1e-4)
    for name in ("contact_s", "contact_link", "contact_point_m", "launch_m_s", "landing_m"):
        assert found[name]["truth"] == found[name]["model"] is not None
    assert found["contact_link"]["truth"] == "right_foot"
    assert found["contact_s"]["truth"] == pytest.approx(task.reference.strike * task.scene.dt)
    assert np.linalg.norm(found["contact_point_m"]["truth"]) == pytest.approx(0.11, abs=1e-4)


def test_a_prediction_that_turns_the_ball_is_reported_with_its_angle(task: kick.Kick) -> None:
    states = task.reference.states[:160]
    turned = states[20:].copy()
    velocity = turned[:, task.ball, packed.VELOCITY]
    turned[:, task.ball, packed.VELOCITY] = Rotation.from_euler("z", 10.0, degrees=True).apply(1.1 * velocity)
    found = gap(task.scene, states, turned, 20, at_rest(task, len(states)))
    assert 5.0 < found["launch_angle_deg"] <= 10.0
    assert found["launch_error"] > 0.1


def test_a_graze_before_the_reference_strikes_does_not_end_the_kick(task: kick.Kick) -> None:
    strike, still = task.reference.strike, task.start()
    for step, speed, is_over in ((5, 0.5, False), (5, 2.0, True), (strike, 0.5, True), (strike, 0.0, False)):
        state = still.copy()
        state[task.ball, 7] = speed
        assert task.is_done(step, state, still[task.ball]) == is_over


def test_a_ball_that_nothing_touches_has_no_events(task: kick.Kick) -> None:
    states = np.repeat(task.reference.states[:1], 20, axis=0)
    assert strike_step(states, at_rest(task, 20)) is None
    assert set(events(task.scene, states, at_rest(task, 20)).values()) == {None}


def test_a_rolling_ball_is_where_it_would_rest_when_the_reference_strikes(task: kick.Kick) -> None:
    random = np.random.default_rng(3)
    for _ in range(3):
        roll = random_roll(random, 2.0)
        state = task.start((0.01, -0.02), roll)
        np.testing.assert_allclose(state[task.ball, 7:9], roll)
        path = task.untouched(state, task.reference.strike)
        wanted = task.reference.ball_spot[:2] + np.array([0.01, -0.02])
        np.testing.assert_allclose(path[-1, :2], wanted, atol=0.005)
        assert strike_step(path[:, None], path) is None


@pytest.mark.slow
@pytest.mark.parametrize("name", ["noisy", "lab"])
def test_the_filter_sees_the_kick_better_than_its_sensors_and_says_how_well(
    task: kick.Kick, name: sensors.SensorName
) -> None:
    start, truth = task.start((0.02, -0.01)), Truth(task.scene, 1, task.substeps, threads=1)
    raw, filtered = (
        sensing.Sensing(task.scene, name, estimator).perception(start, np.random.default_rng(1))
        for estimator in sensing.ESTIMATORS
    )
    assert raw is not None and filtered is not None
    truth.reset(start[None])
    window, state, control = task.window((4.0, 0.0, 0.5)), start, None
    joints, ball, simulator = np.arange(6, 42), np.arange(42, 45), Simulator.of_physics(task.scene)
    errors = []
    for step in range(task.reference.strike - 1):
        deviations = [
            np.asarray(simulator.difference(state.astype(np.float32), each(step, state, control)))
            for each in (raw, filtered)
        ]
        errors.append(deviations)
        control = np.asarray(window(step).reference)[0]
        state = truth.step(control[None])[0]
    late = np.sqrt(np.mean(np.square(np.array(errors)[15:]), axis=0))
    for rows in (joints, ball):
        of_raw, of_filter = np.sqrt(np.mean(np.square(late[:, rows]), axis=1))
        assert of_filter < 0.7 * of_raw
    covariances = [estimate.covariance for estimate in filtered.estimates[15:]]
    normalised = [
        error[rows] @ np.linalg.inv(covariance[np.ix_(rows, rows)]) @ error[rows] / len(rows)
        for (_, error), covariance in zip(errors[15:], covariances, strict=True)
        for rows in (joints,)
    ]
    assert 0.4 < np.mean(normalised) < 1.5


def test_sensing_keeps_joints_closed_and_has_the_noise_it_says(task: kick.Kick) -> None:
    simulator, random = Simulator.of_physics(task.scene), np.random.default_rng(0)
    model = sensors.SensorModel(task.scene, simulator, sensors.SENSORS["noisy"], random)
    state = task.reference.states[25].astype(float)
    seen = np.stack([model.measure(state, 0.0)[0].observation.state for _ in range(200)])
    shape = kinematics.morphology_of(task.scene)[None]
    apart = kinematics.displacement(task.scene, jnp.asarray(seen), shape)
    assert float(jnp.abs(apart).max()) < 1e-5
    assert np.std(seen[:, task.ball, :3] - state[task.ball, :3]) == pytest.approx(0.005, rel=0.15)
    np.testing.assert_allclose(seen[:, 0, :7], np.broadcast_to(state[0, :7], (200, 7)), atol=1e-6)
    child, joint, _ = task.scene.human.motors[-1]
    true, noisy = (
        Rotation.from_quat(each[..., joint.parent, 3:7], scalar_first=True).inv()
        * Rotation.from_quat(each[..., child, 3:7], scalar_first=True)
        for each in (state, seen)
    )
    error = np.degrees((true.inv() * noisy).as_rotvec())
    assert error.std() == pytest.approx(0.5, rel=0.15)

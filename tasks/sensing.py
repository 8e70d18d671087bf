"""Estimates of true states from what sensors measure of them, for the planner."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import ClassVar, Literal

import jax
import jax.numpy as jnp
import numpy as np

from larp_model.errors import InputError
from larp_model.names import require_known
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from mpc.dynamics import Coordinated
from mpc.estimator import Estimate, Estimator, KalmanFilter, LastSample, Observation, moved, rates, rates_of
from mpc.timeline import Sample, Timeline
from tasks.sensors import PERFECT, SENSORS, SensorModel, SensorName, Sensors, biased_coordinates

EstimatorName = Literal["none", "filter"]
ESTIMATORS: tuple[EstimatorName, ...] = ("none", "filter")
# Time for which sensors measure before the first plan, while all bodies move uniformly [s].
BEFORE = 1.0


@dataclass(frozen=True)
class ModelErrors:
    """Standard deviations of what the model does not explain of a step, or of what is unknown of the start.

    Of places [m], angles [rad], velocities [m/s] and angular velocities [rad/s], of a human and of a ball.
    """

    human: tuple[float, float, float, float]
    ball: tuple[float, float, float, float]


# A place that is measured slightly in the ground, or above it, makes the model lift what is there, or drop it: changes
# of velocities are uncertain by a share.
STEP, CHANGE_ERROR = ModelErrors((0.0, 0.0, 0.003, 0.03), (0.0, 0.0, 0.0003, 0.1)), 0.1
UNIFORM = ModelErrors((0.0, 0.0, 0.0, 0.01), (0.0, 0.0, 0.0003, 0.1))
START = ModelErrors((0.01, 0.02, 0.03, 0.1), (0.1, 1.0, 1.0, 10.0))


def coordinate_variances(scene: Scene, errors: ModelErrors) -> np.ndarray:
    """Return the variances (n,) of the coordinates of a scene's states; see `larp_model.linearization`."""
    halves: tuple[list[float], list[float]] = ([], [])
    for body in scene.bodies:
        place, angle, velocity, angular_velocity = errors.ball if body.is_ball else errors.human
        turns = len(body.links)
        halves[0].extend([place] * 3 + [angle] * 3 * turns)
        halves[1].extend([velocity] * 3 + [angular_velocity] * 3 * turns)
    return np.square(np.concatenate(halves))


@dataclass(frozen=True)
class UniformMotion:
    """Dynamics in which all rates stay as they are; joint targets have no effect."""

    dynamics: Coordinated
    dt: float
    differentiable: ClassVar[bool] = True

    def rollout(self, state: jax.Array, controls: jax.Array, *, steps: jax.Array | None = None) -> jax.Array:
        """See `mpc.Dynamics`."""
        states = [state]
        for _ in range(controls.shape[1]):
            speeds = rates_of(self.dynamics, states[-1])
            change = jnp.concatenate([self.dt * speeds, jnp.zeros_like(speeds)], axis=-1)
            states.append(self.dynamics.moved(states[-1], change))
        return jnp.stack(states[1:], axis=1)

    def difference(self, states: jax.Array, references: jax.Array) -> jax.Array:
        """See `mpc.dynamics.Coordinated`."""
        return self.dynamics.difference(states, references)

    def moved(self, states: jax.Array, coordinates: jax.Array) -> jax.Array:
        """See `mpc.dynamics.Coordinated`."""
        return self.dynamics.moved(states, coordinates)

    def basis(self, states: jax.Array) -> jax.Array:
        """See `mpc.dynamics.Coordinated`."""
        return self.dynamics.basis(states)


@dataclass(frozen=True)
class TwoPhaseFilter:
    """Filter of uniform motion until time 0, and of the model from then on."""

    before: KalmanFilter
    after: KalmanFilter

    def init(self, state: np.ndarray, variance: np.ndarray, time: float) -> Estimate:
        """See `mpc.estimator.Estimator`."""
        return self.before.init(state, variance, time)

    def update(
        self, estimate: Estimate, observation: Observation | None, control: np.ndarray | None, time: float
    ) -> Estimate:
        """See `mpc.estimator.Estimator`."""
        return (self.before if time <= 1e-9 else self.after).update(estimate, observation, control, time)


@dataclass
class Perception:
    """Estimates of true states from measurements of them, step by step, for the planner: see `mpc.loop.Sense`.

    start: the estimate before anything was measured. samples: that arrived in each step since then. estimates: of all
    steps so far. lost: the steps in which nothing was measured, so that the estimate is a prediction.
    """

    sensors: SensorModel
    timeline: Timeline
    dt: float
    start: Estimate
    samples: list[list[Sample]] = field(default_factory=list)
    estimates: list[Estimate] = field(default_factory=list)
    lost: int = 0
    first_step: int | None = None

    def __call__(self, step: int, state: np.ndarray, control: np.ndarray | None) -> np.ndarray:
        """Return the estimate of a true state (L, 13) after joint targets (J, 3) [rad] in the step before."""
        if self.first_step is None:
            self.first_step, control = step, None
        time = (step - self.first_step) * self.dt
        samples = self.sensors.measure(state, time)
        self.samples.append(samples)
        self.lost += not samples
        self.estimates.append(self.timeline.update(samples, control, time))
        return self.estimates[-1].state


class Sensing:
    """Sensors and an estimator of a scene's states; what they need is compiled once, for any number of perceptions."""

    def __init__(self, scene: Scene, sensors: SensorName | Sensors, estimator: EstimatorName = "filter") -> None:
        """Set up. sensors, estimator: names, or sensors of your own."""
        require_known("estimator", estimator, ESTIMATORS)
        if isinstance(sensors, str):
            require_known("sensors", sensors, SENSORS)
            sensors = SENSORS[sensors]
        self.scene, self.sensors = scene, sensors
        if any(body.is_ball for body in scene.bodies) and math.isinf(sensors.ball) and sensors.camera is None:
            raise InputError("sensors: got none that measures the ball, needs its place (ball) or a camera")
        if estimator == "none" and (math.isinf(sensors.root) or math.isinf(sensors.ball)):
            raise InputError("estimator: got 'none', but not all places are measured at once: needs 'filter'")
        self.dynamics = Simulator.of_physics(scene)
        self._biased = biased_coordinates(scene, sensors) if estimator == "filter" else []
        self.estimator: Estimator = LastSample(self.dynamics)
        if estimator == "filter":
            filters = (
                KalmanFilter(dynamics, scene.dt, coordinate_variances(scene, errors), CHANGE_ERROR, self._biased)
                for dynamics, errors in ((UniformMotion(self.dynamics, scene.dt), UNIFORM), (self.dynamics, STEP))
            )
            self.estimator = TwoPhaseFilter(*filters)

    def perception(self, start: np.ndarray, random: np.random.Generator) -> Perception | None:
        """Return a perception of states from `start` (L, 13) on; None where the sensors are perfect.

        The sensors have measured for `BEFORE` seconds by then. random: of their errors, and of what was expected first.
        """
        if self.sensors == PERFECT:
            return None
        dt, steps = self.scene.dt, round(BEFORE / self.scene.dt)
        variance = coordinate_variances(self.scene, START)
        errors = np.sqrt(variance) * random.standard_normal(len(variance))
        expected = moved(self.dynamics, moved_uniformly(self.dynamics, start, -steps * dt), errors)
        biases = np.full(len(self._biased), self.sensors.bias**2)
        first = self.estimator.init(expected, np.concatenate([variance, biases]), -steps * dt)
        model = SensorModel(self.scene, self.dynamics, self.sensors, random)
        perception = Perception(model, Timeline(self.estimator, first), dt, first)
        no_control = np.zeros((len(self.scene.motors), 3))
        for step in range(-steps, 1):
            time, control = step * dt, None if step == -steps else no_control
            samples = model.measure(moved_uniformly(self.dynamics, start, time), time) if step else []
            perception.timeline.update(samples, control, time)
            perception.samples += [samples] if step else []
        return perception


def moved_uniformly(dynamics: Coordinated, state: np.ndarray, time: float) -> np.ndarray:
    """Return the state (L, 13) to which uniform motion leads from a state (L, 13) in a time [s], before it if < 0."""
    speeds = rates(dynamics, state)
    return moved(dynamics, state, np.concatenate([time * speeds, np.zeros_like(speeds)]))

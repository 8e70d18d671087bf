"""Sensors between the ground truth and the planner, by name, and estimation of the state from what they measure."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from larp_model import state as packed
from larp_model.names import require_known
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from mpc.estimator import Estimate, Estimator, KalmanFilter, LastSample, Observation, moved, rates

SensorName = Literal["perfect", "noisy", "lab"]
EstimatorName = Literal["none", "filter"]


@dataclass(frozen=True)
class Sensors:
    """Standard deviations of the errors of measurements, independent in every step.

    root: of the place of a human's root [m]; turn: of its orientation about each axis [rad]; joints: of joint angles
    about each axis [rad]; ball: of a ball's place [m]; places: of the centres of all links of a human [m], None: they
    are not measured. velocities: of all velocities and angular velocities, as shares of themselves; None: they are not
    measured.
    """

    root: float = 0.0
    turn: float = 0.0
    joints: float = 0.0
    ball: float = 0.0
    places: float | None = None
    velocities: float | None = 0.0


PERFECT = Sensors()
SENSORS: dict[str, Sensors] = {
    "perfect": PERFECT,
    "noisy": Sensors(joints=math.radians(0.5), ball=0.005, velocities=0.02),
    # Motion capture: every link to a millimetre and half a degree, and no sensor of velocities.
    "lab": Sensors(0.001, math.radians(0.5), math.radians(0.5), 0.001, places=0.001, velocities=None),
}


@dataclass(frozen=True)
class ModelErrors:
    """Standard deviations of what the model does not explain of a step, or of what is unknown of the start.

    Of places [m], angles [rad], velocities [m/s] and angular velocities [rad/s], of a human and of a ball. vertical: of
    a ball's vertical velocity [m/s].
    """

    human: tuple[float, float, float, float]
    ball: tuple[float, float, float, float]
    vertical: float


# A measured place slightly in the ground, or above it, makes the model lift the ball, or drop it.
STEP = ModelErrors((0.0, 0.0, 0.01, 0.1), (0.0, 0.0, 0.002, 0.1), 0.1)
START = ModelErrors((0.02, 0.05, 0.2, 0.5), (0.1, 1.0, 1.0, 10.0), 1.0)


def of_coordinates(scene: Scene, errors: ModelErrors) -> np.ndarray:
    """Return the variances (n,) of the coordinates of a scene's states; see `larp_model.linearization`."""
    halves: tuple[list[float], list[float]] = ([], [])
    for body in scene.bodies:
        place, angle, velocity, angular_velocity = errors.ball if body.is_ball else errors.human
        turns = len(body.links)
        halves[0].extend([place] * 3 + [angle] * 3 * turns)
        halves[1].extend([velocity] * 2 + [errors.vertical if body.is_ball else velocity])
        halves[1].extend([angular_velocity] * 3 * turns)
    return np.square(np.concatenate(halves))


class SensorModel:
    """Sensors of a scene, which measure true states."""

    def __init__(self, scene: Scene, sensors: Sensors, random: np.random.Generator) -> None:
        """Begin; random: of the errors."""
        self.dynamics = Simulator.of_physics(scene)
        self._sensors, self._random = sensors, random
        positions: list[float] = []
        for body in scene.bodies:
            # The orientation of a ball is not measured, and does not matter.
            own = (sensors.ball, math.inf) if body.is_ball else (sensors.root, sensors.turn)
            positions += [own[0]] * 3 + [own[1]] * 3 + [sensors.joints] * 3 * (len(body.links) - 1)
        self._positions = np.array(positions)
        self._human = np.concatenate([np.full(len(body.links), not body.is_ball) for body in scene.bodies])

    def measure(self, state: np.ndarray) -> Observation:
        """Return the measurement of a true state (L, 13)."""
        errors = self._errors(state)
        noise = np.where(np.isfinite(errors), errors, 0.0) * self._random.standard_normal(len(errors))
        measured = moved(self.dynamics, state, noise)
        observation = Observation(measured, self._errors(measured) ** 2)
        if (places := self._sensors.places) is None:
            return observation
        centres = state[:, packed.POSITION] + places * self._random.standard_normal((len(state), 3))
        return observation._replace(places=centres, place_variance=np.where(self._human, places**2, math.inf))

    def _errors(self, state: np.ndarray) -> np.ndarray:
        """Return the standard deviations (n,) of the coordinates of a state, inf where nothing is measured."""
        share = self._sensors.velocities
        unknown = np.full_like(self._positions, math.inf)
        return np.concatenate(
            [self._positions, unknown if share is None else share * np.abs(rates(self.dynamics, state))]
        )


@dataclass
class Perception:
    """Estimates of true states from measurements of them, step by step, for the planner: see `mpc.loop.Sense`.

    estimates: of all steps so far.
    """

    sensors: SensorModel
    estimator: Estimator
    start: Estimate
    dt: float
    estimates: list[Estimate] = field(default_factory=list)

    def __call__(self, step: int, state: np.ndarray, control: np.ndarray | None) -> np.ndarray:
        """Return the estimate of a true state (L, 13) after joint targets (J, 3) [rad] in the step before."""
        last = self.estimates[-1] if self.estimates else self.start._replace(time=step * self.dt)
        observation = self.sensors.measure(state)
        self.estimates.append(self.estimator.update(last, observation, control, step * self.dt))
        return self.estimates[-1].state


def estimator_of(scene: Scene, name: EstimatorName) -> Estimator:
    """Return an estimator of a scene's states by its name; it compiles its prediction once."""
    require_known("estimator", name, ("none", "filter"))
    dynamics = Simulator.of_physics(scene)
    return LastSample(dynamics) if name == "none" else KalmanFilter(dynamics, scene.dt, of_coordinates(scene, STEP))


def perception(
    scene: Scene, start: np.ndarray, sensors: SensorName, estimator: Estimator, random: np.random.Generator
) -> Perception | None:
    """Return a perception of a scene's states by sensors of this name, None where they are perfect.

    start (L, 13): the state that is expected at first. random: of the sensors' errors.
    """
    require_known("sensors", sensors, SENSORS)
    if SENSORS[sensors] == PERFECT:
        return None
    model = SensorModel(scene, SENSORS[sensors], random)
    return Perception(model, estimator, estimator.init(start, of_coordinates(scene, START), 0.0), scene.dt)

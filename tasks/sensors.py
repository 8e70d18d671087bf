"""Sensors of true states, by name: what they measure, how well, and when it arrives."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.errors import InputError
from larp_model.linearization import Coordinates
from larp_model.scene import Scene
from mpc.dynamics import Coordinated
from mpc.estimator import Observation, moved, rates
from mpc.timeline import Sample

SensorName = Literal["perfect", "noisy", "lab", "onboard"]


@dataclass(frozen=True)
class BallCamera:
    """Camera at a human's root that sees where a ball is, from there and in the root's axes.

    noise: standard deviation of each component of the ball's place, as a share of its distance; and its bounds [m].
    rate: pictures a second. delay: after which the ball's place is known [s]. lost: share of pictures without a ball.
    """

    noise: float = 0.015
    bounds: tuple[float, float] = (0.01, 0.03)
    rate: float = 30.0
    delay: float = 0.04
    lost: float = 0.1

    def __post_init__(self) -> None:
        """Raise InputError for numbers that mean nothing."""
        for name, value in (("noise", self.noise), ("delay", self.delay), ("bounds", self.bounds[0])):
            _require(f"camera.{name}", value, math.inf)
        _require("camera.lost", self.lost, 1.0)
        if not (math.isfinite(self.rate) and self.rate > 0.0):
            raise InputError(f"camera.rate: got {self.rate}, needs a finite number > 0")
        if not self.bounds[0] <= self.bounds[1]:
            raise InputError(f"camera.bounds: got {self.bounds}, needs the lower one first")


@dataclass(frozen=True)
class Sensors:
    """Standard deviations of the errors of measurements, independent in every step.

    root: of the place of a human's root [m], inf: it is not measured; turn: of its orientation about each axis [rad];
    joints: of joint angles about each axis [rad]; ball: of a ball's place [m], inf: only by the camera, if at all;
    places: of the centres of all links of a human [m], None: they are not measured. velocities: of all velocities and
    angular velocities, as shares of themselves; None: they are not measured. bias: of a constant error of `turn` and
    `joints` [rad]. contacts: whether it is measured which links of a human rest on the ground. lost: share of steps
    without measurement, pictures apart.

    Of a ball it is known whether it rolls on the ground; a camera sees whether it rests.
    """

    root: float = 0.0
    turn: float = 0.0
    joints: float = 0.0
    ball: float = 0.0
    places: float | None = None
    velocities: float | None = 0.0
    bias: float = 0.0
    contacts: bool = False
    camera: BallCamera | None = None
    lost: float = 0.0

    def __post_init__(self) -> None:
        """Raise InputError for numbers that mean nothing."""
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, int | float):
                _require(field.name, value, 1.0 if field.name == "lost" else math.inf)


def _require(name: str, value: float, most: float) -> None:
    if not 0.0 <= value <= most:
        raise InputError(f"{name}: got {value}, needs a number {'>= 0' if most == math.inf else f'from 0 to {most:g}'}")


class GroundContact(NamedTuple):
    """Limits within which a link is seen to rest or roll on the ground, and the errors of what is then known of it."""

    height: float  # m, of its lowest point at most
    speed: float  # m/s, of that point at most
    height_error: float  # m, standard deviation of its height from 0
    speed_error: float  # m/s, of each component of its velocity from 0


PERFECT = Sensors()
SENSORS: dict[str, Sensors] = {
    "perfect": PERFECT,
    "noisy": Sensors(joints=math.radians(0.5), ball=0.005, velocities=0.02),
    # Motion capture: every link to a millimetre and half a degree, and no sensor of velocities.
    "lab": Sensors(0.001, math.radians(0.5), math.radians(0.5), 0.001, places=0.001, velocities=None),
    # Encoders, an inertial unit that knows its orientation, contact switches, and a camera.
    "onboard": Sensors(
        root=math.inf,
        turn=math.radians(0.2),
        joints=math.radians(0.1),
        ball=math.inf,
        velocities=None,
        bias=math.radians(0.1),
        contacts=True,
        camera=BallCamera(),
        lost=0.01,
    ),
}
# A ball touches the ground in one point, without deformation. Where its height is off by 0.1 mm, the model throws it up
# or drops it at 1 cm/s: heights known to a millimetre alone would make it bounce.
HUMAN_CONTACT, BALL_CONTACT = GroundContact(0.01, 0.1, 0.001, 0.05), GroundContact(0.001, 0.01, 0.0001, 0.005)
# A ball is seen to rest where its speed is below this [m/s].
RESTING = 0.01


class SensorModel:
    """Sensors of a scene, which measure true states, and the errors that they make."""

    def __init__(self, scene: Scene, dynamics: Coordinated, sensors: Sensors, random: np.random.Generator) -> None:
        """Begin at the time of the first measurement. random: of the errors."""
        self._dynamics, self._sensors, self._random = dynamics, sensors, random
        self._balls = [(body, own) for body, own in Coordinates(scene).by_body() if body.is_ball]
        self._scene, self._positions = scene, position_errors(scene, sensors)
        self._human = np.concatenate([np.full(len(body.links), not body.is_ball) for body in scene.bodies])
        self._sees_ball = ~self._human & math.isfinite(sensors.ball)
        self._half_axes = np.array([0.5 * link.length * np.array(link.axis) for link in scene.links])
        self._radii = np.array([link.radius for link in scene.links])
        biased = np.zeros_like(self._positions)
        biased[biased_coordinates(scene, sensors)] = sensors.bias
        self._bias = biased * random.standard_normal(len(biased))
        self._due = -math.inf
        self._pictures = list[Sample]()

    def measure(self, state: np.ndarray, time: float) -> list[Sample]:
        """Return what arrives at a time [s], in which the true state (L, 13) is measured: earlier pictures as well."""
        sensors = self._sensors
        samples = [] if self._random.random() < sensors.lost else [Sample(time, self._measured(state))]
        if sensors.camera is None:
            return samples
        if time >= self._due - 1e-9:
            self._due = max(self._due, time) + 1.0 / sensors.camera.rate
            if self._random.random() >= sensors.camera.lost:
                self._pictures.append(Sample(time, self._picture(state, sensors.camera)))
        arrived = [picture for picture in self._pictures if picture.time + sensors.camera.delay <= time + 1e-9]
        self._pictures = self._pictures[len(arrived) :]
        return samples + arrived

    def _measured(self, state: np.ndarray) -> Observation:
        sensors, errors = self._sensors, self._errors(state)
        noise = np.where(np.isfinite(errors), errors, 0.0) * self._random.standard_normal(len(errors))
        noise[: len(self._bias)] += self._bias
        measured = moved(self._dynamics, state, noise)
        observation = Observation(measured, self._errors(measured) ** 2)
        observation = self._on_ground(observation, state, sensors.contacts & self._human | self._sees_ball)
        if (places := sensors.places) is None:
            return observation
        centres = state[:, packed.POSITION] + places * self._random.standard_normal((len(state), 3))
        return observation._replace(places=centres, place_variance=np.where(self._human, places**2, math.inf))

    def _picture(self, state: np.ndarray, camera: BallCamera) -> Observation:
        """Return where balls are as seen from the first human's root."""
        root = int(np.argmax(self._human))
        arms = state[:, packed.POSITION] - state[root, packed.POSITION]
        errors = np.clip(camera.noise * np.linalg.norm(arms, axis=1), *camera.bounds)
        places = arms @ rotations(state[root]).as_matrix() + errors[:, None] * self._random.standard_normal(arms.shape)
        variance = np.where(self._human, math.inf, errors**2)
        unknown = np.full_like(self._positions, math.inf)
        of_rates = unknown.copy()
        for body, own in self._balls:
            if np.linalg.norm(state[self._scene.rows(body.name), packed.VELOCITY]) < RESTING:
                of_rates[own] = RESTING**2
        picture = Observation(state, np.concatenate([unknown, of_rates]), places, variance, root)
        return self._on_ground(picture, state, ~self._human)

    def _on_ground(self, observation: Observation, state: np.ndarray, links: np.ndarray) -> Observation:
        """Return the observation, with which of some links (L,) rest or roll on the ground in a state (L, 13)."""
        halves = rotations(state).apply(self._half_axes)
        arms = -np.sign(halves[:, 2:]) * halves
        arms[:, 2] -= self._radii
        speeds = state[:, packed.VELOCITY] + np.cross(state[:, packed.ANGULAR_VELOCITY], arms)
        height, speed, *errors = np.where(self._human[:, None], HUMAN_CONTACT, BALL_CONTACT).T
        touching = links & (state[:, 2] + arms[:, 2] < height) & (np.linalg.norm(speeds, axis=1) < speed)
        variance = np.where(touching[:, None], np.square(errors).T, math.inf)
        return observation._replace(ground_arms=arms, ground_variance=variance)

    def _errors(self, state: np.ndarray) -> np.ndarray:
        """Return the standard deviations (n,) of the coordinates of a state, inf where nothing is measured."""
        share = self._sensors.velocities
        unknown = np.full_like(self._positions, math.inf)
        return np.concatenate(
            [self._positions, unknown if share is None else share * np.abs(rates(self._dynamics, state))]
        )


def rotations(states: np.ndarray) -> Rotation:
    """Return the orientations of states (*, 13)."""
    return Rotation.from_quat(states[..., packed.ORIENTATION], scalar_first=True)


def position_errors(scene: Scene, sensors: Sensors) -> np.ndarray:
    """Return the standard deviations (n / 2,) of measured places and angles, inf where they are not measured."""
    errors: list[float] = []
    for body in scene.bodies:
        # The orientation of a ball is not measured, and does not matter.
        place, turn = (sensors.ball, math.inf) if body.is_ball else (sensors.root, sensors.turn)
        errors += [place] * 3 + [turn] * 3 + [sensors.joints] * 3 * (len(body.links) - 1)
    return np.array(errors)


def biased_coordinates(scene: Scene, sensors: Sensors) -> list[int]:
    """Return the numbers of the coordinates that are measured with a bias: all angles of humans."""
    if not sensors.bias:
        return []
    return [n for body, own in Coordinates(scene).by_body() if not body.is_ball for n in range(own.start + 3, own.stop)]

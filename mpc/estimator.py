"""Estimates of the state from what sensors show of it.

The filter is a Kalman filter of the error of the state, in the n coordinates of small changes that dynamics have
(`dynamics.Coordinated`): joints stay closed, and the planner's model predicts,

    x' = f(x, u),    P' = A P A^T + Q            A = [1, dt; 0, 1]: errors of rates become errors of positions
    z = y - x - b,   K = P H^T (H P H^T + R)^-1  y: measured; H, R: its coordinates, and the variance of their errors
    x <- x + K z,    P <- (1 - K H) P (1 - K H)^T + K R K^T

(R. Kalman, "A new approach to linear filtering and prediction problems", 1960; the last line is P. Joseph's form, which
stays symmetric and positive.) A is not the derivative of f: contacts with the ground are so stiff that this holds for
errors of a tenth of a millimetre, and a filter that believes it for larger ones is sure of what is false. What A lacks
is part of Q, which grows with the changes of rates in a step: what changes much, by contacts, is predicted less well.
The biases b of sensors, constant and unknown, are estimated as further coordinates.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.errors import InputError
from larp_model.runtime import one_blas_thread
from mpc.dynamics import Coordinated, program_of

# Variance, in units of its coordinate, below which a measurement counts as exact.
LEAST_VARIANCE = 1e-10


class Observation(NamedTuple):
    """Measurement of a state.

    state (L, 13): as measured. variance (n,): of the errors of its coordinates, inf where nothing was measured. places
    (L, 3) [m]: of links' centres where they are measured apart, as by motion capture. place_variance (L,) [m^2]: of
    each of their components, inf where not. origin: the link from whose centre, and in whose axes, these places are
    measured, as by a camera; None: they are in the world's. ground_arms (L, 3) [m]: from links' centres to the points
    with which they rest or roll on the ground; ground_variance (L, 2): of the heights of these points [m^2] and of each
    component of their velocities [m^2/s^2], both of which are 0; inf where links do not touch the ground.
    """

    state: np.ndarray
    variance: np.ndarray
    places: np.ndarray = np.zeros((0, 3))
    place_variance: np.ndarray = np.zeros(0)
    origin: int | None = None
    ground_arms: np.ndarray = np.zeros((0, 3))
    ground_variance: np.ndarray = np.zeros((0, 2))


class Estimate(NamedTuple):
    """Estimate of a state (L, 13) at a time [s].

    covariance (n + m, n + m): of the errors of its coordinates and of m biases. bias (m,): of sensors.
    """

    time: float
    state: np.ndarray
    covariance: np.ndarray
    bias: np.ndarray = np.zeros(0)


class Estimator(Protocol):
    """Estimator of the state: a pair of pure functions."""

    def init(self, state: np.ndarray, variance: np.ndarray, time: float) -> Estimate:
        """Return the estimate before anything is measured: a state (L, 13), and the variance (n + m,) of its errors."""

    def update(
        self, estimate: Estimate, observation: Observation | None, control: np.ndarray | None, time: float
    ) -> Estimate:
        """Return the estimate at a time [s], from the last one and what is measured then, None: nothing.

        control: joint targets (J, 3) [rad] since the last estimate; None where no time has passed.
        """


@dataclass(frozen=True)
class LastSample:
    """An estimator that takes measurements as they are; what was not measured stays as it was."""

    dynamics: Coordinated

    def init(self, state: np.ndarray, variance: np.ndarray, time: float) -> Estimate:
        """See `Estimator`."""
        return Estimate(time, np.asarray(state, float), np.diag(variance))

    def update(
        self, estimate: Estimate, observation: Observation | None, control: np.ndarray | None, time: float
    ) -> Estimate:
        """See `Estimator`. A rate that was not measured is the difference of the last two positions, over the time."""
        _require_time(estimate, time)
        if observation is None:
            return estimate._replace(time=time)
        measured = np.isfinite(observation.variance)
        change = np.where(measured, _difference(self.dynamics, observation.state, estimate.state), 0.0)
        half = len(change) // 2
        if time > estimate.time:
            before = rates(self.dynamics, estimate.state)
            by_difference = change[:half] / (time - estimate.time) - before
            unknown = ~measured[half:] & measured[:half]
            change[half:] = np.where(unknown, by_difference, change[half:])
        variance = np.where(measured, observation.variance, np.diag(estimate.covariance))
        return Estimate(time, moved(self.dynamics, estimate.state, change), np.diag(variance))


@dataclass(frozen=True, eq=False)
class KalmanFilter:
    """The filter of the module.

    dt: a step of the dynamics [s]. process_noise (n,): variance that a step adds to each coordinate. change_error:
    error of the change of a rate in a step, as a share of it. biased: numbers of the m coordinates that are measured
    with an unknown bias.
    """

    dynamics: Coordinated
    dt: float
    process_noise: np.ndarray
    change_error: float = 0.0
    biased: Sequence[int] = ()

    def __post_init__(self) -> None:
        if not (math.isfinite(self.dt) and self.dt > 0.0):
            raise InputError(f"dt: got {self.dt}, needs a finite number > 0")
        if not 0.0 <= self.change_error < math.inf:
            raise InputError(f"change_error: got {self.change_error}, needs a finite number >= 0")
        if not np.all(np.isfinite(self.process_noise) & (np.asarray(self.process_noise) >= 0.0)):
            raise InputError("process_noise: got numbers that are not finite or negative, needs variances")

    def init(self, state: np.ndarray, variance: np.ndarray, time: float) -> Estimate:
        """See `Estimator`."""
        variance, biases = np.asarray(variance, float), len(self.biased)
        count = len(self.process_noise) + biases
        if variance.shape != (count,) or not np.all(np.isfinite(variance) & (variance >= 0.0)):
            raise InputError(f"variance: needs {count} finite numbers >= 0, of the coordinates")
        return Estimate(time, np.asarray(state, float), np.diag(variance), np.zeros(biases))

    def update(
        self, estimate: Estimate, observation: Observation | None, control: np.ndarray | None, time: float
    ) -> Estimate:
        """See `Estimator`. The time passed has to be a number of steps."""
        _require_time(estimate, time)
        steps = (time - estimate.time) / self.dt
        if abs(steps - round(steps)) > 1e-3 or (round(steps) and control is None):
            raise InputError(f"time: got {time} s after {estimate.time} s, needs steps of {self.dt} s under control")
        with one_blas_thread():
            for _ in range(round(steps)):
                estimate = self._predicted(estimate, control)
            if observation is not None:
                estimate = self.corrected(estimate, observation)
        return estimate._replace(time=time)

    def _predicted(self, estimate: Estimate, control: Any) -> Estimate:
        state, change = (
            np.asarray(array, float)
            for array in self._predict(*(np.asarray(array, np.float32) for array in (estimate.state, control)))
        )
        if not np.isfinite(state).all():
            raise InputError(
                "state: the model's step from the estimate is not finite, so that nothing can be predicted"
            )
        half, count = len(change), len(self.process_noise)
        covariance = estimate.covariance.copy()
        covariance[:half] += self.dt * estimate.covariance[half:count]
        covariance[:, :half] += self.dt * covariance[:, half:count]
        noise = np.array(self.process_noise, float)
        noise[half:] += (self.change_error * change) ** 2
        covariance[np.arange(count), np.arange(count)] += noise
        return estimate._replace(state=state, covariance=covariance)

    def corrected(self, estimate: Estimate, observation: Observation) -> Estimate:
        """Return the estimate with what is measured at its time."""
        deviation, basis = (
            np.asarray(array, float)
            for array in self._compare(
                *(np.asarray(array, np.float32) for array in (estimate.state, observation.state))
            )
        )
        count = len(estimate.covariance)
        parts = [self._of_coordinates(observation, deviation, estimate)]
        if np.isfinite(observation.place_variance).any():
            parts.append(_of_places(observation, estimate.state, basis))
        if np.isfinite(observation.ground_variance).any():
            parts.append(_of_ground(observation, estimate.state, basis))
        innovation, noise = (np.concatenate([part[index] for part in parts]) for index in (0, 2))
        by_state = np.concatenate([np.pad(part[1], ((0, 0), (0, count - part[1].shape[1]))) for part in parts])
        noise = np.maximum(noise, LEAST_VARIANCE)
        covariance = estimate.covariance
        total = by_state @ covariance @ by_state.T + np.diag(noise)
        gain = np.linalg.solve(total, by_state @ covariance).T
        rest = np.eye(count) - gain @ by_state
        covariance = rest @ covariance @ rest.T + (gain * noise) @ gain.T
        change, states = gain @ innovation, len(self.process_noise)
        state = moved(self.dynamics, estimate.state, change[:states])
        return estimate._replace(state=state, covariance=covariance, bias=estimate.bias + change[states:])

    def _of_coordinates(self, observation: Observation, deviation: np.ndarray, estimate: Estimate) -> Measured:
        by_state = np.eye(len(deviation), len(estimate.covariance))
        by_state[list(self.biased), len(deviation) + np.arange(len(self.biased))] = 1.0
        innovation = deviation.copy()
        innovation[list(self.biased)] -= estimate.bias
        (measured,) = np.nonzero(np.isfinite(observation.variance))
        return innovation[measured], by_state[measured], observation.variance[measured]

    @cached_property
    def _predict(self) -> Any:
        """Return the compiled `predicted` of the dynamics."""
        return _compiled(predicted, self.dynamics)

    @cached_property
    def _compare(self) -> Any:
        """Return the compiled `compared` of the dynamics."""
        return _compiled(compared, self.dynamics)


def predicted(dynamics: Coordinated, state: jax.Array, control: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the state (L, 13) after a step under a control (J, 3), and the changes (n / 2,) of the rates."""
    following = dynamics.rollout(state[None], control[None, None])[:, 0]
    before, after = (rates_of(dynamics, states) for states in (state[None], following))
    return following[0], (after - before)[0]


def compared(dynamics: Coordinated, state: jax.Array, measured: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the coordinates (n,) of a measured state (L, 13) from a state, and the basis (L, 13, n) of the latter."""
    return dynamics.difference(measured[None], state[None])[0], dynamics.basis(state[None])[0]


def _compiled(function: Callable[..., Any], dynamics: Coordinated) -> Callable[..., Any]:
    """Return a function of dynamics compiled, for all dynamics of the same structure at once."""
    function, arguments = program_of(function, dynamics)
    return partial(jax.jit(function), *arguments)


Measured = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Innovations (M,) of M measured numbers, derivatives (M, n) by the coordinates, variances (M,) of their errors."""


def _of_places(observation: Observation, state: np.ndarray, basis: np.ndarray) -> Measured:
    (links,) = np.nonzero(np.isfinite(observation.place_variance))
    places, by_state = state[links, packed.POSITION], basis[links, packed.POSITION]
    if (origin := observation.origin) is not None:
        arms, quaternion, by_turn = places - state[origin, packed.POSITION], state[origin, 3:7], basis[origin, 3:7]
        w, v = quaternion[0], quaternion[1:]
        turn = 2.0 * (w * by_turn[1:] - np.outer(v, by_turn[0]) - np.cross(by_turn[1:], v, axis=0))
        axes = Rotation.from_quat(quaternion, scalar_first=True).as_matrix()
        # The axes turn with the link: what rests in the world moves backwards in them.
        by_state = by_state - basis[origin, packed.POSITION] + np.cross(arms[:, :, None], turn[None], axis=1)
        places, by_state = arms @ axes, np.einsum("lin,ij->ljn", by_state, axes)
    innovation = observation.places[links] - places
    count = by_state.shape[-1]
    return innovation.ravel(), by_state.reshape(-1, count), np.repeat(observation.place_variance[links], 3)


def _of_ground(observation: Observation, state: np.ndarray, basis: np.ndarray) -> Measured:
    links = np.isfinite(observation.ground_variance).all(axis=1)
    arms, variance = observation.ground_arms[links], observation.ground_variance[links]
    position, velocity, spin = (
        (state[links, part], basis[links, part]) for part in (packed.POSITION, packed.VELOCITY, packed.ANGULAR_VELOCITY)
    )
    heights, speeds = position[0][:, 2] + arms[:, 2], velocity[0] + np.cross(spin[0], arms)
    by_state = np.concatenate([position[1][:, 2:], velocity[1] + np.cross(spin[1], arms[:, :, None], axis=1)], axis=1)
    innovation = -np.concatenate([heights[:, None], speeds], axis=1)
    count = by_state.shape[-1]
    return innovation.ravel(), by_state.reshape(-1, count), np.repeat(variance, (1, 3), axis=1).ravel()


def moved(dynamics: Coordinated, state: np.ndarray, coordinates: np.ndarray) -> np.ndarray:
    """Return a state (L, 13) moved by coordinates (n,)."""
    arrays = (jnp.asarray(array, jnp.float32)[None] for array in (state, coordinates))
    result: np.ndarray = np.array(dynamics.moved(*arrays)[0], float)
    return result


def _difference(dynamics: Coordinated, state: np.ndarray, reference: np.ndarray) -> np.ndarray:
    arrays = (jnp.asarray(array, jnp.float32)[None] for array in (state, reference))
    return np.array(dynamics.difference(*arrays)[0], float)


def rates(dynamics: Coordinated, state: np.ndarray) -> np.ndarray:
    """Return the rates (n / 2,) among the coordinates of a state (L, 13) against the same one at rest."""
    return np.array(rates_of(dynamics, jnp.asarray(state, jnp.float32)[None])[0], float)


def rates_of(dynamics: Coordinated, states: jax.Array) -> jax.Array:
    """Return `rates` (N, n / 2) of states (N, L, 13), inside compiled programs."""
    coordinates = dynamics.difference(states, states.at[..., packed.VELOCITY.start :].set(0.0))
    return coordinates[..., coordinates.shape[-1] // 2 :]


def _require_time(estimate: Estimate, time: float) -> None:
    if not estimate.time <= time < math.inf:
        raise InputError(f"time: got {time} s, needs a time from that of the estimate, {estimate.time} s, on")

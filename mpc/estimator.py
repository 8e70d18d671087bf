"""Estimates of the state from what sensors show of it.

The filter is a Kalman filter of the error of the state, in the n coordinates of small changes that dynamics have
(`dynamics.Coordinated`): joints stay closed, and the planner's model predicts,

    x' = f(x, u),    P' = A P A^T + Q            A = [1, dt; 0, 1]: errors of rates become errors of positions
    z = y - x,       K = P H^T (H P H^T + R)^-1  y: measured; H, R: its coordinates, and the variance of their errors
    x <- x + K z,    P <- (1 - K H) P (1 - K H)^T + K R K^T

(R. Kalman, "A new approach to linear filtering and prediction problems", 1960; the last line is P. Joseph's form, which
stays symmetric and positive.) A is not the derivative of f: contacts with the ground are so stiff that this holds for
errors of a tenth of a millimetre, and a filter that believes it for larger ones is sure of what is false. What A lacks
is part of Q.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from larp_model import state as packed
from larp_model.errors import InputError
from larp_model.runtime import one_blas_thread
from mpc.dynamics import Coordinated

# Variance, in units of its coordinate, below which a measurement counts as exact.
LEAST_VARIANCE = 1e-10


class Observation(NamedTuple):
    """Measurement of a state.

    state (L, 13): as measured. variance (n,): of the errors of its coordinates, inf where nothing was measured. age
    (n,) [s]: time since each was measured; only positions may be old. places (L, 3) [m]: of links' centres where they
    are measured apart, as by motion capture. place_variance (L,) [m^2]: of each of their components, inf where not.
    """

    state: np.ndarray
    variance: np.ndarray
    age: np.ndarray | float = 0.0
    places: np.ndarray = np.zeros((0, 3))
    place_variance: np.ndarray = np.zeros(0)


class Estimate(NamedTuple):
    """Estimate of a state (L, 13) at a time [s], and the covariance (n, n) of the errors of its coordinates."""

    time: float
    state: np.ndarray
    covariance: np.ndarray


class Estimator(Protocol):
    """Estimator of the state: a pair of pure functions."""

    def init(self, state: np.ndarray, variance: np.ndarray, time: float) -> Estimate:
        """Return the estimate before anything is measured: a state (L, 13), and the variance (n,) of its errors."""

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

    dt: a step of the dynamics [s]. process_noise (n,): variance that a step adds to each coordinate, the diagonal of Q.
    """

    dynamics: Coordinated
    dt: float
    process_noise: np.ndarray

    def __post_init__(self) -> None:
        if not (math.isfinite(self.dt) and self.dt > 0.0):
            raise InputError(f"dt: got {self.dt}, needs a finite number > 0")
        if not np.all(np.isfinite(self.process_noise) & (np.asarray(self.process_noise) >= 0.0)):
            raise InputError("process_noise: got numbers that are not finite or negative, needs variances")

    def init(self, state: np.ndarray, variance: np.ndarray, time: float) -> Estimate:
        """See `Estimator`."""
        variance = np.asarray(variance, float)
        if variance.shape != np.shape(self.process_noise) or not np.all(np.isfinite(variance) & (variance >= 0.0)):
            raise InputError(f"variance: needs {len(self.process_noise)} finite numbers >= 0, of the coordinates")
        return Estimate(time, np.asarray(state, float), np.diag(variance))

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
                estimate = self._corrected(estimate, observation)
        return estimate._replace(time=time)

    def _predicted(self, estimate: Estimate, control: Any) -> Estimate:
        arrays = (jnp.asarray(array, jnp.float32) for array in (estimate.state, control))
        state = np.array(self._predict(*arrays), float)
        if not np.isfinite(state).all():
            raise InputError(
                "state: the model's step from the estimate is not finite, so that nothing can be predicted"
            )
        transition = np.eye(len(estimate.covariance))
        half = len(transition) // 2
        transition[:half, half:] = self.dt * np.eye(half)
        covariance = transition @ estimate.covariance @ transition.T + np.diag(self.process_noise)
        return estimate._replace(state=state, covariance=covariance)

    def _corrected(self, estimate: Estimate, observation: Observation) -> Estimate:
        count, half = len(estimate.covariance), len(estimate.covariance) // 2
        age = np.broadcast_to(np.asarray(observation.age, float), (count,))
        if not np.all(age >= 0.0):
            raise InputError("observation: got an age below 0, needs measurements of the past")
        by_state = np.eye(count)
        by_state[:half, half:] = -np.diag(age[:half])
        past = _difference(self.dynamics, observation.state, estimate.state)
        past[:half] += age[:half] * rates(self.dynamics, estimate.state)
        (measured,) = np.nonzero(np.isfinite(observation.variance))
        innovation, by_state, noise = past[measured], by_state[measured], observation.variance[measured]
        (links,) = np.nonzero(np.isfinite(observation.place_variance))
        if len(links):
            basis = np.asarray(self.dynamics.basis(jnp.asarray(estimate.state, jnp.float32)[None])[0], float)
            distance = observation.places[links] - estimate.state[links, packed.POSITION]
            innovation = np.concatenate([innovation, distance.ravel()])
            by_state = np.concatenate([by_state, basis[links, packed.POSITION].reshape(-1, count)])
            noise = np.concatenate([noise, np.repeat(observation.place_variance[links], 3)])
        noise = np.maximum(noise, LEAST_VARIANCE)
        covariance = estimate.covariance
        total = by_state @ covariance @ by_state.T + np.diag(noise)
        gain = np.linalg.solve(total, by_state @ covariance).T
        rest = np.eye(count) - gain @ by_state
        covariance = rest @ covariance @ rest.T + (gain * noise) @ gain.T
        return estimate._replace(state=moved(self.dynamics, estimate.state, gain @ innovation), covariance=covariance)

    @cached_property
    def _predict(self) -> Any:
        """Return the compiled step (state, control) -> state."""
        return jax.jit(lambda state, control: self.dynamics.rollout(state[None], control[None, None])[0, 0])


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
    at_rest = np.array(state)
    at_rest[:, packed.VELOCITY.start :] = 0.0
    coordinates = _difference(dynamics, state, at_rest)
    return coordinates[len(coordinates) // 2 :]


def _require_time(estimate: Estimate, time: float) -> None:
    if not estimate.time <= time < math.inf:
        raise InputError(f"time: got {time} s, needs a time from that of the estimate, {estimate.time} s, on")

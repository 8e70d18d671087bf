"""Small problems of one link, whose motor's target is read as a velocity or an acceleration, and a leg of two."""

from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from larp_model.scene import Body, Joint, Link, Motor
from mpc import CEM, CostTerm, Planner, Window, quadratic

HORIZON, KNOTS, DT = 12, 4, 0.01

MOTOR = Motor(30.0, 2.0, 20.0, (-2.0, -2.0, -2.0), (2.0, 2.0, 2.0))
LINKS = Link("upper", 0.4, 0.05, 3.0), Link("lower", 0.4, 0.05, 1.0)
LEG = Body("leg", "leg", LINKS, (Joint(0, (0.0, 0.0, -1.0), (0.0, 0.0, 1.0), MOTOR),))
"""Two links and a motor."""


@dataclass(frozen=True)
class PointMass:
    """Moves with the velocity 100 u."""

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        return displaced(state, jnp.cumsum(controls[:, :, 0] * 100 * DT, axis=1))


@dataclass(frozen=True)
class Wall:
    """Moves with the acceleration 2000 u and is lost (NaN) once past x = 0.5."""

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        velocity = jnp.cumsum(controls[:, :, 0] * 2000 * DT, axis=1)
        states = displaced(state, jnp.cumsum(velocity * DT, axis=1))
        lost = jnp.cumsum(states[..., 0, 0] > 0.5, axis=1) > 0
        return jnp.where(lost[:, :, None, None], jnp.nan, states)


@dataclass(frozen=True)
class Broken:
    """Always diverges."""

    differentiable = True

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        return jnp.full((*controls.shape[:2], *state.shape[1:]), jnp.nan)


@dataclass(frozen=True)
class Drift:
    """Every link moves by 1 along each axis in a step; it has no motors."""

    differentiable = False

    def rollout(self, state: jax.Array, controls: jax.Array, steps: jax.Array | None = None) -> jax.Array:
        assert controls.shape[2] == 0
        return displaced(state, jnp.cumsum(jnp.ones((*controls.shape[:2], 3)), axis=1))


@dataclass(frozen=True)
class Engine:
    """A point mass outside JAX that loses every row whose first target is above 0.1."""

    batch: int = 5

    def rollout(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        assert len(states) == len(controls) == self.batch
        result = np.repeat(states[:, None], controls.shape[1], axis=1)
        result[..., :3] += np.cumsum(controls * 100 * DT, axis=1)
        return result, controls[:, 0, 0, 0] <= 0.1


def displaced(state: jax.Array, displacement: jax.Array) -> jax.Array:
    """States (N, H, L, 13): the first state with every link displaced (N, H, 3)."""
    states = jnp.repeat(state[:, None], displacement.shape[1], axis=1)
    return states.at[..., :3].add(displacement[:, :, None])


def miss(states: jax.Array, controls: jax.Array, target: Any) -> jax.Array:
    """From the target at the end [m]; a lost link is, treacherously, right on it."""
    distance = states[-1, 0, :3] - target
    return jnp.where(jnp.abs(distance) < 1e6, distance, 0.0)


def effort(states: jax.Array, controls: jax.Array, target: Any) -> jax.Array:
    return controls[:, 0]


TERMS = (CostTerm("miss", miss), CostTerm("effort", effort, quadratic, 1e-3))
STATE = np.eye(1, 13, 3)
REFERENCE = np.zeros((HORIZON, 1, 3))
TARGET = np.array([1.0, -0.5, 0.3])
WINDOW = Window(0.0, REFERENCE, TARGET)
SAMPLING = CEM(samples=32, rounds=4, elites=6)


def planner_of(dynamics: Any = None, optimizers: Any = SAMPLING, **changes: Any) -> Planner:
    arguments = {"spread": np.full((1, 3), 0.1), "lower": -0.5, "upper": 0.5, **changes}
    return Planner(dynamics or PointMass(), TERMS, HORIZON, KNOTS, DT, optimizers=optimizers, **arguments)

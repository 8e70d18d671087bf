"""The packed state: one array (*, L, 13) for all links of a scene, and its named views.

Columns: position of the centre of mass [m], orientation quaternion (w, x, y, z), velocity [m/s], angular velocity
[rad/s]; all in the world frame.
"""

from __future__ import annotations

from typing import Any, Protocol

import jax.numpy as jnp
import numpy as np
from jax import Array

SIZE = 13
POSITION = slice(0, 3)
ORIENTATION = slice(3, 7)
VELOCITY = slice(7, 10)
ANGULAR_VELOCITY = slice(10, 13)
# Beyond these a trajectory has diverged, in every engine [m/s, rad/s].
LIMITS = ((VELOCITY, 1e2), (ANGULAR_VELOCITY, 1e3))


def position(state: Array) -> Array:
    """Return positions (*, L, 3) [m], world frame, of the centres of mass."""
    return state[..., POSITION]


def orientation(state: Array) -> Array:
    """Return orientations (*, L, 4): quaternions w, x, y, z from the link to the world."""
    return state[..., ORIENTATION]


def velocity(state: Array) -> Array:
    """Return velocities (*, L, 3) [m/s], world frame, of the centre of mass."""
    return state[..., VELOCITY]


def angular_velocity(state: Array) -> Array:
    """Return angular velocities (*, L, 3) [rad/s], world frame."""
    return state[..., ANGULAR_VELOCITY]


def pack(position: Array, orientation: Array, velocity: Array, angular_velocity: Array) -> Array:
    """Return the state (*, L, 13) of its four parts."""
    return jnp.concatenate([position, orientation, velocity, angular_velocity], axis=-1)


def healthy(state: Any) -> Any:
    """Return a mask (*,) of states (*, L, 13), of NumPy or JAX, whose links are all finite and within `LIMITS`."""
    xp = state.__array_namespace__()
    result = xp.all(xp.isfinite(state), axis=(-2, -1))
    for columns, limit in LIMITS:
        result = result & xp.all(xp.abs(state[..., columns]) < limit, axis=(-2, -1))
    return result


class Trajectories(Protocol):
    """Recorded ground truth: see `engines.episodes.Episodes`."""

    @property
    def states(self) -> np.ndarray:
        """Return states (E, T + 1, L, 13)."""

    @property
    def controls(self) -> np.ndarray:
        """Return joint targets (E, T, J, 3) [rad]."""

    @property
    def torques(self) -> np.ndarray:
        """Return external torques (E, T, L, 3) [N m]."""

    @property
    def morphology(self) -> np.ndarray:
        """Return sizes (E, L, 3)."""

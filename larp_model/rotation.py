"""Rotations of packed arrays.

Quaternions are (*, 4), w first. Everything here has finite gradients at zero angle.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model import state as packed


def multiply(first: Array, second: Array) -> Array:
    """Return products (*, 4) of quaternions: of rotations, the second and then the first."""
    a, b, c, d = (first[..., k] for k in range(4))
    w, x, y, z = (second[..., k] for k in range(4))
    return jnp.stack(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        axis=-1,
    )


def matrix(quaternion: Array) -> Array:
    """Return rotation matrices (*, 3, 3) of quaternions (*, 4) of any length but zero."""
    w, x, y, z = (quaternion[..., k] for k in range(4))
    double = 2.0 / (w * w + x * x + y * y + z * z)
    rows = (
        (1.0 - double * (y * y + z * z), double * (x * y - w * z), double * (x * z + w * y)),
        (double * (x * y + w * z), 1.0 - double * (x * x + z * z), double * (y * z - w * x)),
        (double * (x * z - w * y), double * (y * z + w * x), 1.0 - double * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


def conjugate(quaternion: Array) -> Array:
    """Return the inverse of unit quaternions (*, 4)."""
    return quaternion * jnp.array([1.0, -1.0, -1.0, -1.0], quaternion.dtype)


def from_rotation_vector(vector: Array) -> Array:
    """Return unit quaternions (*, 4) of rotation vectors (*, 3) [rad]: the exponential map."""
    squared = jnp.sum(vector**2, axis=-1, keepdims=True)
    small = squared < 1e-8
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    scale = jnp.where(small, 0.5 - squared / 48.0, jnp.sin(0.5 * angle) / angle)
    real = jnp.where(small, 1.0 - squared / 8.0, jnp.cos(0.5 * angle))
    return jnp.concatenate([real, scale * vector], axis=-1)


def to_rotation_vector(quaternion: Array) -> Array:
    """Return rotation vectors (*, 3) [rad], at most pi long, of unit quaternions (*, 4): the logarithm."""
    quaternion = jnp.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    real, imaginary = quaternion[..., :1], quaternion[..., 1:]
    squared = jnp.sum(imaginary**2, axis=-1, keepdims=True)
    small = squared < 1e-8
    norm = jnp.sqrt(jnp.where(small, 1.0, squared))
    scale = jnp.where(small, 2.0 + squared / 3.0, 2.0 * jnp.arctan2(norm, real) / norm)
    return scale * imaginary


def integrate(quaternion: Array, rotation_vector: Array) -> Array:
    """Turn orientations (*, 4) by world-frame rotation vectors (*, 3) [rad], keeping them of unit length."""
    turned = multiply(from_rotation_vector(rotation_vector), quaternion)
    unit: Array = turned / jnp.linalg.norm(turned, axis=-1, keepdims=True)
    return unit


def heading(quaternion: Array) -> Array:
    """Return cosine and sine (*, 2) of the turn about z in orientations (*, 4) (swing-twist decomposition).

    Turning an orientation about z turns its heading by the same angle. It is undefined where the body stands on its
    head; there the heading is x and its gradient zero.
    """
    real, along = quaternion[..., 0], quaternion[..., 3]
    squared = real**2 + along**2
    degenerate = squared < 1e-8
    squared = jnp.where(degenerate, 1.0, squared)
    cosine = jnp.where(degenerate, 1.0, (real**2 - along**2) / squared)
    sine = jnp.where(degenerate, 0.0, 2.0 * real * along / squared)
    return jnp.stack([cosine, sine], axis=-1)


def course(quaternion: Array, axis: tuple[float, float, float]) -> Array:
    """Return cosine and sine (*, 2) of the direction along the ground of an axis that orientations (*, 4) turn.

    It is undefined where the axis is upright; there it is x and its gradient zero.
    """
    turned = jnp.sum(matrix(quaternion) * jnp.asarray(axis, quaternion.dtype), axis=-1)
    squared = turned[..., 0] ** 2 + turned[..., 1] ** 2
    upright = squared < 1e-8
    scale = jnp.where(upright, 1.0, squared) ** -0.5
    along = jnp.where(upright, 1.0, turned[..., 0] * scale), jnp.where(upright, 0.0, turned[..., 1] * scale)
    return jnp.stack(along, axis=-1)


def about_z(vector: Array, turn: Array) -> Array:
    """Turn vectors (*, 3) about z by the angle of cosine and sine `turn` (*, 2)."""
    cosine, sine = turn[..., 0], turn[..., 1]
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    return jnp.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=-1)


def opposite(turn: Array) -> Array:
    """Return cosine and sine (*, 2) of the opposite angle."""
    return turn * jnp.array([1.0, -1.0], turn.dtype)


def random_turns(key: Array, count: int) -> Array:
    """Return cosines and sines (count, 2) of uniform turns about z."""
    angle = jax.random.uniform(key, (count,), maxval=2.0 * jnp.pi)
    return jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)


def turn_states(state: Array, turn: Array) -> Array:
    """Return states (*, L, 13) turned about the world's z by `turn` (*, 2)."""
    turn = turn[..., None, :]
    half = jnp.arctan2(turn[..., 1], turn[..., 0]) / 2.0
    zero = jnp.zeros_like(half)
    quaternion = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=-1)
    return packed.pack(
        about_z(packed.position(state), turn),
        multiply(quaternion, packed.orientation(state)),
        about_z(packed.velocity(state), turn),
        about_z(packed.angular_velocity(state), turn),
    )


def turned_about_z(states: np.ndarray, angle: np.ndarray | float) -> np.ndarray:
    """Return NumPy states (*, L, 13) turned about the world's z by angles (*,) [rad], in 64 bits; see `turn_states`."""
    with jax.enable_x64(True):
        turn = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        return np.array(turn_states(jnp.asarray(states, float), jnp.asarray(turn, float)))

"""Small vectors and matrices with the batch last: (..., 3, B) and (..., 3, 3, B), leading axes broadcast.

Products are sums and stacks of slices: XLA makes one quick loop over the batch of them, and a slow one of a reduction.
"""

from __future__ import annotations

from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array

Arrays = TypeVar("Arrays")


def barrier(arrays: Arrays) -> Arrays:
    """Return arrays as they are; XLA computes them before it uses them, once, and moves nothing across."""
    same: Arrays = jax.lax.optimization_barrier(arrays)
    return same


def mv(matrix: Array, vector: Array) -> Array:
    """Return matrices (..., m, k, B) times vectors (..., k, B)."""
    parts = [matrix[..., k, :] * vector[..., None, k, :] for k in range(matrix.shape[-2])]
    return sum(parts[1:], parts[0])


def mm(first: Array, second: Array) -> Array:
    """Return products of matrices (..., l, k, B) and (..., k, m, B)."""
    parts = [first[..., k, None, :] * second[..., None, k, :, :] for k in range(first.shape[-2])]
    return sum(parts[1:], parts[0])


def dot(first: Array, second: Array) -> Array:
    """Return inner products (..., 1, B) of vectors (..., 3, B)."""
    x, y, z = (first[..., k : k + 1, :] * second[..., k : k + 1, :] for k in range(3))
    return x + y + z


def norm(vector: Array) -> Array:
    """Return lengths (n, 1, B) of vectors (n, 3, B), with gradient zero at zero."""
    squared = dot(vector, vector)
    zero = squared < 1e-20
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def cross(first: Array, second: Array) -> Array:
    """Return cross products (..., 3, B) of vectors."""
    return _cross(first, second, -2)


def cross_columns(vector: Array, matrix: Array) -> Array:
    """Return [v] M: each column of M (..., 3, m, B) crossed from the left with v (..., 3, B)."""
    return _cross(vector[..., None, :], matrix, -3)


def cross_rows(matrix: Array, vector: Array) -> Array:
    """Return M [v]: each row of M (..., m, 3, B) crossed with v (..., 3, B)."""
    return _cross(matrix, vector[..., None, :, :], -2)


def _cross(first: Array, second: Array, axis: int) -> Array:
    (a, b, c), (x, y, z) = (jnp.moveaxis(array, axis, 0) for array in (first, second))
    return jnp.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=axis)


def inverse_cholesky(matrix: Array) -> Array:
    """Return L^-1 (n, 3, 3, B) of positive definite matrices L L' and lower triangles L."""
    a = jax.lax.rsqrt(matrix[:, 0, 0])
    b, c = matrix[:, 1, 0] * a, matrix[:, 2, 0] * a
    d = jax.lax.rsqrt(matrix[:, 1, 1] - b * b)
    e = (matrix[:, 2, 1] - c * b) * d
    f = jax.lax.rsqrt(matrix[:, 2, 2] - c * c - e * e)
    none = jnp.zeros_like(a)
    rows = ((a, none, none), (-b * a * d, d, none), ((e * b * d - c) * a * f, -e * d * f, f))
    return barrier(jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1))


def inverse(matrix: Array) -> Array:
    """Return the inverses of regular matrices (n, 3, 3, B), by their adjugates."""
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    adjugate = jnp.stack([cross(b, c), cross(c, a), cross(a, b)], axis=2)
    x, y, z = (a[:, k] * adjugate[:, k, 0] for k in range(3))
    return adjugate / (x + y + z)[:, None, None]


def rotated(orientation: Array, rotation_vector: Array) -> Array:
    """Return orientations (n, 4, B) turned by rotation vectors (n, 3, B) [rad], right to the second order."""
    w, v = orientation[:, :1], orientation[:, 1:]
    half = 0.5 * rotation_vector
    real = w - dot(half, v)
    imaginary = v + w * half + cross(half, v)
    scale = jax.lax.rsqrt(real**2 + dot(imaginary, imaginary))
    return scale * jnp.concatenate([real, imaginary], axis=1)


def rotation_matrices(orientation: Array) -> Array:
    """Return the rotation matrices (n, 3, 3, B) of orientations (n, 4, B)."""
    w, x, y, z = (orientation[:, k] for k in range(4))
    rows = (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
    return jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1)

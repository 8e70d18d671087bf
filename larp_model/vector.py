"""Vectors by their components: what is computed with them is one loop over a batch, where arrays (*, 3) make many."""

from __future__ import annotations

from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Vector:
    """Of arrays of one shape (*,) each."""

    x: Array
    y: Array
    z: Array

    @staticmethod
    def of(array: Array) -> Vector:
        """From an array (*, 3)."""
        return Vector(array[..., 0], array[..., 1], array[..., 2])

    @staticmethod
    def zero(like: Array) -> Vector:
        """Of the shape of an array."""
        return Vector(*[jnp.zeros_like(like)] * 3)

    @property
    def array(self) -> Array:
        """(*, 3)."""
        return jnp.stack([self.x, self.y, self.z], axis=-1)

    def __add__(self, other: Vector) -> Vector:
        return Vector(self.x + other.x, self.y + other.y, self.z + other.z)

    def __sub__(self, other: Vector) -> Vector:
        return Vector(self.x - other.x, self.y - other.y, self.z - other.z)

    def __neg__(self) -> Vector:
        return Vector(-self.x, -self.y, -self.z)

    def __mul__(self, scale: Array | float) -> Vector:
        return Vector(self.x * scale, self.y * scale, self.z * scale)

    __rmul__ = __mul__

    def dot(self, other: Vector) -> Array:
        """(*,)."""
        return self.x * other.x + self.y * other.y + self.z * other.z

    def cross(self, other: Vector) -> Vector:
        """Of both, right-handed."""
        return Vector(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

"""What the optimisers share: the state of a search, the ranking of candidates, and their noise."""

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

Score = Callable[[jax.Array], jax.Array]
"""Knots (N, K, J, 3) [rad] to costs (N,), +inf for a candidate that is not finite."""


class Search(NamedTuple):
    """What one optimiser hands to the next within a plan."""

    mean: jax.Array  # (K, J, 3) rad, centre of the sampling distribution
    spread: jax.Array  # (K, J, 3) rad, its standard deviation
    elites: jax.Array  # (M, K, J, 3) rad, the best candidates, best first
    costs: jax.Array  # (M,) of the elites, +inf while unknown
    scale: jax.Array  # (J, 3) rad, the spread of a first plan: how far each joint is worth moving


def best_first(knots: jax.Array, costs: jax.Array, count: int) -> tuple[jax.Array, jax.Array]:
    """The `count` cheapest of knots (N, K, J, 3) and their costs (N,); infinite ones last, ties in order."""
    order = jnp.argsort(costs, stable=True)[:count]
    return knots[order], costs[order]


def coloured_noise(key: jax.Array, shape: tuple[int, ...], exponent: float) -> jax.Array:
    """Normal noise (N, K, J, 3) of unit variance whose power along the K knots falls as frequency^-exponent.

    0 is white, 2 a random walk's: neighbouring knots move together (Pinneri et al. 2020, "iCEM").
    """
    return jnp.einsum("kl,nljd->nkjd", _colour(shape[1], exponent), jax.random.normal(key, shape))


@functools.cache
def _colour(count: int, exponent: float) -> np.ndarray:
    """Square root (K, K) of the noise's covariance, cut from twice the length so that the ends differ."""
    index = np.arange(2 * count)
    frequency = np.maximum(np.minimum(index, 2 * count - index), 1)
    covariance = np.fft.ifft(frequency.astype(float) ** -exponent).real[:count]
    lag = np.abs(index[:count, None] - index[:count])
    value, vector = np.linalg.eigh(covariance[lag] / covariance[0])
    return ((vector * np.sqrt(np.maximum(value, 0))) @ vector.T).astype(np.float32)

"""Knots to trajectories: interpolation in time, and the shift that a warm start needs."""

from typing import Literal

import jax
import jax.numpy as jnp

Interpolation = Literal["linear", "cubic"]


def interpolate(knots: jax.Array, knot_times: jax.Array, times: jax.Array, kind: Interpolation = "cubic") -> jax.Array:
    """Return values (H, *D) at `times` (H,) of the spline through `knots` (K, *D) at rising `knot_times` (K,) [s].

    Linear in the knots, and through every one of them. "cubic" is the Hermite spline whose slope at a knot is
    the chord between its neighbours (Catmull and Rom 1974). Before the first and after the last knot it is
    constant.
    """
    times = jnp.clip(times, knot_times[0], knot_times[-1])
    right = jnp.clip(jnp.searchsorted(knot_times, times, side="right"), 1, len(knot_times) - 1)
    left = right - 1
    span = _column(knot_times[right] - knot_times[left], knots.ndim)
    s = _column(times - knot_times[left], knots.ndim) / span
    if kind == "linear":
        return (1 - s) * knots[left] + s * knots[right]
    slope = _slopes(knots, knot_times)
    return (
        (1 + 2 * s) * (1 - s) ** 2 * knots[left]
        + s**2 * (3 - 2 * s) * knots[right]
        + s * (1 - s) * span * ((1 - s) * slope[left] - s * slope[right])
    )


def shift(
    knots: jax.Array, knot_times: jax.Array, elapsed: jax.Array | float, kind: Interpolation = "cubic"
) -> jax.Array:
    """Return the trajectory `elapsed` [s] later: knots (K, *D) at knot_times + elapsed, constant beyond the end.

    Exact where `elapsed` is a multiple of the (even) knot spacing, a smoothing otherwise.
    """
    return interpolate(knots, knot_times, knot_times + elapsed, kind)


def _slopes(knots: jax.Array, knot_times: jax.Array) -> jax.Array:
    """Return the chord between the neighbours of each knot (K, *D) [1/s], one-sided at the ends."""
    next_knot = jnp.minimum(jnp.arange(len(knots)) + 1, len(knots) - 1)
    previous_knot = jnp.maximum(jnp.arange(len(knots)) - 1, 0)
    return (knots[next_knot] - knots[previous_knot]) / _column(
        knot_times[next_knot] - knot_times[previous_knot], knots.ndim
    )


def _column(values: jax.Array, ndim: int) -> jax.Array:
    return values.reshape(-1, *(1,) * (ndim - 1))

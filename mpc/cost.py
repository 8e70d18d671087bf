"""A cost is a sum of named terms, each residual x norm x weight, so that each can be plotted and tuned."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from larp_model.errors import InputError

Residual = Callable[[jax.Array, jax.Array, Any], jax.Array]
Norm = Callable[[jax.Array], jax.Array]


def quadratic(residual: jax.Array) -> jax.Array:
    """Return half the squared length of each vector: (*, R) -> (*)."""
    return 0.5 * jnp.sum(residual**2, axis=-1)


def l2(width: float) -> Norm:
    """Return the norm (*, R) -> (*) that is the vector's length, a parabola below `width` (residual's unit)."""
    _require_width(width)
    return partial(_rounded_length, width=width)


def absolute(width: float) -> Norm:
    """Return the norm (*, R) -> (*) that sums absolute components, each smooth below `width` (residual's unit)."""
    _require_width(width)
    return partial(_rounded_sum, width=width)


def _rounded_length(residual: jax.Array, width: float) -> jax.Array:
    return jnp.sqrt(jnp.sum(residual**2, axis=-1) + width**2) - width


def _rounded_sum(residual: jax.Array, width: float) -> jax.Array:
    return jnp.sum(jnp.sqrt(residual**2 + width**2) - width, axis=-1)


@dataclass(frozen=True)
class CostTerm:
    """weight x norm(residual(states, controls, context)) of one candidate.

    The residual sees states (H', L, 13), controls (H, J, 3) [rad] and the task's `context` (any pytree of
    arrays), and returns (R,), or (T, R) of which the norm is averaged over its T instants.
    """

    name: str
    residual: Residual
    norm: Norm = quadratic
    weight: float = 1.0

    def __post_init__(self) -> None:
        require_weight(self.name, self.weight)


def residuals(
    terms: Sequence[CostTerm],
    states: jax.Array,
    controls: jax.Array,
    context: Any = None,
    corrections: Mapping[str, jax.Array] | None = None,
) -> dict[str, jax.Array]:
    """Return each term's residual of one candidate, (R,) or (T, R), plus the correction of its name, if any."""
    values = {term.name: term.residual(states, controls, context) for term in terms}
    for name, residual in values.items():
        if residual.ndim not in (1, 2):
            raise InputError(f"residual of {name!r}: got shape {residual.shape}, needs (R,) or (T, R)")
    return {name: residual + (corrections or {}).get(name, 0.0) for name, residual in values.items()}


def weighted_cost(
    terms: Sequence[CostTerm],
    residual_values: Mapping[str, jax.Array],
    states: jax.Array,
    weights: Mapping[str, jax.Array | float] | None = None,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return the cost of one candidate from its residuals and states (H', L, 13), and each term's weighted share.

    `weights` replaces the terms' own by name. The total is +inf where a state or the sum is not finite: such a
    candidate is never chosen. The shares are reported as they are.
    """
    shares = {
        term.name: (weights or {}).get(term.name, term.weight) * jnp.mean(term.norm(residual_values[term.name]))
        for term in terms
    }
    total = jnp.sum(jnp.stack(list(shares.values())))
    finite = jnp.isfinite(total) & jnp.all(jnp.isfinite(states))
    return jnp.where(finite, total, jnp.inf), shares


def evaluate(
    terms: Sequence[CostTerm],
    states: jax.Array,
    controls: jax.Array,
    context: Any = None,
    weights: Mapping[str, jax.Array | float] | None = None,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Return `weighted_cost` of one candidate with states (H', L, 13) under controls (H, J, 3)."""
    return weighted_cost(terms, residuals(terms, states, controls, context), states, weights)


def curvatures(
    terms: Sequence[CostTerm],
    residual_values: Mapping[str, jax.Array],
    weights: Mapping[str, jax.Array | float] | None = None,
) -> dict[str, jax.Array]:
    """Return c >= 0 for each residual r, of its shape: sum(c r^2) / 2 + constant touches the cost, with its slope.

    The weights of iteratively reweighted least squares (P. Holland and R. Welsch 1977): slope of the norm / r; where r
    is nearly zero, that ratio at a small r.
    """

    def curvature(term: CostTerm) -> jax.Array:
        residual = residual_values[term.name]
        size = jnp.sqrt(jnp.mean(residual**2, axis=-1, keepdims=True))
        least = jnp.maximum(1e-3 * size, 1e-6)
        nonzero = jnp.where(jnp.abs(residual) < least, least, residual)
        slope = jax.grad(lambda r: (weights or {}).get(term.name, term.weight) * jnp.mean(term.norm(r)))(nonzero)
        return jnp.maximum(slope / nonzero, 0.0)

    return {term.name: curvature(term) for term in terms}


def nearest_on_path(path: Any, point: Any) -> tuple[Any, Any]:
    """Return the point of a path (T, 3) [m] that is nearest to `point` (3,) [m], and the row before it.

    The path is straight between its rows.

    NumPy or JAX arrays, in their own precision. A ball flies some 10 cm between two states, so that the distance at
    the states alone overstates the miss.
    """
    xp = path.__array_namespace__()
    start, along = path[:-1], path[1:] - path[:-1]
    squared = xp.sum(along**2, axis=-1)
    fraction = xp.sum((point - start) * along, axis=-1) / xp.where(squared > 0.0, squared, 1.0)
    points = start + xp.clip(fraction, 0.0, 1.0)[:, None] * along
    row = xp.argmin(xp.sum((points - point) ** 2, axis=-1))
    return points[row], row


def require_weight(name: str, weight: float) -> None:
    """Raise InputError for a weight that is negative or not finite."""
    if not (np.isfinite(weight) and weight >= 0):
        raise InputError(f"weight of {name!r}: got {weight}, needs a finite number >= 0")


def _require_width(width: float) -> None:
    if not (np.isfinite(width) and width > 0):
        raise InputError(f"width: got {width}, needs a finite number > 0 for a gradient at zero")

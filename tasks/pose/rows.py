"""Calls of compiled functions on a fixed number of rows, so that films of any length share one compiled program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

ROWS = 48


def single(tree: Any) -> Any:
    """Return a tree of arrays and numbers as JAX arrays of single precision."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), tree)


def by_rows(function: Callable[..., Any], *arrays: np.ndarray) -> Any:
    """Return the result of a function of arrays (ROWS, ...) on arrays (N, ...), called on ROWS rows at a time."""
    count = len(arrays[0])
    blocks = np.minimum(np.arange(-(-count // ROWS) * ROWS), count - 1).reshape(-1, ROWS)
    parts = [function(*single([array[block] for array in arrays])) for block in blocks]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count].astype(float), *parts)

"""Compiled functions of many rows, a fixed number of them at a time, so that films of any length share one program."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

ROWS = 48


def single(tree: Any) -> Any:
    """Arrays and numbers as JAX arrays of single precision."""
    return jax.tree.map(lambda each: jnp.asarray(each, jnp.float32), tree)


def by_rows(function: Callable[..., Any], *arrays: np.ndarray) -> Any:
    """What a function of arrays (ROWS, ...) makes of arrays (N, ...)."""
    count = len(arrays[0])
    rows = np.minimum(np.arange(-(-count // ROWS) * ROWS), count - 1).reshape(-1, ROWS)
    parts = [function(*single([each[chosen] for each in arrays])) for chosen in rows]
    return jax.tree.map(lambda *each: np.concatenate(each)[:count].astype(float), *parts)

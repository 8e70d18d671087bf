"""Batches shared evenly among a process's devices, by `jax.sharding`: rows of a batch do not depend on each other.

Under `jax.distributed` too each process takes its own devices: plans of several hosts are independent as well.

The cores of a CPU are devices too (`runtime.prepare_compiler`): XLA takes hardly more than one core for a program whose
arrays are as small as a scene's.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import Array
from jax.sharding import Mesh, PartitionSpec

# Rows of a batch that a device takes at least: fewer are not worth a shared program, which compiles for longer.
LEAST_ROWS = 4


def shared(function: Callable[..., Array], count: int, arguments: tuple[Any, ...], by_row: tuple[bool, ...]) -> Array:
    """Return function(*arguments) of `count` rows, each device with as many of them, or one with all.

    by_row: which arguments (pytrees) have an axis of rows, which is their first; the result has one as well. One device
    takes all where the devices do not divide the rows or have fewer than `LEAST_ROWS` each, and where the number is a
    symbol (`jax.export`) or the user has chosen a device (`jax.default_device`).
    """
    devices = jax.local_devices()
    chosen = jax.config.jax_default_device is not None  # type: ignore[attr-defined]
    if len(devices) == 1 or chosen or not isinstance(count, int):
        return function(*arguments)
    if count % len(devices) or count < LEAST_ROWS * len(devices):
        return function(*arguments)
    rows, all_rows = PartitionSpec("rows"), PartitionSpec()
    specs = tuple(rows if has_rows else all_rows for has_rows in by_row)
    mesh = Mesh(np.array(devices), ("rows",))
    sharded = jax.shard_map(function, mesh=mesh, in_specs=specs, out_specs=rows, check_vma=False)
    result: Array = sharded(*arguments)
    return result

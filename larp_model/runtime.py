"""Setup of JAX: its device and memory, XLA's way to compile for CPUs, a compilation cache that processes share."""

from __future__ import annotations

import functools
import gc
import math
import os
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from larp_model.errors import InputError

# Of the file times of an entry and of the stamp [ns]: file systems round them.
TOLERANCE = 1_000_000_000
# XLA's older way to compile fused operations for CPUs, and loops over the axes of small matrices that LLVM does not
# unroll: a step compiles in half the time, and takes less. See `tasks.benchmarks.compilation`.
# A process ends whose XLA does not know a flag, so they are given to the versions in which they were measured.
COMPILER_FLAGS = {
    "xla_cpu_use_fusion_emitters": "false",
    "xla_backend_extra_options": "xla_cpu_disable_loop_unrolling",
}
MEASURED_VERSIONS = "0.10."
# So many of a CPU's cores are devices at most: the batches of a planner do not suffice for more.
MOST_DEVICES = 8
# Memory that is asked for without a look at what is free [bytes].
LITTLE = 2**28
DEVICES_FLAG = "xla_force_host_platform_device_count"


def require_device() -> None:
    """Refuse a JAX_PLATFORMS that names a device which this machine or installation lacks."""
    platforms = jax.config.jax_platforms  # type: ignore[attr-defined]
    try:
        jax.devices()
    except (AssertionError, RuntimeError):
        if not platforms:
            raise
        raise InputError(
            f"JAX_PLATFORMS is {platforms!r}, but this machine or installation has no such device; "
            "unset it, or take 'cpu'"
        ) from None


def prepare_compiler() -> None:
    """Choose how XLA compiles for CPUs, and remember compiled programs from one process to the next.

    A CPU's cores become devices, which share batches (`sharding`). These choices count from JAX's first computation on;
    where XLA_FLAGS or `jax_num_cpu_devices` choose already, they stay. Programs are in the user's cache folder. A cache
    folder that JAX has already (JAX_COMPILATION_CACHE_DIR) stays; without a home, or where its cache folder cannot be
    written, nothing is remembered.
    """
    flags = os.environ.get("XLA_FLAGS", "")
    if version("jaxlib").startswith(MEASURED_VERSIONS):
        chosen = [f"--{name}={value}" for name, value in COMPILER_FLAGS.items() if name not in flags]
        if chosen:
            os.environ["XLA_FLAGS"] = " ".join([flags, *chosen]).strip()
    if DEVICES_FLAG not in flags and jax.config.jax_num_cpu_devices < 1:  # type: ignore[attr-defined]
        with suppress(RuntimeError):  # JAX has computed something already
            jax.config.update("jax_num_cpu_devices", min(MOST_DEVICES, cores()))
    if jax.config.jax_compilation_cache_dir is not None:  # type: ignore[attr-defined]
        return
    try:
        folder = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "larp-mpc"
        folder.mkdir(parents=True, exist_ok=True)
        discard_unreadable(folder)
    except (RuntimeError, OSError):  # RuntimeError: the user has no home
        return
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


def cores() -> int:
    """Return how many processors this process may use, which can be fewer than the machine has."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_memory() -> float:
    """Return the memory that arrays can still take where JAX computes [bytes]; infinite where no one says.

    Of several GPUs, which share a batch, that of all together.
    """
    statistics = [device.memory_stats() for device in jax.local_devices()]
    if all(statistics):
        return float(sum(values["bytes_limit"] - values["bytes_in_use"] for values in statistics))
    with suppress(OSError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        return 1024.0 * int(next(line.split()[1] for line in lines if line.startswith("MemAvailable:")))
    return math.inf


def require_memory(name: str, rows: int, bytes_a_row: int) -> None:
    """Raise InputError where an argument has more rows than results of this size leave memory for."""
    if rows * bytes_a_row < LITTLE:
        return
    free = free_memory()
    if rows * bytes_a_row > free:
        raise InputError(
            f"{name} has {rows} rows, whose results need {1e-9 * rows * bytes_a_row:.3g} GB, but {1e-9 * free:.3g} GB "
            f"are free: take at most {int(free / bytes_a_row)} at a time"
        )


def one_blas_thread() -> AbstractContextManager[Any]:
    """Return a context in which NumPy's linear algebra takes one thread.

    Several gain nothing on small matrices, and wait for the next one in a loop, on cores that JAX needs.
    """
    context: AbstractContextManager[Any] = _thread_pools().limit(limits=1, user_api="blas")
    return context


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Keep Python from looking for garbage meanwhile, as it would again and again among what tracing makes."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


@functools.cache
def _thread_pools() -> Any:
    from threadpoolctl import ThreadpoolController  # its import sets an environment variable

    return ThreadpoolController()


def discard_unreadable(folder: Path) -> None:
    """Delete the entries of a compilation cache that JAX cannot read, of those written since this was last done.

    JAX never overwrites an entry: what a full disk or a power cut truncated would be compiled anew at every start.
    """
    try:
        from jax._src.compilation_cache import decompress_executable
    except ImportError:  # private, but the only reader of JAX's format
        return
    stamp, now = folder / "checked", time.time_ns()
    last_check = stamp.stat().st_mtime_ns if stamp.exists() else 0
    for entry in folder.glob("*-cache"):
        with suppress(FileNotFoundError):  # another process deletes them too
            if entry.stat().st_mtime_ns < last_check - TOLERANCE:
                continue
            try:
                decompress_executable(entry.read_bytes())
            except OSError:
                raise
            except Exception:  # zlib and zstandard raise their own
                entry.unlink()
    stamp.touch()
    os.utime(stamp, ns=(now, now))

"""JAX as the project runs it: a device that is missing is named, what is compiled is remembered and heals."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jax
import jax.numpy as jnp
import psutil
import pytest
from jax._src.compilation_cache import compress_executable
from jax.experimental.compilation_cache import compilation_cache

from larp_model import runtime
from larp_model.runtime import discard_unreadable, no_garbage_collection, prepare_compiler

FOLDER = "jax_compilation_cache_dir"
FUSION, EXTRA = "--xla_cpu_use_fusion_emitters", "--xla_backend_extra_options"


@pytest.fixture(autouse=True)
def nothing_is_set() -> Iterator[None]:
    """JAX as a process finds it that has set no cache folder."""
    before = jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined]
    jax.config.update(FOLDER, None)
    yield
    jax.config.update(FOLDER, before)
    compilation_cache.reset_cache()


def folder() -> str | None:
    """Return the folder of JAX's compilation cache."""
    return jax.config.jax_compilation_cache_dir  # type: ignore[attr-defined,no-any-return]


def test_a_device_that_is_missing_is_named_in_one_line() -> None:
    ended = subprocess.run(
        [sys.executable, "-m", "tasks.kick"], capture_output=True, text=True, env=os.environ | {"JAX_PLATFORMS": "cuda"}
    )
    assert ended.returncode == 2 and ended.stderr.count("\n") == 1
    assert ended.stderr.startswith("error: JAX_PLATFORMS is 'cuda', but")


def test_free_memory_is_what_the_machine_says() -> None:
    assert 1e8 < runtime.free_memory() <= psutil.virtual_memory().total


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ("", f"{FUSION}=false {EXTRA}=xla_cpu_disable_loop_unrolling"),
        ("--xla_dump_to=here", f"--xla_dump_to=here {FUSION}=false {EXTRA}=xla_cpu_disable_loop_unrolling"),
        (f"{FUSION}=true", f"{FUSION}=true {EXTRA}=xla_cpu_disable_loop_unrolling"),
        (f"{FUSION}=true {EXTRA}=a", f"{FUSION}=true {EXTRA}=a"),
    ],
)
def test_flags_of_the_user_stay(flags: str, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", flags)
    prepare_compiler()
    assert os.environ["XLA_FLAGS"] == expected


def test_a_version_of_xla_that_may_not_know_the_flags_does_not_get_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XLA_FLAGS", "")
    monkeypatch.setattr(runtime, "version", lambda name: "0.11.0")
    prepare_compiler()
    assert os.environ["XLA_FLAGS"] == ""


def test_commands_make_cores_devices_before_they_look_for_one() -> None:
    program = "from tasks.command import prepare_jax; prepare_jax(); import jax; print(len(jax.devices()))"
    environment = {
        name: value for name, value in os.environ.items() if name not in ("XLA_FLAGS", "JAX_NUM_CPU_DEVICES")
    }
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, env=environment)
    assert ended.stdout.strip() == str(min(runtime.MOST_DEVICES, runtime.cores()))


@pytest.mark.parametrize("enabled", [True, False])
def test_garbage_is_collected_afterwards_as_before_whatever_happens(enabled: bool) -> None:
    (gc.enable if enabled else gc.disable)()
    try:
        with pytest.raises(ValueError, match="in between"), no_garbage_collection():
            assert not gc.isenabled()
            raise ValueError("in between")
        assert gc.isenabled() == enabled
    finally:
        gc.enable()


def test_without_a_home_nothing_is_remembered_and_nothing_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def nobody() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", nobody)
    prepare_compiler()
    assert folder() is None


def test_where_the_cache_folder_cannot_be_made_nothing_is_remembered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    prepare_compiler()
    assert folder() is None


def test_a_cache_folder_that_the_user_has_set_stays(tmp_path: Path) -> None:
    jax.config.update(FOLDER, str(tmp_path))
    prepare_compiler()
    assert folder() == str(tmp_path)


def test_entries_that_cannot_be_read_are_deleted_and_all_others_stay(tmp_path: Path) -> None:
    whole = compress_executable(b"0123456789" * 1000)
    entries = {"whole": whole, "empty": b"", "truncated": whole[: len(whole) // 2], "noise": b"no executable"}
    for name, content in entries.items():
        (tmp_path / f"{name}-cache").write_bytes(content)
    discard_unreadable(tmp_path)
    assert [path.name for path in tmp_path.glob("*-cache")] == ["whole-cache"]
    (tmp_path / "whole-cache").write_bytes(b"")
    discard_unreadable(tmp_path)
    assert not list(tmp_path.glob("*-cache")), "what was damaged since is found the next time"


@pytest.mark.filterwarnings("ignore:Error reading persistent compilation cache")
def test_a_damaged_cache_is_rewritten_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))

    def compiled() -> dict[str, int]:
        """Names and sizes of what is remembered after another process has compiled one program."""
        jax.config.update(FOLDER, None)
        compilation_cache.reset_cache()
        prepare_compiler()
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.clear_caches()
        jax.jit(lambda x: jnp.sin(x) @ x.T + 41.0)(jnp.ones((3, 3))).block_until_ready()
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)
        return {path.name: path.stat().st_size for path in (tmp_path / "larp-mpc").glob("*-cache")}

    first = compiled()
    for path in (tmp_path / "larp-mpc").glob("*-cache"):
        path.write_bytes(b"")
    again = compiled()
    assert again.keys() == first.keys() and min(again.values()) > 0

"""The installed commands, and what is told of names that were mistyped."""

from __future__ import annotations

import errno
import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from importlib.metadata import entry_points, version
from pathlib import Path
from typing import TextIO

import jax
import numpy as np
import pytest

import larp_model
from larp_model import commands, human
from larp_model.errors import InputError
from larp_model.files import write_whole, written_whole
from larp_model.names import require_file
from mpc.loop import DivergenceError
from tasks.command import Stream, Teller, run
from tasks.presets import preset_of
from tasks.scenarios import scenario


def test_every_installed_command_exists_and_the_version_is_the_packages() -> None:
    found = {each.name: each.load() for each in entry_points(group="console_scripts") if each.name.startswith("larp-")}
    assert {name: each.__module__ for name, each in found.items()} == dict.fromkeys(
        ("larp-kick", "larp-train", "larp-adapt", "larp-pose", "larp-bench"), "larp_model.commands"
    )
    assert version("larp-mpc") == larp_model.__version__


def test_another_package_called_tasks_is_named_where_it_hides_ours(tmp_path: Path) -> None:
    assert commands.hidden() is None
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "__init__.py").touch()
    program = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from larp_model import commands; commands.kick()"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=commands.HOME)
    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1 and f"'tasks' is at {tmp_path / 'tasks'}, another project's" in ended.stderr


def test_a_mistyped_name_is_answered_with_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "kick.bvh").touch()
    for mistyped, meant in (
        (lambda: preset_of("balancd"), "balanced"),
        (lambda: scenario("any_humn"), "any_human"),
        (lambda: human(lengths={"thig": 1.1}), "thigh"),
        (lambda: require_file("reference", tmp_path / "kik.bvh"), "kick.bvh"),
    ):
        with pytest.raises(InputError, match=f"did you mean '{meant}'"):
            mistyped()


def raising(error: BaseException) -> Callable[[], None]:
    """A task that ends so."""

    def task() -> None:
        raise error

    return task


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (InputError("target is 1"), 2, "error: target is 1"),
        (DivergenceError("the world diverged in step 3"), 1, "error: the world diverged in step 3"),
        (KeyboardInterrupt(), 130, "error: interrupted"),
        (OSError(errno.ENOSPC, "No space left on device", "a.npz"), 1, "error: a.npz cannot be written: No space left"),
    ],
)
def test_an_end_that_is_no_defect_is_told_in_one_line(
    error: BaseException, code: int, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        run(raising(error), [])
    told = capsys.readouterr().err
    assert ended.value.code == code and told.startswith(line) and told.count("\n") == 1


@pytest.mark.parametrize(
    "error", [ValueError("operands"), TypeError("x"), FileNotFoundError(errno.ENOENT, "No such file"), OSError("y")]
)
def test_a_defect_keeps_its_traceback(error: Exception) -> None:
    with pytest.raises(type(error)) as raised:
        run(raising(error), [])
    assert raised.value is error


def test_a_reader_that_leaves_does_not_end_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    reading, writing = os.pipe()
    done = []

    def task() -> None:
        tell = Teller()
        tell("first")
        os.close(reading)
        for _ in range(3):
            tell("nobody hears this")
        done.append(True)

    with os.fdopen(writing, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        run(task, [])
        assert done == [True]


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs a device that is always full")
def test_a_full_stdout_is_told_when_all_is_done(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    done = []

    def task() -> None:
        Teller()("a line")
        print("another")
        done.append(True)

    with open("/dev/full", "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        with pytest.raises(SystemExit) as ended:
            run(task, [])
    assert done == [True] and ended.value.code == 1
    assert capsys.readouterr().err == "error: stdout cannot be written: No space left on device\n"


def test_a_terminal_is_told_in_the_signs_that_it_has() -> None:
    raw = io.BytesIO()
    terminal: TextIO = io.TextIOWrapper(raw, encoding="ascii")
    stream = Stream(terminal)
    print("turned by 3° …", file=stream)
    stream.flush()
    assert raw.getvalue() == b"turned by 3? ?\n" and stream.failure is None


def test_what_cannot_be_written_is_named_and_what_was_there_stays(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    path = tmp_path / "kick.npz"
    write_whole(path, b"before")
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, limits[1]))  # as on a full disk
    try:
        with pytest.raises(OSError) as full:
            write_whole(path, bytes(100_000))
        with pytest.raises(OSError), written_whole(path) as file:
            np.save(file, np.zeros(100_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert full.value.filename == str(path) and full.value.errno == errno.EFBIG
    assert [each.name for each in tmp_path.iterdir()] == ["kick.npz"] and path.read_bytes() == b"before"


def test_ctrl_c_in_a_program_that_calls_back_ends_the_command(capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(x: np.ndarray) -> np.ndarray:
        raise KeyboardInterrupt

    def task() -> None:
        shape = jax.ShapeDtypeStruct((), np.float32)
        jax.jit(lambda x: jax.pure_callback(interrupted, shape, x))(np.float32(1.0)).block_until_ready()

    with pytest.raises(SystemExit) as ended:
        run(task, [])
    assert ended.value.code == 130 and capsys.readouterr().err == "error: interrupted\n"


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C as at a terminal: a shell that starts the tests in the background has it ignored."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_while_garbage_is_collected_is_not_lost(capsys: pytest.CaptureFixture[str]) -> None:
    class Garbage:
        def __del__(self) -> None:
            raise KeyboardInterrupt

    def task() -> None:
        Garbage()
        for _ in range(50):  # a machine that was suspended may wake up with all of one sleep over
            time.sleep(0.1)
        raise AssertionError("it went on")

    with pytest.raises(SystemExit) as ended:
        run(task, [])
    assert ended.value.code == 130 and capsys.readouterr().err == "error: interrupted\n"

"""Parts that all commands share: the command line, progress output, and JAX with its compilation cache."""

from __future__ import annotations

import errno
import io
import json as text
import logging
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from typing import Any, NoReturn, TextIO, cast

import jax
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from larp_model.errors import InputError
from larp_model.runtime import prepare_compiler, require_device
from mpc.loop import DivergenceError

# Error numbers of a write to a disk that is full or read-only.
DISK = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


def run(task: Callable[..., None] | dict[str, Callable[..., None]], arguments: list[str] | None = None) -> None:
    """Run the command line of a task, or of several by name, and end the process as its user expects.

    An error is one line on stderr, with exit code 2 for input that cannot be used, 1 where a disk is full or read-only,
    the world diverged or stdout could not be written, and 130 after Ctrl-C. Any other exception is a defect and keeps
    its traceback. A command goes on when the reader of its output ends: see `Stream`.
    """
    out, err = Stream(sys.stdout), Stream(sys.stderr)
    with redirect_stdout(cast(TextIO, out)), redirect_stderr(cast(TextIO, err)), _interruptible():
        try:
            if isinstance(task, dict):
                tyro.extras.subcommand_cli_from_dict(task, args=arguments)
            else:
                tyro.cli(task, args=arguments)
        except InputError as error:
            _end(2, str(error))
        except DivergenceError as error:
            _end(1, str(error))
        except KeyboardInterrupt:
            _end(130, "interrupted")
        except jax.errors.JaxRuntimeError as error:
            if "KeyboardInterrupt" not in str(error):  # raised where a compiled program called back
                raise
            _end(130, "interrupted")
        except OSError as error:
            if error.errno not in DISK:
                raise
            _end(1, f"{error.filename or 'a file'} cannot be written: {error.strerror}")
        out.flush()
        if out.failure is not None and not isinstance(out.failure, BrokenPipeError):
            _end(1, f"stdout cannot be written: {out.failure.strerror}")


@contextmanager
def _interruptible() -> Iterator[None]:
    """Raise Ctrl-C again where it came while JAX collected garbage: exceptions raised there are dropped.

    Where it came in a callback of a compiled program, JAX would log its traceback; that log record is suppressed.
    """
    before, logger = sys.unraisablehook, logging.getLogger("jax._src.callback")

    def hook(dropped: sys.UnraisableHookArgs) -> None:
        if issubclass(dropped.exc_type, KeyboardInterrupt):
            # A signal of its own: `_thread.interrupt_main` of another thread wakes up nobody, and is seen by chance.
            main_thread = threading.main_thread().ident
            assert main_thread is not None
            threading.Timer(0.01, signal.pthread_kill, (main_thread, signal.SIGINT)).start()
        else:
            before(dropped)

    def is_not_interrupt(record: logging.LogRecord) -> bool:
        return not (record.exc_info and isinstance(record.exc_info[1], KeyboardInterrupt))

    sys.unraisablehook = hook
    logger.addFilter(is_not_interrupt)
    try:
        yield
    finally:
        sys.unraisablehook = before
        logger.removeFilter(is_not_interrupt)


def _end(code: int, reason: str) -> NoReturn:
    print(f"error: {reason}", file=sys.stderr)
    raise SystemExit(code) from None


def prepare_jax() -> None:
    """Prepare JAX once arguments are checked: choose how it compiles, require a device that exists."""
    prepare_compiler()  # its choices count only before JAX looks for devices
    require_device()


class Stream(io.TextIOBase):
    """Standard output or error that never stops the program: silent from the first failed write on.

    A reader may leave (`| head -1`) and a disk may be full; `failure` then says why. What the terminal's encoding lacks
    is shown as "?".
    """

    def __init__(self, stream: TextIO | None) -> None:
        """Wrap a stream; None, where the process was started without one, stands for the null device."""
        self._stream = stream if stream is not None else open(os.devnull, "w")  # noqa: SIM115 as long as the process
        self.failure: OSError | None = None
        if isinstance(self._stream, io.TextIOWrapper):
            self._stream.reconfigure(errors="replace")

    @property
    def encoding(self) -> str:  # type: ignore[override]
        """Return the encoding of the wrapped stream."""
        return self._stream.encoding

    def write(self, text: str) -> int:
        """Write text, or drop it after a failure."""
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Flush, or do nothing after a failure."""
        self._try(self._stream.flush)

    def isatty(self) -> bool:
        """Return True where the stream is a terminal."""
        return self._stream.isatty()

    def fileno(self) -> int:
        """Return the file descriptor of the wrapped stream."""
        return self._stream.fileno()

    def _try(self, action: Callable[[], object]) -> None:
        if self.failure is not None:
            return
        try:
            action()
        except OSError as error:
            self.failure = error
            # What is still buffered goes where it does not fail, or the interpreter complains at its exit.
            with suppress(OSError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


class Teller:
    """Printer of a command's progress, of the time that each part took, and of its result."""

    def __init__(self, quiet: bool = False, json: bool = False) -> None:
        """Set where output goes.

        quiet: print nothing but JSON results. json: print results as JSON on stdout, and all else on stderr.
        """
        self._json, self._console = json, Console(quiet=quiet, stderr=json, highlight=False)

    def __call__(self, message: str) -> None:
        """Print a line."""
        self._console.print(message)

    @contextmanager
    def part(self, label: str) -> Iterator[None]:
        """Print that a part begins and, when it ends, how long it took."""
        begin = time.perf_counter()
        self._console.print(f"{label} ...", end=" ")
        try:
            yield
        except BaseException:
            self._console.print()
            raise
        self._console.print(f"{time.perf_counter() - begin:.1f} s")

    @contextmanager
    def bar(self, label: str) -> Iterator[Callable[[int, int], None]]:
        """Show a progress bar with the remaining time; yields a function to call with what is done and the whole."""
        with Progress(
            TextColumn(label), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=self._console
        ) as progress:
            task = progress.add_task(label, total=None)

            def at(done: int, whole: int) -> None:
                progress.update(task, completed=done, total=whole)

            yield at

    def result(self, table: Table, summary: dict[str, Any]) -> None:
        """Show the result: the table, or the summary as JSON."""
        if self._json:
            print(text.dumps(summary, indent=2))
        else:
            self._console.print(table)

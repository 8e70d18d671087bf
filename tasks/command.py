"""What every command here has in common: its line, what it tells while it works, and what it remembers."""

from __future__ import annotations

import json as text
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import tyro
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table


def run(task: Callable[..., None] | dict[str, Callable[..., None]], arguments: list[str] | None = None) -> None:
    """The command line of a task, or of several by name: wrong values end it with one line and exit code 2."""
    try:
        if isinstance(task, dict):
            tyro.extras.subcommand_cli_from_dict(task, args=arguments)
        else:
            tyro.cli(task, args=arguments)
    except ValueError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(2) from None


def remember_compilations() -> None:
    """Keep compiled planners in the user's cache folder, so that the second run starts at once."""
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    jax.config.update("jax_compilation_cache_dir", str(base / "larp-mpc"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)


class Teller:
    """Says what a command is at, and how long each part took."""

    def __init__(self, quiet: bool = False, json: bool = False) -> None:
        """json: results are JSON on stdout, and all else goes to stderr."""
        self._json, self._console = json, Console(quiet=quiet, stderr=json, highlight=False)

    def __call__(self, what: str) -> None:
        """Say a line."""
        self._console.print(what)

    @contextmanager
    def part(self, what: str) -> Iterator[None]:
        """Say that a part begins and, when it ends, how long it took."""
        begin = time.perf_counter()
        self._console.print(f"{what} ...", end=" ")
        yield
        self._console.print(f"{time.perf_counter() - begin:.1f} s")

    @contextmanager
    def bar(self, what: str) -> Iterator[Callable[[int, int], None]]:
        """Show how far a part is and how long it still takes; to be told how much is done, of how much."""
        with Progress(
            TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(), console=self._console
        ) as progress:
            task = progress.add_task(what, total=None)

            def at(done: int, whole: int) -> None:
                progress.update(task, completed=done, total=whole)

            yield at

    def result(self, table: Table, summary: dict[str, Any]) -> None:
        """Show the result: the table, or the summary as JSON."""
        if self._json:
            print(text.dumps(summary, indent=2))
        else:
            self._console.print(table)

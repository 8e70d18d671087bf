"""Shared output of the benchmarks: resumable rows, hardware name, JSON, picture and tables in RESULTS.md."""

from __future__ import annotations

import hashlib
import json
import platform
import re
import subprocess
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from larp_model.errors import InputError
from larp_model.files import require_writable, write_whole, written_whole
from larp_model.runtime import cores

RESULTS = Path("RESULTS.md")
# Pictures that the README shows.
PICTURES = Path("docs")
PROJECT = Path(__file__).parents[2]
PACKAGES = ("larp_model", "mpc", "tasks")
# Characters of a table's lines where no terminal shows them.
FULL_WIDTH = 400

Row = dict[str, Any]


def ready(path: Path, publish: bool, weights: Path | None = None) -> None:
    """Raise InputError, before anything is computed, if the JSON cannot be written or results cannot be published.

    Results are published only from committed code and without weights.
    """
    require_writable(path.parent, "json")
    if not publish:
        return
    if not RESULTS.is_file():
        raise InputError(f"publish is set, but {RESULTS} is not in this folder: run it where the project lies")
    if weights is not None:
        raise InputError(f"publish is set, but weights is {str(weights)!r}: results are those of what ships")
    if changed := _git("status", "--porcelain", "--", *PACKAGES):
        raise InputError(f"publish is set, but {changed.split()[-1]} differs from what is committed")


def collect(path: Path, command: str, jobs: Mapping[str, Callable[[], Row]]) -> list[Row]:
    """Run all jobs and return their rows; each row is saved beside the JSON `path` as soon as it is done.

    An interrupted run resumes from the saved rows if command, hardware, code and weights are the same. Prints the
    estimated time left.
    """
    made_by = {"command": command, "hardware": hardware(), "version": version()}
    path_of_rows = _partial(path)
    done = _rows_of(path_of_rows, made_by)
    console = Console(stderr=True)
    if done:
        console.print(f"{len(done)} of {len(jobs)} rows are kept in {path_of_rows}")
    begin, fresh = time.monotonic(), 0
    for name, job in jobs.items():
        if name in done:
            continue
        done[name] = job()
        write_whole(path_of_rows, (json.dumps({"made_by": made_by, "rows": done}) + "\n").encode())
        fresh += 1
        left = (time.monotonic() - begin) / fresh * (len(jobs) - len(done))
        console.print(f"{len(done)} of {len(jobs)}: {name}; {_duration(left)} left", highlight=False, soft_wrap=True)
    return [done[name] for name in jobs]


def _partial(path: Path) -> Path:
    return path.with_suffix(".partial.json")


def _rows_of(path: Path, made_by: Mapping[str, str]) -> dict[str, Row]:
    """Return the rows by name that a run of the same kind saved; none where there was no such run."""
    try:
        saved = json.loads(path.read_text())
        return dict(saved["rows"]) if saved["made_by"] == made_by else {}
    except (OSError, ValueError, KeyError, TypeError):
        return {}


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"about {minutes} min" if minutes else f"about {rest} s"


def _git(*arguments: str) -> str:
    """Return the output of a git command in this project."""
    try:
        result = subprocess.run(["git", *arguments], cwd=PROJECT, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise InputError(f"publish is set, but git does not know {PROJECT.name}: {error}") from None
    return result.stdout.strip()


def version() -> str:
    """Return a digest of all code and weights that a figure can depend on, other benchmarks included."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        for file in sorted((PROJECT / package).rglob("*")):
            if file.suffix in (".py", ".json", ".safetensors"):
                digest.update(file.relative_to(PROJECT).as_posix().encode())
                digest.update(file.read_bytes())
    return digest.hexdigest()[:16]


def hardware() -> str:
    """Return the machine that figures are measured on: processor, cores, accelerator and version of JAX."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        match = re.search(r"model name\s*:\s*(.+)", cpuinfo.read_text())
        model = match.group(1) if match else model
    accelerators = [device.device_kind for device in jax.devices() if device.platform != "cpu"]
    extra = f", {accelerators[0]}" if accelerators else ""
    return f"{model}, {cores()} cores{extra}, jax {jax.__version__}"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a benchmark's JSON, whole or not at all, and delete the rows saved on the way."""
    write_whole(path, (json.dumps(content, indent=2) + "\n").encode())
    _partial(path).unlink(missing_ok=True)


def write_picture(path: Path, figure: Figure) -> None:
    """Write a figure as PNG."""
    FigureCanvasAgg(figure)
    with written_whole(path) as file:
        figure.savefig(file, format="png", dpi=120)


def publish(name: str, title: str, command: str, *tables: Table) -> None:
    """Put a benchmark's tables into RESULTS.md, in place of its last ones, with the command above them.

    Of several tables, each has its title above it where that is not the title of all.
    """
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    texts = [
        text if len(tables) == 1 or table.title == title else f"{table.title}:\n\n{text}"
        for table, text in zip(tables, map(markdown, tables), strict=True)
    ]
    shown = "\n\n".join(texts)
    made_by = f"Measured on {hardware()}, at commit {_git('rev-parse', '--short=10', 'HEAD')}, with nothing learned."
    part = f"{begin}\n## {title}\n\n`{command}`\n\n{shown}\n\n{made_by}\n{end}"
    text = RESULTS.read_text()
    if begin in text:
        before, after = text.split(begin)[0], text.split(end)[1]
        text = before + part + after
    else:
        text = text.rstrip("\n") + "\n\n" + part + "\n"
    write_whole(RESULTS, text.encode())


def markdown(table: Table) -> str:
    """Return a rich table as markdown."""
    columns = [list(column.cells) for column in table.columns]
    header = [str(column.header) for column in table.columns]
    rows = [header, ["---"] * len(header), *zip(*columns, strict=True)]
    return "\n".join("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)


def show(table: Table) -> None:
    """Print a table; where it is read from a file or a pipe, in full width."""
    width = None if Console().is_terminal else FULL_WIDTH
    Console(width=width, markup=False).print(table)  # [m] is a unit

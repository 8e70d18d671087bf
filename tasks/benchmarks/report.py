"""What every benchmark does: name the hardware, write its JSON, its picture and its part of RESULTS.md."""

from __future__ import annotations

import json
import os
import platform
import re
from pathlib import Path
from typing import Any

import jax
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from rich.console import Console
from rich.table import Table

from larp_model.files import write_whole, written_whole

RESULTS = Path("RESULTS.md")


def hardware() -> str:
    """The machine a figure was measured on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        found = re.search(r"model name\s*:\s*(.+)", cpuinfo.read_text())
        model = found.group(1) if found else model
    accelerators = [device.device_kind for device in jax.devices() if device.platform != "cpu"]
    extra = f", {accelerators[0]}" if accelerators else ""
    return f"{model}, {os.cpu_count()} cores{extra}, jax {jax.__version__}"


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a benchmark's JSON, whole or not at all."""
    write_whole(path, (json.dumps(content, indent=2) + "\n").encode())


def write_picture(path: Path, figure: Figure) -> None:
    """Write a figure as PNG."""
    FigureCanvasAgg(figure)
    with written_whole(path) as file:
        figure.savefig(file, format="png", dpi=120)


def publish(name: str, title: str, command: str, table: Table) -> None:
    """Put a benchmark's table into RESULTS.md, in place of its last one, with the command above it."""
    begin, end = f"<!-- {name} -->", f"<!-- end of {name} -->"
    part = f"{begin}\n## {title}\n\n`{command}`\n\n{markdown(table)}\n\nMeasured on {hardware()}.\n{end}"
    text = RESULTS.read_text() if RESULTS.exists() else "# Results\n\nWritten by the benchmarks, never by hand.\n"
    if begin in text:
        before, after = text.split(begin)[0], text.split(end)[1]
        text = before + part + after
    else:
        text = text.rstrip("\n") + "\n\n" + part + "\n"
    write_whole(RESULTS, text.encode())


def markdown(table: Table) -> str:
    """A rich table as markdown."""
    columns = [list(column.cells) for column in table.columns]
    header = [str(column.header) for column in table.columns]
    rows = [header, ["---"] * len(header), *zip(*columns, strict=True)]
    return "\n".join("| " + " | ".join(str(cell) for cell in row) + " |" for row in rows)


def show(table: Table) -> None:
    """Print a table."""
    Console().print(table)

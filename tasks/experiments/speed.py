"""Time of a step of the human in LARP and in other engines, by batch, beside the paper's on a V100."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from rich.table import Table

from tasks.benchmarks import report
from tasks.benchmarks.engines import Question, titled
from tasks.benchmarks.speed import QuestionRunner, batches, speed_picture

BATCHES = "1,8,64,512,4096,32768"
# Engines with their engine steps in a step of 10 ms.
ENGINES = {"larp": 1, "networks": 1, "networks bfloat16": 1, "mjx": 20, "mjwarp": 20, "mujoco": 20}
STEP = 0.01  # s
# Time limit of an engine's process [s]: MuJoCo Warp compiles for minutes.
MOST = 600.0
# Milliseconds a step by batch in the paper: LARP, MJX and Brax on a V100, MuJoCo and Bullet on 48 cores.
PAPER = {
    "LARP, the paper": {1: 0.07, 4096: 1.3},
    "MJX, the paper": {4096: 20.0},
    "MuJoCo, the paper": {1: 0.19, 4096: 20.0},
    "Bullet, the paper": {1: 1.8},
}


def measure_speed(batch: str, folder: Path, publish: bool) -> None:
    """Time the human's steps in every engine, each in a process of its own, and show them beside the paper's.

    batch: sizes with commas between them. See `runner.main`.
    """
    sizes, path = batches(batch), folder / "speed.json"
    report.ready(path, publish)
    command = f"python -m tasks.experiments speed --batch {','.join(map(str, sizes))}"
    ask = QuestionRunner({False: MOST})
    questions = [
        Question(engine, "human", None, substeps, size) for engine, substeps in ENGINES.items() for size in sizes
    ]
    rows = report.collect(path, command, {question.name: partial(ask, question) for question in questions})
    report.write_json(path, {"command": command, "hardware": report.hardware(), "rows": rows})
    report.write_picture(path.with_suffix(".png"), speed_picture(rows))
    tables = [speed_table(rows, sizes), rate_table(rows, sizes)]
    for table in tables:
        report.show(table)
    if publish:
        report.publish("experiment_speed", str(tables[0].title), command, *tables)


def by_engine(rows: Sequence[report.Row]) -> dict[str, dict[int, report.Row]]:
    """Return the rows by engine and batch."""
    groups: dict[str, dict[int, report.Row]] = {}
    for row in rows:
        groups.setdefault(titled(row["engine"], row["substeps"]), {})[row["batch"]] = row
    return groups


def speed_table(rows: Sequence[report.Row], sizes: Sequence[int]) -> Table:
    """Return a table of milliseconds a step of all simulations together, ours and the paper's."""
    table = Table("engine", "on", *map(str, sizes), title="Milliseconds per step of 10 ms of the human, by batch")
    for name, by_batch in by_engine(rows).items():
        first = by_batch[min(by_batch)]
        if first["refused"] is not None:
            table.add_row(name, "-", first["refused"], *[""] * (len(sizes) - 1))
            continue
        done = {size: row for size, row in by_batch.items() if row["refused"] is None}
        cells = (f"{done[size]['ms_per_step']:.3g}" if size in done else "-" for size in sizes)
        table.add_row(name, first["device"], *cells)
    for name, times in PAPER.items():
        table.add_row(name, "-", *(f"{times[size]:g}" if size in times else "-" for size in sizes))
    return table


def rate_table(rows: Sequence[report.Row], sizes: Sequence[int]) -> Table:
    """Return a table of simulated seconds per second, of all simulations together."""
    table = Table("engine", *map(str, sizes), title="Simulated seconds per second, by batch")
    for name, by_batch in by_engine(rows).items():
        done = {size: row["ms_per_step"] for size, row in by_batch.items() if row["refused"] is None}
        if done:
            table.add_row(name, *(f"{1e3 * STEP * size / done[size]:.3g}" if size in done else "-" for size in sizes))
    for name, times in PAPER.items():
        table.add_row(name, *(f"{1e3 * STEP * size / times[size]:.3g}" if size in times else "-" for size in sizes))
    return table

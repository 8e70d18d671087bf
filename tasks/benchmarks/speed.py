"""Cost of a simulated step in each engine, and accuracy of replayed kicks at that cost.

Each row is measured in a process of its own: time, compilation and peak memory of one engine with one scene and batch.
Each kick is planned and executed in MuJoCo once and then replayed open loop by every engine.
"""

from __future__ import annotations

import json as codec
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from rich.table import Table

from larp_model.engines.mujoco import SUBSTEPS as CONVERGED
from larp_model.errors import InputError
from tasks.benchmarks import replays, report
from tasks.benchmarks.engines import LEARNED, NAMES, PIPELINES, Question, case, titled
from tasks.command import prepare_jax, run
from tasks.kick import Kick
from tasks.presets import PresetName
from tasks.session import Session
from tasks.targets import random_kick

# Engine steps in a step, by engine; all of Brax's pipelines have the same. Those that replay kicks: Brax supports no
# human, MJX and MuJoCo Warp are MuJoCo again, and the paper's networks are timed untrained.
SUBSTEPS = {
    "larp": (1,), "mujoco": (2, 4, 5, 10, 20, 40), "mjx": (20,), "brax": (20,), "bullet": (20,), "mjwarp": (20,),
    "networks": (1,), "networks bfloat16": (1,),
}  # fmt: skip
REPLAYING = ("larp", "mujoco", "bullet")
# Further engine steps, with which kicks are replayed beside the above.
MORE = {"mujoco": (80,), "bullet": (5,)}
CASES = {
    "ball": (("ball", None),),
    "human": (("human", None),),
    "human_ball": (("human_ball", "far"), ("human_ball", "struck")),
}
DIFFERENTIABLE = ("larp", "mjx", "brax")
# Engines that step one simulation after another, so that a larger batch adds no information.
ALONE = ("bullet",)
# Largest batch of gradients; the batch whose time is shown beside accuracy, and at which memory is shown.
MIDDLE = 512
# Time limit of a row's process [s] by whether it takes a gradient, which compiles for long.
SECONDS = {False: 120.0, True: 300.0}
# Larger batches are skipped where a step takes longer than this [s].
SLOW = 0.5
PRESET: PresetName = "fast"
STYLES = {"spring": "--", "positional": ":"}
COLOURS = {"larp": "#d55e00", "mujoco": "#0072b2", "mjx": "#009e73", "brax": "#cc79a7", "bullet": "#7f7f7f",
           "mjwarp": "#56b4e9", "networks": "#e69f00"}  # fmt: skip


@dataclass(frozen=True)
class SpeedSettings:
    """Settings of a run that its figures depend on; see the arguments of `main`."""

    scenes: tuple[str, ...]
    engines: tuple[str, ...]
    sizes: tuple[int, ...]
    kicks: int
    seed: int

    @property
    def command(self) -> str:
        """Return the command that repeats the run."""
        names = f"--scenes {','.join(self.scenes)} --engines {','.join(self.engines)}"
        counts = f"--batch {','.join(map(str, self.sizes))} --kicks {self.kicks} --seed {self.seed}"
        return f"python -m tasks.benchmarks.speed {names} {counts}"


class SpeedMeasurement(NamedTuple):
    """Rows of all questions, each engine's errors over all replayed kicks, and the rows of these kicks."""

    times: list[report.Row]
    replays: list[report.Row]
    kicks: list[report.Row]

    @property
    def content(self) -> dict[str, Any]:
        """Return the entries of the JSON."""
        return {
            "rows": [row for row in self.times if not row["gradient"]],
            "gradient": [row for row in self.times if row["gradient"]],
            "replays": self.replays,
            "kicks": self.kicks,
        }


def listed(name: str, text: str, options: tuple[str, ...]) -> list[str]:
    """Return the words between commas; raise InputError for one that is not known."""
    words = [word.strip() for word in text.split(",")]
    if odd := [word for word in words if word not in options]:
        raise InputError(f"{name} has {odd[0]!r}, but can have {', '.join(options)}, with commas between them")
    return words


def batches(text: str) -> list[int]:
    """Return the batch sizes between commas, smallest first; raise InputError unless they are positive integers."""
    words = text.split(",")
    if not all(word.strip().isdecimal() and int(word) > 0 for word in words):
        raise InputError(f"batch is {text!r}, but must be integers of at least 1, with commas between them")
    return sorted({int(word) for word in words})


def variants(engine: str) -> list[str]:
    """Return the engine's pipelines where it has some (Brax), else the engine itself."""
    return [f"brax {pipeline}" for pipeline in PIPELINES] if engine == "brax" else [engine]


def questions(scenes: Sequence[str], engines: Sequence[str], sizes: Sequence[int], seed: int) -> Iterator[Question]:
    """Yield the questions of all rows; of one engine in one case the smaller batch comes first."""
    cases = [scene_case for scene in scenes for scene_case in CASES[scene]]
    for engine in engines:
        for name, (scene, reach), substeps in product(variants(engine), cases, SUBSTEPS[engine]):
            for size in sizes if engine not in ALONE else (1,):
                yield Question(name, scene, reach, substeps, size, seed=seed)
    # Gradients compile for long, and planners use those of the learned simulator in their own scene: for all else,
    # one batch is enough.
    few = [size for size in sizes if size <= MIDDLE]
    for engine in (engine for engine in engines if engine in DIFFERENTIABLE):
        # Of the others, Brax supports no other scene and MJX fails in all of them.
        for name, (scene, reach) in product(variants(engine), cases if engine == "larp" else cases[:1]):
            for size in few if engine == "larp" and reach == "struck" else few[-1:]:
                yield Question(name, scene, reach, SUBSTEPS[engine][-1], size, gradient=True, seed=seed)


class QuestionRunner:
    """Runner of questions, each in a process of its own.

    Where an engine refused or was slow, later questions that differ only in the batch are not run.
    """

    def __init__(self, seconds: Mapping[bool, float] = SECONDS) -> None:
        """seconds: time limit of a process [s]; see `SECONDS`."""
        self.seconds = seconds
        self.refused: dict[Question, str] = {}

    def __call__(self, question: Question) -> report.Row:
        """Return the row of a question; see `engines.answer`."""
        row, same_but_batch = asdict(question) | {"coarse": question.coarse}, replace(question, batch=0)
        row |= {"refused": self.refused[same_but_batch]} if same_but_batch in self.refused else self.ask(question)
        if row["refused"] is not None:
            self.refused[same_but_batch] = row["refused"]
        elif row["ms_per_step"] > 1e3 * SLOW:
            self.refused[same_but_batch] = f"takes {1e-3 * row['ms_per_step']:.1f} s a step at batch {question.batch}"
        return row

    def ask(self, question: Question) -> report.Row:
        """Return the result of a question's process, or in `refused` the reason why there is none."""
        command = [sys.executable, "-m", "tasks.benchmarks.engines", codec.dumps(asdict(question))]
        most = self.seconds[question.gradient]
        try:
            done = subprocess.run(command, cwd=report.PROJECT, capture_output=True, text=True, timeout=most)
        except subprocess.TimeoutExpired:
            return {"refused": f"took longer than {most:.0f} s"}
        if done.returncode:
            message = (done.stderr.strip() or "nothing").splitlines()[-1]
            return {"refused": f"its process ended with code {done.returncode}: {message}"}
        return dict(codec.loads(done.stdout.splitlines()[-1]))


def replayed_by(engines: Sequence[str]) -> list[replays.Engine]:
    """Return the engines that replay kicks, with their engine steps."""
    return [
        (engine, substeps)
        for engine in engines
        if engine in REPLAYING
        for substeps in (*SUBSTEPS[engine], *MORE.get(engine, ()))
    ]


def price(engine: str, substeps: int, seed: int) -> Question:
    """Return the question whose time is a replay's cost: a struck ball, at the middle batch (1 for `ALONE`)."""
    return Question(engine, "human_ball", "struck", substeps, 1 if engine in ALONE else MIDDLE, seed=seed)


def kicks_of(engines: list[replays.Engine], count: int, seed: int) -> dict[str, partial[report.Row]]:
    """Return the jobs that execute and replay kicks, by name."""
    kick = Kick.standard()
    session = Session(kick)
    random = np.random.default_rng(seed)

    @cache
    def players() -> dict[replays.Engine, replays.Player]:
        by_engine = {}
        for engine, substeps in engines:
            with suppress(Exception):  # its row of the speed table gives the reason
                by_engine[engine, substeps] = replays.player_of(kick.scene, engine, substeps)
        return by_engine

    def one(target: np.ndarray, shift: np.ndarray, index: int) -> report.Row:
        kicked = replays.executed(session, PRESET, target, seed + index, shift)
        return {"target": target.tolist(), "replays": replays.replay_errors(kick.scene, kicked, players())}

    return {f"kick {index}": partial(one, *random_kick(random), index) for index in range(count)}


def label(row: report.Row) -> str:
    """Return a row's engine with its engine steps, as tables show it."""
    return titled(row["engine"], row["substeps"])


def speed_table(rows: list[report.Row], sizes: Sequence[int]) -> Table:
    """Return a table of microseconds per scene and step by batch, with compilation and memory at the middle batch."""
    table = Table("engine", "scene", *(f"{size}" for size in sizes), "compiled in", "memory", "launch error")
    table.title = "Microseconds per scene and step of 10 ms, by batch"
    groups: dict[tuple[str, str, bool], list[report.Row]] = {}
    refusals: dict[tuple[str, str], dict[str, None]] = {}
    for row in rows:
        case_name = case(row["scene"], row["reach"])
        groups.setdefault((label(row), case_name, row["gradient"]), []).append(row)
    for (engine, case_name, gradient), group in groups.items():
        done = {row["batch"]: row for row in group if row["refused"] is None}
        if not done:
            name = f"{engine}, gradient" if gradient else engine
            refusals.setdefault((name, group[0]["refused"]), {})[case_name] = None
            continue
        middle = done[max([size for size in done if size <= MIDDLE] or done)]
        launch = group[0].get("launch_error")
        cells = {size: f"{row['us_per_scene_step']:.3g}" for size, row in done.items()}
        if gradient:
            cells = {size: f"{row['reverse_ms'] / row['forward_ms']:.1f} x forward" for size, row in done.items()}
        seconds, extra = middle["compile_seconds"], middle["peak_memory_mib"] - middle["idle_memory_mib"]
        table.add_row(
            f"{engine}, gradient" if gradient else engine,
            case_name,
            *(cells.get(size, "-") for size in sizes),
            f"{seconds:.1f} s" if seconds else "-",
            f"{extra:.0f} MiB",
            "-" if launch is None or gradient else f"{100 * launch:.1f} %",
        )
    for (engine, reason), cases in refusals.items():
        table.add_row(engine, ", ".join(cases), reason, *[""] * (len(sizes) + 2))
    return table


def accuracy_table(rows: list[report.Row]) -> Table:
    """Return a table of the errors of replayed kicks beside the time per scene and step."""
    table = Table("engine", "mean", "median", "launch error, median", "diverged", f"us, batch {MIDDLE}")
    table.title = f"Ball's distance from MuJoCo's at {replays.LIMIT} engine steps, where it passes the target"

    def cell(value: float | None, form: str) -> str:
        return "-" if value is None else form.format(value)

    for row in rows:
        table.add_row(
            label(row),
            cell(row["mean_m"], "{:.3f} m"),
            cell(row["median_m"], "{:.3f} m"),
            cell(row["launch_error"], "{:.1%}"),
            f"{row['diverged']} of {row['kicks']}",
            cell(row["us_per_scene_step"], "{:.3g}"),
        )
    return table


def speed_picture(rows: list[report.Row]) -> Figure:
    """Plot the time per step over the batch size, with one panel per case."""
    panels = list(dict.fromkeys((row["scene"], row["reach"]) for row in rows))
    timed = [
        row
        for row in rows
        if row["refused"] is None and not row["gradient"] and row["substeps"] in SUBSTEPS[row["engine"].split()[0]]
    ]
    figure = Figure(figsize=(3.1 * len(panels) + 0.6, 4.4), layout="constrained")
    drawn = figure.subplots(1, len(panels), sharex=True, sharey=True, squeeze=False)[0]
    shown: dict[str, Any] = {}
    for axes, (scene, reach) in zip(drawn, panels, strict=True):
        here = [row for row in timed if (row["scene"], row["reach"]) == (scene, reach)]
        for name, lines in curves(here).items():
            text, line = draw(axes, name, lines)
            shown.setdefault(text, line)
        where = {"far": ", ball out of reach", "struck": ", ball struck"}.get(reach or "", "")
        axes.set(xscale="log", yscale="log", xlabel="simulations side by side")
        axes.set_title(scene.replace("_", " and ") + where, fontsize=11)
        sizes = sorted({row["batch"] for row in here})
        axes.set_xticks(sizes, [str(size) for size in sizes], minor=False)
        axes.minorticks_off()
        axes.grid(alpha=0.3, which="major")
    drawn[0].set_ylabel("time per step of 10 ms [ms]")
    figure.legend(shown.values(), shown.keys(), loc="outside lower center", ncols=4, frameon=False)
    return figure


Curve = dict[int, float]


def curves(rows: list[report.Row]) -> dict[str, dict[int, Curve]]:
    """Return the milliseconds per step by engine, engine steps and batch."""
    by_engine: dict[str, dict[int, Curve]] = {}
    for row in rows:
        by_engine.setdefault(row["engine"], {}).setdefault(row["substeps"], {})[row["batch"]] = row["ms_per_step"]
    return by_engine


def draw(axes: Axes, engine: str, lines: dict[int, Curve]) -> tuple[str, Line2D]:
    """Draw an engine's line with a band from its fewest to its most engine steps; return its name and the line."""
    colour, style = COLOURS[engine.split()[0]], STYLES.get(engine.split()[-1], "-")
    substeps = CONVERGED if CONVERGED in lines else max(lines)
    name = NAMES[engine] if engine in LEARNED else f"{NAMES[engine]}, {substeps} engine steps"
    if len(lines) > 1:
        low, high = lines[min(lines)], lines[max(lines)]
        shared = [size for size in low if size in high]
        axes.fill_between(shared, [low[n] for n in shared], [high[n] for n in shared], color=colour, alpha=0.15, lw=0)
        name += f" (band: {min(lines)} to {max(lines)})"
    line = lines[substeps]
    width = 2.5 if engine == "larp" else 1.5
    (drawn,) = axes.plot(list(line), list(line.values()), style, marker="o", ms=4, color=colour, lw=width)
    return name, drawn


def accuracy_picture(summaries: list[report.Row]) -> Figure:
    """Plot the error over the time per scene and step; an engine's points are joined, and marked by engine steps."""
    figure = Figure(figsize=(7, 4.8), layout="constrained")
    axes = figure.subplots()
    priced = [row for row in summaries if None not in (row["us_per_scene_step"], row["mean_m"], row["median_m"])]
    for engine in dict.fromkeys(row["engine"] for row in priced):
        rows = [row for row in priced if row["engine"] == engine]
        price = [row["us_per_scene_step"] for row in rows]
        colour, mark = COLOURS[engine.split()[0]], "*" if engine == "larp" else "o"
        for measure, style in (("mean_m", "--"), ("median_m", "-")):
            error = [row[measure] for row in rows]
            text = f"{NAMES[engine]}, {measure.removesuffix('_m')}"
            size, face = (14, colour) if engine == "larp" else (6, colour)
            if measure == "mean_m":
                face = "white"
            axes.plot(price, error, style, marker=mark, ms=size, mfc=face, color=colour, label=text)
        for row in rows if engine != "larp" else ():
            at = (row["us_per_scene_step"], row["median_m"])
            axes.annotate(
                str(row["substeps"]), at, (-4, -5), textcoords="offset points", ha="right", va="top", fontsize=9
            )
    axes.set(xscale="log", yscale="log", xlabel=f"time per scene and step of 10 ms, batch {MIDDLE} [us]")
    axes.set(ylabel=f"ball's error at the target [m]\nagainst MuJoCo at {replays.LIMIT} engine steps")
    axes.grid(alpha=0.3, which="major")
    axes.legend(frameon=False)
    return figure


def main(
    scenes: str = "ball,human,human_ball",
    engines: str = "larp,mujoco,mjx,brax,bullet",
    batch: str = "1,8,64,512,4096",
    kicks: int = 32,
    seed: int = 0,
    json: Path = Path("runs/benchmarks/speed.json"),
    publish: bool = False,
) -> None:
    """Time simulated steps and gradients of every engine, and replay executed kicks in each.

    Args:
        scenes: of ball, human and human_ball, with commas between them.
        engines: of larp, mujoco, mjx, brax, bullet, mjwarp, networks and networks bfloat16, with commas between them.
        batch: simulations side by side, with commas between them.
        kicks: how many are replayed; 0 for none. They need the scene human_ball.
        seed: of joint targets, kicks and planner.
        json: where the figures go; the pictures, speed.png and accuracy.png, go beside them.
        publish: put the tables into RESULTS.md and the pictures into docs/.
    """
    scene_names, engine_names = listed("scenes", scenes, tuple(CASES)), listed("engines", engines, tuple(SUBSTEPS))
    settings = SpeedSettings(tuple(scene_names), tuple(engine_names), tuple(batches(batch)), kicks, seed)
    if kicks < 0:
        raise InputError(f"kicks is {kicks}, but must be at least 0")
    report.ready(json, publish)
    prepare_jax()
    measurement = measure(settings, json)
    report.write_json(json, {"command": settings.command, "hardware": report.hardware(), **measurement.content})
    tables = {"speed": speed_table(measurement.times, settings.sizes)}
    pictures = {"speed": speed_picture(measurement.times)}
    if measurement.replays:
        tables["accuracy_per_microsecond"] = accuracy_table(measurement.replays)
        pictures["accuracy"] = accuracy_picture(measurement.replays)
    for name, figure in pictures.items():
        report.write_picture(json.with_name(f"{name}.png"), figure)
        if publish:
            report.write_picture(report.PICTURES / f"{name}.png", figure)
    for name, table in tables.items():
        report.show(table)
        if publish:
            report.publish(name, str(table.title), settings.command, table)


def measure(settings: SpeedSettings, json: Path) -> SpeedMeasurement:
    """Return the rows of all questions and replayed kicks.

    json: where the figures go; an interrupted run resumes from the rows beside it.
    """
    seed = settings.seed
    replaying = replayed_by(settings.engines) if settings.kicks and "human_ball" in settings.scenes else []
    runner = QuestionRunner()
    all_questions = [
        *questions(settings.scenes, settings.engines, settings.sizes, seed),
        *(price(*engine, seed) for engine in replaying),
    ]
    jobs = {question.name: partial(runner, question) for question in all_questions}
    kick_jobs = kicks_of(replaying, settings.kicks, seed) if replaying else {}
    collected = report.collect(json, settings.command, jobs | kick_jobs)
    rows = dict(zip([*jobs, *kick_jobs], collected, strict=True))
    kicks = [rows[name] for name in kick_jobs]
    summaries = replays.figures_of(row["replays"] for row in kicks)
    launch = {(row["engine"], row["substeps"]): row["launch_error"] for row in summaries}
    for row in summaries:
        row["us_per_scene_step"] = rows[price(row["engine"], row["substeps"], seed).name].get("us_per_scene_step")
    times = [rows[name] | {"launch_error": launch.get((rows[name]["engine"], rows[name]["substeps"]))} for name in jobs]
    return SpeedMeasurement(times, summaries, kicks)


if __name__ == "__main__":
    run(main)

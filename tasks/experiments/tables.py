"""Tables and pictures of experiments: means and spreads over seeds, beside what the paper says."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from statistics import mode
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from rich.table import Table

from tasks.benchmarks.report import Row
from tasks.experiments.lists import Experiment
from tasks.scenarios import scenario

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7")


class Key(NamedTuple):
    """Fields that runs of several seeds have in common."""

    scene: str
    design: str
    change: str
    sequences: int
    updates: int

    def label(self, groups: Collection[Key]) -> str:
        """Return design and change as text, and the numbers of sequences and updates where those of groups differ."""
        words = [self.design, *([] if self.change == "none" else [self.change])]
        for number in ("sequences", "updates"):
            if self.updates and len({getattr(other, number) for other in groups if other.updates}) > 1:
                words.append(f"{getattr(self, number)} {number}")
        return ", ".join(words)


def by_key(rows: Sequence[Row]) -> dict[Key, list[Row]]:
    """Return the rows of several seeds by what they have in common."""
    groups: dict[Key, list[Row]] = {}
    for row in rows:
        groups.setdefault(Key(*(row[name] for name in Key._fields)), []).append(row)
    return groups


def windows_of(experiment: Experiment, scene: str) -> tuple[int, ...]:
    """Return the first n steps over which errors in a scene are averaged."""
    return experiment.windows or scenario(scene).windows


def errors_at(rows: Sequence[Row], window: int, bodies: Collection[str] = ()) -> np.ndarray:
    """Return the mean position error [m] of bodies in a window of each row, NaN where all predictions diverged.

    bodies: their names; all by default.
    """
    means = [
        [np.nan if error is None else error for name, error in row["windows"][str(window)].items()
         if not bodies or name in bodies]
        for row in rows
    ]  # fmt: skip
    errors: np.ndarray = np.array(means, float).mean(axis=1)
    return errors


def with_spread(values: np.ndarray | Sequence[float | None], digits: int = 4) -> str:
    """Return mean and standard deviation of values [m] as text."""
    known = np.array([np.nan if value is None else value for value in values], float)
    if not np.isfinite(known).all():
        return "diverged"
    return f"{known.mean():.{digits}f} ± {known.std():.{digits}f}" if len(known) > 1 else f"{known.mean():.{digits}f}"


def tables_of(experiment: Experiment, rows: Sequence[Row]) -> list[Table]:
    """Return a table of each scene: mean and standard deviation over the seeds, beside what the paper says."""
    groups = by_key(rows)
    scenes = dict.fromkeys(key.scene for key in groups)
    return [
        _table_of(experiment, scene, {key: group for key, group in groups.items() if key.scene == scene})
        for scene in scenes
    ]


def _table_of(experiment: Experiment, scene: str, groups: dict[Key, list[Row]]) -> Table:
    windows, names = windows_of(experiment, scene), dict[str, list[str]]()
    for body in scenario(scene).scene.bodies:
        names.setdefault(body.kind, []).append(body.name)
    # Bodies of one kind have a column together.
    columns = [(bodies, window) for bodies in names.values() for window in windows]
    titles = [f"{bodies[0]}, {n} steps [m]" if len(names) > 1 else f"{n} steps [m]" for bodies, n in columns]
    seeds = len({row["seed"] for group in groups.values() for row in group})
    title = f"{experiment.title}, {scene}: mean ± standard deviation of {seeds} seed{'s' * (seeds > 1)}"
    table = Table("run", *titles, "joints apart [m]", "diverged", "training", "the paper", title=title)
    for key, group in groups.items():
        diverged = 100.0 * sum(row["diverged"] for row in group) / sum(row["judged"] for row in group)
        table.add_row(
            key.label(groups),
            *(with_spread(errors_at(group, window, bodies)) for bodies, window in columns),
            with_spread([row["displacement_m"] for row in group]), f"{diverged:.0f} %",
            f"{np.mean([row['seconds'] for row in group]):.0f} s", experiment.paper.get(key[:3], ""),
        )  # fmt: skip
    return table


def picture(experiment: Experiment, rows: Sequence[Row]) -> Figure:
    """Plot the errors of all runs, and over data and minutes where these differ."""
    groups = by_key(rows)
    counts = {key.sequences for key in groups if key.updates}
    return _curves(experiment, groups) if len(counts) > 1 else _dots(experiment, groups)


def _dots(experiment: Experiment, groups: dict[Key, list[Row]]) -> Figure:
    """Plot the error of all runs of each scene in the longest window, a bar from the least to the largest seed."""
    scenes, designs = [*dict.fromkeys(key.scene for key in groups)], [*dict.fromkeys(key.design for key in groups)]
    heights = [sum(scene == key.scene for key in groups) for scene in scenes]
    figure = Figure(figsize=(8, 1.2 + 0.32 * sum(heights) + 0.9 * len(scenes)), layout="constrained")
    all_axes = figure.subplots(len(scenes), 1, squeeze=False, height_ratios=heights, sharex=True)[:, 0]
    for scene, axes in zip(scenes, all_axes, strict=True):
        window = max(windows_of(experiment, scene))
        own = {key: errors_at(group, window) for key, group in groups.items() if key.scene == scene}
        for place, (key, errors) in enumerate(own.items()):
            if len(known := errors[np.isfinite(errors)]):
                colour = COLOURS[designs.index(key.design)]
                axes.plot([known.min(), known.max()], [place, place], color=colour, linewidth=3, alpha=0.5)
                axes.plot(known.mean(), place, "o", color=colour)
        axes.set_yticks(range(len(own)), [key.label(groups) for key in own])
        axes.invert_yaxis()
        axes.set(title=f"{scene}, {window} steps", xscale="log")
        axes.grid(alpha=0.3, axis="x")
    all_axes[-1].set_xlabel("mean position error [m]")
    return figure


def _curves(experiment: Experiment, groups: dict[Key, list[Row]]) -> Figure:
    """Plot the error in the longest window over sequences and over minutes, the others as most runs have them."""
    figure = Figure(figsize=(9, 4), layout="constrained")
    by_data, by_time = figure.subplots(1, 2, sharey=True)
    window = max(windows_of(experiment, next(iter(groups)).scene))
    for colour, design in zip(COLOURS, dict.fromkeys(key.design for key in groups), strict=False):
        own = {key: group for key, group in groups.items() if key.design == design}
        if not any(key.updates for key in own):
            (error,) = errors_at([row for group in own.values() for row in group], window)
            for axes in (by_data, by_time):
                axes.axhline(error, color=colour, linestyle="--", label=f"{design} alone")
            continue
        updates, sequences = mode([key.updates for key in own]), mode([key.sequences for key in own])
        same_updates = {key.sequences: group for key, group in own.items() if key.updates == updates}
        _curve(by_data, same_updates, window, colour, f"{design}, {updates} updates")
        minutes = {np.mean([row["seconds"] for row in group]) / 60.0: group
                   for key, group in own.items() if key.sequences == sequences}  # fmt: skip
        _curve(by_time, minutes, window, colour, f"{design}, {sequences} sequences")
    by_data.set(xlabel="sequences", ylabel=f"mean position error over {window} steps [m]")
    by_time.set(xlabel="minutes of training")
    for axes in (by_data, by_time):
        axes.set(xscale="log", yscale="log")
        axes.grid(alpha=0.3)
        axes.legend(frameon=False)
        axes.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if axes is by_time else (1,)))
        axes.xaxis.set_minor_formatter(NullFormatter())
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_formatter("{x:g}")
    return figure


def _curve(axes: Axes, groups: Mapping[Any, list[Row]], window: int, colour: str, label: str) -> None:
    """Plot means over the numbers by which groups go, with bars from the least to the largest seed."""
    places = sorted(groups)
    errors = [errors_at(groups[place], window) for place in places]
    means = np.array([values.mean() for values in errors])
    bars = [means - [values.min() for values in errors], [values.max() for values in errors] - means]
    axes.errorbar(places, means, bars, color=colour, marker="o", capsize=3, label=label)

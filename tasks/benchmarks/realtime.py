"""Kicks in a world that goes on while the planner plans: misses over delay and over the rate of replans."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from larp_model.engines.mujoco import SUBSTEPS, Truth
from larp_model.errors import InputError
from mpc.loop import DeadlineError, Execution, Latency, World
from mpc.realtime import PacedWorld, PlanningThread, SimulatedLatency
from tasks.benchmarks import report
from tasks.benchmarks.estimation import EstimateErrors, errors_table, estimate_errors, mean_errors
from tasks.command import prepare_jax, run
from tasks.episodes.people import random_people
from tasks.kick import USUAL, Kick
from tasks.models import DynamicsName
from tasks.presets import PresetName, preset_of
from tasks.run import summary_of, timing_figures
from tasks.sensing import EstimatorName, Perception, Sensing
from tasks.sensors import SensorName
from tasks.session import Planners, Session
from tasks.strike import strike_step
from tasks.targets import random_kick, random_roll

# Delays that are no number: drawn from what plans took before, and by the clock, with plans made in a thread.
MEASURED, CLOCK = "measured", "clock"


@dataclass(frozen=True)
class RealtimeSettings:
    """Settings of a run that its figures depend on; see the arguments of `main`."""

    targets: int
    seed: int
    delay: tuple[str, ...]
    preset: tuple[PresetName, ...]
    dynamics: tuple[DynamicsName, ...]
    interval: tuple[int, ...]
    substeps: int
    sensors: tuple[SensorName, ...]
    estimator: tuple[EstimatorName, ...]
    rolling: float
    bodies: Literal["usual", "varied"] = "usual"

    def check(self) -> None:
        """Raise InputError if a setting is invalid."""
        if self.targets < 1:
            raise InputError(f"targets is {self.targets}, but must be at least 1")
        for delay in self.delay:
            if delay not in (MEASURED, CLOCK) and not _milliseconds(delay) >= 0.0:
                raise InputError(f"delay is {delay!r}, but must be {MEASURED}, {CLOCK} or a number of ms of at least 0")
        for interval in self.interval:
            if interval < 1:
                raise InputError(f"interval is {interval}, but must be at least 1")
        if not (math.isfinite(self.rolling) and self.rolling >= 0.0):
            raise InputError(f"rolling is {self.rolling}, but must be a finite speed of at least 0 m/s")

    @property
    def command(self) -> str:
        """Return the command that repeats the run."""
        parts = [
            f"python -m tasks.benchmarks.realtime --targets {self.targets} --seed {self.seed}",
            f"--delay {' '.join(self.delay)} --preset {' '.join(self.preset)} --dynamics {' '.join(self.dynamics)}",
        ]
        if self.interval:
            parts.append(f"--interval {' '.join(map(str, self.interval))}")
        if self.substeps != SUBSTEPS:
            parts.append(f"--substeps {self.substeps}")
        parts.append(f"--sensors {' '.join(self.sensors)} --estimator {' '.join(self.estimator)}")
        if self.rolling:
            parts.append(f"--rolling {self.rolling:g}")
        if self.bodies != "usual":
            parts.append(f"--bodies {self.bodies}")
        return " ".join(parts)

    @property
    def name(self) -> str:
        """Return the name of the run's JSON and of its part of RESULTS.md."""
        parts = ["realtime", *self.sensors]
        if self.rolling:
            parts.append(f"rolling_{self.rolling:g}".replace(".", "_"))
        if self.bodies != "usual":
            parts.append(f"bodies_{self.bodies}")
        if self.preset != ("fast",):
            parts += self.preset
        if self.dynamics != ("larp",):
            parts += self.dynamics
        if self.substeps != SUBSTEPS:
            parts.append(f"substeps_{self.substeps}")
        if self.interval:
            parts.append("rates")
        return "_".join(parts)

    def points(self) -> list[RealtimePoint]:
        """Return the points to measure, each once."""
        return [
            RealtimePoint(preset, dynamics, interval, sensors, estimator, delay)
            for dynamics in self.dynamics
            for preset in self.preset
            for interval in self.interval or (preset_of(preset).interval,)
            for sensors in self.sensors
            for estimator in (self.estimator if sensors != "perfect" else self.estimator[:1])
            for delay in self.delay
        ]


def _milliseconds(delay: str) -> float:
    """Return a delay [ms]; NaN where it is no finite number."""
    try:
        value = float(delay)
    except ValueError:
        return math.nan
    return value if math.isfinite(value) else math.nan


class RealtimePoint(NamedTuple):
    """A preset, its model and interval, what it sees of the state, and the delay of its plans."""

    preset: PresetName
    dynamics: DynamicsName
    interval: int
    sensors: SensorName
    estimator: EstimatorName
    delay: str

    @property
    def planner(self) -> str:
        """Return the planner, and what it sees, as text."""
        return f"{self.dynamics}, {self.preset}, every {self.interval}; {self.sees}"

    @property
    def without_interval(self) -> str:
        """Return all of the point but its interval as text."""
        return f"{self.dynamics}, {self.preset}; {self.sees}, {delay_text(self.delay)}"

    @property
    def sees(self) -> str:
        """Return the sensors and the estimator as text."""
        return "the state" if self.sensors == "perfect" else f"{self.sensors}, {self.estimator}"

    @property
    def name(self) -> str:
        """Return the point as text."""
        return f"{self.planner}, {delay_text(self.delay)}"


def delay_text(delay: str) -> str:
    """Return a delay with its unit."""
    return delay if delay in (MEASURED, CLOCK) else f"{delay} ms"


class Sessions:
    """Sessions of a kick, planners of points and times that their plans take, each made when first needed."""

    def __init__(self, settings: RealtimeSettings, kick: Kick) -> None:
        """Begin with none."""
        self.settings, self.kick = settings, kick
        self._sessions: dict[str, Session] = {}
        self.times: dict[tuple[str, str, int], list[float]] = {}
        self._sensing: dict[tuple[str, str], Sensing] = {}

    def of_human(self, sizes: np.ndarray) -> Sessions:
        """Return those of another human, of these sizes (L, 3), whose plans are expected to take as long."""
        other = Sessions(self.settings, Kick.of(self.kick.scene.sized(sizes), substeps=self.kick.substeps))
        other.times = self.times
        return other

    def session(self, dynamics: DynamicsName) -> Session:
        """Return the session of a model."""
        if dynamics not in self._sessions:
            self._sessions[dynamics] = Session(self.kick, dynamics, substeps=self.settings.substeps)
        return self._sessions[dynamics]

    def planners(self, point: RealtimePoint) -> Planners:
        """Return the planners of a point."""
        preset = replace(preset_of(point.preset), interval=point.interval)
        return self.session(point.dynamics).planners(preset)

    def sensing(self, point: RealtimePoint) -> Sensing:
        """Return the sensors and the estimator of a point."""
        key = point.sensors, point.estimator
        if key not in self._sensing:
            self._sensing[key] = Sensing(self.kick.scene, *key)
        return self._sensing[key]

    def seconds(self, point: RealtimePoint) -> list[float]:
        """Return the times [s] that the plans of a kick took, after another kick that compiled all programs."""
        key = point.dynamics, point.preset, point.interval
        if key not in self.times:
            for _ in range(2):
                latency = SimulatedLatency(self.kick.scene.dt)
                self.session(point.dynamics).execute(self.planners(point), np.array(USUAL), 0, latency=latency)
            self.times[key] = latency.seconds
        return self.times[key]

    def timing(self, point: RealtimePoint, seed: int) -> tuple[Latency, World]:
        """Return the latency of a point's plans, and the world for it."""
        dt, world = self.kick.scene.dt, Truth(self.kick.scene, 1, self.kick.substeps, threads=1)
        if point.delay == CLOCK:
            return PlanningThread(dt, float(np.median(self.seconds(point)))), PacedWorld(world, dt)
        delays = self.seconds(point) if point.delay == MEASURED else 1e-3 * float(point.delay)
        return SimulatedLatency(dt, delays, seed), world


def kick_row(
    sessions: Sessions, point: RealtimePoint, index: int, target: np.ndarray, shift: np.ndarray, roll: np.ndarray
) -> report.Row:
    """Return the row of a kick: its summary, and what plans made of the time. See `kick.kick_row` for arguments.

    late: why no plan would be in time, in the row of a kick that does not take place.
    """
    settings, kick, seed = sessions.settings, sessions.kick, sessions.settings.seed + index
    start = kick.start(shift, roll)
    sense = sessions.sensing(point).perception(start, np.random.default_rng((settings.seed, index)))
    latency, world = sessions.timing(point, seed)
    try:
        execution = sessions.session(point.dynamics).execute(
            sessions.planners(point), target, seed, start, sense=sense, world=world, latency=latency
        )
    except DeadlineError as error:
        return {"point": point.name, "seed": seed, "late": str(error)}
    return (
        summary_of(kick, execution, target)
        | timing_figures(execution, kick.scene.dt)
        | {
            "point": point.name,
            "overruns": world.overruns if isinstance(world, PacedWorld) else 0,
            "seed": seed,
            "estimate": estimate_before_contact(kick, execution, sense),
        }
    )


def estimate_before_contact(kick: Kick, execution: Execution, sense: Perception | None) -> EstimateErrors | None:
    """Return what was known in the last step before the ball was touched; None for perfect sensors, or no contact."""
    states, controls = np.stack(execution.states), np.stack(execution.controls)
    contact = strike_step(states, kick.untouched(states[0], len(controls)))
    if sense is None or contact is None:
        return None
    return estimate_errors(kick.scene, sense, states, controls, max(contact - 2, 0))


def point_figures(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of all kicks of a point; only `late`, why not, where no plan would be in time."""
    if late := [row["late"] for row in rows if "late" in row]:
        return {"late": late[0], "estimate": None}
    truth = np.array([row["truth_error_m"] for row in rows])

    def total(name: str) -> int:
        return int(sum(row[name] for row in rows))

    def mean(name: str) -> float:
        return float(np.nanmean([row[name] for row in rows]))

    return {
        "mean_truth_error_m": float(truth.mean()),
        "median_truth_error_m": float(np.median(truth)),
        "p95_truth_error_m": float(np.quantile(truth, 0.95)),
        "mean_model_error_m": mean("model_error_m"),
        "falls": total("fell"),
        **{name: total(name) for name in ("replans", "deadlines_missed", "overruns")},
        **{name: mean(name) for name in ("replans_per_second", "prediction_error_m", "lead_ms")},
        "estimate": mean_errors([row["estimate"] for row in rows if row["estimate"] is not None]),
    }


def table_of(figures: dict[RealtimePoint, dict[str, Any]], settings: RealtimeSettings) -> Table:
    """Return a table with one line a point.

    missed: replans that missed their deadline. off by: the state predicted for the beginning of a plan. The others are
    misses of the target in the ground truth, and falls.
    """
    columns = ("planner", "sees", "delay", "replans/s", "missed", "off by", "mean", "median", "95 %", "fell")
    table = Table(*columns, title=f"Real time, {settings.targets} targets")
    for point, values in figures.items():
        cells = (
            f"{point.dynamics}, {point.preset}, every {point.interval}",
            point.sees,
            delay_text(point.delay),
        )
        if "late" in values:
            table.add_row(*cells, *[""] * (len(columns) - len(cells) - 1), values["late"])
            continue
        table.add_row(
            *cells,
            f"{values['replans_per_second']:.1f}",
            f"{values['deadlines_missed']} of {values['replans']}",
            f"{1e3 * values['prediction_error_m']:.1f} mm",
            *(f"{1e2 * values[f'{which}_truth_error_m']:.1f} cm" for which in ("mean", "median", "p95")),
            f"{values['falls']}",
        )
    return table


def picture(figures: dict[RealtimePoint, dict[str, Any]]) -> Figure:
    """Plot misses over delay and over the rate of replans, as far as they vary."""
    figures = {point: values for point, values in figures.items() if "late" not in values}
    delays, rates = ({getattr(point, name) for point in figures} for name in ("delay", "interval"))
    draws = [draw for draw, values in ((_over_delay, delays), (_over_rate, rates)) if len(values) > 1] or [_over_delay]
    figure = Figure(figsize=(5.5 * len(draws), 4.5), layout="constrained")
    highest = 100.0 * max((value["mean_truth_error_m"] for value in figures.values()), default=1.0)
    for draw, axes in zip(draws, figure.subplots(1, len(draws), squeeze=False)[0], strict=True):
        if figures:
            draw(axes, figures)
        axes.set(ylabel="miss in MuJoCo [cm]", ylim=(0.0, 1.25 * highest))
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    return figure


def _over_delay(axes: Axes, figures: dict[RealtimePoint, dict[str, Any]]) -> None:
    for number, planner in enumerate(dict.fromkeys(point.planner for point in figures)):
        own = {point: value for point, value in figures.items() if point.planner == planner}
        misses = {point: 100.0 * value["mean_truth_error_m"] for point, value in own.items()}
        by_clock = [point for point in own if point.delay in (MEASURED, CLOCK)]
        fixed = sorted(own.keys() - set(by_clock), key=lambda point: float(point.delay))
        colour = f"C{number}"
        axes.plot(
            [float(point.delay) for point in fixed], [misses[point] for point in fixed], "o-", c=colour, label=planner
        )
        for point in by_clock:
            place = own[point]["lead_ms"], misses[point]
            axes.plot(*place, "D", c=colour, label=None if fixed or point is not by_clock[0] else planner)
            axes.annotate(point.delay, place, (6, 4), textcoords="offset points", fontsize=8)
    axes.set(xlabel="delay [ms]")
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def _over_rate(axes: Axes, figures: dict[RealtimePoint, dict[str, Any]]) -> None:
    for number, name in enumerate(dict.fromkeys(point.without_interval for point in figures)):
        own = [value for point, value in figures.items() if point.without_interval == name]
        own.sort(key=lambda value: float(value["replans_per_second"]))
        rates = [value["replans_per_second"] for value in own]
        for which, style in (("mean", "o-"), ("median", "o:")):
            misses = [100.0 * value[f"{which}_truth_error_m"] for value in own]
            axes.plot(rates, misses, style, c=f"C{number}", label=f"{name}: {which}")
    axes.set(xlabel="replans a second", xscale="log")
    axes.set_xticks(ticks := (5, 10, 20, 50, 100), [*map(str, ticks)])
    axes.minorticks_off()
    axes.legend(frameon=False, fontsize=8, loc="upper left")


def main(
    targets: int = 32,
    seed: int = 0,
    delay: tuple[str, ...] = ("0", "10", "25", "50", "100", MEASURED, CLOCK),
    preset: tuple[PresetName, ...] = ("fast",),
    dynamics: tuple[DynamicsName, ...] = ("larp",),
    interval: tuple[int, ...] = (),
    substeps: int = SUBSTEPS,
    sensors: tuple[SensorName, ...] = ("perfect",),
    estimator: tuple[EstimatorName, ...] = ("filter",),
    rolling: float = 0.0,
    bodies: Literal["usual", "varied"] = "usual",
    json: Path | None = None,
    publish: bool = False,
) -> None:
    """Plan and execute kicks to random targets in a world that does not wait for plans.

    Args:
        targets: how many kicks at each point.
        seed: of targets, ball spots, delays and planner.
        delay: of plans: in ms; measured: drawn from what plans took on this machine; clock: by the wall clock, with
            plans made in a thread.
        preset: fast, balanced or accurate.
        dynamics: the planner's model: larp or mujoco.
        interval: steps between replans at least; those of the preset by default.
        substeps: engine steps in a step of MuJoCo as the model.
        sensors: perfect; noisy: joint angles, velocities and the ball's place are; lab: motion capture; onboard:
            encoders, an inertial unit, contact switches and a camera.
        estimator: of the state: none, which takes the last measurement, or filter.
        rolling: greatest speed [m/s] of a ball that comes from ahead or from the kicking side; 0: it rests.
        bodies: varied: every kick is another human's, of any size.
        json: where the figures go; the picture goes beside them.
        publish: put the table into RESULTS.md.
    """
    settings = RealtimeSettings(
        targets, seed, delay, preset, dynamics, interval, substeps, sensors, estimator, rolling, bodies
    )
    settings.check()
    json = json or Path(f"runs/benchmarks/{settings.name}.json")
    report.ready(json, publish)
    prepare_jax()
    points = settings.points()
    rows = report.collect(json, settings.command, jobs_of(settings, points))
    figures = {point: point_figures([row for row in rows if row["point"] == point.name]) for point in points}
    content = {
        "command": settings.command,
        "hardware": report.hardware(),
        "points": [{**point._asdict(), **values} for point, values in figures.items()],
        "rows": rows,
    }
    report.write_json(json, content)
    report.write_picture(json.with_suffix(".png"), picture(figures))
    table = table_of(figures, settings)
    report.show(table)
    if publish:
        report.publish(settings.name, f"Real time, {targets} targets", settings.command, table)
    errors = {point.name: value["estimate"] for point, value in figures.items() if value["estimate"]}
    if errors:
        report.show(estimates := errors_table(errors))
        if publish:
            report.publish(f"{settings.name}_estimates", "What was known of the state", settings.command, estimates)


def jobs_of(settings: RealtimeSettings, points: list[RealtimePoint]) -> dict[str, Callable[[], report.Row]]:
    """Return the jobs that execute one kick each, by name: the same kicks at every point."""
    usual, random = Sessions(settings, Kick.standard()), np.random.default_rng(settings.seed)
    people = random_people(np.random.default_rng((settings.seed, 1)), usual.kick.scene, settings.targets)
    kicks = []
    for _ in range(settings.targets):
        target, shift = random_kick(random)
        kicks.append((target, shift, random_roll(random, settings.rolling) if settings.rolling else np.zeros(2)))

    def one(point: RealtimePoint, index: int) -> report.Row:
        sessions = usual if settings.bodies == "usual" else usual.of_human(people[index])
        return kick_row(sessions, point, index, *kicks[index])

    names = {f"{point.name}: kick {index}": (point, index) for point in points for index in range(settings.targets)}
    return {name: partial(one, *job) for name, job in names.items()}


if __name__ == "__main__":
    run(main)

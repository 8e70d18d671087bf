"""Motion from keypoints against the motion that was filmed: captured clips, seen by synthetic cameras."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from larp_model.bodies import human_and_ball
from larp_model.names import require_file
from tasks.benchmarks import report
from tasks.command import remember_compilations, run
from tasks.keypoints import figure as figures
from tasks.keypoints import filmed, lift, metrics, physical
from tasks.keypoints.figure import SHARED
from tasks.models import DynamicsName
from tasks.motions import skeleton
from tasks.motions.references import embedded, motion_of
from tasks.pose import reconstruct

# Frames a second of a film, and of it what lies before a kick's strike, as a share.
RATE, BEFORE = 60.0, 0.63
Way = Literal["kinematic", "larp", "mujoco"]
WAYS: tuple[Way, ...] = ("kinematic", "larp", "mujoco")
COLORS = {"kinematic": "#9aa5b1", "larp": "#1f6fb2", "mujoco": "#e69f00"}
# What is told of each way: its name in the JSON, what a person reads, and its unit.
TOLD = {
    "mpjpe_g_mm": ("MPJPE-G", "mm"),
    "mpjpe_mm": ("MPJPE", "mm"),
    "mpjpe_pa_mm": ("MPJPE-PA", "mm"),
    "mpjpe_2d_px": ("MPJPE-2D", "px"),
    "velocity": ("velocity error", "m/s"),
    "foot_skate": ("foot skate", "%"),
    "sunk": ("feet sunk by over 2 cm", "% of frames"),
    "fell": ("fell", "% of films"),
    "plan_seconds": ("planning", "s a film"),
    "ms_per_candidate": ("planning", "ms a candidate"),
}


def filmed_points(clip: Path | None, seconds: float) -> np.ndarray:
    """Points (T, P, 3) [m] of so many seconds around a clip's strike, or of its middle where it is no kick.

    clip: BVH or npz; the embedded kick, performed in the truth, by default.
    """
    if clip is None:
        reference, figure = embedded(human_and_ball()), figures.figure()
        states = reference.states[:, : len(figure.body.links)].astype(np.float32)
        points = np.asarray(physical.Seen(figure.body, figure, np.zeros(SHARED)).points(states), float)
        rate, strike = 100.0, reference.strike / 100.0
    else:
        motion = motion_of(clip)
        points, rate = filmed.points_of(motion), motion.rate
        kick = skeleton.toe_speed(motion).max() >= 1.5 * skeleton.SLOWEST_KICK
        strike = (skeleton.strike(motion) if kick else BEFORE * len(points)) / rate
    points = filmed.resampled(points, rate, RATE)
    count = min(round(seconds * RATE), len(points))
    first = int(np.clip(round((strike - BEFORE * seconds) * RATE), 0, len(points) - count))
    return points[first : first + count]


def measured(clip: Path | None, camera: int, seconds: float, ways: Sequence[Way], seed: int) -> dict[str, Any]:
    """One film, reconstructed in each way."""
    true = filmed_points(clip, seconds)
    random = np.random.default_rng((seed, camera))
    lens = filmed.camera_around(random, true)
    film = filmed.seen(random, lens, true, RATE)
    lifted = lift.lift(film, lens)

    def judged(points: np.ndarray) -> dict[str, float]:
        return metrics.position_errors(points, true) | metrics.off_the_ground(points) | {
            "mpjpe_2d_px": metrics.pixel_error(lens.project(points), lens.project(true)),
            "velocity": metrics.velocity_error(points, true, RATE),
            "foot_skate": metrics.foot_skate(points),
        }  # fmt: skip

    row: dict[str, Any] = {
        "clip": "embedded" if clip is None else clip.stem,
        "camera_m": lens.position.tolist(),
        "frames": len(film),
        "true_foot_skate": metrics.foot_skate(true),
    }
    names: dict[Way, DynamicsName] = {"larp": "larp", "mujoco": "mujoco"}
    for way in ways:
        if way == "kinematic":
            row[way] = judged(figures.figure().all_points(lifted.pose, lifted.proportions))
            continue
        made = reconstruct(film, lifted, names[way], seed)
        row[way] = judged(made.found) | {
            "fell": 100.0 * made.fell,
            "plan_seconds": made.spent.seconds,
            "ms_per_candidate": 1e3 * made.spent.seconds / made.spent.candidates,
        }
    return row


def means(rows: list[dict[str, Any]], way: Way) -> dict[str, float]:
    """Of each figure of a way, over all films."""
    return {name: float(np.mean([row[way][name] for row in rows])) for name in TOLD if name in rows[0][way]}


def picture(rows: list[dict[str, Any]], ways: Sequence[Way]) -> Figure:
    """Position errors of every film, way by way."""
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for each, name in zip(axes, ("mpjpe_g_mm", "mpjpe_mm", "mpjpe_pa_mm"), strict=True):
        for place, way in enumerate(ways):
            values = [row[way][name] for row in rows]
            each.scatter(place + np.linspace(-0.15, 0.15, len(values)), values, s=22, color=COLORS[way])
            each.plot([place - 0.3, place + 0.3], 2 * [np.mean(values)], color=COLORS[way], lw=2)
        each.set(title=TOLD[name][0], xticks=range(len(ways)), xlim=(-0.6, len(ways) - 0.4), yscale="log")
        each.set_xticklabels(ways)
    axes[0].set_ylabel("error of a film's joints [mm]; line: mean")
    return figure


def main(
    clips: tuple[Path, ...] = (),
    cameras: int = 2,
    seconds: float = 2.5,
    ways: tuple[Way, ...] = WAYS,
    seed: int = 0,
    json: Path = Path("runs/benchmarks/pose.json"),
    publish: bool = False,
) -> None:
    """Reconstruct motion from the keypoints of synthetic films, and compare it with what was filmed.

    Args:
        clips: captured motions (BVH or npz); the embedded kick by default.
        cameras: that see each of them, somewhere around it.
        seconds: of each film, at 60 frames a second.
        ways: the kinematic start alone, or followed by a planner whose model is larp or mujoco.
        seed: of cameras, detector and planner.
        json: where the figures go; the picture goes beside them.
        publish: put the table into RESULTS.md.
    """
    if cameras < 1:
        raise ValueError(f"cameras is {cameras}, but must be at least 1")
    if not 0.4 <= seconds <= 60.0:
        raise ValueError(f"seconds is {seconds:g}, but must be from 0.4 to 60")
    if not ways or len(set(ways)) != len(ways):
        raise ValueError(f"ways are {', '.join(ways) or 'none'}, but must be some of {', '.join(WAYS)}, each once")
    for clip in clips:
        require_file("clips", clip)
    report.ready(json, publish)
    remember_compilations()
    named = f" --clips {' '.join(clip.name for clip in clips)}" if clips else ""
    chosen = "" if ways == WAYS else f" --ways {' '.join(ways)}"
    command = f"python -m tasks.benchmarks.pose{named} --cameras {cameras} --seconds {seconds:g}{chosen} --seed {seed}"
    jobs = {
        f"{'embedded' if clip is None else clip.stem}, camera {camera}": partial(
            measured, clip, camera, seconds, ways, seed
        )
        for clip in (clips or (None,))
        for camera in range(cameras)
    }
    rows = report.collect(json, command, jobs)
    found = {way: means(rows, way) for way in ways}
    content = {"command": command, "hardware": report.hardware(), "means": found, "rows": rows}
    report.write_json(json, content)
    report.write_picture(json.with_suffix(".png"), picture(rows, ways))
    table = Table("measure", *ways, title=f"Motion from keypoints, {len(rows)} films")
    for name, (measure, unit) in TOLD.items():
        values = [f"{found[way][name]:.3g} {unit}" if name in found[way] else "" for way in ways]
        if any(values):
            table.add_row(measure, *values)
    skate = float(np.mean([row["true_foot_skate"] for row in rows]))
    table.add_row("foot skate of what was filmed", f"{skate:.3g} %", *[""] * (len(ways) - 1))
    report.show(table)
    if publish:
        report.publish("pose", f"Motion from keypoints, {len(rows)} films", command, table)


if __name__ == "__main__":
    run(main)

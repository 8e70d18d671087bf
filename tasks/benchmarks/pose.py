"""Errors of motion from keypoints: of clips filmed by synthetic cameras, of AIST++, or of one's own films."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table
from scipy.spatial.transform import Rotation

from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from larp_model.names import require_file
from mpc.gauss_newton import FACTORS
from tasks.benchmarks import report
from tasks.command import prepare_jax, run
from tasks.models import DynamicsName
from tasks.motions import skeleton
from tasks.motions.references import embedded, motion_of
from tasks.pose import aist as dances
from tasks.pose import figure as figures
from tasks.pose import joint_files, lift, metrics, physical, sources, synthetic_film
from tasks.pose.figure import SHARED
from tasks.pose.points import Keypoints, interpolated
from tasks.pose.reconstruction import reconstruct
from tasks.pose.synchronisation import resampled
from tasks.pose.views import Viewpoint, Views, places_in_all
from tasks.presets import PresetName

# Half of the points of a film may be this far from its truth, in standard deviations of its keypoints.
MAX_MISFIT = 6.0
# Frame rate of a synthetic film [1/s], and the share of it before a kick's strike.
RATE, BEFORE = 60.0, 0.63
Way = Literal["kinematic", "larp", "mujoco", "mujoco_timed"]
WAYS: tuple[Way, ...] = ("kinematic", "larp", "mujoco")
COLORS = {"kinematic": "#9aa5b1", "larp": "#1f6fb2", "mujoco": "#e69f00", "mujoco_timed": "#b3541e"}
# Figures of each way by their name in the JSON: title and unit in the table.
MEASURES = {
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
# The paper's own figures of AIST's videos, in the order of `MEASURES`: DiffPhy's (E. Gartner et al. 2022), and what
# their trajectory optimisation reaches in Bullet and in LARP.
PAPER: dict[str, tuple[float | None, ...]] = {
    "easy: DiffPhy": (150.0, 106.0, 66.0, 12.0, None, 19.6),
    "easy: Bullet": (154.0, 113.0, 69.0, 13.0, 0.41, 4.0),
    "easy: LARP": (150.0, 113.0, 70.0, 13.0, 0.37, 5.0),
    "hard: Bullet": (654.0, 437.0, 83.0, 16.0, 0.17, 8.5),
    "hard: LARP": (643.0, 442.0, 73.0, 14.0, 0.13, 7.2),
}
# 15 videos on which others compare themselves with the same works, so the paper's easy ones in all likelihood: it names
# neither these nor the hard ones.
EASY = (
    "gBR_sBM_c06_d06_mBR4_ch06", "gBR_sBM_c07_d06_mBR4_ch02", "gBR_sBM_c08_d05_mBR1_ch01", "gBR_sFM_c03_d04_mBR0_ch01",
    "gJB_sBM_c02_d09_mJB3_ch10", "gKR_sBM_c09_d30_mKR5_ch05", "gLH_sBM_c04_d18_mLH5_ch07", "gLH_sBM_c07_d18_mLH4_ch03",
    "gLH_sBM_c09_d17_mLH1_ch02", "gLH_sFM_c03_d18_mLH0_ch15", "gLO_sBM_c05_d14_mLO4_ch07", "gLO_sBM_c07_d15_mLO4_ch09",
    "gLO_sFM_c02_d15_mLO4_ch21", "gMH_sBM_c01_d24_mMH3_ch02", "gMH_sBM_c05_d24_mMH4_ch07",
)  # fmt: skip


@dataclass(frozen=True)
class FilmSettings:
    """Settings of films and of how they are reconstructed; see the arguments of `main`."""

    clips: tuple[Path, ...]
    aist: Path | None
    sequences: tuple[str, ...]
    film: tuple[Path, ...]
    cameras: tuple[Path, ...]
    rate: tuple[float, ...]
    truth: Path | None
    viewpoints: int
    together: int
    seconds: float
    ways: tuple[Way, ...]
    preset: PresetName
    seed: int

    def check(self) -> None:
        """Raise InputError if a setting is invalid, or two of them contradict each other."""
        self._check_viewpoints()
        if not 0.4 <= self.seconds <= 60.0:
            raise InputError(f"seconds is {self.seconds:g}, but must be from 0.4 to 60")
        self._check_ways()
        self._check_sources()

    def _check_viewpoints(self) -> None:
        for name, count in (("viewpoints", self.viewpoints), ("together", self.together)):
            if count < 1:
                raise InputError(f"{name} is {count}, but must be at least 1")
        if self.aist is not None and self.viewpoints > dances.CAMERAS:
            raise InputError(f"viewpoints is {self.viewpoints}, but AIST++ has {dances.CAMERAS}")
        if self.together > 1 and (self.aist is not None or self.film):
            raise InputError("together is set, but is of clips' synthetic cameras: aist and film have their own")

    def _check_ways(self) -> None:
        ways = self.ways
        if not ways or len(set(ways)) != len(ways):
            raise InputError(f"ways are {', '.join(ways) or 'none'}, but must be some of {', '.join(WAYS)}, each once")
        if "mujoco_timed" in ways and not {"larp", "mujoco"} <= set(ways[: ways.index("mujoco_timed")]):
            raise InputError("ways has mujoco_timed, but needs larp and mujoco before it, whose times it goes by")

    def _check_sources(self) -> None:
        sources = {"clips": bool(self.clips), "aist": self.aist is not None, "film": bool(self.film)}
        if sum(sources.values()) > 1:
            both = " and ".join(name for name, is_set in sources.items() if is_set)
            raise InputError(f"{both} are both set, but films are of one of them")
        if bool(self.film) != (self.truth is not None):
            raise InputError("film and truth belong together, but only one of them is set")
        if self.sequences and self.aist is None:
            raise InputError(f"sequences has {self.sequences[0]!r}, but aist, the folder they are in, is not set")
        for clip in self.clips:
            require_file("clips", clip)

    @property
    def command(self) -> str:
        """Return the command that repeats the run."""
        source = f" --clips {' '.join(clip.name for clip in self.clips)}" if self.clips else ""
        if self.aist is not None:
            source = f" --aist {self.aist.name}"
            source += f" --sequences {' '.join(self.sequences)}" if self.sequences else ""
        if self.truth is not None:
            names = {"film": self.film, "cameras": self.cameras, "truth": (self.truth,)}
            source = "".join(
                f" --{name} {' '.join(path.name for path in paths)}" for name, paths in names.items() if paths
            )
        options = "" if self.ways == WAYS else f" --ways {' '.join(self.ways)}"
        options += "" if self.preset == "balanced" else f" --preset {self.preset}"
        together = "" if self.together == 1 else f" --together {self.together}"
        films = f"{source} --viewpoints {self.viewpoints}{together} --seconds {self.seconds:g}"
        if self.film:
            films = source
        return f"python -m tasks.benchmarks.pose{films}{options} --seed {self.seed}"


class Film(NamedTuple):
    """A film to reconstruct, with its ground truth.

    clip: name. views: by cameras that are known. true: points (T, P, 3) [m], NaN where they are not known.
    """

    clip: str
    views: Views
    true: np.ndarray


def filmed_points(clip: Path | None, seconds: float) -> np.ndarray:
    """Return points (T, P, 3) [m] of some seconds around a clip's strike, or of its middle where it is no kick.

    clip: BVH or npz; the embedded kick, performed in the ground truth, by default.
    """
    if clip is None:
        reference, figure = embedded(human_and_ball()), figures.figure()
        states = reference.states[:, : len(figure.body.links)].astype(np.float32)
        points = np.asarray(physical.BodyPoints(figure.body, figure, np.zeros(SHARED)).points(states), float)
        rate, strike = 100.0, reference.strike / 100.0
    else:
        motion = motion_of(clip)
        points, rate = synthetic_film.points_of(motion), motion.rate
        kick = skeleton.toe_speed(motion).max() >= 1.5 * skeleton.SLOWEST_KICK
        strike = (skeleton.strike(motion) if kick else BEFORE * len(points)) / rate
    frame_numbers = np.arange(int((len(points) - 1) * RATE / rate) + 1)
    points = interpolated(points, rate, frame_numbers / RATE)
    count = min(round(seconds * RATE), len(points))
    first = int(np.clip(round((strike - BEFORE * seconds) * RATE), 0, len(points) - count))
    return points[first : first + count]


def film_of_clip(clip: Path | None, viewpoint: int, together: int, seconds: float, seed: int) -> Film:
    """Return films of some seconds of a clip, seen by so many synthetic cameras and detectors together."""
    true = filmed_points(clip, seconds)
    random = np.random.default_rng((seed, viewpoint))
    lenses = tuple(synthetic_film.camera_around(random, true) for _ in range(together))
    films = tuple(synthetic_film.detected(random, lens, true, RATE) for lens in lenses)
    return Film("embedded" if clip is None else clip.stem, Views(films, lenses), true)


def films_with_truth(settings: FilmSettings) -> dict[str, Callable[[], Film]]:
    """Return loaders of one's own films, by name: of each camera alone, of each two, and of all together."""
    assert settings.truth is not None
    person = sources.load(settings.film, settings.rate, camera_files=settings.cameras)
    if not person.position_known:
        raise InputError("cameras have no positions, but the truth is in the world that they are in")
    true = true_points(person.views, joint_files.load(settings.truth, grounded=False).keypoints)
    films = [*zip(settings.film, person.views.films, person.views.cameras, strict=True)]
    subsets = [subset for count in sorted({1, 2, len(films)}) for subset in combinations(films, count)]
    return {
        "+".join(path.stem for path, *_ in subset): partial(film_of_subset, [part[1:] for part in subset], true)
        for subset in subsets
    }


def film_of_subset(subset: Sequence[tuple[Keypoints, Viewpoint]], true: np.ndarray) -> Film:
    """Return a film of some of several cameras, as far as they show the person; true: points (T, P, 3) [m]."""
    views = Views(tuple(film for film, _ in subset), tuple(camera for _, camera in subset))
    shown = views.with_person()
    name = f"{len(subset)} camera{'s' if len(subset) > 1 else ''}"
    return Film(name, shown, true[views.frames_with_person[0] :][: len(shown)])


def true_points(views: Views, joints: Keypoints) -> np.ndarray:
    """Return true joints, at the times of the films' frames and turned about z as they see them.

    joints: in space, from the first film's first frame on. Their axes may be exchanged, as z is not up in every file.
    """
    at_frames = resampled(joints, views.times, views.rate).places
    places, sigma = views.places, views.sigma[:, None]

    def misfit(points: np.ndarray) -> float:
        distances = np.linalg.norm(places_in_all(views.cameras, points) - places, axis=-1) / sigma
        return float(np.nanmedian(distances)) if np.isfinite(distances).any() else np.inf

    turns = Rotation.from_euler("z", 90.0 * np.arange(4)[:, None], degrees=True).as_matrix()
    best: np.ndarray = min((at_frames @ turn for turn in turns), key=misfit)
    if misfit(best) > MAX_MISFIT:
        raise InputError(
            f"truth is {misfit(best) * float(sigma[0, 0]):.0f} px off the first film in half of its points: its world, "
            "or its first frame, is another one"
        )
    return best


def film_of_dance(folder: Path, sequence: str, camera: int, seconds: float) -> Film:
    """Return a film of the first seconds of a dance of AIST++, seen by one of its cameras."""
    name = dances.video(sequence, camera)
    keypoints, lens, true = dances.load(folder, sequence, camera)
    excerpt = Views((keypoints.cut(0, round(seconds * keypoints.rate) - 1),), (lens,))
    try:
        views = excerpt.with_person()
    except InputError as error:
        raise InputError(f"sequences has {name!r}, whose {error}") from None
    true = true[excerpt.frames_with_person[0] :][: len(views)]
    if np.isnan(metrics.pelvis(true)).any(axis=(1, 2)).all():
        raise InputError(f"sequences has {name!r}, of which no frame has both hips")
    return Film(name, views, true)


def dances_of(folder: Path, names: Sequence[str], cameras: int, seconds: float) -> dict[str, Callable[[], Film]]:
    """Return loaders of films of AIST++, by video: the videos named, and the first cameras of the sequences named.

    Loads each film once, to raise an error if one is missing or damaged.
    """
    available = sorted(dances.sequences(folder).keys() & {path.stem for path in (folder / "keypoints2d").glob("*.pkl")})
    names = names or [video for video in EASY if dances.sequence_and_camera(video)[0] in available] or available
    if not names:
        raise InputError(f"aist is {str(folder)!r}, but keypoints2d in it has no sequence that mapping.txt has")
    films: dict[str, Callable[[], Film]] = {}
    for sequence, only in map(dances.sequence_and_camera, names):
        for camera in range(cameras) if only is None else (only,):
            film = partial(film_of_dance, folder, sequence, camera, seconds)
            film()
            films[dances.video(sequence, camera)] = film
    return films


def as_fast(preset: physical.FitPreset, share: float) -> physical.FitPreset:
    """Return a preset with which each plan tries a share of the candidates, in one round."""
    steps = preset.steps
    candidates = 1 + steps.rounds * (steps.directions + len(FACTORS))
    directions = max(1, round(share * candidates) - 1 - len(FACTORS))
    return preset._replace(steps=replace(steps, rounds=1, directions=directions))


def row_of_film(film: Callable[[], Film], ways: Sequence[Way], preset: physical.FitPreset, seed: int) -> dict[str, Any]:
    """Reconstruct a film in each way and return its errors."""
    name, views, true = film()
    lifted = lift.lift(views)

    def errors_of(points: np.ndarray) -> dict[str, float]:
        return metrics.position_errors(points, true) | metrics.off_the_ground(points) | {
            "mpjpe_2d_px": metrics.pixel_error(*(places_in_all(views.cameras, shown) for shown in (points, true))),
            "velocity": metrics.velocity_error(points, true, views.rate),
            "foot_skate": metrics.foot_skate(points),
        }  # fmt: skip

    row: dict[str, Any] = {
        "clip": name,
        "cameras_m": [camera.position.tolist() for camera in views.as_images()[1]],
        "frames": len(views),
    }
    if not math.isnan(skate := metrics.foot_skate(true)):
        row["true_foot_skate"] = skate
    names: dict[Way, DynamicsName] = {"larp": "larp", "mujoco": "mujoco", "mujoco_timed": "mujoco"}
    for way in ways:
        if way == "kinematic":
            row[way] = errors_of(figures.figure().all_points(lifted.pose, lifted.proportions))
            continue
        way_preset = preset
        if way == "mujoco_timed":
            way_preset = as_fast(preset, row["larp"]["plan_seconds"] / row["mujoco"]["plan_seconds"])
        reconstruction = reconstruct(views, lifted, names[way], way_preset, seed)
        row[way] = errors_of(reconstruction.executed) | {
            "fell": 100.0 * reconstruction.fell,
            "plan_seconds": reconstruction.effort.seconds,
            "ms_per_candidate": 1e3 * reconstruction.effort.seconds / reconstruction.effort.candidates,
        }
    return row


def means(rows: list[dict[str, Any]], way: Way) -> dict[str, float]:
    """Return the mean over all films of each figure of a way."""
    return {name: float(np.mean([row[way][name] for row in rows])) for name in MEASURES if name in rows[0][way]}


def picture(rows: list[dict[str, Any]], ways: Sequence[Way]) -> Figure:
    """Plot the position errors of every film, by way."""
    figure = Figure(figsize=(9.0, 4.0), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
    for panel, name in zip(axes, ("mpjpe_g_mm", "mpjpe_mm", "mpjpe_pa_mm"), strict=True):
        for place, way in enumerate(ways):
            values = [row[way][name] for row in rows]
            panel.scatter(place + np.linspace(-0.15, 0.15, len(values)), values, s=22, color=COLORS[way])
            panel.plot([place - 0.3, place + 0.3], 2 * [np.mean(values)], color=COLORS[way], lw=2)
        panel.set(title=MEASURES[name][0], xticks=range(len(ways)), xlim=(-0.6, len(ways) - 0.4), yscale="log")
        panel.set_xticklabels([way.replace("_", "\n") for way in ways])
        panel.yaxis.set_major_formatter("{x:g}")
        panel.yaxis.set_minor_formatter("{x:g}")
    axes[0].set_ylabel("error of a film's joints [mm]; line: mean")
    return figure


def main(
    clips: tuple[Path, ...] = (),
    aist: Path | None = None,
    sequences: tuple[str, ...] = (),
    film: tuple[Path, ...] = (),
    cameras: tuple[Path, ...] = (),
    rate: tuple[float, ...] = (),
    truth: Path | None = None,
    viewpoints: int = 2,
    together: int = 1,
    seconds: float = 2.5,
    ways: tuple[Way, ...] = WAYS,
    preset: PresetName = "balanced",
    seed: int = 0,
    json: Path = Path("runs/benchmarks/pose.json"),
    publish: bool = False,
) -> None:
    """Reconstruct motion from the keypoints of films, and compare it with what was filmed.

    Args:
        clips: captured motions (BVH or npz), seen by synthetic cameras; the embedded kick by default.
        aist: folder of AIST++'s annotations, whose dances are taken instead; the paper's figures are put beside.
        sequences: of aist, by its names (gBR_sBM_cAll_d06_mBR4_ch06) or those of videos (gBR_sBM_c06_d06_mBR4_ch06,
            camera 6 alone); 15 videos that others take by default, as far as the folder has them, else all that it has.
        film: keypoints of one's own films of a person, as tasks.pose takes them; each camera is judged alone, each two,
            and all together.
        cameras: of film, as tasks.pose takes them.
        rate: of film, frames a second, as tasks.pose takes it.
        truth: joints in space (TRC, C3D or npz) of film, in the cameras' world, from its first frame on.
        viewpoints: from which each clip is filmed, somewhere around it; of aist, its first cameras.
        together: cameras that film a clip at once from each viewpoint.
        seconds: of each film, of 60 frames each; of aist, the first.
        ways: the kinematic start alone, or followed by a planner whose model is larp or mujoco, with as many candidates
            each; mujoco_timed has so few that it takes about larp's time, and comes after both.
        preset: how much a plan may cost.
        seed: of cameras, detector and planner.
        json: where the figures go; the picture goes beside them.
        publish: put the table into RESULTS.md.
    """
    settings = FilmSettings(
        clips, aist, sequences, film, cameras, rate, truth, viewpoints, together, seconds, ways, preset, seed
    )
    settings.check()
    films = films_of(settings)
    report.ready(json, publish)
    prepare_jax()
    jobs = {name: partial(row_of_film, film, ways, physical.PRESETS[preset], seed) for name, film in films.items()}
    rows = report.collect(json, settings.command, jobs)
    averages = {way: means(rows, way) for way in ways}
    content = {"command": settings.command, "hardware": report.hardware(), "means": averages, "rows": rows}
    report.write_json(json, content)
    report.write_picture(json.with_suffix(".png"), picture(rows, ways))
    for count in sorted({len(row["cameras_m"]) for row in rows}):
        show(settings, [row for row in rows if len(row["cameras_m"]) == count], count, publish)


def show(settings: FilmSettings, rows: list[dict[str, Any]], cameras: int, publish: bool) -> None:
    """Show the table of films by so many cameras at once, and put it into RESULTS.md if asked to."""
    title = f"Motion from keypoints, {settings.preset}, {len(rows)} motion{'' if len(rows) == 1 else 's'}"
    title += f" by {cameras} camera{'' if cameras == 1 else 's at once'}"
    if settings.aist is not None:
        title += " of AIST++, beside the paper's figures, of videos that it does not name"
    averages = {way: means(rows, way) for way in settings.ways}
    table = table_of(rows, averages, title, {} if settings.aist is None else PAPER)
    report.show(table)
    if publish:
        source = ["aist"] if settings.aist else ["film"] if settings.film else []
        number = [] if cameras == 1 else [f"{cameras}-cameras"]
        preset = [] if settings.preset == "balanced" else [settings.preset]
        report.publish("-".join(["pose", *source, *number, *preset]), title, settings.command, table)


def films_of(settings: FilmSettings) -> dict[str, Callable[[], Film]]:
    """Return loaders of films, by name: of AIST++, or of clips seen by synthetic cameras."""
    if settings.aist is not None:
        return dances_of(settings.aist, settings.sequences, settings.viewpoints, settings.seconds)
    if settings.film:
        return films_with_truth(settings)
    return {
        f"{'embedded' if clip is None else clip.stem}, viewpoint {viewpoint}": partial(
            film_of_clip, clip, viewpoint, settings.together, settings.seconds, settings.seed
        )
        for clip in (settings.clips or (None,))
        for viewpoint in range(settings.viewpoints)
    }


def table_of(
    rows: list[dict[str, Any]],
    averages: dict[Way, dict[str, float]],
    title: str,
    published: dict[str, tuple[float | None, ...]],
) -> Table:
    """Return a table with one line per figure: the ways' averages, and beside them those published, by source."""
    table = Table("measure", *averages, *published, title=title)
    others = [dict(zip(MEASURES, values, strict=False)) for values in published.values()]
    for name, (measure, unit) in MEASURES.items():
        cells = [f"{average[name]:.3g} {unit}" if name in average else "" for average in averages.values()]
        if any(cells):
            beside = ("" if (value := other.get(name)) is None else f"{value:g}" for other in others)
            table.add_row(measure, *cells, *beside)
    if skates := [row["true_foot_skate"] for row in rows if "true_foot_skate" in row]:
        table.add_row("foot skate of what was filmed", f"{np.mean(skates):.3g} %")
    return table


if __name__ == "__main__":
    run(main)

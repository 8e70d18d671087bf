"""Command that reconstructs a filmed person's motion from keypoints; the result is a reference for `tasks.kick`."""

from __future__ import annotations

import io
import json as text
from pathlib import Path
from typing import Annotated, Any, Literal

import jax
import numpy as np
import tyro
from rich.table import Table

from larp_model.errors import InputError
from larp_model.files import require_writable, write_whole
from tasks.command import Teller, prepare_jax, run
from tasks.models import DynamicsName
from tasks.motions import angles, bvh
from tasks.pose import figure as figures
from tasks.pose import lift, metrics, physical, sources
from tasks.pose.camera import Camera
from tasks.pose.checkpoint import Progress, fingerprint
from tasks.pose.lift import Lifted
from tasks.pose.picture import pose_picture
from tasks.pose.reconstruction import DT, Reconstruction, angles_of, overlay_of, reconstruct
from tasks.pose.views import Views, places_in_all
from tasks.presets import PresetName
from viewer import write_overlay

# Heights of people [m].
HEIGHTS = 1.3, 2.2
# A median error, in standard deviations of the points, beyond which the figure does not fit the person.
MAX_MEDIAN_ERROR = 7.5
# Feet slip less than this in films of a camera that stands still [m/s].
MAX_SLIP = 0.12


def lifted_of(views: Views, position_known: bool, height: float | None, progress: Progress, teller: Teller) -> Lifted:
    """Return the kinematic start, from the saved progress if it is there.

    position_known: whether the cameras' positions are known.
    """
    if progress.lifted is not None:
        steps_done = 0 if progress.checkpoint is None else len(progress.checkpoint.controls)
        teller(f"going on from {progress.path}, {steps_done} steps done")
        return progress.lifted
    with teller.part(f"laying a figure over {len(views)} frames"):
        lifted = lift.lift(views, position_known, height)
    progress.save(lifted)
    return lifted


def slip_of(views: Views, lifted: Lifted, teller: Teller) -> float:
    """Return the slip of the kinematic start [m/s], and warn where it, or the fit, shows that the camera moves."""
    if lifted.error > MAX_MEDIAN_ERROR * views.sigma.max():
        cause = "is it no person?" if views.in_space else "does the camera move, or is it another one?"
        teller(f"half of the points are more than {length_of(lifted.error, views)} off: {cause}")
    slip = metrics.slip(figures.figure().all_points(lifted.pose, lifted.proportions), views.rate)
    if slip > MAX_SLIP:
        teller(f"the feet slip, by {slip:.2f} m/s where they ought to stand: does the camera move, or the ground?")
    return slip


def length_of(distance: float, views: Views) -> str:
    """Return a distance [px or m] between points, as text."""
    return f"{1e3 * distance:.0f} mm" if views.in_space else f"{distance:.1f} px"


def summary_of(result: Reconstruction, slip: float) -> dict[str, Any]:
    """Return the figures of a reconstruction, entries of `summary.json`. slip: see `metrics.slip` [m/s]."""
    views, lifted, effort = result.views, result.lifted, result.effort
    distances = np.linalg.norm(places_in_all(views.cameras, result.executed) - views.places, axis=-1)
    scale, unit = (1e3, "mm") if views.in_space else (1.0, "px")
    cameras = [camera for camera in views.cameras if isinstance(camera, Camera)]
    return {
        "films": len(views.films),
        "frames": len(views),
        "rate": views.rate,
        "height_m": float(figures.figure().height(np.asarray(lifted.proportions))),
        "cameras_m": [np.asarray(camera.position, float).tolist() for camera in cameras],
        "focals_px": [float(camera.focal) for camera in cameras],
        f"kinematic_error_{unit}": scale * lifted.error,
        "slip_m_s": slip,
        "camera_seems_to_move": slip > MAX_SLIP,
        f"error_{unit}": scale * float(np.nanmedian(distances)),
        "fell": result.fell,
        "plan_seconds": effort.seconds,
        "compile_seconds": effort.compile_seconds,
        "candidates": effort.candidates,
        "candidates_lost": effort.diverged,
        "truth_rollouts": effort.verified,
    }


def table_of(summary: dict[str, Any]) -> Table:
    """Return the summary as a table for display."""
    unit = "px" if "error_px" in summary else "mm"
    error, error_before = (f"{summary[f'{name}_{unit}']:.1f} {unit}" for name in ("error", "kinematic_error"))
    table = Table("", "", title="Motion from keypoints", show_header=False)
    films = "" if summary["films"] == 1 else f" of {summary['films']} films"
    table.add_row("frames", f"{summary['frames']}{films}, {summary['frames'] / summary['rate']:.1f} s")
    table.add_row("height of the person", f"{summary['height_m']:.2f} m")
    table.add_row(
        "points off, half of them by less than",
        f"{error} ({error_before} before physics)",
    )
    table.add_row("fell", "yes" if summary["fell"] else "no")
    table.add_row("planning", f"{summary['plan_seconds']:.1f} s, {summary['candidates']} candidates")
    return table


def write(folder: Path, result: Reconstruction, summary: dict[str, Any]) -> None:
    """Write the motion, its pictures and, last, `summary.json`; of a human who fell, the kinematic start."""
    buffer = io.BytesIO()
    motion = angles_of(result.filmed.states if result.fell else result.states, result.body, DT)
    np.savez_compressed(buffer, **motion)
    write_whole(folder / "pose.npz", buffer.getvalue())
    write_whole(folder / "pose.bvh", bvh.dumps(angles.motion(**motion)).encode())
    pose_picture(result.views, result.executed, result.start, folder / "pose.png")
    write_overlay(overlay_of(result), folder / "pose.html")
    write_whole(folder / "summary.json", (text.dumps(summary, indent=2) + "\n").encode())


def main(
    keypoints: Annotated[tuple[Path, ...], tyro.conf.Positional],
    rate: tuple[float, ...] = (),
    cameras: tuple[Path, ...] = (),
    turned: Literal[0, 90, 180, 270] = 0,
    size: tuple[float, float] | None = None,
    person: int | None = None,
    points: str | None = None,
    height: float | None = None,
    dynamics: DynamicsName = "larp",
    preset: PresetName = "balanced",
    seed: int = 0,
    out: Path = Path("runs/pose"),
    quiet: bool = False,
    json: bool = False,
) -> None:
    """Motion in MuJoCo from the keypoints of films, or from joints. A run that was cut off goes on where it was.

    Args:
        keypoints: of OpenPose (a folder), AlphaPose, MMPose, MediaPipe or YOLO (JSON, or a folder of labels), or npz;
            of several cameras one each. The films may begin at different times. Or joints in space: TRC, C3D or npz.
        rate: frames a second of the film, where the file does not say; of several films one number, or each one's.
        cameras: file of the camera, which stands still: a calibration of OpenCV (YAML, JSON), EasyMocap, Pose2Sim
            (TOML), Qualisys or COLMAP, as FILE:NAME where it has several; or JSON with field_of_view (degrees) or focal
            (px), size, centre, distortion and, where they are known, position and look_at or rotation; a phone's by
            default, its height and tilt estimated. Of several films, one calibration with all cameras, or each one's.
        turned: degrees clockwise by which the images were turned after the camera was calibrated.
        size: width and height of the images (px), where neither file says.
        person: which of several in the first film, in order of appearance from 0; the one who is seen best by default.
        points: order of a person's points, such as coco, body_25 or body_25b, where it is not recognised.
        height: of the person (m); where it is not known, it is estimated by a camera whose position is, and taken to be
            1.75 m by any other.
        dynamics: the planner's model: larp or mujoco.
        preset: how much the plans may cost.
        seed: of the planner's random numbers.
        out: folder for summary.json, pose.npz and pose.bvh (each a reference for tasks.kick), pose.png,
            and pose.html, a replay under the keypoints.
        quiet: print nothing.
        json: print the summary as JSON, and all other messages on stderr.
    """
    if height is not None and not HEIGHTS[0] <= height <= HEIGHTS[1]:
        raise InputError(f"height is {height:g}, but must be from {HEIGHTS[0]:g} to {HEIGHTS[1]:g} m")
    require_writable(out, "out")
    loaded = sources.load(keypoints, rate, size, person, points, cameras, turned)
    views = loaded.views.with_person()
    prepare_jax()
    teller = Teller(quiet, json)
    for note in loaded.notes:
        teller(note)
    if loaded.crossed:
        teller(f"another person is before or behind this one in {loaded.crossed} frames: look at them in pose.png")
    camera_inputs = [np.ravel(value) for value in jax.tree.leaves(views.cameras)]
    other_inputs = loaded.position_known, height or 0.0, dynamics, repr(physical.PRESETS[preset]), seed
    inputs = fingerprint(views.places, views.confidence, views.rate, *camera_inputs, *other_inputs)
    progress = Progress(out / "unfinished.npz", inputs)
    lifted = lifted_of(views, loaded.position_known, height, progress, teller)
    slip = slip_of(views, lifted, teller)
    with teller.bar("planning and executing") as on_step:
        result = reconstruct(views, lifted, dynamics, physical.PRESETS[preset], seed, progress, on_step)
    if result.fell:
        teller("the human fell: pose.npz and pose.bvh hold the kinematic start instead, which no physics has seen")
    summary = summary_of(result, slip) | {
        "people": loaded.people,
        "crossed": loaded.crossed,
        "read": loaded.notes,
    }
    summary |= {"dynamics": dynamics, "preset": preset, "seed": seed}
    write(out, result, summary)
    progress.delete()
    teller.result(table_of(summary), summary)
    teller(f"{out}/: summary.json, pose.npz, pose.bvh, pose.png, pose.html")


def cli() -> None:
    """Run the command `larp-pose`."""
    run(main)

"""Reconstruction of a filmed person's motion from keypoints, as a human under gravity could have performed it.

A figure is fitted to the keypoints of all frames (`keypoints.lift`); from that start the motion of a servo-driven human
is planned so that its image lies on the keypoints, and the plan is executed in MuJoCo (`keypoints.physical`). The
result is a motion that `tasks.kick --reference` takes.
"""

from __future__ import annotations

import io
import json as text
import time
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from rich.table import Table
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.bodies import human, standing_height
from larp_model.engines.mujoco import SUBSTEPS, Truth
from larp_model.errors import InputError
from larp_model.files import require_writable, write_whole
from larp_model.scene import Body, Scene
from larp_model.simulator import Simulator
from mpc import Dynamics, MujocoDynamics
from mpc.loop import Checkpoint, Execution
from tasks.command import Teller, prepare_jax, run
from tasks.keypoints import camera as cameras
from tasks.keypoints import figure as figures
from tasks.keypoints import formats, lift, metrics, physical
from tasks.keypoints.kept import Kept, Spent, fingerprint
from tasks.keypoints.picture import pose_picture
from tasks.keypoints.points import Keypoints, interpolated
from tasks.models import ROWS, DynamicsName
from tasks.motions import angles, bvh
from tasks.presets import PresetName
from viewer import Overlay, write_overlay

# Time step of states and controls [s], as every scene's by default.
DT = 0.01
# Keypoints are shown so far before the points they belong to [m], or these would hide them.
BEFORE = 0.2
# Progress is saved every so many seconds.
OFTEN = 5.0
# Heights of people [m].
HEIGHTS = 1.3, 2.2
# Frames that are needed, and a median error [share of the image] beyond which the figure does not fit the person.
LEAST, ASTRAY = 10, 0.03
# Feet slip less than this in films of a camera that stands still [m/s].
SLIPPING = 0.12


def shown(keypoints: Keypoints) -> tuple[int, int]:
    """Return the first and the last frame in which a person is seen; raises InputError if too few show one."""
    frames = np.flatnonzero((keypoints.confidence > 0.3).sum(axis=1) >= 6)
    if len(frames) < LEAST:
        raise InputError(f"keypoints show 6 or more points in {len(frames)} frames, but need {LEAST} such frames")
    return int(frames[0]), int(frames[-1])


def cut(keypoints: Keypoints) -> Keypoints:
    """Return the keypoints from the first frame in which a person is seen to the last."""
    return keypoints.cut(*shown(keypoints))


def angles_of(states: np.ndarray, body: Body, dt: float) -> dict[str, Any]:
    """Return states (T, L, 13) as arguments of `motions.angles.motion`, scaled to the default human of 1.75 m."""
    smaller = standing_height(human()) / standing_height(body)
    turned = [
        Rotation.from_quat(states[:, row, packed.ORIENTATION], scalar_first=True) for row in range(len(body.links))
    ]
    angles = [(turned[joint.parent].inv() * turned[child]).as_rotvec() for child, joint, _ in body.motors]
    return {
        "rate": 1.0 / dt,
        "position": smaller * states[:, 0, packed.POSITION],
        "orientation": states[:, 0, packed.ORIENTATION],
        "angles": np.stack(angles, axis=1),
        "joints": [body.links[child].name for child, _, _ in body.motors],
    }


class Reconstruction(NamedTuple):
    """Reconstructed motion of a film, before physics and after.

    lifted: see `lift.Lifted`. body: as it was simulated. start, found: points (T, P, 3) [m] in every frame, of the
    kinematic start and of the executed motion. wanted: the kinematic start at every step. states: (N, L, 13), executed.
    spent: the cost of planning.
    """

    lifted: lift.Lifted
    body: Body
    start: np.ndarray
    found: np.ndarray
    wanted: physical.WantedMotion
    states: np.ndarray
    spent: Spent

    @property
    def fell(self) -> bool:
        """Return whether the pelvis was below half the standing height in any state."""
        return bool((self.states[:, 0, 2] < 0.5 * standing_height(self.body)).any())


def reconstruct(
    film: Keypoints,
    lifted: lift.Lifted,
    dynamics: DynamicsName = "larp",
    preset: physical.FitPreset = physical.PRESETS["balanced"],
    seed: int = 0,
    kept: Kept | None = None,
    at: Callable[[int, int], None] = lambda step, steps: None,
) -> Reconstruction:
    """Plan and execute the physical motion from the kinematic start, with LARP or MuJoCo as the planner's model.

    preset: the cost of a plan. kept: the saved progress to go on from, and to save progress in. at: called after every
    step, with the number of steps done and of all.
    """
    figure = figures.figure()
    body = figure.of(lifted.proportions)
    scene = Scene((body,), dt=DT)
    model: Dynamics
    truth: Dynamics | None = None
    if dynamics == "mujoco":
        model = MujocoDynamics(Truth(scene, ROWS, SUBSTEPS))
    else:
        model, truth = Simulator.of_physics(scene), MujocoDynamics(Truth(scene, 1, SUBSTEPS))
    wanted = physical.wanted_of(scene, figure, lifted, film)
    points = physical.Seen(body, figure, lifted.proportions)
    sigma = lift.noise(film, lifted.camera)
    planner = physical.planner_of(scene, points, lifted.camera, sigma, model, preset, truth)
    spent, counted, saved = Spent() if kept is None else kept.spent, 0, time.monotonic()

    def observe(execution: Execution) -> None:
        nonlocal spent, counted, saved
        for plan in execution.plans[counted:]:
            spent = spent.and_by(plan.info)
        counted = len(execution.plans)
        if kept is not None and counted and time.monotonic() - saved > OFTEN:
            kept.keep(lifted, Checkpoint.of(execution), spent)
            saved = time.monotonic()
        at(len(execution.controls), len(wanted.states) - 1)

    begun, state = None if kept is None else kept.begun, physical.started(scene, wanted)
    execution = physical.fit(scene, planner, wanted, state, preset.every, seed, observe, begun)
    states = np.stack(execution.states)
    executed = np.asarray(points.points(states.astype(np.float32)), float)
    found = interpolated(executed, 1.0 / scene.dt, film.times)
    start = figure.all_points(lifted.pose, lifted.proportions)
    return Reconstruction(lifted, body, start, found, wanted, states, spent)


def overlay_of(film: Keypoints, made: Reconstruction) -> Overlay:
    """Return the motion under the keypoints, for a page."""
    lens = made.lifted.camera
    position, turn = np.asarray(lens.position, float), np.asarray(lens.turn, float)
    depth = (made.found - position) @ turn[2]
    places = np.where(film.seen[..., None], film.places, np.nan), lens.project(made.found)
    seen, found = (position + (depth - BEFORE)[..., None] * lens.ray(each) for each in places)
    ahead = position + float(np.median(depth)) * lens.ray(np.asarray(lens.centre, float))
    return Overlay(
        Scene((made.body,), dt=DT), made.states, made.wanted.states, seen, found, film.rate, (position, ahead),
        2.0 * float(np.arctan(np.asarray(lens.centre)[1] / lens.focal)),
        summary=(f"{len(film)} frames, {len(film) / film.rate:.1f} s", "fell" if made.fell else "did not fall"),
    )  # fmt: skip


def main(
    keypoints: Annotated[Path, tyro.conf.Positional],
    rate: float | None = None,
    camera: Path | None = None,
    size: tuple[float, float] | None = None,
    person: int | None = None,
    height: float | None = None,
    dynamics: DynamicsName = "larp",
    preset: PresetName = "balanced",
    seed: int = 0,
    out: Path = Path("runs/pose"),
    quiet: bool = False,
    json: bool = False,
) -> None:
    """Motion in 3D from the 2D keypoints of a film. A run that was cut off goes on where it was.

    Args:
        keypoints: of OpenPose (a folder), AlphaPose, MMPose or MediaPipe (JSON), or npz.
        rate: frames a second of the film, where the file does not say.
        camera: JSON file of the camera, which stands still: field_of_view (degrees) or focal (px), size, and, where it
            is known, position and look_at; a phone's by default, its height and tilt estimated.
        size: width and height of the images (px), where neither file says.
        person: which of several, in order of appearance from 0; the one who is seen best by default.
        height: of the person (m); where it is not known, it is estimated by a camera whose position is, and taken to be
            1.75 m by any other.
        dynamics: the planner's model: larp or mujoco.
        preset: how much the plans may cost.
        seed: of the planner's random numbers.
        out: folder for summary.json, pose.npz and pose.bvh (each a reference for tasks.kick), pose.png,
            and pose.html, a replay under the keypoints.
        quiet: print nothing.
        json: print the summary as JSON, and on stderr what else is told.
    """
    if height is not None and not HEIGHTS[0] <= height <= HEIGHTS[1]:
        raise InputError(f"height is {height:g}, but must be from {HEIGHTS[0]:g} to {HEIGHTS[1]:g} m")
    require_writable(out, "out")
    loaded = formats.load(keypoints, rate, size, person)
    film = cut(loaded.keypoints)
    if camera is not None:
        lens, known = cameras.load(camera, film.size)
    elif film.size is None:
        raise InputError("size is not known, but the images' width and height are needed, or a camera file with them")
    else:
        lens, known = cameras.held(cameras.focal_length(cameras.FIELD_OF_VIEW, film.size[0]), film.size), False
    prepare_jax()
    tell = Teller(quiet, json)
    if loaded.crossed:
        tell(f"another person is before or behind this one in {loaded.crossed} frames: look at them in pose.png")
    given = (
        film.places,
        film.confidence,
        film.rate,
        lens.focal,
        lens.centre,
        lens.turn,
        lens.position,
        known,
        height or 0.0,
        dynamics,
        repr(physical.PRESETS[preset]),
        seed,
    )
    kept = Kept(out / "unfinished.npz", fingerprint(*given))
    if kept.lifted is None:
        with tell.part(f"laying a figure over {len(film)} frames"):
            lifted = lift.lift(film, lens, known, height)
        kept.keep(lifted)
    else:
        lifted = kept.lifted
        tell(f"going on from {out}/unfinished.npz, {0 if kept.begun is None else len(kept.begun.controls)} steps done")
    image = 2.0 * np.asarray(lens.centre)
    if lifted.error > ASTRAY * image.max():
        tell(f"half of the points are more than {lifted.error:.0f} px off: does the camera move, or is it another one?")
    slip = metrics.slip(figures.figure().all_points(lifted.pose, lifted.proportions), film.rate)
    if slip > SLIPPING:
        tell(f"the feet slip, by {slip:.2f} m/s where they ought to stand: does the camera move, or the ground?")
    with tell.bar("planning and executing") as at:
        made = reconstruct(film, lifted, dynamics, physical.PRESETS[preset], seed, kept, at)
    apart = np.linalg.norm(lifted.camera.project(made.found) - film.places, axis=-1)[film.seen]
    summary = {
        "frames": len(film),
        "rate": film.rate,
        "people": loaded.people,
        "crossed": loaded.crossed,
        "height_m": float(figures.figure().height(np.asarray(lifted.proportions))),
        "camera_m": np.asarray(lifted.camera.position, float).tolist(),
        "focal_px": float(lifted.camera.focal),
        "kinematic_error_px": lifted.error,
        "slip_m_s": slip,
        "camera_seems_to_move": slip > SLIPPING,
        "error_px": float(np.median(apart)),
        "fell": made.fell,
        "plan_seconds": made.spent.seconds,
        "compile_seconds": made.spent.compile_seconds,
        "candidates": made.spent.candidates,
        "candidates_lost": made.spent.lost,
        "truth_rollouts": made.spent.verified,
        "dynamics": dynamics,
        "preset": preset,
        "seed": seed,
    }
    if made.fell:
        tell("the human fell: pose.npz and pose.bvh hold the kinematic start instead, which no physics has seen")
    told = Table("", "", title="Motion from keypoints", show_header=False)
    told.add_row("frames", f"{len(film)}, {len(film) / film.rate:.1f} s")
    told.add_row("height of the person", f"{summary['height_m']:.2f} m")
    told.add_row(
        "points off, half of them by less than", f"{summary['error_px']:.1f} px ({lifted.error:.1f} px before physics)"
    )
    told.add_row("fell", "yes" if made.fell else "no")
    told.add_row("planning", f"{summary['plan_seconds']:.1f} s, {summary['candidates']} candidates")
    buffer, motion = io.BytesIO(), angles_of(made.wanted.states if made.fell else made.states, made.body, DT)
    np.savez_compressed(buffer, **motion)
    write_whole(out / "pose.npz", buffer.getvalue())
    write_whole(out / "pose.bvh", bvh.dumps(angles.motion(**motion)).encode())
    pose_picture(film, lifted.camera, made.found, made.start, out / "pose.png")
    write_overlay(overlay_of(film, made), out / "pose.html")
    write_whole(out / "summary.json", (text.dumps(summary, indent=2) + "\n").encode())
    kept.done()
    tell.result(told, summary)
    tell(f"{out}/: summary.json, pose.npz, pose.bvh, pose.png, pose.html")


def cli() -> None:
    """Run the command `larp-pose`."""
    run(main)


if __name__ == "__main__":
    cli()

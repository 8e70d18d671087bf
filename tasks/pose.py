"""Motion from keypoints: what a person did in a film, as a human under gravity could have done it.

A figure is laid over the keypoints of all frames (`keypoints.lift`); from there a servo-driven human is planned so that
its image lies on the keypoints, and the plan is executed in MuJoCo (`keypoints.physical`). What comes out is a motion
that `tasks.kick --reference` takes.
"""

from __future__ import annotations

import io
import json as text
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import tyro
from rich.table import Table
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model import weights as stored
from larp_model.bodies import human, standing_height
from larp_model.files import require_writable, write_whole
from larp_model.scene import Body, Scene
from larp_model.simulator import Simulator
from larp_model.truth.mujoco import SUBSTEPS, Truth
from mpc import Dynamics, GaussNewton, MujocoDynamics, PlanInfo
from tasks.command import Teller, remember_compilations, run
from tasks.keypoints import camera as cameras
from tasks.keypoints import formats, lift, physical
from tasks.keypoints.picture import pose_picture
from tasks.keypoints.points import Keypoints
from tasks.models import ROWS, DynamicsName
from tasks.motions import angles, bvh
from tasks.scenarios import ANY_HUMAN

# Of each plan.
STEPS = GaussNewton(rounds=2, directions=32)
# Of states and controls [s], as every scene's by default.
DT = 0.01
# Frames that are needed, and a median error [shares of the image] beyond which the figure does not fit the person.
LEAST, ASTRAY = 10, 0.03


def simulated(figure: lift.Figure, proportions: np.ndarray, manifest: Path) -> Body:
    """The human of these proportions, each link as near to them as the weights know."""
    body = figure.of(proportions)
    known = stored.trained_sizes(text.loads(manifest.read_bytes()))[body.kind]
    return body.sized(np.clip(body.sizes, *known))


def cut(keypoints: Keypoints) -> Keypoints:
    """The frames from the first in which a person is seen to the last; refuses what shows too little."""
    shown = np.flatnonzero((keypoints.confidence > 0.3).sum(axis=1) >= 6)
    if len(shown) < LEAST:
        raise ValueError(f"keypoints show 6 or more points in {len(shown)} frames, but need {LEAST} such frames")
    return keypoints.cut(int(shown[0]), int(shown[-1]))


def angles_of(states: np.ndarray, body: Body, dt: float) -> dict[str, Any]:
    """States (T, L, 13) as arguments of `motions.angles.motion`: those of our human of 1.75 m, as it would move."""
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
    """What a film shows, before physics and after.

    lifted: see `lift.Lifted`. body: as it was simulated. start, found: points (T, P, 3) [m] in every frame, of the
    kinematic start and of what was executed. wanted: the start at every step. states: (N, L, 13), executed. plans: what
    each planning step found out.
    """

    lifted: lift.Lifted
    body: Body
    start: np.ndarray
    found: np.ndarray
    wanted: physical.Wanted
    states: np.ndarray
    plans: list[PlanInfo]

    @property
    def fell(self) -> bool:
        """Whether the pelvis was below half its standing height."""
        return bool((self.states[:, 0, 2] < 0.5 * standing_height(self.body)).any())


def reconstruct(film: Keypoints, lifted: lift.Lifted, dynamics: DynamicsName = "larp", seed: int = 0) -> Reconstruction:
    """The physical motion from the kinematic start on, by a planner whose model is LARP or MuJoCo."""
    manifest, figure = stored.SHIPPED / f"{ANY_HUMAN['lean']}.json", lift.figure()
    body = simulated(figure, lifted.proportions, manifest)
    scene = Scene((body,), dt=DT)
    model: Dynamics
    if dynamics == "larp":
        model = Simulator(*stored.load(manifest, scene)[:2])
    else:
        model = MujocoDynamics(Truth(scene, ROWS, SUBSTEPS))
    wanted = physical.wanted_of(scene, figure, lifted, film)
    points = physical.Seen(body, figure, lifted.proportions)
    sigma = lift.PIXELS * 2.0 * float(np.max(lifted.camera.centre))
    planner = physical.planner_of(scene, points, lifted.camera, sigma, model, (STEPS,))
    execution = physical.fit(scene, planner, wanted, physical.started(scene, wanted), seed)
    states = np.stack(execution.states)
    at = np.minimum(np.rint(np.arange(len(film)) / film.rate / scene.dt).astype(int), len(states) - 1)
    return Reconstruction(
        lifted, body, figure.all_points(lifted.pose, lifted.proportions),
        np.asarray(points.points(states[at].astype(np.float32)), float), wanted, states,
        [replan.info for replan in execution.replans],
    )  # fmt: skip


def main(
    keypoints: Annotated[Path, tyro.conf.Positional],
    rate: float | None = None,
    camera: Path | None = None,
    size: tuple[float, float] | None = None,
    person: int | None = None,
    dynamics: DynamicsName = "larp",
    seed: int = 0,
    out: Path = Path("runs/pose"),
    quiet: bool = False,
    json: bool = False,
) -> None:
    """Motion in 3D from the 2D keypoints of a film.

    Args:
        keypoints: of OpenPose (a folder), AlphaPose, MMPose or MediaPipe (JSON), or npz.
        rate: frames a second of the film, where the file does not say.
        camera: JSON file of the camera, which stands still: field_of_view (degrees) or focal (px), size, and, where it
            is known, position and look_at; a phone's by default, its height and tilt estimated.
        size: width and height of the images (px), where neither file says.
        person: which of several, in order of appearance from 0; the one who is seen best by default.
        dynamics: the planner's model: larp (learned) or mujoco.
        seed: of the planner's random numbers.
        out: folder for summary.json, pose.npz and pose.bvh (each a reference for tasks.kick), and pose.png.
        quiet: print nothing.
        json: print the summary as JSON, and on stderr what else is told.
    """
    require_writable(out, "out")
    loaded = formats.load(keypoints, rate, size, person)
    film = cut(loaded.keypoints)
    if camera is not None:
        lens, known = cameras.load(camera, film.size)
    elif film.size is None:
        raise ValueError("size is not known, but the images' width and height are needed, or a camera file with them")
    else:
        lens, known = cameras.held(cameras.focal_length(cameras.FIELD_OF_VIEW, film.size[0]), film.size), False
    remember_compilations()
    tell = Teller(quiet, json)
    if loaded.crossed:
        tell(f"another person is before or behind this one in {loaded.crossed} frames: look at them in pose.png")
    with tell.part(f"laying a figure over {len(film)} frames"):
        lifted = lift.lift(film, lens, known)
    image = 2.0 * np.asarray(lens.centre)
    if lifted.error > ASTRAY * image.max():
        tell(f"half of the points are more than {lifted.error:.0f} px off: does the camera move, or is it another one?")
    tell("planning and executing; what is new is compiled first")
    made = reconstruct(film, lifted, dynamics, seed)
    apart = np.linalg.norm(lifted.camera.project(made.found) - film.places, axis=-1)[film.seen]
    summary = {
        "frames": len(film),
        "rate": film.rate,
        "people": loaded.people,
        "crossed": loaded.crossed,
        "height_m": 1.75 * standing_height(made.body) / standing_height(human()),
        "camera_m": np.asarray(lifted.camera.position, float).tolist(),
        "focal_px": float(lifted.camera.focal),
        "kinematic_error_px": lifted.error,
        "error_px": float(np.median(apart)),
        "fell": made.fell,
        "plan_seconds": float(sum(info.seconds for info in made.plans)),
        "compile_seconds": float(sum(info.compile_seconds for info in made.plans)),
        "candidates": int(sum(info.candidates for info in made.plans)),
        "candidates_lost": int(sum(info.candidates - info.finite for info in made.plans)),
        "dynamics": dynamics,
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
    tell.result(told, summary)
    buffer, given = io.BytesIO(), angles_of(made.wanted.states if made.fell else made.states, made.body, DT)
    np.savez_compressed(buffer, **given)
    write_whole(out / "pose.npz", buffer.getvalue())
    write_whole(out / "pose.bvh", bvh.dumps(angles.motion(**given)).encode())
    pose_picture(film, lifted.camera, made.found, made.start, out / "pose.png")
    write_whole(out / "summary.json", (text.dumps(summary, indent=2) + "\n").encode())
    tell(f"{out}/: summary.json, pose.npz, pose.bvh, pose.png")


def cli() -> None:
    """The command `larp-pose`."""
    run(main)


if __name__ == "__main__":
    cli()

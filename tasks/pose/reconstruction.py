"""Reconstruction of a filmed person's motion from keypoints, as a human under gravity could have performed it.

A figure is fitted to the keypoints of all frames (`lift`); from that start the motion of a servo-driven human is
planned so that its image lies on the keypoints, and the plan is executed in MuJoCo (`physical`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.bodies import human, standing_height
from larp_model.engines.mujoco import SUBSTEPS, Truth
from larp_model.errors import InputError
from larp_model.scene import Body, Scene
from larp_model.simulator import Simulator
from mpc import Dynamics, MujocoDynamics
from mpc.loop import Checkpoint, Execution
from tasks.models import ROWS, DynamicsName
from tasks.pose import figure as figures
from tasks.pose import lift, physical
from tasks.pose.checkpoint import Progress, Spent
from tasks.pose.points import Keypoints, interpolated
from viewer import Overlay

# Time step of states and controls [s], as every scene's by default.
DT = 0.01
# Keypoints are shown so far before the points they belong to [m], or these would hide them.
BEFORE = 0.2
# Progress is saved every so many seconds.
OFTEN = 5.0
# Frames that are needed.
LEAST = 10


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
    progress: Progress | None = None,
    at: Callable[[int, int], None] = lambda step, steps: None,
) -> Reconstruction:
    """Plan and execute the physical motion from the kinematic start, with LARP or MuJoCo as the planner's model.

    preset: the cost of a plan. progress: to continue from, and to save progress in. at: called after every
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
    spent, counted, saved = Spent() if progress is None else progress.spent, 0, time.monotonic()

    def observe(execution: Execution) -> None:
        nonlocal spent, counted, saved
        for plan in execution.plans[counted:]:
            spent = spent.and_by(plan.info)
        counted = len(execution.plans)
        if progress is not None and counted and time.monotonic() - saved > OFTEN:
            progress.save(lifted, Checkpoint.of(execution), spent)
            saved = time.monotonic()
        at(len(execution.controls), len(wanted.states) - 1)

    checkpoint, state = None if progress is None else progress.checkpoint, physical.started(scene, wanted)
    execution = physical.fit(scene, planner, wanted, state, preset.interval, seed, observe, checkpoint)
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

"""Reconstruction of a filmed person's motion from keypoints, as a human under gravity could have performed it.

A figure is fitted to the keypoints of all frames (`lift`); from that start the motion of a servo-driven human is
planned so that its image lies on the keypoints, and the plan is executed in MuJoCo (`physical`).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from larp_model import state as packed
from larp_model.bodies import human, standing_height
from larp_model.engines.mujoco import SUBSTEPS, Truth
from larp_model.scene import Body, Scene
from larp_model.simulator import Simulator
from mpc import Dynamics, MujocoDynamics
from mpc.loop import Checkpoint, Execution
from tasks.models import ROWS, DynamicsName
from tasks.pose import figure as figures
from tasks.pose import lift, physical
from tasks.pose.checkpoint import PlanningEffort, Progress
from tasks.pose.points import interpolated
from tasks.pose.views import Views
from viewer import Overlay

# Time step of states and controls [s], as every scene's by default.
DT = 0.01
# Keypoints are shown this far before the points they belong to [m], or these would hide them.
OVERLAY_DISTANCE = 0.2
# Time between saves of the progress [s].
SAVE_INTERVAL = 5.0


def angles_of(states: np.ndarray, body: Body, dt: float) -> dict[str, Any]:
    """Return states (T, L, 13) as arguments of `motions.angles.motion`, scaled to the default human of 1.75 m."""
    height_ratio = standing_height(human()) / standing_height(body)
    return {
        "rate": 1.0 / dt,
        "position": height_ratio * states[:, 0, packed.POSITION],
        "orientation": states[:, 0, packed.ORIENTATION],
        "angles": body.angles(states[..., packed.ORIENTATION]),
        "joints": [body.links[child].name for child, _, _ in body.motors],
    }


class Reconstruction(NamedTuple):
    """Reconstructed motion of a film, before physics and after.

    views: by cameras as estimated. lifted: see `lift.Lifted`. body: as it was simulated. start, executed: points
    (T, P, 3) [m] in every frame, of the kinematic start and of the executed motion. filmed: the kinematic start at
    every step. states: (N, L, 13), executed. effort: the cost of planning.
    """

    views: Views
    lifted: lift.Lifted
    body: Body
    start: np.ndarray
    executed: np.ndarray
    filmed: physical.FilmedMotion
    states: np.ndarray
    effort: PlanningEffort

    @property
    def fell(self) -> bool:
        """Return whether the pelvis was below half the standing height in any state."""
        return bool((self.states[:, 0, 2] < 0.5 * standing_height(self.body)).any())


def reconstruct(
    views: Views,
    lifted: lift.Lifted,
    dynamics: DynamicsName = "larp",
    preset: physical.FitPreset = physical.PRESETS["balanced"],
    seed: int = 0,
    progress: Progress | None = None,
    on_step: Callable[[int, int], None] = lambda step, steps: None,
) -> Reconstruction:
    """Plan and execute the physical motion from the kinematic start, with LARP or MuJoCo as the planner's model.

    preset: the cost of a plan. progress: to continue from, and to save progress in. on_step: called after every
    step, with the number of steps done and of all.
    """
    views, figure = views.corrected(lifted.corrections), figures.figure()
    body = figure.body_of(lifted.proportions)
    scene = Scene((body,), dt=DT)
    model: Dynamics
    truth: Dynamics | None = None
    if dynamics == "mujoco":
        model = MujocoDynamics(Truth(scene, ROWS, SUBSTEPS))
    else:
        model, truth = Simulator.of_physics(scene), MujocoDynamics(Truth(scene, 1, SUBSTEPS))
    filmed = physical.filmed_motion(scene, figure, lifted, views)
    body_points = physical.BodyPoints(body, figure, lifted.proportions)
    planner = physical.planner_of(scene, body_points, views.cameras, views.sigma, model, preset, truth)
    effort, plans_counted, save_time = PlanningEffort() if progress is None else progress.effort, 0, time.monotonic()

    def observe(execution: Execution) -> None:
        nonlocal effort, plans_counted, save_time
        for plan in execution.plans[plans_counted:]:
            effort = effort.plus(plan.info)
        plans_counted = len(execution.plans)
        if progress is not None and plans_counted and time.monotonic() - save_time > SAVE_INTERVAL:
            progress.save(lifted, Checkpoint.of(execution), effort)
            save_time = time.monotonic()
        on_step(len(execution.controls), len(filmed.states) - 1)

    checkpoint, state = None if progress is None else progress.checkpoint, physical.initial_state(scene, filmed)
    execution = physical.fit(scene, planner, filmed, state, preset.interval, seed, observe, checkpoint)
    states = np.stack(execution.states)
    points_at_steps = np.asarray(body_points.points(states.astype(np.float32)), float)
    executed = interpolated(points_at_steps, 1.0 / scene.dt, views.times)
    start = figure.all_points(lifted.pose, lifted.proportions)
    return Reconstruction(views, lifted, body, start, executed, filmed, states, effort)


def overlay_of(result: Reconstruction) -> Overlay:
    """Return the motion under the keypoints of the first film, for a page."""
    (film, *_), (camera, *_) = result.views.as_images()
    position, turn = np.asarray(camera.position, float), np.asarray(camera.turn, float)
    depth = (result.executed - position) @ turn[2]
    places = np.where(film.detected[..., None], film.places, np.nan), camera.project(result.executed)
    detected, executed = (
        position + (depth - OVERLAY_DISTANCE)[..., None] * camera.ray(image_places) for image_places in places
    )
    target = position + float(np.median(depth)) * camera.ray(np.asarray(camera.centre, float))
    return Overlay(
        Scene((result.body,), dt=DT), result.states, result.filmed.states, detected, executed, film.rate,
        (position, target), 2.0 * float(np.arctan(np.asarray(camera.centre)[1] / camera.focal)),
        summary=(f"{len(film)} frames, {len(film) / film.rate:.1f} s", "fell" if result.fell else "did not fall"),
    )  # fmt: skip

"""Physical fit: a servo-driven human whose projection lies on the keypoints, executed in the ground truth.

    minimise over theta   w_2 sum_i,t c_it |project(p_i(t)) - y_it|^2      points lie where the detector saw them
                        + w_x sum_i,t |x_i(t) - x_i^start(t)|^2           links stay near the kinematic start
                        + w_v sum_i,t |x_i'(t) - x_i^start'(t)|^2         and move as fast
                        + w_s sum_f,t a_ft |p_f'(t)|^2                    feet that stand stay
                        + w_e |Q - Q^start|^2                             joint targets stay near the start's
                        + w_d |Q''|^2                                     and are smooth
    subject to            S_{t+1} = dynamics(S_t, Q_t),  Q = Q^start + spline(theta)

in overlapping windows, each from the state that the ground truth has reached, warm-started by the last. The dynamics
are LARP or MuJoCo; the result is the motion in MuJoCo.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation, Slerp

from larp_model import state as packed
from larp_model.engines.mujoco import Truth, closed
from larp_model.rotation import matrix
from larp_model.scene import Body, Scene, anchor
from mpc import CostTerm, Dynamics, GaussNewton, Optimizer, Planner, Verified, Window, quadratic
from mpc.loop import Checkpoint, Execution, Phase, execute
from tasks.exploration import exploration_std
from tasks.motions.references import clearance, with_angular_velocities, with_servo_lead
from tasks.motions.skeleton import sampled_times
from tasks.pose.figure import Figure, Pose
from tasks.pose.lift import STANDING_SPEED, Lifted
from tasks.pose.points import FEET, POINTS, interpolated
from tasks.pose.views import OUTLIER, Viewpoint, Views, places_in_all
from tasks.presets import PresetName

# Spread of a first plan, as a share of the training data's spread around its motions.
SPREAD_SHARE = 0.5
# Scales of the costs: distance [m] and velocity [m/s] from the kinematic start's, a standing foot's speed [m/s].
POSITION_SCALE, VELOCITY_SCALE, FOOT_SPEED_SCALE = 0.05, 0.5, 0.3


class FitPreset(NamedTuple):
    """Budget of a fit: horizon of a plan [steps] and its knots, its optimiser, steps between plans.

    verify: rounds in which each plan of a learned model is executed in the ground truth and corrected.
    """

    horizon: int
    knots: int
    steps: GaussNewton
    interval: int = 5
    verify: int = 0

    def optimizers(self, truth: Dynamics | None) -> tuple[Optimizer, ...]:
        """Return the optimisers of a plan; truth: the ground truth that verifies a model's plans, if any."""
        if truth is None or not self.verify:
            return (self.steps,)
        return self.steps, Verified(truth, replace(self.steps, rounds=1), self.verify, candidates=1)


# With a horizon of only half a second, a plan notices too late that a start leans too far, and the human falls. A plan
# has so many unknowns that more directions bring it nearer than more rounds.
PRESETS: dict[PresetName, FitPreset] = {
    "fast": FitPreset(80, 11, GaussNewton(rounds=2, directions=48)),
    "balanced": FitPreset(80, 17, GaussNewton(rounds=4, directions=192)),
    "accurate": FitPreset(80, 17, GaussNewton(rounds=2, directions=192), verify=6),
}


class FilmedMotion(NamedTuple):
    """Motion that a film shows, at each of N steps.

    states (N, L, 13) and targets (N, J, 3) [rad] of the kinematic start; places (N, C, P, 2 or 3) and weights (N, C, P)
    of the keypoints of C cameras; standing (N, 4), from 0 to 1, how likely heels and toes stand.
    """

    states: np.ndarray
    targets: np.ndarray
    places: np.ndarray
    weights: np.ndarray
    standing: np.ndarray


def filmed_motion(scene: Scene, figure: Figure, lifted: Lifted, views: Views) -> FilmedMotion:
    """Return the kinematic start and the keypoints, resampled to the steps of the scene."""
    human = scene.human
    frame_times, rate = views.times, views.rate
    times = sampled_times(len(views), rate, scene.dt)
    place = interpolated(lifted.pose.place, rate, times)
    root = Slerp(frame_times, Rotation.from_matrix(lifted.pose.turn))(times)
    angles = np.clip(interpolated(lifted.pose.angles, rate, times), figure.lower, figure.upper)
    states = np.zeros((len(times), len(human.links), packed.SIZE))
    states[..., packed.ORIENTATION] = human.pose(root.as_quat(scalar_first=True), angles)
    states[:, 0, packed.POSITION] = place
    states[:, 0, packed.VELOCITY] = np.gradient(place, scene.dt, axis=0)
    states = closed(scene, with_angular_velocities(states, scene.dt))

    places_detected, confidence = np.nan_to_num(views.places), views.confidence
    places_of_figure = places_in_all(views.cameras, figure.all_points(lifted.pose, lifted.proportions))
    distances = np.linalg.norm(places_of_figure - places_detected, axis=-1) / views.sigma[:, None]
    weights = confidence / (1.0 + (distances / OUTLIER) ** 2) ** 2
    nearest = np.minimum(np.rint(times * rate).astype(int), len(views) - 1)
    places = interpolated(np.where((confidence > 0.0)[..., None], places_detected, places_of_figure), rate, times)
    points = figure.all_points(Pose(place, root.as_matrix(), angles), lifted.proportions)[:, FEET]
    speed = np.linalg.norm(np.gradient(points, scene.dt, axis=0), axis=-1)
    standing = (
        np.exp(-((np.maximum(points[..., 2] - 0.03, 0.0) / 0.05) ** 2)) / (1.0 + (speed / STANDING_SPEED) ** 2) ** 2
    )
    return FilmedMotion(states, with_servo_lead(scene, angles), places, weights[nearest], standing)


class BodyPoints:
    """Places of `POINTS` on the links of a scene's human."""

    def __init__(self, human: Body, figure: Figure, proportions: np.ndarray) -> None:
        """Place the points; human: as simulated, its sizes may differ from those of the figure of these proportions."""
        sizes = np.asarray(figure.scaled(jnp.asarray(proportions)), float)
        self.links, local = np.array([figure.anchors[name][0] for name in POINTS]), []
        for name in POINTS:
            link, anchor_point = figure.anchors[name]
            axis, joint = human.links[link].axis, human.joints[link - 1].child_anchor
            on_human, on_figure = (
                [anchor(point, np.array(length), np.array(radius), axis) for point in (joint, anchor_point)]
                for length, radius in (human.sizes[link, :2], sizes[link])
            )
            local.append(on_human[0] + on_figure[1] - on_figure[0])  # as far from its joint as on the figure
        self.local = np.array(local)
        self.torso = figure.torso
        self.shoulder_shift = (
            proportions[-1] * sizes[figure.torso, 0] * np.array(["shoulder" in name for name in POINTS], float)
        )

    def points(self, states: Any) -> Any:
        """Return the points (*, P, 3) [m] of states (*, L, 13)."""
        rotations = matrix(packed.orientation(states))
        points = packed.position(states)[..., self.links, :]
        points = points + jnp.einsum(
            "...pij,pj->...pi", rotations[..., self.links, :, :], jnp.asarray(self.local, states.dtype)
        )
        return points + jnp.asarray(self.shoulder_shift, states.dtype)[:, None] * rotations[..., self.torso, None, :, 0]


def terms_of(
    body_points: BodyPoints, cameras: tuple[Viewpoint, ...], sigma: np.ndarray, dt: float
) -> tuple[CostTerm, ...]:
    """Return the named cost terms of a candidate; sigma: standard deviation (C,) of each camera's keypoints."""
    feet = np.array(FEET)

    def image(states: Array, controls: Array, context: FilmedMotion) -> Array:
        images = places_in_all(cameras, body_points.points(states))
        distances = (images - context.places) / jnp.asarray(sigma, states.dtype)[:, None, None]
        return (jnp.sqrt(context.weights)[..., None] * jnp.clip(distances, -30.0, 30.0)).reshape(len(states), -1)

    def near(states: Array, controls: Array, context: FilmedMotion) -> Array:
        return ((packed.position(states) - context.states[..., packed.POSITION]) / POSITION_SCALE).reshape(
            len(states), -1
        )

    def pace(states: Array, controls: Array, context: FilmedMotion) -> Array:
        return ((packed.velocity(states) - context.states[..., packed.VELOCITY]) / VELOCITY_SCALE).reshape(
            len(states), -1
        )

    def slip(states: Array, controls: Array, context: FilmedMotion) -> Array:
        points = body_points.points(states)[:, feet]
        scaled_velocity = (points[1:] - points[:-1]) / (dt * FOOT_SPEED_SCALE)
        residual: Array = (context.standing[1:, :, None] * scaled_velocity).reshape(len(scaled_velocity), -1)
        return residual

    def effort(states: Array, controls: Array, context: FilmedMotion) -> Array:
        return (controls - context.targets).reshape(len(controls), -1)

    def smooth(states: Array, controls: Array, context: FilmedMotion) -> Array:
        second = controls[2:] - 2.0 * controls[1:-1] + controls[:-2]
        return (second / 0.02).reshape(len(second), -1)

    return (
        CostTerm("image", image, quadratic, 0.3),
        CostTerm("near", near, quadratic, 1.0),
        CostTerm("pace", pace, quadratic, 1.0),
        CostTerm("slip", slip, quadratic, 0.3),
        CostTerm("effort", effort, quadratic, 0.5),
        CostTerm("smooth", smooth, quadratic, 0.1),
    )


def planner_of(
    scene: Scene, body_points: BodyPoints, cameras: tuple[Viewpoint, ...], sigma: np.ndarray, dynamics: Dynamics,
    preset: FitPreset, truth: Dynamics | None = None,
) -> Planner:  # fmt: skip
    """Return a planner with the costs of `terms_of`.

    sigma: see there. truth: see `FitPreset.optimizers`.
    """
    return Planner(
        dynamics, terms_of(body_points, cameras, sigma, scene.dt), preset.horizon, preset.knots, scene.dt,
        SPREAD_SHARE * exploration_std(scene), preset.optimizers(truth), *scene.limits,
    )  # fmt: skip


def initial_state(scene: Scene, filmed: FilmedMotion) -> np.ndarray:
    """Return the initial state (L, 13) of the execution: the kinematic start's, raised out of the ground if needed."""
    human = scene.human
    state: np.ndarray = filmed.states[0].copy()
    height = clearance(human, state[None], human.sizes[None])[0]
    state[:, 2] -= min(height, 0.0)
    return state


def fit(
    scene: Scene, planner: Planner, filmed: FilmedMotion, state: np.ndarray, interval: int, seed: int = 0,
    observe: Callable[[Execution], None] = lambda execution: None, checkpoint: Checkpoint | None = None,
) -> Execution:  # fmt: skip
    """Plan and execute the whole filmed motion in the ground truth, from a state (L, 13); see `mpc.loop.execute`.

    interval: steps between plans.
    """
    steps, horizon = len(filmed.states) - 1, planner.horizon

    def window(step: int) -> Window:
        next_steps = np.minimum(step + 1 + np.arange(horizon), steps)
        steps_of_plan = np.minimum(step + np.arange(horizon), steps)
        context = FilmedMotion(*(values[next_steps] for values in filmed))._replace(
            targets=filmed.targets[steps_of_plan]
        )
        return Window(step * scene.dt, filmed.targets[steps_of_plan], context)

    phase = Phase(planner, planner, interval, window)
    return execute(Truth(scene, 1), state, [phase], steps, jax.random.key(seed), observe, checkpoint=checkpoint)

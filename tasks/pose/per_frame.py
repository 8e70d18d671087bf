"""Fits to single frames of a film, and the choice of one solution per frame that moves least.

    minimise over x_t     sum_i c_it |project(p_i(x_t, b)) - y_it|^2 / (3 sigma)^2      points lie on the keypoints
                        + |hinge(angles)|^2 + |S^(-1/2) (angles - m)|^2                poses are as people's are
                        + sum_feet |min(0, h_f)|^2                                     nobody is in the ground

from many headings and poses in every frame. One image does not show whether a limb points towards the camera or away
from it, so of the solutions of all frames, the sequence that moves least is taken (R. Bellman's dynamic programming).
"""

from __future__ import annotations

from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation, Slerp

from tasks.pose.figure import SHARED, SOLE_HEIGHT, Figure, Pose, figure
from tasks.pose.image import TILT_STD, points_and_places
from tasks.pose.points import FEET, POINTS
from tasks.pose.prior import INITIAL_POSES, prior_residuals, usual_poses
from tasks.pose.rows import by_rows, single
from tasks.pose.views import Viewpoint, Views

# Frames per second that are solved alone, initial headings of each, and steps of the solver.
FRAME_RATE, HEADINGS, STEPS = 12.0, 12, 12
# Speed [m/s] at which motion between them costs one unit, and the weight of that cost beside the fit.
MOTION_SPEED, MOTION_WEIGHT = 0.9, 5.0
# Standard deviation of depth in the ground [m].
DEPTH_STD = 0.08
# Camera tilts [rad] that are evaluated, the standard deviation [m] of a person's height above the ground in them, and
# the number of frames that are solved for each.
TILTS, HEIGHT_STD, TILT_FRAMES = (-0.1, 0.0, 0.1, 0.2, 0.3, 0.45), 0.1, 6


class PerFrameFit:
    """Least-squares problems of the single frames of a film, or of several at once."""

    def __init__(self, views: Views) -> None:
        self.views, self.figure = views, figure()
        self.usual_angles = usual_poses()[2]

    def solve(
        self, frames: np.ndarray, turns: np.ndarray, guesses: np.ndarray, free: np.ndarray, shared: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Solve single frames (F,) from S starts each: turns (F, S, 3, 3) and changes (F, S, D).

        free: (D,) 1 for the degrees of freedom that may change, else 0. Returns turns, changes and costs (F, S).
        """
        common = single((self.views.cameras, self.views.sigma, shared, free))
        values = (np.nan_to_num(array[frames]) for array in (self.views.places, self.views.confidence))
        places, weights = (np.repeat(array, guesses.shape[1], axis=0) for array in values)
        rows_of_arguments = turns.reshape(-1, 3, 3), places, weights, guesses.reshape(len(places), -1)
        changes, costs = by_rows(lambda *rows: _all_solved(self.figure, *common, *rows), *rows_of_arguments)
        changes, costs = changes.reshape(guesses.shape), costs.reshape(guesses.shape[:2])
        rotations = Rotation.from_rotvec(changes[..., 3:6].reshape(-1, 3)).as_matrix().reshape(*costs.shape, 3, 3)
        return rotations @ turns, changes, costs

    def initial_guesses(self, frames: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return starts of frames (F,): turns (F, S, 3, 3) and changes (F, S, D), of every heading and usual pose.

        The distance from the camera follows from the size of the person in the image that shows most points.
        """
        views, confidence = self.views.corrected(shared[SHARED : SHARED + 3]), self.views.confidence
        headings = np.linspace(-np.pi, np.pi, HEADINGS, endpoint=False)
        turns = np.repeat(Rotation.from_rotvec(headings[:, None] * (0.0, 0.0, 1.0)).as_matrix(), INITIAL_POSES, axis=0)
        angles = np.tile(self.usual_angles, (HEADINGS, 1, 1))
        pose = Pose(np.zeros((len(turns), 3)), turns, angles)
        points_at_origin = self.figure.all_points(pose, shared[:SHARED])
        guesses = np.zeros((len(frames), len(turns), 6 + 3 * self.figure.joints))
        for row, frame in enumerate(frames):
            view = int(confidence[frame].sum(axis=-1).argmax())
            is_detected, camera = views.films[view].detected[frame], views.cameras[view]
            guesses[row, :, :3] = camera.placed(
                views.films[view].places[frame, is_detected], points_at_origin[:, is_detected]
            )
        guesses[:, :, 6:] = angles.reshape(len(angles), -1)
        return np.broadcast_to(turns, (len(frames), *turns.shape)), guesses

    def least_motion(self, frames: np.ndarray, points: np.ndarray, costs: np.ndarray) -> np.ndarray:
        """Return the index of the chosen solution of each frame (F,), by points (F, S, P, 3) [m] and costs (F, S)."""
        least_cost, previous = costs[0], []
        for row in range(1, len(frames)):
            reach = MOTION_SPEED * (frames[row] - frames[row - 1]) / self.views.rate
            distance = np.linalg.norm(points[row - 1][:, None] - points[row][None], axis=-1)
            total = least_cost[:, None] + MOTION_WEIGHT * (distance**2).mean(axis=-1) / reach**2
            previous.append(total.argmin(axis=0))
            least_cost = total.min(axis=0) + costs[row]
        path = [int(least_cost.argmin())]
        for previous_row in reversed(previous):
            path.append(int(previous_row[path[-1]]))
        return np.array(path[::-1])

    @cached_property
    def frames(self) -> np.ndarray:
        """Return the indices of the frames that are solved alone."""
        interval = max(1, round(self.views.rate / FRAME_RATE))
        usable = self.views.frames_with_person
        return np.unique(np.append(usable[::interval], usable[-1]))

    def points(self, turns: np.ndarray, changes: np.ndarray, shared: np.ndarray) -> np.ndarray:
        """Return the points (F, S, P, 3) [m] of turns (F, S, 3, 3) and changes (F, S, D)."""
        flat = Pose(
            changes[..., :3].reshape(-1, 3),
            turns.reshape(-1, 3, 3),
            changes[..., 6:].reshape(-1, self.figure.joints, 3),
        )
        return self.figure.all_points(flat, shared[:SHARED]).reshape(*changes.shape[:2], len(POINTS), 3)

    def solve_sequence(self, turns: np.ndarray, guesses: np.ndarray, free: np.ndarray, shared: np.ndarray) -> Pose:
        """Return a pose in all frames: of the solutions of single `frames`, the sequence that moves least."""
        turns, changes, costs = self.solve(self.frames, turns, guesses, free, shared)
        points = self.points(turns, changes, shared)
        rows = np.arange(len(self.frames)), self.least_motion(self.frames, points, costs)
        return _interpolated_pose(self.frames, changes[rows], turns[rows], len(self.views))

    def first_pose(self, shared: np.ndarray) -> Pose:
        """Return a pose in all frames, without an initial guess."""
        return self.solve_sequence(*self.initial_guesses(self.frames, shared), self.all_free, shared)

    def with_tilt(self, usual: np.ndarray) -> np.ndarray:
        """Return shared values: the usual ones, with the camera's tilt estimated.

        Of `TILTS`, it is the one at which some frames, solved alone, fit best and show a person on the ground.
        """
        frames, candidates = self.frames[:: max(1, len(self.frames) // TILT_FRAMES)], []
        for tilt in TILTS:
            shared = usual.copy()
            shared[SHARED] = tilt
            turns, changes, costs = self.solve(frames, *self.initial_guesses(frames, shared), self.all_free, shared)
            height = (self.points(turns, changes, shared)[:, :, FEET, 2].min(axis=2) - SOLE_HEIGHT) / HEIGHT_STD
            candidates.append((float((costs + height**2).min(axis=1).mean()) + (tilt / TILT_STD) ** 2, shared))
        return min(candidates, key=lambda candidate: candidate[0])[1]

    @property
    def all_free(self) -> np.ndarray:
        """Return ones (D,): every degree of freedom of a frame may change."""
        return np.ones(6 + 3 * self.figure.joints)

    def with_limb_solved(self, pose: Pose, shared: np.ndarray, limb: tuple[int, ...]) -> Pose:
        """Return the pose with the joints of one limb solved again from its own and the usual poses' angles.

        limb: rows of its joints. Of all solutions of single frames, the sequence that moves least is taken.
        """
        limb_angles = np.concatenate(
            [
                pose.angles[self.frames][:, None, list(limb)],
                np.broadcast_to(self.usual_angles[:, list(limb)], (len(self.frames), INITIAL_POSES, len(limb), 3)),
            ],
            axis=1,
        )
        angles = np.repeat(pose.angles[self.frames][:, None], 1 + INITIAL_POSES, axis=1)
        angles[:, :, list(limb)] = limb_angles
        guesses = np.zeros((*angles.shape[:2], 6 + 3 * self.figure.joints))
        guesses[..., :3], guesses[..., 6:] = pose.place[self.frames][:, None], angles.reshape(*angles.shape[:2], -1)
        turns = np.repeat(pose.turn[self.frames][:, None], 1 + INITIAL_POSES, axis=1)
        free = np.zeros((6 + 3 * self.figure.joints,))
        for joint in limb:
            free[6 + 3 * joint : 9 + 3 * joint] = 1.0
        solved = self.solve_sequence(turns, guesses, free, shared)
        angles_solved = pose.angles.copy()
        angles_solved[:, list(limb)] = solved.angles[:, list(limb)]
        return pose._replace(angles=angles_solved)


def _interpolated_pose(frames: np.ndarray, changes: np.ndarray, turns: np.ndarray, count: int) -> Pose:
    """Return the pose in all `count` frames, interpolated between those in `frames`."""
    frame_positions = np.clip(np.arange(count), frames[0], frames[-1])

    def interpolate(values: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(frame_positions, frames, column) for column in values.T], axis=1)

    solved_rotations = Rotation.from_matrix(turns)
    rotations = (
        Slerp(frames, solved_rotations)(frame_positions)
        if len(frames) > 1
        else Rotation.concatenate([solved_rotations] * count)
    )
    return Pose(interpolate(changes[:, :3]), rotations.as_matrix(), interpolate(changes[:, 6:]).reshape(count, -1, 3))


def _residuals(
    body: Figure, cameras: tuple[Viewpoint, ...], sigma: Array, shared: Array,
    turn: Array, places: Array, weights: Array, change: Array,
) -> Array:  # fmt: skip
    """Return the residuals of one frame with places (C, P, 2) [px] of weights (C, P); see `image.points_and_places`."""
    points, fitted = points_and_places(body, cameras, turn, change, shared)
    image = jnp.sqrt(weights)[..., None] * (fitted - places) / (3.0 * sigma[:, None, None])
    depth = jnp.minimum(points[jnp.array(FEET), 2], 0.0) / DEPTH_STD
    return jnp.concatenate([image.ravel(), prior_residuals(body, turn, change), depth])


def _solved(
    body: Figure, cameras: tuple[Viewpoint, ...], sigma: Array, shared: Array, free: Array,
    turn: Array, places: Array, weights: Array, change: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return a change (D,) and its cost after `STEPS` Levenberg-Marquardt steps; free: (D,) 1 where it may change."""
    residuals = partial(_residuals, body, cameras, sigma, shared, turn, places, weights)

    def step(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        change, damping, cost = carry
        jacobian = jax.jacfwd(residuals)(change) * free
        normal = jacobian.T @ jacobian
        normal = normal + jnp.diag(damping * jnp.diag(normal) + 1e-3 + (free == 0.0))
        next_change = change - jnp.linalg.solve(normal, jacobian.T @ residuals(change))
        next_cost = jnp.sum(residuals(next_change) ** 2)
        better = next_cost < cost
        return (
            jnp.where(better, next_change, change),
            jnp.where(better, 0.4 * damping, 6.0 * damping),
            jnp.where(better, next_cost, cost),
        ), None

    start = (change, jnp.asarray(0.1), jnp.sum(residuals(change) ** 2))
    (change, _, cost), _ = jax.lax.scan(step, start, None, length=STEPS)
    return change, cost


_all_solved = jax.jit(jax.vmap(_solved, (*5 * [None], 0, 0, 0, 0)), static_argnums=0)

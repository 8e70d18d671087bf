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

from tasks.pose.camera import Camera
from tasks.pose.figure import SHARED, SOLE, Figure, Pose, figure
from tasks.pose.image import TILT, moved, seen_by
from tasks.pose.points import FEET, POINTS, Keypoints
from tasks.pose.prior import POSES, usual_poses, within
from tasks.pose.rows import by_rows, single

# Frames per second that are solved alone, initial headings of each, and steps of the solver.
SPARSE, HEADINGS, ALONE = 12.0, 12, 12
# Speed [m/s] at which motion between them costs one unit, and the weight of that cost beside the fit.
PACE, MOVED = 0.9, 5.0
# Standard deviation of depth in the ground [m].
SUNK = 0.08
# Camera tilts [rad] that are tried, the standard deviation [m] of a person's height above the ground in them, and the
# number of frames that are solved for each.
TILTS, AFLOAT, FEW = (-0.1, 0.0, 0.1, 0.2, 0.3, 0.45), 0.1, 6


class Alone:
    """Least-squares problems of the single frames of one film."""

    def __init__(self, keypoints: Keypoints, camera: Camera, sigma: float) -> None:
        """Set up the problems; sigma: standard deviation of the keypoints [px]."""
        self.keypoints, self.camera, self.sigma, self.figure = keypoints, camera, sigma, figure()
        self.starts = usual_poses()[2]

    def solved(
        self, frames: np.ndarray, turns: np.ndarray, begin: np.ndarray, free: np.ndarray, shared: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Solve single frames (F,) from S starts each: turns (F, S, 3, 3) and changes (F, S, D).

        free: (D,) 1 for the degrees of freedom that may change, else 0. Returns turns, changes and costs (F, S).
        """
        known = single((self.camera, self.sigma, shared, free))
        seen = (np.nan_to_num(each[frames]) for each in (self.keypoints.places, self.keypoints.confidence))
        places, weights = (np.repeat(each, begin.shape[1], axis=0) for each in seen)
        flat = turns.reshape(-1, 3, 3), places, weights, begin.reshape(len(places), -1)
        changes, costs = by_rows(lambda *rows: _all_improved(self.figure, *known, *rows), *flat)
        changes, costs = changes.reshape(begin.shape), costs.reshape(begin.shape[:2])
        turned = Rotation.from_rotvec(changes[..., 3:6].reshape(-1, 3)).as_matrix().reshape(*costs.shape, 3, 3)
        return turned @ turns, changes, costs

    def begun(self, frames: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return starts of frames (F,): turns (F, S, 3, 3) and changes (F, S, D), of every heading and usual pose.

        The distance from the camera follows from the size of the person in the image.
        """
        camera = seen_by(self.camera, shared)
        headings = np.linspace(-np.pi, np.pi, HEADINGS, endpoint=False)
        turns = np.repeat(Rotation.from_rotvec(headings[:, None] * (0.0, 0.0, 1.0)).as_matrix(), POSES, axis=0)
        angles = np.tile(self.starts, (HEADINGS, 1, 1))
        pose = Pose(np.zeros((len(turns), 3)), turns, angles)
        around = self.figure.all_points(pose, shared[:SHARED])
        local = around @ camera.turn.T
        begin = np.zeros((len(frames), len(turns), 6 + 3 * self.figure.joints))
        for row, frame in enumerate(frames):
            seen = self.keypoints.seen[frame]
            places = self.keypoints.places[frame, seen]
            spread = np.sqrt(local[:, seen, :2].var(axis=1).sum(axis=-1))
            depth = np.clip(camera.focal * spread / max(np.sqrt(places.var(axis=0).sum()), 1.0), 1.0, 60.0)
            ray = camera.ray(places.mean(axis=0))
            begin[row, :, :3] = camera.position + depth[:, None] * ray - around[:, seen].mean(axis=1)
        begin[:, :, 6:] = angles.reshape(len(angles), -1)
        return np.broadcast_to(turns, (len(frames), *turns.shape)), begin

    def sequence(self, frames: np.ndarray, points: np.ndarray, costs: np.ndarray) -> np.ndarray:
        """Return the index of the chosen solution of each frame (F,), by points (F, S, P, 3) [m] and costs (F, S)."""
        best, steps = costs[0], []
        for row in range(1, len(frames)):
            far = PACE * (frames[row] - frames[row - 1]) / self.keypoints.rate
            moved = np.linalg.norm(points[row - 1][:, None] - points[row][None], axis=-1)
            both = best[:, None] + MOVED * (moved**2).mean(axis=-1) / far**2
            steps.append(both.argmin(axis=0))
            best = both.min(axis=0) + costs[row]
        path = [int(best.argmin())]
        for step in reversed(steps):
            path.append(int(step[path[-1]]))
        return np.array(path[::-1])

    @cached_property
    def frames(self) -> np.ndarray:
        """Return the indices of the frames that are solved alone."""
        every = max(1, round(self.keypoints.rate / SPARSE))
        enough = np.flatnonzero((self.keypoints.confidence > 0.3).sum(axis=1) >= 6)
        return np.unique(np.append(enough[::every], enough[-1]))

    def points(self, turns: np.ndarray, changes: np.ndarray, shared: np.ndarray) -> np.ndarray:
        """Return the points (F, S, P, 3) [m] of turns (F, S, 3, 3) and changes (F, S, D)."""
        flat = Pose(
            changes[..., :3].reshape(-1, 3),
            turns.reshape(-1, 3, 3),
            changes[..., 6:].reshape(-1, self.figure.joints, 3),
        )
        return self.figure.all_points(flat, shared[:SHARED]).reshape(*changes.shape[:2], len(POINTS), 3)

    def chosen(self, turns: np.ndarray, begin: np.ndarray, free: np.ndarray, shared: np.ndarray) -> Pose:
        """Return a pose in all frames: of the solutions of single `frames`, the sequence that moves least."""
        turns, changes, costs = self.solved(self.frames, turns, begin, free, shared)
        points = self.points(turns, changes, shared)
        rows = np.arange(len(self.frames)), self.sequence(self.frames, points, costs)
        return _between(self.frames, changes[rows], turns[rows], len(self.keypoints))

    def first(self, shared: np.ndarray) -> Pose:
        """Return a pose in all frames, without an initial guess."""
        return self.chosen(*self.begun(self.frames, shared), self.free, shared)

    def tilted(self, usual: np.ndarray) -> np.ndarray:
        """Return shared values: the usual ones, with the camera's tilt estimated.

        Of `TILTS`, it is the one at which some frames, solved alone, fit best and show a person on the ground.
        """
        frames, found = self.frames[:: max(1, len(self.frames) // FEW)], []
        for tilt in TILTS:
            shared = usual.copy()
            shared[SHARED] = tilt
            turns, changes, costs = self.solved(frames, *self.begun(frames, shared), self.free, shared)
            afloat = (self.points(turns, changes, shared)[:, :, FEET, 2].min(axis=2) - SOLE) / AFLOAT
            found.append((float((costs + afloat**2).min(axis=1).mean()) + (tilt / TILT) ** 2, shared))
        return min(found, key=lambda each: each[0])[1]

    @property
    def free(self) -> np.ndarray:
        """Return ones (D,): every degree of freedom of a frame may change."""
        return np.ones(6 + 3 * self.figure.joints)

    def rethought(self, pose: Pose, shared: np.ndarray, limb: tuple[int, ...]) -> Pose:
        """Return the pose with the joints of one limb solved again from its own and the usual poses' angles.

        limb: rows of its joints. Of all solutions of single frames, the sequence that moves least is taken.
        """
        ways = np.concatenate(
            [
                pose.angles[self.frames][:, None, list(limb)],
                np.broadcast_to(self.starts[:, list(limb)], (len(self.frames), POSES, len(limb), 3)),
            ],
            axis=1,
        )
        angles = np.repeat(pose.angles[self.frames][:, None], 1 + POSES, axis=1)
        angles[:, :, list(limb)] = ways
        begin = np.zeros((*angles.shape[:2], 6 + 3 * self.figure.joints))
        begin[..., :3], begin[..., 6:] = pose.place[self.frames][:, None], angles.reshape(*angles.shape[:2], -1)
        turns = np.repeat(pose.turn[self.frames][:, None], 1 + POSES, axis=1)
        free = np.zeros((6 + 3 * self.figure.joints,))
        for joint in limb:
            free[6 + 3 * joint : 9 + 3 * joint] = 1.0
        found = self.chosen(turns, begin, free, shared)
        changed = pose.angles.copy()
        changed[:, list(limb)] = found.angles[:, list(limb)]
        return pose._replace(angles=changed)


def _between(frames: np.ndarray, changes: np.ndarray, turns: np.ndarray, count: int) -> Pose:
    """Return the pose in all `count` frames, interpolated between those in `frames`."""
    at = np.clip(np.arange(count), frames[0], frames[-1])
    mix = lambda values: np.stack([np.interp(at, frames, each) for each in values.T], axis=1)  # noqa: E731
    turn = Rotation.from_matrix(turns)
    between = Slerp(frames, turn)(at) if len(frames) > 1 else Rotation.concatenate([turn] * count)
    return Pose(mix(changes[:, :3]), between.as_matrix(), mix(changes[:, 6:]).reshape(count, -1, 3))


def _residuals(
    body: Figure, camera: Camera, sigma: Array, shared: Array, turn: Array, places: Array, weights: Array, change: Array
) -> Array:
    """Return the residuals of one frame with places (P, 2) [px] of weights (P,); see `image.moved`."""
    points, found = moved(body, camera, turn, change, shared)
    image = jnp.sqrt(weights)[:, None] * (found - places) / (3.0 * sigma)
    sunk = jnp.minimum(points[jnp.array(FEET), 2], 0.0) / SUNK
    return jnp.concatenate([image.ravel(), within(body, turn, change), sunk])


def _improved(
    body: Figure, camera: Camera, sigma: Array, shared: Array, free: Array,
    turn: Array, places: Array, weights: Array, change: Array,
) -> tuple[Array, Array]:  # fmt: skip
    """Return a change (D,) and its cost after `ALONE` Levenberg-Marquardt steps; free: (D,) 1 where it may change."""
    residuals = partial(_residuals, body, camera, sigma, shared, turn, places, weights)

    def step(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
        change, damping, cost = carry
        slopes = jax.jacfwd(residuals)(change) * free
        normal = slopes.T @ slopes
        normal = normal + jnp.diag(damping * jnp.diag(normal) + 1e-3 + (free == 0.0))
        there = change - jnp.linalg.solve(normal, slopes.T @ residuals(change))
        after = jnp.sum(residuals(there) ** 2)
        better = after < cost
        return (
            jnp.where(better, there, change),
            jnp.where(better, 0.4 * damping, 6.0 * damping),
            jnp.where(better, after, cost),
        ), None

    first = (change, jnp.asarray(0.1), jnp.sum(residuals(change) ** 2))
    (change, _, cost), _ = jax.lax.scan(step, first, None, length=ALONE)
    return change, cost


_all_improved = jax.jit(jax.vmap(_improved, (*5 * [None], 0, 0, 0, 0)), static_argnums=0)

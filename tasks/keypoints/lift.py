"""The kinematic start: a figure laid over the keypoints of a film, without any physics.

    minimise over x_t = (place, turn, angles), proportions b and what is not known of the camera

        sum_t  sum_i c_it rho(|project(p_i(x_t, b)) - y_it| / sigma)      points lie where the detector saw them
             + |hinge(angles)|^2 + |S^(-1/2) (angles - m)|^2              joints bend as joints do, and as people's do
             + sum_i sqrt(1 + |p_i'' / s_i|^2)                            nothing jerks
             + sum_feet a_ft |p_f'|^2 + a_ft h_f^2 + |min(0, h_f)|^2      feet that stand do so on the ground, and stay
             + a_t |c - p - c'' z / g|^2                                  whom no foot holds up falls over
        + |b / sigma_b|^2

rho is Geman and McClure's, m and S are those of the project's own motions, a_ft says how much a foot looks as if it
stood (both by iteratively reweighted least squares); c is the middle of the mass and p of the feet that stand.

One image leaves open who leans forwards and who backwards: so each frame is first solved alone from many headings and
poses, and of what they lead to the sequence that moves least is taken (R. Bellman's dynamic programming). From there
all frames are solved together by Levenberg and Marquardt's steps, whose matrix is a band with an edge.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation, Slerp

from larp_model.rotation import from_rotation_vector, matrix
from tasks.keypoints.banded import Banded
from tasks.keypoints.camera import Camera
from tasks.keypoints.figure import SHARED, SOLE, Figure, Pose
from tasks.keypoints.points import POINTS, SIDES, Keypoints
from tasks.motions import styles

# Standard deviations: of a detector's points, in shares of the image's larger side; of angles beyond a joint's limits
# [rad]; of a trunk's lean [rad]; of the body's size and of single proportions, in shares.
PIXELS, BEYOND, LEAN, GROWN = 0.004, 0.05, 0.6, 0.06
# Of `figure.PROPORTIONS` and of the shoulders: hips and trunks are seen where they are not, limbs are like limbs.
VARIED = (0.15, 0.15, 0.15, 0.15, 0.06, 0.12, 0.06, 0.06, 0.1, 0.15)
# By how much more people's poses differ than those of the project's own motions [rad].
WIDER = 0.05
LIMBS = ("upper_arm", "lower_arm"), ("thigh", "shin", "foot")
# Of accelerations [m/s^2]: trunk and head, arms and legs.
TRUNK = 12.0
QUICK = {"elbow": 40.0, "wrist": 40.0, "knee": 50.0, "ankle": 50.0, "heel": 50.0, "toe": 50.0}
# Of what a standing foot moves [m/s], of its height and of its depth in the ground [m]; speeds [m/s] and heights [m] at
# which one may stand.
STILL, LEVEL, SUNK, SLOW, LOW = 0.10, 0.015, 0.005, 0.8, 0.08
# Residuals beyond so many standard deviations count less and less.
OUTLIER = 6.0
# Frames a second, headings and poses from which frames are solved alone, and steps for each.
SPARSE, HEADINGS, POSES, ALONE = 12.0, 12, 4, 12
# How fast the body may seem to move between them [m/s], and what that counts beside how well it fits.
PACE, MOVED = 0.9, 5.0
STEPS = 40
# Of what is not known of a camera: tilts [rad], and its height as a share.
TILT, ROLL, HEIGHT = 0.3, 0.05, 0.3
# Of the body's size where it is not known how high a camera stands: no image tells it, and what is small jerks least.
UNSEEN = 0.005
# Tilts from which the least costly is taken, the height [m] that a person is above the ground there, and frames tried.
TILTS, AFLOAT, FEW = (-0.1, 0.0, 0.1, 0.2, 0.3, 0.45), 0.1, 6
# Of where the weight is borne, beside the feet that stand [m]; the mass that is nearest to each point, as a share.
BORNE = 0.08
MASSES = {"nose": 0.07, "shoulder": 0.16, "elbow": 0.035, "wrist": 0.02, "hip": 0.16, "knee": 0.06, "ankle": 0.03}
GRAVITY = 9.81
# Of how high what a detector takes for heel and toe is in a foot that stands [m].
SOLES = 0.02

FEET = [POINTS.index(f"{side}_{end}") for side in SIDES for end in ("heel", "toe")]
_SWAPS = (
    [[POINTS.index(f"{side}_{limb}") for limb in ("shoulder", "elbow", "wrist")] for side in SIDES],
    [[POINTS.index(f"{side}_{limb}") for limb in ("hip", "knee", "ankle", "heel", "toe")] for side in SIDES],
)


class Lifted(NamedTuple):
    """A figure in all frames.

    pose: see `figure.Pose`. proportions: (11,), see `Figure`. camera: as given, or as estimated. error: of the
    points that were seen [px], the median.
    """

    pose: Pose
    proportions: np.ndarray
    camera: Camera
    error: float


class _Seen(NamedTuple):
    """What one frame shows: places (P, 2) [px], weights (P,)."""

    places: Array
    weights: Array


class Now(NamedTuple):
    """What follows from a pose: points (T, P, 3) [m], places (T, P, 2) [px], how high soles are (T, 4) [m]."""

    pose: Pose
    points: np.ndarray
    places: np.ndarray
    heights: np.ndarray


class Term(NamedTuple):
    """Residuals (F, K) of weights (F, K), and derivatives (F, K, D + S) by frames f + offset and what all share."""

    weights: np.ndarray
    residual: Callable[[Now], np.ndarray]
    slopes: tuple[tuple[int, np.ndarray], ...]


@cache
def figure() -> Figure:
    """The one that films are seen by."""
    return Figure()


@cache
def usual_poses() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean (J * 3,) and a square root (J * 3, J * 3) of the inverse covariance of angles, and some poses (M, J, 3)."""
    random, body = np.random.default_rng(0), figure().body
    drawn = (
        styles.kicks(random, body, random.integers(0, 60, 160), 120, 0.01)[:, ::8],
        styles.gaits(random, body, 160, 100, 0.01)[:, ::8],
        styles.moves(random, body, 120, 100, 0.01)[:, ::8],
    )
    angles = np.concatenate([each.reshape(-1, *each.shape[2:]) for each in drawn])
    angles = np.concatenate([angles, styles.mirrored(body, angles)])
    flat = angles.reshape(len(angles), -1)
    mean, covariance = flat.mean(axis=0), np.cov(flat.T) + WIDER**2 * np.eye(flat.shape[1])
    whitening = np.linalg.cholesky(np.linalg.inv(covariance)).T
    chosen = [mean]  # poses unlike each other, but not the oddest
    nearest = np.linalg.norm((flat - chosen[0]) @ whitening.T, axis=1)
    while len(chosen) < POSES:
        chosen.append(flat[np.argsort(nearest)[int(0.9 * len(flat))]])
        nearest = np.minimum(nearest, np.linalg.norm((flat - chosen[-1]) @ whitening.T, axis=1))
    return mean, whitening, np.reshape(chosen, (POSES, -1, 3))


def _tilted(camera: Camera, unknown: Array) -> Camera:
    """The camera turned by pitch and roll [rad] and raised by a share of its height, (3,)."""
    turn = matrix(from_rotation_vector(jnp.stack([unknown[0], jnp.zeros(()), unknown[1]])))
    position = jnp.asarray(camera.position) * jnp.stack([1.0, 1.0, jnp.exp(unknown[2])])
    return Camera(camera.focal, jnp.asarray(camera.centre), turn @ jnp.asarray(camera.turn), position)


def _seen_by(camera: Camera, shared: np.ndarray) -> Camera:
    """The camera as what is shared says that it is turned and raised."""
    tilted = _tilted(camera, jnp.asarray(shared[SHARED : SHARED + 3]))
    return Camera(camera.focal, camera.centre, np.asarray(tilted.turn, float), np.asarray(tilted.position, float))


def _moved(body: Figure, camera: Camera, turn: Array, change: Array, shared: Array) -> tuple[Array, Array]:
    """Points (P, 3) [m] and their places (P, 2) [px]; change: place, turn, angles; shared: proportions, camera."""
    turned = matrix(from_rotation_vector(change[3:6])) @ turn
    points = body.points(change[:3], turned, change[6:].reshape(-1, 3), shared[:SHARED])
    return points, _tilted(camera, shared[SHARED : SHARED + 3]).project(points)


class _Lifter:
    """The equations of one film."""

    def __init__(self, keypoints: Keypoints, camera: Camera, known: bool) -> None:
        self.keypoints, self.camera, self.known, self.figure = keypoints, camera, known, figure()
        size = keypoints.size or tuple(2.0 * camera.centre)
        self.sigma = PIXELS * max(size)
        self.mean, self.whitening, self.starts = usual_poses()
        grown, unknown = (GROWN, (1e-4, 1e-4, 1e-4)) if known else (UNSEEN, (TILT, ROLL, HEIGHT))
        self.shared_sigma = np.array([grown, *VARIED, *unknown, SOLES, SOLES])
        self.values = jax.jit(jax.vmap(partial(_moved, self.figure, camera), (0, 0, None)))
        both = jax.jacfwd(partial(_moved, self.figure, camera), (1, 2))
        self.slopes = jax.jit(jax.vmap(both, (0, 0, None)))

    # One frame at a time.

    def alone(
        self, frames: np.ndarray, turns: np.ndarray, begin: np.ndarray, free: np.ndarray, shared: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What single frames (F,) lead to from turns (F, S, 3, 3) and changes (F, S, D) on, those free (D,) to change.

        Returns turns, changes and costs (F, S).
        """
        seen = _Seen(*(np.nan_to_num(each[frames]) for each in (self.keypoints.places, self.keypoints.confidence)))
        given = jax.tree.map(partial(jnp.asarray, dtype=jnp.float32), (begin, turns, seen, free, shared))
        changes, costs = map(np.asarray, self.improved(*given))
        turned = Rotation.from_rotvec(changes[..., 3:6].reshape(-1, 3)).as_matrix().reshape(*costs.shape, 3, 3)
        return turned @ turns, changes, costs

    @cached_property
    def improved(self) -> Callable[..., tuple[Array, Array]]:
        """Compiled: changes (F, S, D) and costs (F, S) after some steps of Levenberg and Marquardt's."""

        def residuals(change: Array, turn: Array, seen: _Seen, shared: Array) -> Array:
            points, found = _moved(self.figure, self.camera, turn, change, shared)
            image = jnp.sqrt(seen.weights)[:, None] * (found - seen.places) / (3.0 * self.sigma)
            sunk = jnp.minimum(points[jnp.array(FEET), 2], 0.0) / LOW
            return jnp.concatenate([image.ravel(), *self._within(turn, change), sunk])

        def improved(change: Array, turn: Array, seen: _Seen, free: Array, shared: Array) -> tuple[Array, Array]:
            def step(carry: tuple[Array, Array, Array], _: None) -> tuple[tuple[Array, Array, Array], None]:
                change, damping, cost = carry
                found = residuals(change, turn, seen, shared)
                slopes = jax.jacfwd(residuals)(change, turn, seen, shared) * free
                normal = slopes.T @ slopes
                normal = normal + jnp.diag(damping * jnp.diag(normal) + 1e-3 + (free == 0.0))
                there = change - jnp.linalg.solve(normal, slopes.T @ found)
                after = jnp.sum(residuals(there, turn, seen, shared) ** 2)
                better = after < cost
                return (
                    jnp.where(better, there, change),
                    jnp.where(better, 0.4 * damping, 6.0 * damping),
                    jnp.where(better, after, cost),
                ), None

            first = (change, jnp.asarray(0.1), jnp.sum(residuals(change, turn, seen, shared) ** 2))
            (change, _, cost), _ = jax.lax.scan(step, first, None, length=ALONE)
            return change, cost

        over_starts = jax.vmap(improved, (0, 0, None, None, None))
        return jax.jit(jax.vmap(over_starts, (0, 0, 0, None, None)))

    def begun(self, frames: np.ndarray, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Turns (F, S, 3, 3) and changes (F, S, D): every heading and usual pose, as far away as the image is small."""
        camera = _seen_by(self.camera, shared)
        headings = np.linspace(-np.pi, np.pi, HEADINGS, endpoint=False)
        turns = np.repeat(Rotation.from_rotvec(headings[:, None] * (0.0, 0.0, 1.0)).as_matrix(), POSES, axis=0)
        angles = np.tile(self.starts, (HEADINGS, 1, 1))
        pose = Pose(np.zeros((len(turns), 3)), turns, angles)
        around = self.figure.all_points(pose, np.zeros(SHARED))
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
        """Which of S possibilities to take in each of the frames (F,), by points (F, S, P, 3) and costs (F, S)."""
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
        """The frames that are solved alone."""
        every = max(1, round(self.keypoints.rate / SPARSE))
        enough = np.flatnonzero((self.keypoints.confidence > 0.3).sum(axis=1) >= 6)
        return np.unique(np.append(enough[::every], enough[-1]))

    def points(self, turns: np.ndarray, changes: np.ndarray, shared: np.ndarray) -> np.ndarray:
        """Points (F, S, P, 3) [m] of turns (F, S, 3, 3) and changes (F, S, D)."""
        flat = Pose(
            changes[..., :3].reshape(-1, 3),
            turns.reshape(-1, 3, 3),
            changes[..., 6:].reshape(-1, self.figure.joints, 3),
        )
        return self.figure.all_points(flat, shared[:SHARED]).reshape(*changes.shape[:2], len(POINTS), 3)

    def chosen(self, turns: np.ndarray, begin: np.ndarray, free: np.ndarray, shared: np.ndarray) -> Pose:
        """A pose in all frames: of what `frames` lead to when solved alone, the sequence that moves least."""
        turns, changes, costs = self.alone(self.frames, turns, begin, free, shared)
        points = self.points(turns, changes, shared)
        rows = np.arange(len(self.frames)), self.sequence(self.frames, points, costs)
        return _between(self.frames, changes[rows], turns[rows], len(self.keypoints))

    def first(self, shared: np.ndarray) -> Pose:
        """A pose in all frames, from nothing."""
        return self.chosen(*self.begun(self.frames, shared), self.free, shared)

    def tilted(self) -> np.ndarray:
        """What is shared at first: the tilt at which some frames, solved alone, show a person on the ground."""
        frames, found = self.frames[:: max(1, len(self.frames) // FEW)], []
        for tilt in TILTS:
            shared = np.zeros(len(self.shared_sigma))
            shared[SHARED] = tilt
            turns, changes, costs = self.alone(frames, *self.begun(frames, shared), self.free, shared)
            afloat = (self.points(turns, changes, shared)[:, :, FEET, 2].min(axis=2) - SOLE) / AFLOAT
            found.append((float((costs + afloat**2).min(axis=1).mean()) + (tilt / TILT) ** 2, shared))
        return min(found, key=lambda each: each[0])[1]

    @property
    def free(self) -> np.ndarray:
        """Every degree of freedom of a frame (D,)."""
        return np.ones(6 + 3 * self.figure.joints)

    def rethought(self, pose: Pose, shared: np.ndarray, limb: tuple[int, ...]) -> Pose:
        """The pose, the joints of one limb in another way where a sequence of such ways fits better."""
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

    def _within(self, turn: Array, change: Array) -> list[Array]:
        """What of a pose is unlike people's: beyond the joints' limits, unusual, leaning."""
        angles = change[6:]
        lower, upper = (jnp.asarray(each.ravel(), change.dtype) for each in (self.figure.lower, self.figure.upper))
        beyond = (jnp.minimum(angles - lower, 0.0) + jnp.maximum(angles - upper, 0.0)) / BEYOND
        unusual = jnp.asarray(self.whitening, change.dtype) @ (angles - jnp.asarray(self.mean, change.dtype))
        upright = (matrix(from_rotation_vector(change[3:6])) @ turn)[:2, 2] / LEAN
        return [beyond, unusual, upright]

    # All frames together.

    def solved(self) -> tuple[Pose, np.ndarray]:
        """The pose and what is shared."""
        begin = np.zeros(len(self.shared_sigma)) if self.known else self.tilted()
        pose, shared = self.together(self.first(begin), begin, STEPS // 2)
        names = [self.figure.body.links[child].name for child, _, _ in self.figure.body.motors]
        for side in SIDES:
            for limb in LIMBS:
                pose = self.rethought(pose, shared, tuple(names.index(f"{side}_{each}") for each in limb))
        return self.together(pose, shared, STEPS)

    def together(self, pose: Pose, shared: np.ndarray, steps: int) -> tuple[Pose, np.ndarray]:
        """The pose and what is shared, after so many steps at most."""
        places, confidence = self.keypoints.places, self.keypoints.confidence
        known = len(pose.place) / self.keypoints.rate / self.shared_sigma**2
        for again in range(3):
            damping = 1e-2
            if again:
                places, confidence = self._unswapped(pose, shared, places, confidence)
            for _ in range(steps // 3):
                terms = self.terms(pose, shared, places, confidence)
                normal = Banded(len(pose.place), 6 + 3 * self.figure.joints, len(shared))

                def cost(now: Now, shared: np.ndarray, terms: list[Term] = terms) -> float:
                    return sum(float(np.sum(w * of(now) ** 2)) for w, of, _ in terms) + float(known @ shared**2)

                here = self.now(pose, shared)
                for weights, residual, slopes in terms:
                    normal.add(weights, residual(here), slopes)
                normal.share(known, shared)
                for _ in range(8):
                    change, common = normal.solved(damping)
                    there = _after(pose, change)
                    if cost(self.now(there, shared + common), shared + common) < cost(here, shared):
                        pose, shared, damping = there, shared + common, max(0.3 * damping, 1e-6)
                        break
                    damping *= 5.0
                else:
                    break  # nothing gains any more
        return pose, shared

    def _unswapped(
        self, pose: Pose, shared: np.ndarray, places: np.ndarray, confidence: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Keypoints, left and right exchanged where they then fit better."""
        found = self.now(pose, shared).places
        places, confidence = places.copy(), confidence.copy()
        for left, right in _SWAPS:
            own, other = left + right, right + left

            def misfit(rows: list[int], own: list[int] = own) -> np.ndarray:
                apart = np.linalg.norm(found[:, own] - places[:, rows], axis=-1) / self.sigma
                return np.nansum(np.minimum(apart, 20.0) * confidence[:, rows], axis=1)

            worse = misfit(own) > 1.3 * misfit(other) + 10.0
            places[:, own] = np.where(worse[:, None, None], places[:, other], places[:, own])
            confidence[:, own] = np.where(worse[:, None], confidence[:, other], confidence[:, own])
        return places, confidence

    def terms(self, pose: Pose, shared: np.ndarray, places: np.ndarray, confidence: np.ndarray) -> list[Term]:
        """The residuals around a pose, their weights as they are there."""
        frames, count, rate = len(pose.place), len(POINTS), self.keypoints.rate
        now = self.now(pose, shared)
        x, y = self.derivatives(pose, shared)
        each = 30.0 / rate  # neighbouring frames of a fast film tell little that is new
        seen = (confidence > 0.0)[..., None]

        def image(now: Now) -> np.ndarray:
            return (np.where(seen, now.places - np.nan_to_num(places), 0.0) / self.sigma).reshape(frames, -1)

        apart = image(now).reshape(frames, count, 2)
        trusted = each * confidence / (1.0 + (apart**2).sum(axis=-1) / OUTLIER**2) ** 2
        quick = np.array([QUICK.get(name.partition("_")[2], TRUNK) for name in POINTS]) / rate**2
        jerk = each / quick**2 / np.sqrt(1.0 + (second_differences(now.points) ** 2).sum(axis=-1) / quick**2)
        feet, height = now.points[:, FEET], now.heights
        speed = np.linalg.norm(np.diff(feet, axis=0), axis=-1) * rate
        speed = np.minimum(np.concatenate([speed[:1], speed]), np.concatenate([speed, speed[-1:]]))
        stands = np.exp(-((np.maximum(height, 0.0) / LOW) ** 2)) / (1.0 + (speed / SLOW) ** 2) ** 2
        still = each * np.minimum(stands[1:], stands[:-1]) / (STILL / rate) ** 2
        rows = [3 * foot + axis for foot in FEET for axis in range(3)]
        of_heights = x[:, [3 * foot + 2 for foot in FEET]]
        of_heights[:, [0, 2], -2] -= 1.0
        of_heights[:, [1, 3], -1] -= 1.0
        return [
            Term(np.repeat(trusted, 2, axis=1), image, ((0, y / self.sigma),)),
            Term(
                np.repeat(jerk, 3, axis=1), lambda now: second_differences(now.points).reshape(frames - 2, -1),
                ((0, x[:-2]), (1, -2.0 * x[1:-1]), (2, x[2:])),
            ),
            Term(
                np.repeat(still, 3, axis=1), lambda now: np.diff(now.points[:, FEET], axis=0).reshape(frames - 1, -1),
                ((0, -x[:-1, rows]), (1, x[1:, rows])),
            ),
            Term(
                each * (stands / LEVEL**2 + (height < 0.0) / SUNK**2), lambda now: now.heights, ((0, of_heights),)
            ),
            self.balance(now, stands, x),
            Term(
                np.full((frames, 6 * self.figure.joints + 2), each), lambda now: self._unlike(now.pose),
                ((0, self._of_pose(pose)),),
            ),
        ]  # fmt: skip

    def balance(self, now: Now, stands: np.ndarray, x: np.ndarray) -> Term:
        """x'' = (x - p) g / z: whom no foot holds up falls over; p is where the weight is borne, among the feet."""
        rate, mass = self.keypoints.rate, np.array([MASSES.get(name.rpartition("_")[2], 0.0) for name in POINTS])
        mass /= mass.sum()
        share = stands[1:-1] + 1e-9
        share = share / share.sum(axis=1, keepdims=True)
        feet = now.points[1:-1, FEET, :2]
        apart = feet - (share[..., None] * feet).sum(axis=1, keepdims=True)
        variance = BORNE**2 + (share * (apart**2).sum(axis=-1)).sum(axis=1)
        weights = 30.0 / rate * stands[1:-1].max(axis=1) / variance
        pace = (np.maximum(now.points[1:-1, :, 2] @ mass, 0.3) * rate**2 / GRAVITY)[:, None]

        def unborne(now: Now) -> np.ndarray:
            middle = np.einsum("p,tpx->tx", mass, now.points[..., :2])
            held = (share[..., None] * now.points[1:-1, FEET, :2]).sum(axis=1)
            return middle[1:-1] - held - pace * second_differences(middle)

        by_point = x.reshape(len(x), len(POINTS), 3, -1)[:, :, :2]
        of_middle = np.einsum("p,tpxd->txd", mass, by_point)
        of_feet = (share[..., None, None] * by_point[1:-1, FEET]).sum(axis=1)
        along = pace[..., None]
        return Term(
            np.repeat(weights[:, None], 2, axis=1),
            unborne,
            (
                (0, -along * of_middle[:-2]),
                (1, (1.0 + 2.0 * along) * of_middle[1:-1] - of_feet),
                (2, -along * of_middle[2:]),
            ),
        )

    def now(self, pose: Pose, shared: np.ndarray) -> Now:
        """What follows from a pose and what is shared."""
        points, places = (np.asarray(each, float) for each in self.values(*_arguments(pose, shared)))
        return Now(pose, points, places, points[:, FEET, 2] - SOLE - np.tile(shared[-2:], 2))

    def derivatives(self, pose: Pose, shared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of points (T, 3 P, D + S) and of their places (T, 2 P, D + S), along changes and what is shared."""
        found = self.slopes(*_arguments(pose, shared))
        return tuple(  # type: ignore[return-value]
            np.concatenate([np.asarray(each, float) for each in both], axis=-1).reshape(len(pose.place), rows, -1)
            for both, rows in zip(found, (3 * len(POINTS), 2 * len(POINTS)), strict=True)
        )

    def _unlike(self, pose: Pose) -> np.ndarray:
        """`_within` of all frames (T, K)."""
        angles = pose.angles.reshape(len(pose.place), -1)
        lower, upper = self.figure.lower.ravel(), self.figure.upper.ravel()
        beyond = np.minimum(angles - lower, 0.0) + np.maximum(angles - upper, 0.0)
        unusual = (angles - self.mean) @ self.whitening.T
        return np.concatenate([beyond / BEYOND, unusual, pose.turn[:, :2, 2] / LEAN], axis=1)

    def _of_pose(self, pose: Pose) -> np.ndarray:
        """Derivatives (T, K, D + S) of `_unlike`."""
        frames, count = len(pose.place), 3 * self.figure.joints
        slopes = np.zeros((frames, 2 * count + 2, 6 + count + len(self.shared_sigma)))
        rows = np.arange(count)
        slopes[:, rows, 6 + rows] = (self._unlike(pose)[:, :count] != 0.0) / BEYOND
        slopes[:, count : 2 * count, 6 : 6 + count] = self.whitening
        axis = pose.turn[:, :, 2]  # which a turn d moves by d x axis
        slopes[:, 2 * count, 4], slopes[:, 2 * count, 5] = axis[:, 2] / LEAN, -axis[:, 1] / LEAN
        slopes[:, 2 * count + 1, 3], slopes[:, 2 * count + 1, 5] = -axis[:, 2] / LEAN, axis[:, 0] / LEAN
        return slopes


def second_differences(values: np.ndarray) -> np.ndarray:
    """Second differences (T - 2, ...) along the frames."""
    return values[2:] - 2.0 * values[1:-1] + values[:-2]


def _arguments(pose: Pose, shared: np.ndarray) -> tuple[Array, Array, Array]:
    """Of `_moved` in all frames: turns, changes and what is shared."""
    change = np.concatenate([pose.place, np.zeros_like(pose.place), pose.angles.reshape(len(pose.place), -1)], axis=1)
    turn, moved, common = (jnp.asarray(each, jnp.float32) for each in (pose.turn, change, shared))
    return turn, moved, common


def _after(pose: Pose, change: np.ndarray) -> Pose:
    """The pose after a step (T, D) of place, turn and angles."""
    turn = Rotation.from_rotvec(change[:, 3:6]).as_matrix() @ pose.turn
    return Pose(pose.place + change[:, :3], turn, pose.angles + change[:, 6:].reshape(pose.angles.shape))


def _between(frames: np.ndarray, changes: np.ndarray, turns: np.ndarray, count: int) -> Pose:
    """The pose in all of so many frames, from some of them."""
    at = np.clip(np.arange(count), frames[0], frames[-1])
    mix = lambda values: np.stack([np.interp(at, frames, each) for each in values.T], axis=1)  # noqa: E731
    turn = Rotation.from_matrix(turns)
    between = Slerp(frames, turn)(at) if len(frames) > 1 else Rotation.concatenate([turn] * count)
    return Pose(mix(changes[:, :3]), between.as_matrix(), mix(changes[:, 6:]).reshape(count, -1, 3))


def lift(keypoints: Keypoints, camera: Camera, known: bool = True) -> Lifted:
    """The figure in all frames, of which the first and the last show most of a person.

    known: whether it is known where the camera stands; else its tilt and height are estimated, from the given ones on.
    """
    lifter = _Lifter(keypoints, camera, known)
    pose, shared = lifter.solved()
    apart = np.linalg.norm(lifter.now(pose, shared).places - keypoints.places, axis=-1)
    found = camera if known else _seen_by(camera, shared)
    return Lifted(pose, shared[:SHARED], found, float(np.nanmedian(apart)))

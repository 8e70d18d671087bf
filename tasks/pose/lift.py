"""Kinematic start: a figure fitted to the keypoints of a film, without any physics.

    minimise over x_t = (place, turn, angles), proportions b and the unknowns of the camera

        sum_t  sum_i c_it rho(|project(p_i(x_t, b)) - y_it| / sigma)      points lie where the detector saw them
             + |hinge(angles)|^2 + |S^(-1/2) (angles - m)|^2              joint angles are within limits, and usual
             + sum_i sqrt(1 + |p_i'' / s_i|^2)                            accelerations are small
             + sum_feet a_ft |p_f'|^2 + a_ft h_f^2 + |min(0, h_f)|^2      feet that stand are on the ground, and stay
             + a_t |c - p - c'' z / g|^2                                  a body that no foot supports falls over
        + |(b - b_usual) / sigma_b|^2

rho is Geman and McClure's, m and S are those of the project's own motions, a_ft says how likely a foot stands (both by
iteratively reweighted least squares); c is the centre of mass and p the mean position of the feet that stand.

Starting from frames solved alone (`pose.alone`), all frames are solved together by Levenberg-Marquardt steps,
whose matrix is banded with a border (`pose.banded`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.spatial.transform import Rotation

from tasks.pose.banded import Banded
from tasks.pose.camera import Camera
from tasks.pose.figure import SHARED, SOLE, USUAL, Figure, Pose, figure
from tasks.pose.image import COMMON, HEIGHT, ROLL, TILT, moved, seen_by
from tasks.pose.per_frame import Alone
from tasks.pose.points import FEET, POINTS, SIDES, Keypoints
from tasks.pose.prior import within
from tasks.pose.rows import by_rows, single

# Standard deviations: of a detector's points, as a share of the image's larger side; of the body's size, as a share.
PIXELS, GROWN = 0.004, 0.06
# Standard deviations of `figure.PROPORTIONS` and of the shoulders' shift: detectors place hips and trunks with a bias,
# limbs differ little.
VARIED = (0.15, 0.15, 0.15, 0.15, 0.06, 0.12, 0.06, 0.06, 0.1, 0.15)
LIMBS = ("upper_arm", "lower_arm"), ("thigh", "shin", "foot")
# Scales of accelerations [m/s^2]: trunk and head, arms and legs.
TRUNK = 12.0
QUICK = {"elbow": 40.0, "wrist": 40.0, "knee": 50.0, "ankle": 50.0, "heel": 50.0, "toe": 50.0}
# Scales of a standing foot's speed [m/s], of its height and of its depth in the ground [m]; speed [m/s] and height [m]
# at which a foot may stand.
STILL, LEVEL, SUNK, SLOW, LOW = 0.10, 0.015, 0.005, 0.8, 0.08
# Residuals beyond this number of standard deviations are weighted down.
OUTLIER = 6.0
STEPS = 40
# Standard deviation of the body's height, as a share, where the height is known or the camera is not. In the latter
# case no image shows the scale and a small body accelerates least, so people are taken to be as tall as usual.
UNSEEN = 0.005
# Standard deviation [m] of the centre of pressure around the feet that stand; mass nearest to each point, as a share.
BORNE = 0.08
MASSES = {"nose": 0.07, "shoulder": 0.16, "elbow": 0.035, "wrist": 0.02, "hip": 0.16, "knee": 0.06, "ankle": 0.03}
GRAVITY = 9.81
# Standard deviation of the height of a detector's heel and toe points in a foot that stands [m].
SOLES = 0.02

_SWAPS = (
    [[POINTS.index(f"{side}_{limb}") for limb in ("shoulder", "elbow", "wrist")] for side in SIDES],
    [[POINTS.index(f"{side}_{limb}") for limb in ("hip", "knee", "ankle", "heel", "toe")] for side in SIDES],
)


class Lifted(NamedTuple):
    """Figure fitted to all frames.

    pose: see `figure.Pose`. proportions: (11,), see `Figure`. camera: as given, or as estimated. error: median
    reprojection error of the points that were seen [px].
    """

    pose: Pose
    proportions: np.ndarray
    camera: Camera
    error: float


class Now(NamedTuple):
    """Quantities that follow from a pose and the shared values.

    points: (T, P, 3) [m]. places: (T, P, 2) [px]. unlike: `likely.within` (T, K). heights: of the soles (T, 4) [m].
    """

    points: np.ndarray
    places: np.ndarray
    unlike: np.ndarray
    heights: np.ndarray


class Term(NamedTuple):
    """Residuals (F, K) with weights (F, K), and derivatives (F, K, D + S) by frames f + offset and shared values."""

    weights: np.ndarray
    residual: Callable[[Now], np.ndarray]
    slopes: tuple[tuple[int, np.ndarray], ...]


class _Lifter:
    """Least-squares problem of one film."""

    def __init__(self, keypoints: Keypoints, camera: Camera, known: bool, height: float | None) -> None:
        self.keypoints, self.camera, self.known, self.figure = keypoints, camera, known, figure()
        self.sigma = noise(keypoints, camera)
        self.alone = Alone(keypoints, camera, self.sigma)
        unknown = (1e-4, 1e-4, 1e-4) if known else (TILT, ROLL, HEIGHT)
        if height is None and not known:
            height = USUAL
        seconds, sigma = len(keypoints) / keypoints.rate, np.array([GROWN, *VARIED, *unknown, SOLES, SOLES])
        self.usual, self.prior = np.zeros(COMMON), seconds * np.diag(1.0 / sigma**2)
        if height is not None:  # a prior on the height, which depends on all proportions
            along = np.zeros(COMMON)
            along[:SHARED] = jax.grad(self.figure.height)(jnp.zeros(SHARED)) / USUAL
            self.usual[0] = np.log(height / USUAL)
            self.prior += seconds * np.outer(along, along) / UNSEEN**2

    def solved(self) -> tuple[Pose, np.ndarray]:
        """Return the pose and the shared values (S,)."""
        begin = self.usual if self.known else self.alone.tilted(self.usual)
        pose, shared = self.together(self.alone.first(begin), begin, STEPS // 2)
        names = [self.figure.body.links[child].name for child, _, _ in self.figure.body.motors]
        for side in SIDES:
            for limb in LIMBS:
                pose = self.alone.rethought(pose, shared, tuple(names.index(f"{side}_{each}") for each in limb))
        return self.together(pose, shared, STEPS)

    def together(self, pose: Pose, shared: np.ndarray, steps: int) -> tuple[Pose, np.ndarray]:
        """Return the pose and the shared values (S,) after at most `steps` steps on all frames together."""
        places, confidence = self.keypoints.places, self.keypoints.confidence
        for again in range(3):
            damping = 1e-2
            if again:
                places, confidence = self._unswapped(pose, shared, places, confidence)
            for _ in range(steps // 3):
                terms = self.terms(pose, shared, places, confidence)
                normal = Banded(len(pose.place), 6 + 3 * self.figure.joints, len(shared))

                def cost(now: Now, shared: np.ndarray, terms: list[Term] = terms) -> float:
                    unusual = shared - self.usual
                    fit = sum(float(np.sum(weights * of(now) ** 2)) for weights, of, _ in terms)
                    return fit + float(unusual @ self.prior @ unusual)

                here = self.now(pose, shared)
                for weights, residual, slopes in terms:
                    normal.add(weights, residual(here), slopes)
                normal.share(self.prior, shared - self.usual)
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
        """Return the places and confidence of keypoints, left and right exchanged where they then fit better."""
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
        """Return the residual terms around a pose, with weights and derivatives evaluated there."""
        frames, count, rate = len(pose.place), len(POINTS), self.keypoints.rate
        now = self.now(pose, shared)
        x, y, of_unlike = self.derivatives(pose, shared)
        each = 30.0 / rate  # neighbouring frames at a high frame rate add little information
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
            Term(np.full(now.unlike.shape, each), lambda now: now.unlike, ((0, of_unlike),)),
        ]  # fmt: skip

    def balance(self, now: Now, stands: np.ndarray, x: np.ndarray) -> Term:
        """Return the residuals of balance, x'' = (x - p) g / z: a body that no foot supports falls over.

        x is the centre of mass at height z, p the centre of pressure, the mean of the feet weighted by `stands`.
        """
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
        """Return the quantities that follow from a pose and the shared values (S,)."""
        points, places, unlike = self.by_frames(_all_followed, pose, shared)
        return Now(points, places, unlike, points[:, FEET, 2] - SOLE - np.tile(shared[-2:], 2))

    def derivatives(self, pose: Pose, shared: np.ndarray) -> list[np.ndarray]:
        """Return derivatives by pose and shared values.

        They are those of points (T, 3 P, D + S), places (T, 2 P, D + S) and `likely.within` (T, K, D + S).
        """
        found = self.by_frames(_all_slopes, pose, shared)
        return [each.reshape(len(each), -1, each.shape[-1]) for each in found]

    def by_frames(self, function: Callable[..., Any], pose: Pose, shared: np.ndarray) -> Any:
        """Return the result of a compiled `_followed` or `_slopes` for all frames."""
        still = np.zeros_like(pose.place)
        change = np.concatenate([pose.place, still, pose.angles.reshape(len(pose.place), -1)], axis=1)
        camera, common = single((self.camera, shared))
        return by_rows(lambda turn, change: function(self.figure, camera, turn, change, common), pose.turn, change)


def _followed(body: Figure, camera: Camera, turn: Array, change: Array, shared: Array) -> tuple[Array, ...]:
    """Return points (P, 3) [m] of one frame, their places (P, 2) [px], and the prior residuals (K,) of its pose."""
    return *moved(body, camera, turn, change, shared), within(body, turn, change)


def _slopes(body: Figure, camera: Camera, turn: Array, change: Array, shared: Array) -> tuple[Array, ...]:
    """Return the derivatives of `_followed` by change and shared values (D + S,), on their last axis."""
    both = jax.jacfwd(_followed, (3, 4))(body, camera, turn, change, shared)
    return tuple(jnp.concatenate(each, axis=-1) for each in both)


# Compiled for many frames at once; cameras are arguments, or each would be compiled anew.
_all_followed, _all_slopes = (
    jax.jit(jax.vmap(each, (None, None, 0, 0, None)), static_argnums=0) for each in (_followed, _slopes)
)


def noise(keypoints: Keypoints, camera: Camera) -> float:
    """Return the standard deviation [px] of detected keypoints."""
    return PIXELS * float(max(keypoints.size or 2.0 * np.asarray(camera.centre)))


def second_differences(values: np.ndarray) -> np.ndarray:
    """Return the second differences (T - 2, ...) of values (T, ...) along the frames."""
    return values[2:] - 2.0 * values[1:-1] + values[:-2]


def _after(pose: Pose, change: np.ndarray) -> Pose:
    """Return the pose after a step (T, D) of place, turn and angles."""
    turn = Rotation.from_rotvec(change[:, 3:6]).as_matrix() @ pose.turn
    return Pose(pose.place + change[:, :3], turn, pose.angles + change[:, 6:].reshape(pose.angles.shape))


def lift(keypoints: Keypoints, camera: Camera, known: bool = True, height: float | None = None) -> Lifted:
    """Return the figure fitted to all frames, of which the first and the last must show most of a person.

    known: whether the camera's position is known; else its tilt and height are estimated, starting from the given ones.
    height: of the person [m], where it is known; the usual one by default where the camera is not known.
    """
    lifter = _Lifter(keypoints, camera, known, height)
    pose, shared = lifter.solved()
    apart = np.linalg.norm(lifter.now(pose, shared).places - keypoints.places, axis=-1)
    found = camera if known else seen_by(camera, shared)
    return Lifted(pose, shared[:SHARED], found, float(np.nanmedian(apart)))

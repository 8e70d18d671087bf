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

Starting from frames solved alone (`pose.per_frame`), all frames are solved together by Levenberg-Marquardt steps,
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

from larp_model.errors import InputError
from mpc.damping import next_damping
from tasks.pose.banded import Banded
from tasks.pose.figure import SHARED, SOLE_HEIGHT, USUAL_HEIGHT, Figure, Pose, figure
from tasks.pose.image import HEIGHT_STD, ROLL_STD, SHARED_VALUES, TILT_STD, points_and_places
from tasks.pose.per_frame import PerFrameFit
from tasks.pose.points import FEET, POINTS, SIDES
from tasks.pose.prior import prior_residuals
from tasks.pose.rows import by_rows, single
from tasks.pose.views import OUTLIER, Viewpoint, Views, places_in_all

# Standard deviation of the body's size, as a share.
SIZE_STD = 0.06
# Standard deviations of `figure.PROPORTIONS` and of the shoulders' shift: detectors place hips and trunks with a bias,
# limbs differ little.
PROPORTION_STD = (0.15, 0.15, 0.15, 0.15, 0.06, 0.12, 0.06, 0.06, 0.1, 0.15)
LIMBS = ("upper_arm", "lower_arm"), ("thigh", "shin", "foot")
# Scales of accelerations [m/s^2]: trunk and head, arms and legs.
TRUNK_ACCELERATION = 12.0
ACCELERATIONS = {"elbow": 40.0, "wrist": 40.0, "knee": 50.0, "ankle": 50.0, "heel": 50.0, "toe": 50.0}
# Scales of a standing foot's speed [m/s], of its height and of its depth in the ground [m]; speed [m/s] and height [m]
# at which a foot may stand.
FOOT_SPEED, FOOT_HEIGHT, FOOT_DEPTH, STANDING_SPEED, STANDING_HEIGHT = 0.10, 0.015, 0.005, 0.8, 0.08
STEPS = 40
# Standard deviation of the body's height, as a share, where the height is known or the camera is not. In the latter
# case no image shows the scale and a small body accelerates least, so people are taken to be as tall as usual.
FIXED_HEIGHT_STD = 0.005
# Standard deviation [m] of the centre of pressure around the feet that stand; mass nearest to each point, as a share.
PRESSURE_STD = 0.08
MASSES = {"nose": 0.07, "shoulder": 0.16, "elbow": 0.035, "wrist": 0.02, "hip": 0.16, "knee": 0.06, "ankle": 0.03}
GRAVITY = 9.81
# Standard deviation of the height of a detector's heel and toe points in a foot that stands [m].
SOLE_STD = 0.02

_SWAPS = (
    [[POINTS.index(f"{side}_{limb}") for limb in ("shoulder", "elbow", "wrist")] for side in SIDES],
    [[POINTS.index(f"{side}_{limb}") for limb in ("hip", "knee", "ankle", "heel", "toe")] for side in SIDES],
)


class Lifted(NamedTuple):
    """Figure fitted to all frames.

    pose: see `figure.Pose`. proportions: (11,), see `Figure`. corrections: (3,) of the camera, see
    `Camera.tilted`, zeros where its position is known. error: median distance of the detected points [px or m].
    """

    pose: Pose
    proportions: np.ndarray
    corrections: np.ndarray
    error: float


class PoseQuantities(NamedTuple):
    """Quantities that follow from a pose and the shared values.

    points: (T, P, 3) [m]. places: (T, C, P, 2 or 3) [px or m]. prior: its residuals (T, K). heights: of the soles
    (T, 4) [m].
    """

    points: np.ndarray
    places: np.ndarray
    prior: np.ndarray
    heights: np.ndarray


class ResidualTerm(NamedTuple):
    """Residuals (F, K) with weights (F, K), and derivatives (F, K, D + S) by frames f + offset and shared values."""

    weights: np.ndarray
    residual: Callable[[PoseQuantities], np.ndarray]
    derivatives: tuple[tuple[int, np.ndarray], ...]


class _FilmFit:
    """Least-squares problem of a film, or of several at once."""

    def __init__(self, views: Views, position_known: bool, height: float | None) -> None:
        self.views, self.position_known, self.figure = views, position_known, figure()
        self.sigma, self.per_frame = views.sigma[:, None, None], PerFrameFit(views)
        camera_std = (1e-4, 1e-4, 1e-4) if position_known else (TILT_STD, ROLL_STD, HEIGHT_STD)
        if height is None and not position_known:
            height = USUAL_HEIGHT
        duration, std = (
            len(views) / views.rate,
            np.array([SIZE_STD, *PROPORTION_STD, *camera_std, SOLE_STD, SOLE_STD]),
        )
        self.usual, self.prior = np.zeros(SHARED_VALUES), duration * np.diag(1.0 / std**2)
        if height is not None:  # a prior on the height, which depends on all proportions
            gradient = np.zeros(SHARED_VALUES)
            gradient[:SHARED] = jax.grad(self.figure.height)(jnp.zeros(SHARED)) / USUAL_HEIGHT
            self.usual[0] = np.log(height / USUAL_HEIGHT)
            self.prior += duration * np.outer(gradient, gradient) / FIXED_HEIGHT_STD**2

    def solve(self) -> tuple[Pose, np.ndarray]:
        """Return the pose and the shared values (S,)."""
        first_values = self.usual if self.position_known else self.per_frame.with_tilt(self.usual)
        pose, shared = self.solve_together(self.per_frame.first_pose(first_values), first_values, STEPS // 2)
        names = [self.figure.body.links[child].name for child, _, _ in self.figure.body.motors]
        for side in SIDES:
            for limb in LIMBS:
                pose = self.per_frame.with_limb_solved(
                    pose, shared, tuple(names.index(f"{side}_{link}") for link in limb)
                )
        return self.solve_together(pose, shared, STEPS)

    def solve_together(self, pose: Pose, shared: np.ndarray, steps: int) -> tuple[Pose, np.ndarray]:
        """Return the pose and the shared values (S,) after at most `steps` steps on all frames together."""
        places, confidence = self.views.places, self.views.confidence
        for round_ in range(3):
            damping = 1e-2
            if round_:
                places, confidence = self._sides_corrected(pose, shared, places, confidence)
            for _ in range(steps // 3):
                terms = self.terms(pose, shared, places, confidence)
                normal_equations = Banded(len(pose.place), 6 + 3 * self.figure.joints, len(shared))

                def cost(quantities: PoseQuantities, shared: np.ndarray, terms: list[ResidualTerm] = terms) -> float:
                    deviation = shared - self.usual
                    squares = sum(
                        float(np.sum(weights * residual_of(quantities) ** 2)) for weights, residual_of, _ in terms
                    )
                    return squares + float(deviation @ self.prior @ deviation)

                current = self.quantities(pose, shared)
                current_cost = cost(current, shared)
                for weights, residual, derivatives in terms:
                    normal_equations.add(weights, residual(current), derivatives)
                normal_equations.add_prior(self.prior, shared - self.usual)
                for _ in range(8):
                    step, shared_step = normal_equations.solve(damping)
                    next_pose, next_shared = _stepped(pose, step), shared + shared_step
                    gain = current_cost - cost(self.quantities(next_pose, next_shared), next_shared)
                    damping = next_damping(damping, gain, normal_equations.gain(step, shared_step, damping))
                    if gain > 0.0:
                        pose, shared = next_pose, next_shared
                        break
                else:
                    break  # no step lowers the cost any more
        return pose, shared

    def _sides_corrected(
        self, pose: Pose, shared: np.ndarray, places: np.ndarray, confidence: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the places and confidence of keypoints, left and right exchanged where they then fit better."""
        fitted = self.quantities(pose, shared).places
        places, confidence = places.copy(), confidence.copy()
        for left, right in _SWAPS:
            side_rows, other_rows = left + right, right + left

            def misfit(rows: list[int], side_rows: list[int] = side_rows) -> np.ndarray:
                offsets = (fitted[..., side_rows, :] - places[..., rows, :]) / self.sigma
                distances = np.minimum(np.linalg.norm(offsets, axis=-1), 20.0)
                total: np.ndarray = np.nansum(distances * confidence[..., rows], axis=-1)
                return total

            is_swapped = misfit(side_rows) > 1.3 * misfit(other_rows) + 10.0
            places[..., side_rows, :] = np.where(
                is_swapped[..., None, None], places[..., other_rows, :], places[..., side_rows, :]
            )
            confidence[..., side_rows] = np.where(
                is_swapped[..., None], confidence[..., other_rows], confidence[..., side_rows]
            )
        return places, confidence

    def terms(self, pose: Pose, shared: np.ndarray, places: np.ndarray, confidence: np.ndarray) -> list[ResidualTerm]:
        """Return the residual terms around a pose, with weights and derivatives evaluated there."""
        frames, rate = len(pose.place), self.views.rate
        quantities = self.quantities(pose, shared)
        of_points, of_places, of_prior = self.derivatives(pose, shared)
        frame_weight = 30.0 / rate  # neighbouring frames at a high frame rate add little information
        is_detected = (confidence > 0.0)[..., None]
        scale = np.repeat(self.views.sigma, places[0, 0].size)[:, None]

        def image(quantities: PoseQuantities) -> np.ndarray:
            residuals: np.ndarray = np.where(is_detected, quantities.places - np.nan_to_num(places), 0.0) / self.sigma
            return residuals.reshape(frames, -1)

        image_residuals = image(quantities).reshape(places.shape)
        image_weights = frame_weight * confidence / (1.0 + (image_residuals**2).sum(axis=-1) / OUTLIER**2) ** 2
        scales = np.array([ACCELERATIONS.get(name.partition("_")[2], TRUNK_ACCELERATION) for name in POINTS]) / rate**2
        acceleration_weights = (
            frame_weight
            / scales**2
            / np.sqrt(1.0 + (second_differences(quantities.points) ** 2).sum(axis=-1) / scales**2)
        )
        feet, heights = quantities.points[:, FEET], quantities.heights
        speed = np.linalg.norm(np.diff(feet, axis=0), axis=-1) * rate
        speed = np.minimum(np.concatenate([speed[:1], speed]), np.concatenate([speed, speed[-1:]]))
        standing = (
            np.exp(-((np.maximum(heights, 0.0) / STANDING_HEIGHT) ** 2)) / (1.0 + (speed / STANDING_SPEED) ** 2) ** 2
        )
        foot_weights = frame_weight * np.minimum(standing[1:], standing[:-1]) / (FOOT_SPEED / rate) ** 2
        foot_rows = [3 * foot + axis for foot in FEET for axis in range(3)]
        of_heights = of_points[:, [3 * foot + 2 for foot in FEET]]
        of_heights[:, [0, 2], -2] -= 1.0
        of_heights[:, [1, 3], -1] -= 1.0
        return [
            ResidualTerm(
                np.repeat(image_weights.reshape(frames, -1), places.shape[-1], axis=1), image, ((0, of_places / scale),)
            ),
            ResidualTerm(
                np.repeat(acceleration_weights, 3, axis=1),
                lambda quantities: second_differences(quantities.points).reshape(frames - 2, -1),
                ((0, of_points[:-2]), (1, -2.0 * of_points[1:-1]), (2, of_points[2:])),
            ),
            ResidualTerm(
                np.repeat(foot_weights, 3, axis=1),
                lambda quantities: np.diff(quantities.points[:, FEET], axis=0).reshape(frames - 1, -1),
                ((0, -of_points[:-1, foot_rows]), (1, of_points[1:, foot_rows])),
            ),
            ResidualTerm(
                frame_weight * (standing / FOOT_HEIGHT**2 + (heights < 0.0) / FOOT_DEPTH**2),
                lambda quantities: quantities.heights,
                ((0, of_heights),),
            ),
            self.balance(quantities, standing, of_points),
            ResidualTerm(
                np.full(quantities.prior.shape, frame_weight), lambda quantities: quantities.prior, ((0, of_prior),)
            ),
        ]

    def balance(self, quantities: PoseQuantities, standing: np.ndarray, of_points: np.ndarray) -> ResidualTerm:
        """Return the residuals of balance, x'' = (x - p) g / z: a body that no foot supports falls over.

        x is the centre of mass at height z, p the centre of pressure, the mean of the feet weighted by `standing`.
        """
        rate, mass = self.views.rate, np.array([MASSES.get(name.rpartition("_")[2], 0.0) for name in POINTS])
        mass /= mass.sum()
        share = standing[1:-1] + 1e-9
        share = share / share.sum(axis=1, keepdims=True)
        feet = quantities.points[1:-1, FEET, :2]
        offsets = feet - (share[..., None] * feet).sum(axis=1, keepdims=True)
        variance = PRESSURE_STD**2 + (share * (offsets**2).sum(axis=-1)).sum(axis=1)
        weights = 30.0 / rate * standing[1:-1].max(axis=1) / variance
        factor = (np.maximum(quantities.points[1:-1, :, 2] @ mass, 0.3) * rate**2 / GRAVITY)[:, None]

        def residual(quantities: PoseQuantities) -> np.ndarray:
            centre = np.einsum("p,tpx->tx", mass, quantities.points[..., :2])
            pressure = (share[..., None] * quantities.points[1:-1, FEET, :2]).sum(axis=1)
            imbalance: np.ndarray = centre[1:-1] - pressure - factor * second_differences(centre)
            return imbalance

        by_point = of_points.reshape(len(of_points), len(POINTS), 3, -1)[:, :, :2]
        of_centre = np.einsum("p,tpxd->txd", mass, by_point)
        of_feet = (share[..., None, None] * by_point[1:-1, FEET]).sum(axis=1)
        factor_by_value = factor[..., None]
        return ResidualTerm(
            np.repeat(weights[:, None], 2, axis=1),
            residual,
            (
                (0, -factor_by_value * of_centre[:-2]),
                (1, (1.0 + 2.0 * factor_by_value) * of_centre[1:-1] - of_feet),
                (2, -factor_by_value * of_centre[2:]),
            ),
        )

    def quantities(self, pose: Pose, shared: np.ndarray) -> PoseQuantities:
        """Return the quantities that follow from a pose and the shared values (S,)."""
        points, places, prior = self.by_frames(_all_quantities, pose, shared)
        return PoseQuantities(points, places, prior, points[:, FEET, 2] - SOLE_HEIGHT - np.tile(shared[-2:], 2))

    def derivatives(self, pose: Pose, shared: np.ndarray) -> list[np.ndarray]:
        """Return derivatives by pose and shared values.

        They are those of points (T, 3 P, D + S), places (T, 2 C P or 3 P, D + S) and prior residuals (T, K, D + S).
        """
        stacked = self.by_frames(_all_derivatives, pose, shared)
        return [derivatives.reshape(len(derivatives), -1, derivatives.shape[-1]) for derivatives in stacked]

    def by_frames(self, function: Callable[..., Any], pose: Pose, shared: np.ndarray) -> Any:
        """Return the result of a compiled `_frame_quantities` or `_frame_derivatives` for all frames."""
        no_rotation = np.zeros_like(pose.place)
        change = np.concatenate([pose.place, no_rotation, pose.angles.reshape(len(pose.place), -1)], axis=1)
        cameras, shared_values = single((self.views.cameras, shared))
        return by_rows(
            lambda turn, change: function(self.figure, cameras, turn, change, shared_values), pose.turn, change
        )


def _frame_quantities(
    body: Figure, cameras: tuple[Viewpoint, ...], turn: Array, change: Array, shared: Array
) -> tuple[Array, ...]:
    """Return points (P, 3) [m] of one frame, their places (C, P, 2 or 3), and the prior residuals (K,) of its pose."""
    return *points_and_places(body, cameras, turn, change, shared), prior_residuals(body, turn, change)


def _frame_derivatives(
    body: Figure, cameras: tuple[Viewpoint, ...], turn: Array, change: Array, shared: Array
) -> tuple[Array, ...]:
    """Return the derivatives of `_frame_quantities` by change and shared values (D + S,), on their last axis."""
    by_argument = jax.jacfwd(_frame_quantities, (3, 4))(body, cameras, turn, change, shared)
    return tuple(jnp.concatenate(parts, axis=-1) for parts in by_argument)


# Compiled for many frames at once; cameras are arguments, or each would be compiled anew.
_all_quantities, _all_derivatives = (
    jax.jit(jax.vmap(function, (None, None, 0, 0, None)), static_argnums=0)
    for function in (_frame_quantities, _frame_derivatives)
)


def second_differences(values: np.ndarray) -> np.ndarray:
    """Return the second differences (T - 2, ...) of values (T, ...) along the frames."""
    differences: np.ndarray = values[2:] - 2.0 * values[1:-1] + values[:-2]
    return differences


def _stepped(pose: Pose, change: np.ndarray) -> Pose:
    """Return the pose after a step (T, D) of place, turn and angles."""
    turn = Rotation.from_rotvec(change[:, 3:6]).as_matrix() @ pose.turn
    return Pose(pose.place + change[:, :3], turn, pose.angles + change[:, 6:].reshape(pose.angles.shape))


def lift(views: Views, position_known: bool = True, height: float | None = None) -> Lifted:
    """Return the figure fitted to all frames, of which the first and the last must show most of a person.

    position_known: whether the cameras' positions are known; else the tilt and height of one are estimated, from its
    own ones. height: of the person [m], where it is known; the usual one by default where the camera is not known.
    """
    if not position_known and len(views.cameras) > 1:
        raise InputError(f"cameras are {len(views.cameras)}, whose positions are not all known, but must be")
    film_fit = _FilmFit(views, position_known, height)
    pose, shared = film_fit.solve()
    corrections = np.zeros(3) if position_known else shared[SHARED : SHARED + 3]
    points = figure().all_points(pose, shared[:SHARED])
    distances = np.linalg.norm(places_in_all(views.corrected(corrections).cameras, points) - views.places, axis=-1)
    return Lifted(pose, shared[:SHARED], corrections, float(np.nanmedian(distances)))

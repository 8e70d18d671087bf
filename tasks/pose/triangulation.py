"""Triangulation: points in space from their places in the images of several cameras."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from tasks.pose.camera import Camera
from tasks.pose.views import OUTLIER, places_in_all


def triangulated(
    cameras: Sequence[Camera], places: np.ndarray, confidence: np.ndarray, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return points (T, P, 3) [m] and the distances (T, C, P) [px] of their projections from the places.

    places (T, C, P, 2) [px] of confidence (T, C, P), 0 where not detected; sigma: standard deviation (C,) [px] of the
    places in each image. Of the points that each two cameras see, the one that lies nearest to all images is taken, and
    is solved again by all images in which it is no outlier. NaN where fewer than two cameras see a point.
    """
    weights = np.where(np.isfinite(places[..., 0]), confidence, 0.0)
    frames, _, count = weights.shape
    points, least_cost = np.full((frames, count, 3), np.nan), np.full((frames, count), np.inf)
    for pair in map(list, combinations(range(len(cameras)), 2)):
        candidates = _nearest_to_rays(cameras, places, _of_views(weights, pair), sigma)
        misfit = np.minimum(_distances(cameras, candidates, places) / sigma[:, None], OUTLIER)
        cost = np.where((weights[:, pair] > 0.0).all(axis=1), np.nansum(weights * misfit**2, axis=1), np.inf)
        better = cost < least_cost
        points[better], least_cost[better] = candidates[better], cost[better]
    inliers = np.where(_distances(cameras, points, places) < OUTLIER * sigma[:, None], weights, 0.0)
    refined = _nearest_to_rays(cameras, places, inliers, sigma)
    points = np.where((inliers > 0.0).sum(axis=1)[..., None] >= 2, refined, points)
    return points, _distances(cameras, points, places)


def _of_views(weights: np.ndarray, views: list[int]) -> np.ndarray:
    """Return the weights (T, C, P), 0 but in some views."""
    result = np.zeros_like(weights)
    result[:, views] = weights[:, views]
    return result


def _distances(cameras: Sequence[Camera], points: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return the distances (T, C, P) [px] of points' projections from places, NaN where either is not known."""
    distances: np.ndarray = np.linalg.norm(places_in_all(cameras, points) - places, axis=-1)
    return distances


def _nearest_to_rays(
    cameras: Sequence[Camera], places: np.ndarray, weights: np.ndarray, sigma: np.ndarray
) -> np.ndarray:
    """Return the points (T, P, 3) [m] nearest to the rays of places of weights (T, C, P), as the images measure it."""
    positions = np.stack([camera.position for camera in cameras])[:, None]
    rays = np.stack([camera.ray(np.nan_to_num(places[:, view])) for view, camera in enumerate(cameras)], axis=1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    points = _solved(positions, across, weights)
    pixels_at_a_metre = (np.array([camera.focal for camera in cameras]) / sigma)[:, None]
    for _ in range(2):
        depth = np.maximum(((points[:, None] - positions) * rays).sum(axis=-1), 0.1)
        points = _solved(positions, across, weights * (pixels_at_a_metre / depth) ** 2)
    return points


def _solved(positions: np.ndarray, across: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the points (T, P, 3) of least weighted squares of the distances from rays through positions (C, 1, 3).

    across: (T, C, P, 3, 3), projections onto the plane across each ray.
    """
    weighted = weights[..., None, None] * across
    matrix, right_side = weighted.sum(axis=1), (weighted @ positions[..., None]).sum(axis=1)
    # Rays that are parallel, or none, leave a direction open.
    matrix += 1e-9 * (1.0 + weights.sum(axis=1)[..., None, None]) * np.eye(3)
    points: np.ndarray = np.linalg.solve(matrix, right_side)[..., 0]
    return points

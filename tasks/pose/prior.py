"""Prior on poses: joint limits, the distribution of the project's own motions, and an upright trunk."""

from __future__ import annotations

from functools import cache

import jax.numpy as jnp
import numpy as np
from jax import Array

from larp_model.rotation import from_rotation_vector, matrix
from tasks.motions import styles
from tasks.pose.figure import Figure, figure

# Standard deviations of angles beyond a joint's limits [rad], and of a trunk's lean [rad].
LIMIT_STD, LEAN_STD = 0.05, 0.6
# Standard deviation [rad] that is added to that of the project's own motions, as people's poses differ more.
EXTRA_STD = 0.15
# Number of initial poses, unlike each other, from which frames are solved alone.
INITIAL_POSES = 4


@cache
def usual_poses() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean and whitening matrix of joint angles, and some poses unlike each other.

    Shapes: (J * 3,) [rad], (J * 3, J * 3), a square root of the inverse covariance, and (POSES, J, 3) [rad].
    """
    random, body = np.random.default_rng(0), figure().body
    motions = (
        styles.kicks(random, body, random.integers(0, 60, 160), 120, 0.01)[:, ::8],
        styles.gaits(random, body, 160, 100, 0.01)[:, ::8],
        styles.moves(random, body, 120, 100, 0.01)[:, ::8],
    )
    angles = np.concatenate([angles_of_motion.reshape(-1, *angles_of_motion.shape[2:]) for angles_of_motion in motions])
    angles = np.concatenate([angles, styles.mirrored(body, angles)])
    flat = angles.reshape(len(angles), -1)
    mean, covariance = flat.mean(axis=0), np.cov(flat.T) + EXTRA_STD**2 * np.eye(flat.shape[1])
    whitening = np.linalg.cholesky(np.linalg.inv(covariance)).T
    poses = [mean]  # poses unlike each other, but not the oddest
    nearest = np.linalg.norm((flat - poses[0]) @ whitening.T, axis=1)
    while len(poses) < INITIAL_POSES:
        poses.append(flat[np.argsort(nearest)[int(0.9 * len(flat))]])
        nearest = np.minimum(nearest, np.linalg.norm((flat - poses[-1]) @ whitening.T, axis=1))
    return mean, whitening, np.reshape(poses, (INITIAL_POSES, -1, 3))


def prior_residuals(body: Figure, turn: Array, change: Array) -> Array:
    """Return the prior residuals (K,) of one pose, by its turn (3, 3) and change (D,), see `image.points_and_places`.

    They are angles beyond the limits, whitened angles and the lean, each in standard deviations.
    """
    mean, whitening, _ = usual_poses()
    angles = change[6:]
    lower, upper = (jnp.asarray(limit.ravel(), change.dtype) for limit in (body.lower, body.upper))
    beyond = (jnp.minimum(angles - lower, 0.0) + jnp.maximum(angles - upper, 0.0)) / LIMIT_STD
    unusual = jnp.asarray(whitening, change.dtype) @ (angles - jnp.asarray(mean, change.dtype))
    upright = (matrix(from_rotation_vector(change[3:6])) @ turn)[:2, 2] / LEAN_STD
    return jnp.concatenate([beyond, unusual, upright])

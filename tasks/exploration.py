"""Random deviations of joint targets from a reference: what planners explore, and what episodes are disturbed by."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from larp_model.bodies import segment_of
from larp_model.scene import Scene

# Standard deviation of joint targets by segment [rad].
EXPLORATION_STD = {
    "abdomen": 0.08,
    "torso": 0.15,
    "chest": 0.08,
    "neck": 0.03,
    "head": 0.05,
    "collar": 0.05,
    "upper_arm": 0.15,
    "lower_arm": 0.10,
    "hand": 0.10,
    "fingers": 0.15,
    "thumb": 0.10,
    "thigh": 0.25,
    "shin": 0.25,
    "foot": 0.20,
    "toes": 0.10,
}


def exploration_std(scene: Scene) -> np.ndarray:
    """Return `EXPLORATION_STD` by motor and axis (J, 3) [rad], a fifth of it on axes with a range up to 0.45 rad."""
    rows = []
    for body in scene.bodies:
        for child, _, motor in body.motors:
            free = np.subtract(motor.upper, motor.lower) > 0.45
            rows.append(EXPLORATION_STD[segment_of(body.links[child].name)] * np.where(free, 1.0, 0.2))
    return np.array(rows)


def smooth_noise(random: np.random.Generator, count: int, steps: int, knots: int, scale: np.ndarray) -> np.ndarray:
    """Return smooth noise (count, steps, J, 3): splines through `knots` normal values of deviation `scale` (J, 3)."""
    values = random.standard_normal((count, knots, *scale.shape)) * scale
    noise: np.ndarray = CubicSpline(np.linspace(0.0, 1.0, knots), values, axis=1)(np.linspace(0.0, 1.0, steps))
    return noise

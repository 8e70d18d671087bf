"""Random kicks: targets, places of the ball and velocities of a rolling one, as benchmarks draw them."""

from __future__ import annotations

import numpy as np

# Bearing [degrees], distance [m] and height [m] of targets; largest shift of the ball [m].
BEARING, DISTANCE, HEIGHT, SHIFT = 25.0, (2.0, 5.0), (0.11, 1.0), 0.03


def random_roll(random: np.random.Generator, fastest: float) -> np.ndarray:
    """Return a velocity (2,) [m/s], up to `fastest`, of a ball that comes from ahead or from the kicking side."""
    bearing = np.radians(random.uniform(-90.0, 30.0))
    return -random.uniform(0.0, fastest) * np.array([np.cos(bearing), np.sin(bearing)])


def random_kick(random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a target (3,) [m] and a shift of the ball (2,) [m]."""
    bearing = np.radians(random.uniform(-BEARING, BEARING))
    distance, height = random.uniform(*DISTANCE), random.uniform(*HEIGHT)
    return (
        np.array([distance * np.cos(bearing), distance * np.sin(bearing), height]),
        random.uniform(-SHIFT, SHIFT, 2),
    )

"""Detection of the strike: the ball leaves the path that it would take if nothing but the ground touched it."""

from __future__ import annotations

import numpy as np

from larp_model import state as packed
from larp_model.engines.mujoco import FINE_SUBSTEPS, Truth
from larp_model.scene import Scene

# The ball has been struck when its velocity differs by more than this from the untouched ball's [m/s].
STRUCK = 0.3
# Before the reference strikes, a smaller difference is a graze, after which the strike is still to come [m/s].
GRAZED = 1.0


def untouched(scene: Scene, state: np.ndarray, steps: int, substeps: int = FINE_SUBSTEPS) -> np.ndarray:
    """Return states (steps + 1, 13) of the untouched ball, the scene's last link, from a state (L, 13) on.

    substeps: engine steps of the ground truth in a step.
    """
    truth = Truth(scene.only(scene.ball.name), 1, substeps, threads=1)
    ball = state[None, -1:]
    after, _ = truth.rollout(ball, np.zeros((1, steps, 0, 3)))
    return np.concatenate([ball[0], after[0][:, 0]])


def is_struck(ball: np.ndarray, free: np.ndarray, least: float = STRUCK) -> np.ndarray:
    """Return a mask (*) of the states (*, 13) of the ball after the strike.

    free: (*, 13), see `untouched`. least: difference of velocities from there on [m/s].
    """
    apart = ball[..., packed.VELOCITY] - free[..., packed.VELOCITY]
    mask: np.ndarray = np.linalg.norm(apart, axis=-1) > least
    return mask


def strike_step(states: np.ndarray, free: np.ndarray) -> int | None:
    """Return the first row of states (T, L, 13) in which the ball has been struck, or None if there is none.

    free: (T', 13), states of the untouched ball; the last one continues.
    """
    rows = np.minimum(np.arange(len(states)), len(free) - 1)
    struck = is_struck(states[:, -1], free[rows])
    return int(struck.argmax()) if struck.any() else None

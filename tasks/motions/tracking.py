"""Tracking of a motion by the servo-driven human in the ground truth, with planned joint targets.

    minimise over theta   mean_t sum_i w_i |x_i(t) - x_i^target(t)|^2    links are near their target positions
    subject to            S_{t+1} = dynamics(S_t, Q_t),  Q = Q^target + spline(theta)

Captured joint angles alone do not keep a free body up: its size and its ground are not the captured person's.
"""

from __future__ import annotations

import jax
import numpy as np
from jax import Array

from larp_model import state as packed
from larp_model.engines.mujoco import Truth
from larp_model.scene import Scene
from mpc import CEM, CostTerm, MujocoDynamics, Planner, Window, quadratic
from mpc.loop import Phase, execute

HORIZON = 30
KNOTS = 7
INTERVAL = 4
OPTIMIZER = CEM(samples=64, rounds=2, elites=12)
# The planner's own ground truth: engine steps per control step, enough to stand on, and parallel simulations.
SUBSTEPS, BATCH = 4, 32
# Standard deviation of the candidates' joint targets, as a share of the motors' range.
SPREAD = 0.1


class Tracker:
    """Planner that tracks the positions of target states (T, L, 13) with weights (T, L).

    controls: joint targets (T, J, 3) [rad] that the search begins from.
    """

    def __init__(self, scene: Scene, target_states: np.ndarray, weights: np.ndarray, controls: np.ndarray) -> None:
        self.scene, self.controls = scene, controls
        self.positions, self.weights = target_states[..., packed.POSITION], np.sqrt(weights)[..., None]

        def position_error(states: Array, controls: Array, context: tuple[Array, Array]) -> Array:
            positions, weights = context
            return (weights * (states[..., packed.POSITION] - positions)).reshape(len(states), -1)

        lower, upper = scene.limits
        self.planner = Planner(
            MujocoDynamics(Truth(scene, BATCH, SUBSTEPS)), [CostTerm("position", position_error, quadratic)], HORIZON,
            KNOTS, scene.dt, SPREAD * (upper - lower), OPTIMIZER, lower, upper,
        )  # fmt: skip

    def follow(self, state: np.ndarray, begin: int, end: int) -> tuple[np.ndarray, np.ndarray]:
        """Track the motion in the ground truth, from `state` (L, 13) at step `begin` to step `end`.

        Returns the states (end - begin + 1, L, 13), `state` first, and the joint targets (end - begin, J, 3) [rad].
        """

        def window(step: int) -> Window:
            rows = np.minimum(begin + step + np.arange(HORIZON + 1), len(self.positions) - 1)
            context = self.positions[rows[1:]], self.weights[rows[1:]]
            return Window(step * self.scene.dt, self.controls[rows[:-1]], context)

        def diverged(step: int, current: np.ndarray) -> bool:
            return not np.isfinite(current).all()

        execution = execute(
            Truth(self.scene), state, [Phase(self.planner, self.planner, INTERVAL, window, diverged)],
            end - begin, jax.random.key(0),
        )  # fmt: skip
        return np.array(execution.states), np.array(execution.controls)

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
from mpc import CEM, CostTerm, Dynamics, MujocoDynamics, Planner, Window, quadratic
from mpc.loop import Phase, World, execute

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

    controls: joint targets (T, J, 3) [rad] that the search begins from. dynamics: by which it plans `horizon`
    steps; MuJoCo by default.
    """

    def __init__(
        self, scene: Scene, target_states: np.ndarray, weights: np.ndarray, controls: np.ndarray,
        dynamics: Dynamics | None = None, horizon: int = HORIZON, optimizer: CEM = OPTIMIZER,
    ) -> None:  # fmt: skip
        self.scene, self.controls = scene, controls
        self.positions, self.weights = target_states[..., packed.POSITION], np.sqrt(weights)[..., None]

        def position_error(states: Array, controls: Array, context: tuple[Array, Array]) -> Array:
            positions, weights = context
            return (weights * (states[..., packed.POSITION] - positions)).reshape(len(states), -1)

        lower, upper = scene.limits
        dynamics = dynamics or MujocoDynamics(Truth(scene, BATCH, SUBSTEPS))
        self.planner = Planner(
            dynamics, [CostTerm("position", position_error, quadratic)], horizon, KNOTS, scene.dt,
            SPREAD * (upper - lower), optimizer, lower, upper,
        )  # fmt: skip

    def follow(
        self, state: np.ndarray, begin: int, end: int, world: World | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Track the motion in a world, by default the ground truth, from `state` (L, 13) at step `begin` to step `end`.

        Returns the states (end - begin + 1, L, 13), `state` first, and the joint targets (end - begin, J, 3) [rad].
        """

        def window(step: int) -> Window:
            rows = np.minimum(begin + step + np.arange(self.planner.horizon + 1), len(self.positions) - 1)
            context = self.positions[rows[1:]], self.weights[rows[1:]]
            return Window(step * self.scene.dt, self.controls[rows[:-1]], context)

        def diverged(step: int, current: np.ndarray) -> bool:
            return not np.isfinite(current).all()

        execution = execute(
            world or Truth(self.scene), state, [Phase(self.planner, self.planner, INTERVAL, window, diverged)],
            end - begin, jax.random.key(0),
        )  # fmt: skip
        return np.array(execution.states), np.array(execution.controls)

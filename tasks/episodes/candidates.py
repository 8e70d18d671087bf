"""Episodes from rollouts of a kick planner's candidates, with the ground truth as its model."""

from __future__ import annotations

import math
import time

import jax
import numpy as np

from larp_model.engines.episodes import Episodes
from larp_model.engines.mujoco import SUBSTEPS, Truth
from mpc import GaussNewton, MujocoDynamics
from mpc.dynamics import BatchedTruth
from tasks.kick import Kick
from tasks.models import ROWS, with_flight
from tasks.targets import random_kick

# Optimiser that steps as the presets do, with enough rounds for most kicks to hit.
OPTIMIZER = GaussNewton(rounds=8, directions=24)


class RecordingTruth:
    """Ground truth that stores its rollouts: states (N, L, 13), controls (N, H, J, 3) [rad], states after each step."""

    def __init__(self, truth: BatchedTruth) -> None:
        self.truth = truth
        self.rollouts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    @property
    def batch(self) -> int:
        """Return the number of rows that are rolled out side by side."""
        return self.truth.batch

    def rollout(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `mpc.dynamics.BatchedTruth`; rollouts that stay finite are stored."""
        next_states, is_finite = self.truth.rollout(states, controls)
        self.rollouts.append((states[is_finite], controls[is_finite], next_states[is_finite]))
        return next_states, is_finite


def candidate_episodes(kick: Kick, kicks: int, per_plan: int, seed: int, seconds: float = math.inf) -> Episodes:
    """Return episodes of the first plans of `kicks` random kicks: at most `per_plan` rollouts each, with its horizon.

    seconds: time after which no other kick is begun.
    """
    random, start_time = np.random.default_rng(seed), time.perf_counter()
    recording = RecordingTruth(Truth(kick.scene, ROWS, SUBSTEPS))
    ball = MujocoDynamics(Truth(kick.scene.only(kick.scene.ball.name), ROWS, SUBSTEPS))
    planner = kick.planner(with_flight(kick.scene, MujocoDynamics(recording), ball), (OPTIMIZER,))
    chosen = []
    for index in range(kicks):
        target, shift = random_kick(random)
        plan, window = planner.init(jax.random.key(seed + index)), kick.window(target)(0)
        planner.step(plan, kick.start(shift), window._replace(steps=None))
        states, controls, next_states = (np.concatenate(rows) for rows in zip(*recording.rollouts, strict=True))
        recording.rollouts.clear()
        rows = random.choice(len(states), min(per_plan, len(states)), replace=False)
        trajectories = np.concatenate([states[rows, None], next_states[rows]], axis=1)
        chosen.append((trajectories.astype(np.float32), controls[rows].astype(np.float32)))
        if time.perf_counter() - start_time > seconds:
            break
    states, controls = (np.concatenate(rows) for rows in zip(*chosen, strict=True))
    count, links = len(states), len(kick.scene.links)
    sizes = np.broadcast_to(kick.scene.morphology.astype(np.float32), (count, links, 3))
    return Episodes(states, controls, np.zeros((*controls.shape[:2], links, 3), np.float32), sizes)

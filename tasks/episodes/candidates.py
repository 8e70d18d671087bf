"""Episodes from rollouts of a kick planner's candidates, with the ground truth as its model."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import jax
import numpy as np

from larp_model.engines.episodes import Episodes
from larp_model.engines.mujoco import SUBSTEPS
from mpc import Continued, GaussNewton, MujocoDynamics
from mpc.dynamics import BatchedTruth
from tasks.kick import Kick
from tasks.models import models_of
from tasks.targets import random_kick

# Optimiser that steps as the presets do, with enough rounds for most kicks to hit.
STEPS = GaussNewton(rounds=8, directions=24)


class Watched:
    """Ground truth that stores its rollouts: states (N, L, 13), controls (N, H, J, 3) [rad], states after each step."""

    def __init__(self, truth: BatchedTruth) -> None:
        self.truth = truth
        self.seen: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    @property
    def batch(self) -> int:
        """Return the number of rows that are rolled out side by side."""
        return self.truth.batch

    def rollout(self, states: np.ndarray, controls: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `mpc.dynamics.BatchedTruth`; rollouts that stay finite are stored."""
        after, finite = self.truth.rollout(states, controls)
        self.seen.append((states[finite], controls[finite], after[finite]))
        return after, finite


def tried_episodes(kick: Kick, kicks: int, each: int, seed: int, seconds: float = math.inf) -> Episodes:
    """Return episodes of the first plans of `kicks` random kicks: at most `each` rollouts of a plan, with its horizon.

    seconds: time after which no other kick is begun.
    """
    random, began = np.random.default_rng(seed), time.perf_counter()
    whole = models_of(kick.scene, "mujoco", substeps=SUBSTEPS).whole
    assert isinstance(whole, Continued) and isinstance(whole.dynamics, MujocoDynamics)
    watched = Watched(whole.dynamics.truth)
    planner = kick.planner(replace(whole, dynamics=MujocoDynamics(watched)), (STEPS,))
    parts = []
    for index in range(kicks):
        target, shift = random_kick(random)
        plan, window = planner.init(jax.random.key(seed + index)), kick.window(target)(0)
        planner.step(plan, kick.start(shift), window._replace(steps=None))
        states, controls, after = (np.concatenate(rows) for rows in zip(*watched.seen, strict=True))
        watched.seen.clear()
        rows = random.choice(len(states), min(each, len(states)), replace=False)
        whole_way = np.concatenate([states[rows, None], after[rows]], axis=1)
        parts.append((whole_way.astype(np.float32), controls[rows].astype(np.float32)))
        if time.perf_counter() - began > seconds:
            break
    states, controls = (np.concatenate(rows) for rows in zip(*parts, strict=True))
    count, links = len(states), len(kick.scene.links)
    sizes = np.broadcast_to(kick.scene.morphology.astype(np.float32), (count, links, 3))
    return Episodes(states, controls, np.zeros((*controls.shape[:2], links, 3), np.float32), sizes)

"""Errors of single steps against the ground truth, beside those that the model expects of itself."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from scipy.stats import spearmanr

from larp_model import state as packed
from larp_model.engines.episodes import Episodes, record
from larp_model.engines.mujoco import Truth
from larp_model.expected_error import expected_errors
from larp_model.simulator import Simulator
from tasks.benchmarks.promises import row
from tasks.benchmarks.report import Row
from tasks.scenarios import scenario

# Episodes of which steps are drawn, and how many of these are drawn, by scenario.
EPISODES = {"human_ball": 48, "any_human": 64, "full_human": 24, "chains2": 24}
DRAWN = 1024
# Kicks are also taken up to so many times as fast.
FASTER = 3.0
# Least rank correlation of expected and true errors, and largest ratio of their means.
CORRELATION, RATIO = 0.6, 2.0


class StepErrors(NamedTuple):
    """Errors of N steps (N,) [m]: expected, and true, both as distances of the links in the mean."""

    expected: np.ndarray
    true: np.ndarray

    @property
    def correlation(self) -> float:
        """Return the rank correlation of expected and true errors."""
        return float(spearmanr(self.expected, self.true).statistic)

    @property
    def ratio(self) -> float:
        """Return the mean of the true errors as a multiple of that of the expected ones."""
        return float(self.true.mean() / self.expected.mean())


def drawn_steps(episodes: Episodes, random: np.random.Generator, count: int) -> Episodes:
    """Return `count` steps of the episodes, each an episode of one step."""
    numbers, steps = random.integers(len(episodes.states), size=count), random.integers(episodes.steps, size=count)
    return Episodes(
        np.stack([episodes.states[numbers, steps], episodes.states[numbers, steps + 1]], axis=1),
        episodes.controls[numbers, steps][:, None],
        episodes.torques[numbers, steps][:, None],
        episodes.morphology[numbers],
    )


def errors_of(simulator: Simulator, steps: Episodes) -> StepErrors:
    """Return the errors of episodes of one step."""
    before, sizes = steps.states[:, 0], steps.morphology
    step = jax.jit(simulator.step)
    after = np.asarray(step(before, steps.controls[:, 0], steps.torques[:, 0], sizes))
    distance = np.linalg.norm((after - steps.states[:, 1])[..., packed.POSITION], axis=-1)
    predicted = np.stack([before, after], axis=1)
    return StepErrors(expected_errors(simulator.scene, predicted, sizes)[:, 0], distance.mean(axis=-1))


def faster(simulator: Simulator, steps: Episodes, random: np.random.Generator) -> Episodes:
    """Return the ground truth of one step from the same states, all velocities up to `FASTER` times as large."""
    states = steps.states[:, 0].copy()
    states[..., packed.VELOCITY.start :] *= random.uniform(1.0, FASTER, (len(states), 1, 1))
    truth = Truth(simulator.scene, batch=256)
    return record(truth, states, steps.controls, steps.torques, steps.morphology)[0]


def expected(seed: int, drawn: int = DRAWN) -> list[Row]:
    """Return rows that compare expected and true errors of steps, scenario by scenario and of all together."""
    random, results = np.random.default_rng(seed), dict[str, StepErrors]()
    for name, count in EPISODES.items():
        chosen = scenario(name)
        simulator = Simulator.of_physics(chosen.scene)
        steps = drawn_steps(chosen.draw(count, seed)[0], random, drawn)
        results[name] = errors_of(simulator, steps)
        if name == "human_ball":
            results[f"{name}, up to {FASTER:g} times as fast"] = errors_of(simulator, faster(simulator, steps, random))
    rows = []
    for name, errors in results.items():
        promise = f"true errors within a factor of {RATIO:g} of the expected ones in the mean"
        true, foreseen = 1e3 * errors.true.mean(), 1e3 * errors.expected.mean()
        observation = f"{true:.2f} mm, expected {foreseen:.2f}; rank correlation {errors.correlation:.2f}"
        rows.append(row("error of a step", name, promise, observation, 1.0 / RATIO <= errors.ratio <= RATIO))
    together = StepErrors(*(np.concatenate(columns) for columns in zip(*results.values(), strict=True)))
    promise = f"rank correlation of expected and true errors at least {CORRELATION:g}"
    observation, passed = f"{together.correlation:.2f}", together.correlation >= CORRELATION
    return [*rows, row("error of a step", "all together", promise, observation, passed)]

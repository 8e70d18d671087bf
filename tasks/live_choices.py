"""Choices of a page: presets, models, weights and references, sensors, delays of plans; and ranges of its settings."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mpc.loop import Latency
from mpc.realtime import PlanningThread, SimulatedLatency
from tasks.models import NO_WEIGHTS, DynamicsName
from tasks.presets import Preset
from tasks.sensors import SENSORS
from tasks.task import Task
from viewer import Offer

# Ranges of the settings: targets [m], the ball's spot from its usual one [m], its velocity [m/s].
TARGETS = ((1.5, -2.5, 0.11), (6.0, 2.5, 1.5))
SPOTS = ((-0.06, -0.06), (0.06, 0.06))
ROLLS = ((-2.0, -2.0), (1.0, 2.0))
# Delays of plans by name [s], the default first: None where they are those of the clock, or the world waits.
WORLD_WAITS, REAL_TIME = "the world waits", "real time"
DELAYS = {REAL_TIME: None, WORLD_WAITS: None, "25 ms": 0.025, "50 ms": 0.05, "100 ms": 0.1}


class Choices(NamedTuple):
    """Options of the page, by name, the default first. tasks: one for each reference, created when needed."""

    tasks: Mapping[str, Callable[[], Task]]
    presets: Mapping[str, Preset]
    dynamics: tuple[DynamicsName, ...]
    weights: Mapping[str, Path | None]
    delays: tuple[str, ...] = tuple(DELAYS)

    def offer(self, task: Task) -> Offer:
        """Return the options that the page shows, with a task's cost terms and the ranges of the settings."""
        terms = tuple((term.name, term.weight) for term in task.terms)
        names = tuple(self.presets), self.dynamics, tuple(self.weights), tuple(self.tasks)
        return Offer(*names, tuple(SENSORS), self.delays, terms, TARGETS, SPOTS, ROLLS)


def weights_for(chosen: Path | None) -> dict[str, Path | None]:
    """Return the weights that can be chosen, by name: the chosen ones, if any, and none."""
    return ({} if chosen is None else {chosen.stem: chosen}) | {NO_WEIGHTS: None}


def latency_of(delay: str, dt: float, seconds: Sequence[float], speed: float, horizon: int) -> Latency | None:
    """Return the latency of plans with a delay by its name, in steps of dt [s]; None where the world waits.

    It also waits where plans take too long for real time. seconds: that recent plans took. speed: of time, as a
    fraction of real time. horizon: of the plans, in steps.
    """
    if delay == REAL_TIME:
        thread = PlanningThread(dt, speed * float(np.median(seconds)))
        return thread if thread.lead < horizon else None
    simulated = DELAYS[delay]
    return None if simulated is None else SimulatedLatency(dt, simulated)

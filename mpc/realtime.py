"""Latencies of plans in a world that goes on, simulated and real, and a world that keeps to the clock."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from larp_model.errors import InputError
from mpc.loop import PlanResult, World

# The next plan is expected to take as long as the longest of so many before it,
RECENT = 20
# and by the clock so many steps longer: one in 20 takes longer than the 20 before it.
MARGIN = 2


class Leads:
    """Steps that recent plans took, and the next one is expected to take."""

    def __init__(self, dt: float, expected: float) -> None:
        """Begin with an expectation. dt: a step [s]. expected: time that a plan takes [s]."""
        if not (math.isfinite(dt) and dt > 0.0):
            raise InputError(f"dt: got {dt}, needs a finite number > 0")
        if not (math.isfinite(expected) and expected >= 0.0):
            raise InputError(f"expected: got {expected}, needs a finite number >= 0")
        self.dt = dt
        self._recent = deque([self.steps(expected)], maxlen=RECENT)

    def steps(self, seconds: float) -> int:
        """Return the steps after which what takes so long is there."""
        return math.ceil(seconds / self.dt - 1e-6)

    def add(self, steps: int) -> None:
        """Take note of the steps that a plan took."""
        self._recent.append(steps)

    @property
    def expected(self) -> int:
        """Return the steps that the next plan is expected to take."""
        return max(self._recent)


class SimulatedLatency:
    """Plans are there after simulated delays, while the world waits on the clock: executions can be repeated.

    A `loop.Latency`. Its plans are expected to take as long as the longest of the last ones. seconds: that they took.
    """

    def __init__(
        self, dt: float, delays: float | Sequence[float] | None = None, seed: int = 0, expected: float = 0.0
    ) -> None:
        """Begin. dt: a step [s].

        delays: of each plan [s]; or several, of which one is drawn for each plan; or None: the times that plans take,
        at first expected to be `expected` [s]. seed: of the draws.
        """
        self._drawn = None if delays is None else np.atleast_1d(np.asarray(delays, float))
        if self._drawn is not None and not (
            self._drawn.ndim == 1 and len(self._drawn) and np.all(np.isfinite(self._drawn) & (self._drawn >= 0.0))
        ):
            raise InputError(f"delays: got {delays}, needs finite numbers of seconds >= 0")
        self._leads = Leads(dt, expected if self._drawn is None else float(np.quantile(self._drawn, 0.99)))
        self._random = np.random.default_rng(seed)
        self.seconds: list[float] = []
        self._result: tuple[int, PlanResult] | None = None

    @property
    def lead(self) -> int:
        """See `loop.Latency`."""
        return self._leads.expected

    def submit(self, step: int, job: Callable[[], PlanResult]) -> None:
        """See `loop.Latency`."""
        result = job()
        seconds = result[1].seconds
        self.seconds.append(seconds)
        steps = self._leads.steps(seconds if self._drawn is None else float(self._random.choice(self._drawn)))
        self._leads.add(steps)
        self._result = step + steps, result

    def result(self, step: int) -> PlanResult | None:
        """See `loop.Latency`."""
        if self._result is None or step < self._result[0]:
            return None
        (_, result), self._result = self._result, None
        return result

    def close(self) -> None:
        """See `loop.Latency`."""


class PlanningThread:
    """Plans are made in a thread beside the loop, and are there when they are finished.

    A `loop.Latency`, for worlds that keep to the clock by themselves: robots, and `PacedWorld`. What it calls has to be
    compiled before.
    """

    def __init__(self, dt: float, expected: float) -> None:
        """Begin the thread. dt: a step [s]. expected: time that plans take [s], until some are measured."""
        self._leads = Leads(dt, expected)
        self._executor = ThreadPoolExecutor(1, "planning")
        self._future: Future[PlanResult] | None = None
        self._submitted = 0

    @property
    def lead(self) -> int:
        """See `loop.Latency`."""
        return self._leads.expected + MARGIN

    def submit(self, step: int, job: Callable[[], PlanResult]) -> None:
        """See `loop.Latency`."""
        self._submitted, self._future = step, self._executor.submit(job)

    def result(self, step: int) -> PlanResult | None:
        """See `loop.Latency`."""
        if self._future is None or not self._future.done():
            return None
        future, self._future = self._future, None
        self._leads.add(step - self._submitted)
        return future.result()

    def close(self) -> None:
        """See `loop.Latency`; waits for the plan that is being made."""
        self._executor.shutdown(wait=True, cancel_futures=True)


class PacedWorld:
    """A simulated world that takes as long for a step as the step lasts.

    overruns: steps that took longer; the world is then late by as much, and does not catch up.
    """

    def __init__(self, world: World, dt: float) -> None:
        """Begin with a world whose steps last dt [s]."""
        self._world, self._dt = world, dt
        self._due: float | None = None
        self.overruns = 0

    def reset(self, states: np.ndarray) -> None:
        """See `loop.World`."""
        self._world.reset(states)

    def step(self, control: np.ndarray) -> np.ndarray:
        """See `loop.World`; returns when the step is over, counted from when the last one was."""
        begin = time.monotonic() if self._due is None else self._due
        states = self._world.step(control)
        now = time.monotonic()
        self._due = begin + self._dt
        if now > self._due:
            self.overruns, self._due = self.overruns + 1, now
        else:
            time.sleep(self._due - now)
        return states

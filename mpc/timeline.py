"""Samples that arrive late, or out of order, count for the time at which they were measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from larp_model.errors import InputError
from mpc.estimator import Estimate, Estimator, Observation

# Time [s] for which estimates are kept: a sample may be so late.
SPAN = 0.2


class Sample(NamedTuple):
    """A measurement, and the time [s] at which it was made."""

    time: float
    observation: Observation


@dataclass
class _Update:
    """An update of the estimate: its time [s], the control since the one before, and all samples of this time."""

    time: float
    control: np.ndarray | None
    estimate: Estimate
    observations: list[Observation] = field(default_factory=list)


class Timeline:
    """Estimates of the last `SPAN` seconds.

    Where a sample arrives late, the estimates since its time are computed again: they are then what they would be had
    it not been late.
    """

    def __init__(self, estimator: Estimator, start: Estimate) -> None:
        """Begin with the estimate before anything is measured."""
        self.estimator = estimator
        self._start, self._updates = start, list[_Update]()

    @property
    def estimate(self) -> Estimate:
        """Return the latest estimate."""
        return self._updates[-1].estimate if self._updates else self._start

    def update(self, samples: Sequence[Sample], control: np.ndarray | None, time: float) -> Estimate:
        """Return the estimate at a time [s], from all samples so far.

        control: joint targets (J, 3) [rad] since the last update; None where no time has passed. A sample counts in the
        update nearest to its time. Raises InputError for samples from the future and for those older than `SPAN`, and
        the timeline stays as it was.
        """
        updates = [*self._updates, _Update(time, control, self.estimate)]
        times = np.array([update.time for update in updates])
        for sample in samples:
            if not sample.time <= time + 1e-9:
                raise InputError(f"sample: is of {sample.time} s, but it is {time} s: needs one of the past")
            if sample.time < time - SPAN:
                raise InputError(f"sample: is of {sample.time} s, but it is {time} s: needs one of the last {SPAN} s")
        rows = [int(np.argmin(np.abs(times - sample.time))) for sample in samples]
        first = min([*rows, len(updates) - 1])
        updates[first:] = [
            _Update(update.time, update.control, update.estimate, [*update.observations]) for update in updates[first:]
        ]
        for row, sample in zip(rows, samples, strict=True):
            updates[row].observations.append(sample.observation)
        estimate = updates[first - 1].estimate if first else self._start
        for update in updates[first:]:
            own: list[Observation | None] = [*update.observations] or [None]
            estimate = self.estimator.update(estimate, own[0], update.control, update.time)
            for observation in own[1:]:
                estimate = self.estimator.update(estimate, observation, None, update.time)
            update.estimate = estimate
        outdated = sum(update.time < time - SPAN for update in updates[:-1])
        if outdated:
            self._start = updates[outdated - 1].estimate
        self._updates = updates[outdated:]
        return estimate

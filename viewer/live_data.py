"""Data of a kick that is planned or running, handed from the planner to the thread that draws it."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from viewer.recording import mask_unpredicted

# Frames by which drawing may be behind the execution, whose states arrive in bursts.
LAG = 5


class StateUpdate(NamedTuple):
    """State (L, 13) of the ground truth at a time [s], the new prediction from there, reference and estimate of it."""

    state: np.ndarray
    time: float
    predicted: np.ndarray | None
    reference: np.ndarray | None = None
    estimate: np.ndarray | None = None


@dataclass
class LiveData:
    """Data of a kick that is planned or running; a plan, fan, reference or estimate that is None is not drawn."""

    state: np.ndarray
    time: float
    path: list[np.ndarray] = field(default_factory=list)  # states (L, 13) so far
    plan: np.ndarray | None = None
    plan_time: float = 0.0
    fan: tuple[np.ndarray, np.ndarray] | None = None
    reference: np.ndarray | None = None
    estimate: np.ndarray | None = None
    state_is_new: bool = True  # the state is not drawn yet
    plan_is_new: bool = True  # the plan and its fan are not drawn yet
    updates: deque[StateUpdate] = field(default_factory=deque)

    def advance(self) -> None:
        """Take the next update, or skip some if many wait: they arrive in bursts, between plans."""
        for _ in range(-(-len(self.updates) // LAG)):
            update = self.updates.popleft()
            if update.predicted is not None:
                self.plan, self.plan_time, self.plan_is_new = mask_unpredicted(update.predicted), update.time, True
            self.path.append(update.state)
            self.state, self.time, self.state_is_new = update.state, update.time, True
            self.reference, self.estimate = update.reference, update.estimate

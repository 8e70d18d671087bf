"""Recording of an executed kick, and the closest approach of its path to a target."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np

from larp_model.errors import InputError
from larp_model.scene import Scene
from larp_model.state import POSITION, SIZE
from mpc.cost import nearest_on_path


class Approach(NamedTuple):
    """Closest approach of a path to a target."""

    distance: float  # m
    point: np.ndarray  # (3,) m, on the path
    row: int  # of the path, at or before the point


def nearest_approach(path: np.ndarray, target: np.ndarray) -> Approach:
    """Return the closest approach of a path (T, 3) [m] to `target` (3,) [m]; see `mpc.nearest_on_path`."""
    path, target = np.asarray(path, float), np.asarray(target, float)
    if path.ndim != 2 or path.shape[1] != 3 or not len(path):
        raise InputError(f"path has shape {path.shape}, but needs (T, 3) with at least one point")
    point, row = nearest_on_path(np.append(path, path[-1:], axis=0), target)
    return Approach(float(np.linalg.norm(point - target)), point, int(row))


def mask_unpredicted(predicted: np.ndarray, traced: int = -1) -> np.ndarray:
    """Return states (T, L, 13), NaN for links but the traced after the last row in which any of these links moves.

    Beyond that row their states were not predicted: they only repeat the last ones.
    """
    states = np.array(predicted, float)
    others = np.arange(states.shape[1]) != traced % states.shape[1]
    any_moves = (states[1:, others] != states[:-1, others]).any(axis=(1, 2))
    last_row = int(any_moves.nonzero()[0][-1]) + 1 if any_moves.any() else len(states) - 1
    states[last_row + 1 :, others] = np.nan
    return states


@dataclass(frozen=True, eq=False)
class Recording:
    """Motion in the ground truth, with the model's prediction and the reference.

    states: (T, L, 13) of the ground truth, row k at the time k `scene.dt`.
    target: (3,) [m], where the traced link should pass.
    predicted: (T', L, 13) of the model, its row 0 at row `predicted_start` of the ground truth.
    reference: (T'', L, 13), from row 0 of the ground truth on.
    summary: what to print beside the motion, with units, e.g. {"ball speed": "11.2 m/s"}.
    traced: row in the state of the link whose path is drawn; by default the last, the ball.
    estimated: (T'', L, 13), what the planner took for the ground truth, from row 0 on.
    """

    scene: Scene
    states: np.ndarray
    target: np.ndarray
    predicted: np.ndarray | None = None
    predicted_start: int = 0
    reference: np.ndarray | None = None
    title: str = ""
    summary: Mapping[str, str] = field(default_factory=dict)
    traced: int = -1
    estimated: np.ndarray | None = None

    def __post_init__(self) -> None:
        links = len(self.scene.links)
        for name in ("states", "predicted", "reference", "estimated"):
            value = getattr(self, name)
            if value is None and name != "states":
                continue
            if np.ndim(value) != 3 or np.shape(value)[1:] != (links, SIZE) or not len(value):
                raise InputError(f"{name} has shape {np.shape(value)}, but needs (T > 0, {links}, {SIZE})")
            if not np.all(np.isfinite(value)):
                raise InputError(f"{name} holds values that are not finite, but all must be")
        if np.shape(self.target) != (3,) or not np.all(np.isfinite(self.target)):
            raise InputError(f"target is {self.target!r}, but must be three finite numbers")
        if not 0 <= self.predicted_start < len(self.states):
            raise InputError(
                f"predicted_start is {self.predicted_start!r}, but must be a row in [0, {len(self.states)})"
            )
        if not -links <= self.traced < links:
            raise InputError(f"traced is {self.traced!r}, but must be a row in [{-links}, {links})")

    @property
    def duration(self) -> float:
        """Return the time from the first to the last state [s]."""
        return (len(self.states) - 1) * self.scene.dt

    @property
    def path(self) -> np.ndarray:
        """Return the path (T, 3) [m] of the traced link in the ground truth."""
        return np.asarray(self.states)[:, self.traced, POSITION]

    @property
    def predicted_path(self) -> np.ndarray | None:
        """Return the path (T', 3) [m] of the traced link that the model predicted, or None."""
        return None if self.predicted is None else np.asarray(self.predicted)[:, self.traced, POSITION]

    @property
    def radius(self) -> float:
        """Return the radius of the traced link [m]."""
        return self.scene.links[self.traced].radius

    @cached_property
    def _masked(self) -> np.ndarray | None:
        return None if self.predicted is None else mask_unpredicted(self.predicted, self.traced)

    def predicted_at(self, row: int) -> np.ndarray | None:
        """Return the state (L, 13) predicted for a row of the ground truth, or None.

        It is NaN for links that were not predicted so far ahead.
        """
        index = row - self.predicted_start
        if self._masked is None or not 0 <= index < len(self._masked):
            return None
        return np.asarray(self._masked[index])

    def reference_at(self, row: int) -> np.ndarray | None:
        """Return the reference's state (L, 13) at a row of the ground truth, or None beyond its end."""
        return _row(self.reference, row)

    def estimate_at(self, row: int) -> np.ndarray | None:
        """Return the estimate (L, 13) of a row of the ground truth, or None beyond its end."""
        return _row(self.estimated, row)


def _row(states: np.ndarray | None, row: int) -> np.ndarray | None:
    return None if states is None or row >= len(states) else np.asarray(states[row])

"""Settings of a kick on the page of a task: those that its users choose, and what they can choose from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

Box = tuple[tuple[float, ...], tuple[float, ...]]
"""Lowest and highest corner of a box [m] or [m/s]."""


class Settings(NamedTuple):
    """Settings of the next kick, as chosen on the page.

    target: (3,) [m]. spot: (2,), offset of the ball from its usual position [m]. roll: (2,), its rolling velocity
    [m/s]. preset, dynamics, weights, reference, sensors, delay: names from those offered; sensors are what the planner
    sees of the state, and delay is that of its plans. budget: seconds that a plan may take; 0: as long as the preset
    takes. terms: weight of each named cost.
    """

    target: tuple[float, ...]
    spot: tuple[float, ...]
    roll: tuple[float, ...]
    preset: str
    dynamics: str
    weights: str
    reference: str
    sensors: str
    delay: str
    budget: float
    terms: Mapping[str, float]


@dataclass(frozen=True)
class Offer:
    """Settings that users may choose: names, the default first; initial cost weights; boxes that bound the rest.

    push: largest component of a push, a change of velocity [m/s]. longest: largest budget [s].
    """

    presets: tuple[str, ...]
    dynamics: tuple[str, ...]
    weights: tuple[str, ...]
    references: tuple[str, ...]
    sensors: tuple[str, ...]
    delays: tuple[str, ...]
    terms: tuple[tuple[str, float], ...]
    target: Box
    spot: Box
    roll: Box
    push: float = 3.0
    longest: float = 5.0


class Push(NamedTuple):
    """Instant change (3,) [m/s] of a body's velocity."""

    body: str
    change: tuple[float, ...]

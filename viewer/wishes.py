"""What a task offers on its page, and what people ask for there."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

Box = tuple[tuple[float, ...], tuple[float, ...]]
"""The lowest and the highest corner [m], or [m/s]."""


class Wishes(NamedTuple):
    """What the next kick should be, as it is set on the page.

    target: (3,) [m]. spot: (2,), where the ball lies [m], from its usual place. roll: (2,), how fast it rolls [m/s].
    preset, dynamics, weights, reference: names out of those offered. budget: seconds that a plan may take; 0: as long
    as the preset takes. terms: weight of each named cost.
    """

    target: tuple[float, ...]
    spot: tuple[float, ...]
    roll: tuple[float, ...]
    preset: str
    dynamics: str
    weights: str
    reference: str
    budget: float
    terms: Mapping[str, float]


@dataclass(frozen=True)
class Offer:
    """What may be asked for: names, the usual one first; weights of the costs as they are; boxes that bound the rest.

    push: the strongest push, a change of velocity [m/s]. longest: the largest budget [s].
    """

    presets: tuple[str, ...]
    dynamics: tuple[str, ...]
    weights: tuple[str, ...]
    references: tuple[str, ...]
    terms: tuple[tuple[str, float], ...]
    target: Box
    spot: Box
    roll: Box
    push: float = 3.0
    longest: float = 5.0


class Push(NamedTuple):
    """A body is hit: its velocity changes by this much (3,) [m/s] at once."""

    body: str
    change: tuple[float, ...]

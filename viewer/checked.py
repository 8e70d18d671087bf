"""Values that a browser sends, made safe: any client may send anything, and Viser hands it on."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import TypeVar

import numpy as np

T = TypeVar("T")

LARGEST = 2.0**53  # of a number in JavaScript that is still exact


def within(value: object, low: float, high: float) -> float:
    """A number brought between bounds; `low` where it is none, or not finite."""
    if isinstance(value, int):
        return float(min(max(value, low), high))  # which may be too large for a float
    return min(max(float(value), low), high) if isinstance(value, Real) and math.isfinite(value) else low


def vector(value: object, low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """A vector (3,) brought into the box from `low` (3,) to `high` (3,), each component as by `within`.

    The corner `low` where it is no vector of three.
    """
    value = value.tolist() if isinstance(value, np.ndarray) else value
    parts = value if isinstance(value, tuple | list) and len(value) == len(low) else low
    bounds = zip(parts, low, high, strict=True)
    return np.array([within(part, least, most) for part, least, most in bounds])


def option(value: object, offered: Sequence[T]) -> T:
    """The one of the options offered that this is; the first where it is none."""
    return next((each for each in offered if type(each) is type(value) and each == value), offered[0])


def flag(value: object) -> bool:
    """Whether this is true, not only something that counts as true, such as the text "false"."""
    return value is True


def alike(value: object, current: object) -> bool:
    """Whether a value just decoded can stand for the current one of a control, be it within its bounds or not.

    A number is finite and exact in JavaScript, a vector as long as it was. Other values are no control's.
    """
    match current:
        case bool():
            return isinstance(value, bool)
        case int() | float():
            return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST
        case str():
            return isinstance(value, str)
        case tuple():
            if not isinstance(value, list) or len(value) != len(current):
                return False
            return all(alike(*pair) for pair in zip(value, current, strict=True))
        case _:
            return False

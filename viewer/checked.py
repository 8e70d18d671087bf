"""Validation of values that a browser sends: any client may send anything, and Viser passes it on unchecked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import TypeVar

import numpy as np

T = TypeVar("T")

LARGEST = 2.0**53  # of a number in JavaScript that is still exact


def within(value: object, low: float, high: float) -> float:
    """Return a number clipped to [low, high], or `low` if the value is not a finite number."""
    if isinstance(value, int):
        return float(min(max(value, low), high))  # which may be too large for a float
    return min(max(float(value), low), high) if isinstance(value, Real) and math.isfinite(value) else low


def vector(value: object, low: Sequence[float], high: Sequence[float]) -> np.ndarray:
    """Return a vector (3,) clipped to the box from `low` (3,) to `high` (3,), each component as by `within`.

    If the value is not a vector of three, return the corner `low`.
    """
    value = value.tolist() if isinstance(value, np.ndarray) else value
    components = value if isinstance(value, tuple | list) and len(value) == len(low) else low
    bounds = zip(components, low, high, strict=True)
    return np.array([within(component, lowest, highest) for component, lowest, highest in bounds])


def option(value: object, options: Sequence[T]) -> T:
    """Return the offered option that equals the value, in type too, or the first option if none does."""
    return next(
        (candidate for candidate in options if type(candidate) is type(value) and candidate == value), options[0]
    )


def flag(value: object) -> bool:
    """Return whether the value is `True` itself, not only truthy, such as the text "false"."""
    return value is True


def has_type_of(value: object, current: object) -> bool:
    """Return whether a decoded value has the type of a control's current one, be it within its bounds or not.

    A number must be finite and exact in JavaScript, a vector as long as the current one. Current values of other types
    belong to no control: the result is then False.
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
            return all(has_type_of(*pair) for pair in zip(value, current, strict=True))
        case _:
            return False

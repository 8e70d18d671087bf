"""Rows of the stability benchmark: a case, its quantitative promise, and whether the observation keeps it.

A row is {axis, value, promise, seen: the observation, held: whether the promise was kept}.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from larp_model import state as packed
from larp_model.errors import InputError
from larp_model.simulator import Simulator
from tasks.benchmarks.report import Row
from tasks.kick import Kick

STEPS = 48
# Speed [m/s] that no link of a kick exceeds; MuJoCo's trajectories count as diverged beyond it.
FASTEST = 100.0
# How far joints may be from being closed [m].
CLOSED = 0.05


class Bench(NamedTuple):
    """Subject of the stress cases: the kick's task and the learned simulator of its scene."""

    kick: Kick
    model: Simulator

    @property
    def controls(self) -> np.ndarray:
        """Return the reference's joint targets (48, J, 3) [rad]."""
        return self.kick.reference.window(0, STEPS)[1]


def row(axis: str, value: Any, promise: str, observation: str, passed: bool) -> Row:
    """Return the row of one case."""
    return {"axis": axis, "value": str(value), "promise": promise, "seen": observation, "held": bool(passed)}


def greatest_speed(states: np.ndarray) -> float:
    """Return the greatest speed along an axis [m/s] in states (*, L, 13)."""
    return float(np.abs(np.asarray(states, float)[..., packed.VELOCITY]).max(initial=0.0))


def before_divergence(states: np.ndarray) -> np.ndarray:
    """Return the steps of a trajectory (H, L, 13) before it is flagged as diverged by a step of NaN alone."""
    flagged = np.isnan(states).all(axis=(1, 2))
    return states[: int(flagged.argmax()) if flagged.any() else len(states)]


def bounded(axis: str, value: Any, states: np.ndarray) -> Row:
    """Check that a trajectory (H, L, 13) stays finite, with bounded speeds and unit quaternions, until flagged."""
    valid_states = np.asarray(before_divergence(states), float)
    speed = greatest_speed(valid_states)
    unit = float(np.abs(np.linalg.norm(valid_states[..., packed.ORIENTATION], axis=-1) - 1.0).max(initial=0.0))
    passed = bool(np.isfinite(valid_states).all() and speed <= FASTEST and unit <= 1e-3)
    promise = f"LARP: finite, quaternions of unit length, no link beyond {FASTEST:g} m/s, or flagged from there on"
    until = f", flagged after {len(valid_states)} steps" if len(valid_states) < len(states) else ""
    return row(axis, value, promise, f"fastest {speed:.3g} m/s, quaternions off by {unit:.0e}{until}", passed)


def flagged(axis: str, value: Any, states: np.ndarray, flag: bool) -> Row:
    """Check that the engine flags a trajectory (H, L, 13) that is not finite."""
    is_finite = bool(np.isfinite(states).all())
    observation = (
        "finite, not flagged" if is_finite and flag else "flagged" if not flag else "not finite and not flagged"
    )
    return row(axis, value, "MuJoCo: finite, or flagged as diverged", observation, is_finite or not flag)


def refusal(call: Callable[[], Any], words: str, kind: type[Exception] = InputError) -> tuple[str, bool]:
    """Return the message of a call that must raise an error of this kind with these words, and whether it did."""
    try:
        call()
    except Exception as error:
        message = f"{type(error).__name__}: {str(error).splitlines()[0][:90]}"
        return message, isinstance(error, kind) and words in str(error)
    return "not refused", False


def in_double(model: Simulator) -> Simulator:
    """Return the model with weights of 64 bits."""
    return replace(model, weights=jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float64), model.weights))

"""Key poses of the embedded kick: plant, backswing, strike, follow-through, landing, stance.

Their numbers are in `key_poses.json`: authored by hand, then refined in the ground truth by `tasks.refine`, which
writes the file.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import PchipInterpolator

from larp_model.bodies import human
from larp_model.errors import InputError
from larp_model.scene import Body
from tasks.motions.details import in_detail

FILE = Path(__file__).with_suffix(".json")
# Axes of a joint as they are written, and numbers of each part of the initial state.
AXES = ("0", "1", "2")
START = {"lean": 2, "velocity": 3, "ball": 2}


@dataclass(frozen=True)
class KeyPoses:
    """Joint targets at a few times, and the initial state of the kick.

    times: (K,) [s]. angles: by joint and axis (0 rolls about x, 1 pitches about y, 2 yaws about z), the component of
    the joint's rotation vector at each time [rad]. lean: initial lean of the pelvis about x and y [rad]. velocity:
    initial velocity of the whole body [m/s]. ball: its place on the ground relative to the point below the pelvis [m].
    """

    times: tuple[float, ...]
    angles: dict[tuple[str, int], tuple[float, ...]]
    lean: tuple[float, float]
    velocity: tuple[float, float, float]
    ball: tuple[float, float]

    def controls(self, body: Body, steps: int, dt: float) -> np.ndarray:
        """Return the body's joint targets (steps, J, 3) [rad], monotone between key poses, constant after the last."""
        default_human = human()
        names = [default_human.links[child].name for child, _, _ in default_human.motors]
        times = np.minimum(np.arange(steps) * dt, self.times[-1])
        controls = np.zeros((steps, len(names), 3))
        for (joint, axis), angles in self.angles.items():
            controls[:, names.index(joint), axis] = PchipInterpolator(self.times, angles)(times)
        targets: np.ndarray = np.clip(in_detail(body, controls), *body.limits)
        return targets


def load(path: Path = FILE) -> KeyPoses:
    """Read key poses from a JSON file in the form that `dumps` writes; raise InputError where it is another."""
    joints = {link.name for link in human().links}
    try:
        content = json.loads(path.read_bytes())
        times = _numbers(content["times"])
        start: Any = {name: _numbers(content[name], size) for name, size in START.items()}
        if len(times) < 2 or not (np.diff(times) > 0.0).all():
            raise ValueError("times do not rise")
        angles = {
            (joint, AXES.index(axis)): _numbers(row, len(times))
            for joint, axes in content["angles"].items()
            for axis, row in axes.items()
        }
        if unknown := {joint for joint, _ in angles} - joints:
            raise ValueError(f"there is no joint {unknown}")
    except (ValueError, LookupError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(f"key poses {path.name} cannot be read: {type(error).__name__}: {error}") from None
    return KeyPoses(times, angles, **start)


def _numbers(values: list[float], size: int | None = None) -> tuple[float, ...]:
    """Return a list's numbers; raise ValueError where they are not finite, or not so many."""
    numbers = tuple(map(float, values))
    if not np.isfinite(numbers).all() or size not in (None, len(numbers)):
        raise ValueError(f"a list does not hold {size or 'some'} finite numbers")
    return numbers


def dumps(poses: KeyPoses) -> str:
    """Return key poses as the text that `load` reads, with three decimals and one line per joint axis."""

    def numbers(values: tuple[float, ...]) -> str:
        return "[" + ", ".join(f"{value + 0.0:.3f}" for value in values) + "]"

    joints: dict[str, list[str]] = {}
    for (joint, axis), row in poses.angles.items():
        joints.setdefault(joint, []).append(f'      "{axis}": {numbers(row)}')
    angles = ",\n".join(f'    "{joint}": {{\n' + ",\n".join(rows) + "\n    }" for joint, rows in joints.items())
    start = "".join(f'  "{name}": {numbers(getattr(poses, name))},\n' for name in ("times", "lean", "velocity", "ball"))
    return f'{{\n{start}  "angles": {{\n{angles}\n  }}\n}}\n'

"""Ground-truth episodes: recorded, joined, stored and read again."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from larp_model import state as packed
from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from larp_model.files import arrays_of, written_whole
from larp_model.scene import Scene

VERSION = 2


class Episodes(NamedTuple):
    """E recorded trajectories of T steps.

    states: (E, T + 1, L, 13), the first before any step. controls: (E, T, J, 3) [rad]. torques: (E, T, L, 3) [N m],
    external, world frame. morphology: (E, L, 3) length [m], radius [m] and mass [kg] of every link.
    """

    states: np.ndarray
    controls: np.ndarray
    torques: np.ndarray
    morphology: np.ndarray

    @property
    def steps(self) -> int:
        """Return T, the steps of each episode."""
        return int(self.controls.shape[1])


def record(
    truth: Truth,
    states: np.ndarray,
    controls: np.ndarray,
    torques: np.ndarray | None = None,
    morphology: np.ndarray | None = None,
) -> tuple[Episodes, int]:
    """Roll out any number of controls (E, T, J, 3) from states (E, L, 13); return the episodes and how many diverged.

    morphology: (E, L, 3); the scene's by default. Diverged trajectories are dropped.
    """
    count, links = len(states), len(truth.scene.links)
    if controls.shape[0] != count:
        raise InputError(f"controls hold {controls.shape[0]} episodes, but states hold {count}")
    if torques is None:
        torques = np.zeros((*controls.shape[:2], links, 3), np.float32)
    sizes = np.broadcast_to(truth.scene.morphology, (count, links, 3)) if morphology is None else morphology
    parts, dropped = [], 0
    for start in range(0, count, truth.batch):
        batch_rows = np.arange(start, start + truth.batch)
        batch_rows[batch_rows >= count] = count - 1  # the last batch is filled up with copies
        if morphology is not None:
            truth.resize(morphology[batch_rows])
        truth.reset(states[batch_rows])
        first = truth.state()
        after, finite = truth.rollout(states[batch_rows], controls[batch_rows], torques[batch_rows])
        finite[count - start :] = False
        dropped += int((~finite[: count - start]).sum())
        trajectories = np.concatenate([first[:, None], after], axis=1)
        rows = batch_rows[finite]
        parts.append(
            Episodes(
                trajectories[finite].astype(np.float32),
                controls[rows].astype(np.float32),
                torques[rows].astype(np.float32),
                sizes[rows].astype(np.float32),
            )
        )
    return join(parts), dropped


def join(parts: Sequence[Episodes]) -> Episodes:
    """Return several recordings of the same scene and length as one."""
    return Episodes(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def save(path: Path, scene: Scene, episodes: Episodes) -> None:
    """Write episodes to an .npz file, whole or not at all."""
    header = json.dumps({"version": VERSION, "dt": scene.dt, "links": [link.name for link in scene.links]})
    with written_whole(path) as file:
        np.savez(file, header=np.array(header), **episodes._asdict())


def load(path: Path, scene: Scene) -> Episodes:
    """Read episodes of this scene; raise InputError for a file that is damaged or does not fit."""
    try:
        arrays = arrays_of(path)
        header = dict(json.loads(str(arrays["header"])))
        episodes = Episodes(*(arrays[name] for name in Episodes._fields))
    except FileNotFoundError:
        raise InputError(f"episodes file {path} does not exist") from None
    except Exception as error:  # numpy and zipfile raise many kinds for a damaged file
        raise InputError(f"episodes file {path} cannot be read: {type(error).__name__}: {error}") from None
    if header.get("version") != VERSION:
        raise InputError(f"episodes file {path} is of version {header.get('version')}, but {VERSION} is needed")
    links, motors = len(scene.links), len(scene.motors)
    steps = episodes.controls.shape[1] if episodes.controls.ndim == 4 else 0
    count = len(np.atleast_1d(episodes.states))
    expected = {
        "states": (count, steps + 1, links, packed.SIZE),
        "controls": (count, steps, motors, 3),
        "torques": (count, steps, links, 3),
        "morphology": (count, links, 3),
    }
    for name, shape in expected.items():
        array = getattr(episodes, name)
        if array.shape != shape:
            raise InputError(f"episodes file {path}: {name} has shape {array.shape}, but the scene needs {shape}")
        if not np.isfinite(array).all():
            raise InputError(f"episodes file {path}: {name} holds values that are not finite")
    if header.get("links") != [link.name for link in scene.links] or header.get("dt") != scene.dt:
        raise InputError(
            f"episodes file {path} is of another scene: links {header.get('links')}, dt {header.get('dt')}"
        )
    return episodes

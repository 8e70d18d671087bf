"""Checkpoint of an unfinished reconstruction, from which an interrupted one continues."""

from __future__ import annotations

import hashlib
import io
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from larp_model.files import write_whole
from mpc import Plan, PlanInfo
from mpc.loop import Checkpoint
from tasks.pose.figure import Pose
from tasks.pose.lift import Lifted


class PlanningEffort(NamedTuple):
    """Effort of planning so far: seconds, seconds of compilation counted separately, and candidates.

    diverged: candidates whose rollout was not finite. verified: candidates that were also executed in the ground truth.
    """

    seconds: float = 0.0
    compile_seconds: float = 0.0
    candidates: int = 0
    diverged: int = 0
    verified: int = 0

    def plus(self, info: PlanInfo) -> PlanningEffort:
        """Return the effort with that of another plan added."""
        diverged = info.candidates - info.finite
        return PlanningEffort(
            self.seconds + info.seconds,
            self.compile_seconds + info.compile_seconds,
            self.candidates + info.candidates,
            self.diverged + diverged,
            self.verified + info.verified,
        )


class Progress:
    """Progress of a reconstruction in a file, which only one with the same inputs loads.

    lifted: the kinematic start; checkpoint: the executed part of the physical fit; each None while there is none.
    spent: the effort of planning so far.
    """

    lifted: Lifted | None = None
    checkpoint: Checkpoint | None = None
    effort: PlanningEffort = PlanningEffort()

    def __init__(self, path: Path, inputs: str) -> None:
        """Load the file; path: npz; inputs: see `fingerprint`. A file of another one, or damaged, is ignored."""
        self.path, self._inputs = path, inputs
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
                if str(file["made_by"]) == inputs:
                    self._take({name: file[name] for name in file.files})
        except Exception:  # numpy and zipfile raise many kinds for a damaged file
            self.lifted, self.checkpoint, self.effort = None, None, PlanningEffort()

    def save(
        self,
        lifted: Lifted,
        checkpoint: Checkpoint | None = None,
        effort: PlanningEffort = PlanningEffort(),  # noqa: B008
    ) -> None:
        """Write the file."""
        content: dict[str, Any] = {
            "made_by": self._inputs,
            **{f"pose_{name}": value for name, value in lifted.pose._asdict().items()},
            "corrections": lifted.corrections,
            "proportions": lifted.proportions,
            "error": lifted.error,
            "spent": np.array(effort, float),
        }
        if checkpoint is not None:
            content |= {f"plan_{name}": value for name, value in checkpoint.plan._asdict().items()}
            content |= {name: getattr(checkpoint, name) for name in ("states", "controls", "step", "phase")}
        buffer = io.BytesIO()
        np.savez(buffer, **content)
        write_whole(self.path, buffer.getvalue())

    def delete(self) -> None:
        """Delete the file, as the reconstruction is complete."""
        self.path.unlink(missing_ok=True)

    def _take(self, arrays: dict[str, np.ndarray]) -> None:
        def values_of(kind: str, fields: tuple[str, ...]) -> Iterator[np.ndarray]:
            return (arrays[f"{kind}_{name}"] for name in fields)

        self.lifted = Lifted(
            Pose(*values_of("pose", Pose._fields)),
            arrays["proportions"],
            arrays["corrections"],
            float(arrays["error"]),
        )
        seconds, compiling, *counts = arrays["spent"].tolist()
        self.effort = PlanningEffort(seconds, compiling, *map(int, counts))
        if "states" in arrays:
            elites, spread, start, key = values_of("plan", Plan._fields)
            plan = Plan(elites, spread, np.float32(start), key)
            self.checkpoint = Checkpoint(
                arrays["states"], arrays["controls"], plan, int(arrays["step"]), int(arrays["phase"])
            )


def fingerprint(*parts: Any) -> str:
    """Return a SHA-256 digest of arrays, bytes, texts and numbers, equal only for equal parts."""
    digest = hashlib.sha256()
    for part in parts:
        raw = np.asarray(part).tobytes()
        digest.update(len(raw).to_bytes(8, "little") + raw)
    return digest.hexdigest()

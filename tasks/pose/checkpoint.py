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
from tasks.pose.camera import Camera
from tasks.pose.figure import Pose
from tasks.pose.lift import Lifted


class Spent(NamedTuple):
    """Effort of planning so far: seconds, seconds of compilation counted separately, and candidates.

    lost: candidates whose rollout was not finite. verified: candidates that were also tried in the ground truth.
    """

    seconds: float = 0.0
    compile_seconds: float = 0.0
    candidates: int = 0
    lost: int = 0
    verified: int = 0

    def and_by(self, info: PlanInfo) -> Spent:
        """Return the effort with that of another plan added."""
        lost = info.candidates - info.finite
        return Spent(
            self.seconds + info.seconds,
            self.compile_seconds + info.compile_seconds,
            self.candidates + info.candidates,
            self.lost + lost,
            self.verified + info.verified,
        )


class Progress:
    """Progress of a reconstruction in a file, which only one with the same inputs loads.

    lifted: the kinematic start; checkpoint: the executed part of the physical fit; each None while there is none.
    spent: the effort of planning so far.
    """

    lifted: Lifted | None = None
    checkpoint: Checkpoint | None = None
    spent: Spent = Spent()

    def __init__(self, path: Path, made_by: str) -> None:
        """Load the file; path: npz; made_by: see `fingerprint`. A file of another one, or damaged, is ignored."""
        self.path, self._made_by = path, made_by
        try:
            with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as file:
                if str(file["made_by"]) == made_by:
                    self._take({name: file[name] for name in file.files})
        except Exception:  # numpy and zipfile raise many kinds for a damaged file
            self.lifted, self.checkpoint, self.spent = None, None, Spent()

    def save(self, lifted: Lifted, checkpoint: Checkpoint | None = None, spent: Spent = Spent()) -> None:  # noqa: B008
        """Write the file."""
        camera = lifted.camera
        content: dict[str, Any] = {
            "made_by": self._made_by,
            **{f"pose_{name}": value for name, value in lifted.pose._asdict().items()},
            **{f"camera_{name}": getattr(camera, name) for name in ("focal", "centre", "turn", "position")},
            "proportions": lifted.proportions,
            "error": lifted.error,
            "spent": np.array(spent, float),
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

    def _take(self, found: dict[str, np.ndarray]) -> None:
        def of(kind: str, fields: tuple[str, ...]) -> Iterator[np.ndarray]:
            return (found[f"{kind}_{name}"] for name in fields)

        focal, *rest = of("camera", ("focal", "centre", "turn", "position"))
        camera = Camera(float(focal), *rest)
        self.lifted = Lifted(Pose(*of("pose", Pose._fields)), found["proportions"], camera, float(found["error"]))
        seconds, compiling, *counts = found["spent"].tolist()
        self.spent = Spent(seconds, compiling, *map(int, counts))
        if "states" in found:
            elites, spread, start, key = of("plan", Plan._fields)
            plan = Plan(elites, spread, np.float32(start), key)
            self.checkpoint = Checkpoint(
                found["states"], found["controls"], plan, int(found["step"]), int(found["phase"])
            )


def fingerprint(*parts: Any) -> str:
    """Return a SHA-256 digest of arrays, bytes, texts and numbers, equal only for equal parts."""
    digest = hashlib.sha256()
    for part in parts:
        raw = np.asarray(part).tobytes()
        digest.update(len(raw).to_bytes(8, "little") + raw)
    return digest.hexdigest()

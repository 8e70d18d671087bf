"""Entry points of the installed commands. The packages have common names, so that another's may hide one of ours."""

from __future__ import annotations

import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

HOME = Path(__file__).resolve().parents[1]


def kick() -> None:
    """Run `larp-kick`: plan a kick and execute it."""
    _start("tasks.kick")


def train() -> None:
    """Run `larp-train`: train networks."""
    _start("tasks.train")


def adapt() -> None:
    """Run `larp-adapt`: fit weights to a motion and a body."""
    _start("tasks.adapt")


def pose() -> None:
    """Run `larp-pose`: motion from keypoints."""
    _start("tasks.pose.command")


def bench() -> None:
    """Run `larp-bench`: the benchmarks."""
    _start("tasks.benchmarks.__main__")


def hidden() -> str | None:
    """Return what is wrong if a package of another project has the name of one of ours; None if none has."""
    for name in ("mpc", "viewer", "tasks"):
        spec = find_spec(name)
        folder = None if spec is None or spec.origin is None else Path(spec.origin).resolve().parent
        if folder != HOME / name:
            difference = "is not installed" if folder is None else f"is at {folder}, another project's"
            return f"the package {name!r} {difference}, but larp-mpc needs its own, which belongs in {HOME}"
    return None


def _start(module: str) -> None:
    problem = hidden()
    if problem:
        sys.exit(f"error: {problem}")
    try:
        import_module(module).cli()
    except KeyboardInterrupt:  # while modules are imported; `tasks.command.run` sees all later ones
        sys.exit(130)

"""Command line of all benchmarks: `python -m tasks.benchmarks NAME`, or `larp-bench NAME`."""

from collections.abc import Callable

from tasks.benchmarks import (
    compilation,
    content,
    damaged_files,
    gap,
    kick,
    model,
    optimizers,
    page,
    pose,
    realtime,
    reference,
    speed,
    stability,
    tradeoff,
)
from tasks.command import run

NAMED: dict[str, Callable[..., None]] = {
    "kick": kick.main,
    "model": model.main,
    "speed": speed.main,
    "compilation": compilation.main,
    "content": content.main,
    "tradeoff": tradeoff.main,
    "optimizers": optimizers.main,
    "gap": gap.main,
    "realtime": realtime.main,
    "stability": stability.main,
    "damaged_files": damaged_files.main,
    "reference": reference.main,
    "page": page.main,
    "pose": pose.main,
}


def cli() -> None:
    """Run the command `larp-bench`."""
    run(NAMED)


if __name__ == "__main__":
    cli()

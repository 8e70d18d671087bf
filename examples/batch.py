"""Many kicks without a page, as a data set: one npz file of targets, states and joint targets, in float32.

python examples/batch.py 1000 runs/kicks.npz
"""

import sys

import numpy as np
from rich.progress import track

from larp_model.files import written_whole
from tasks.command import remember_compilations
from tasks.data import random_task
from tasks.kick import Kick


def main(count: int = 1000, path: str = "runs/kicks.npz", seed: int = 0) -> None:
    """Kick to random targets, the ball's spot moved a little each time; compiled once."""
    remember_compilations()
    kick, random, rows = Kick.standard(), np.random.default_rng(seed), []
    for number in track(range(count), "kicks"):
        target, offset = random_task(random)
        run = kick.to(target, preset="fast", seed=number, state=kick.start(offset))
        rows.append((target, run.states, run.joint_targets, run.truth_error_m, run.summary["fell"]))
    steps = min(len(row[1]) for row in rows)  # what lies beyond them, of kicks that took longer, is left out
    targets, states, controls, errors, fell = zip(*rows, strict=True)
    arrays = {
        "targets": np.array(targets, np.float32),  # (N, 3) [m]
        "states": np.array([each[:steps] for each in states], np.float32),  # (N, T, L, 13)
        "joint_targets": np.array([each[: steps - 1] for each in controls], np.float32),  # (N, T - 1, J, 3) [rad]
        "truth_error_m": np.array(errors),
        "fell": np.array(fell),
    }
    with written_whole(path) as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)
    print(f"{path}: {count} kicks of {steps} states, missed by {100 * np.mean(errors):.1f} cm in the mean")
    assert np.isfinite(arrays["states"]).all() and np.median(errors) < 0.2


if __name__ == "__main__":
    main(*(kind(each) for kind, each in zip((int, str, int), sys.argv[1:], strict=False)))

"""Data set of many kicks, without a page: one npz file of targets, states and joint targets, in float32.

python examples/batch.py 1000 runs/kicks.npz        # and, as a last argument, how many processes share the work
"""

import sys
from concurrent.futures import ProcessPoolExecutor
from itertools import chain
from multiprocessing import get_context

import numpy as np
from rich.progress import track

from larp_model.files import written_whole
from tasks.kick import Kick
from tasks.session import Session
from tasks.targets import random_kick

Row = tuple[np.ndarray, np.ndarray, np.ndarray, float, bool]


def kicks(session: Session, numbers: np.ndarray, seed: int) -> list[Row]:
    """Return kicks to random targets, with the ball's place moved a little each time; compiled once."""
    rows = []
    for number in track(numbers.tolist(), "kicks"):
        target, offset = random_kick(np.random.default_rng((seed, number)))
        run = session.run(target, "fast", number, session.task.start(offset))
        rows.append((target, run.states, run.joint_targets, run.truth_error_m, run.summary["fell"]))
    return rows


def main(count: int = 1000, path: str = "runs/kicks.npz", processes: int = 1, seed: int = 0) -> None:
    """Share the kicks among processes, gather them, write the file."""
    shares = np.array_split(np.arange(count), processes)
    # Spawned, not forked: JAX has threads, which a fork would lack and wait for.
    with ProcessPoolExecutor(processes, get_context("spawn")) as pool:
        made = pool.map(kicks, [Session(Kick.standard())] * processes, shares, [seed] * processes)
        targets, states, controls, errors, fell = zip(*chain.from_iterable(made), strict=True)
    steps = min(map(len, states))  # longer kicks are cut to this length
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

"""Data set of many kicks, without a page: one npz file of targets, states and joint targets, in float32.

python examples/batch.py --count 1000 --workers 4                   # by so many processes, one by default
python examples/batch.py --count 1000 --workers tcp://host:8786     # by a Dask scheduler's, on any machines

Needs `pip install 'larp-mpc[batch]'`. Kicks of a worker that dies are planned again by another one.
"""

from itertools import chain

import numpy as np
import tyro
from distributed import Client, as_completed
from rich.progress import track

from larp_model.files import written_whole
from tasks.kick import Kick
from tasks.session import Session
from tasks.targets import random_kick

Row = tuple[np.ndarray, np.ndarray, np.ndarray, float, bool]


def kicks(session: Session, numbers: list[int], seed: int) -> list[Row]:
    """Return kicks to random targets, with the ball's place moved a little each time; compiled once a worker."""
    rows = []
    for number in numbers:
        target, offset = random_kick(np.random.default_rng((seed, number)))
        run = session.run(target, "fast", number, session.task.start(offset))
        rows.append((target, run.states, run.joint_targets, run.truth_error_m, run.summary["fell"]))
    return rows


def main(count: int = 1000, path: str = "runs/kicks.npz", workers: int | str = 1, seed: int = 0) -> None:
    """Share the kicks among workers, a number of processes here or a scheduler's, gather them, write the file."""
    local = {"n_workers": workers, "threads_per_worker": 1, "host": "127.0.0.1", "dashboard_address": None}
    with Client(**local) if isinstance(workers, int) else Client(workers) as client:
        # Made by a worker, so that it can be made again; the others copy it.
        session = client.submit(lambda: Session(Kick.standard()))
        # What a worker plans in a row, and again if another dies.
        shares = np.array_split(np.arange(count), max(1, min(count, 100)))
        futures = [client.submit(kicks, session, share.tolist(), seed) for share in shares]
        list(track(as_completed(futures), "kicks", total=len(futures)))
        targets, states, controls, errors, fell = zip(*chain.from_iterable(client.gather(futures)), strict=True)
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
    tyro.cli(main)

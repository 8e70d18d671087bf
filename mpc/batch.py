"""Several plans made side by side: whatever they roll out at a time is rolled out as one batch.

The optimisers of each plan run in a thread of its own, one thread at a time. Once every plan waits for a rollout, or is
made, their rows are rolled out together.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, TypeVar

import jax
import numpy as np

from mpc.problem import RollOut, Rows

Result = TypeVar("Result")


@dataclass(eq=False)
class Request:
    """Rows that a plan waits for. Requests with the same key can be rolled out together, by any one's `roll_out`."""

    key: Hashable
    roll_out: RollOut
    rows: Rows
    size: int
    result: Any = None
    error: BaseException | None = None


@dataclass(eq=False)
class SharedRollouts:
    """Rollouts of plans that are made side by side. running: plans that neither wait for rows nor are made."""

    running: int = 0
    waiting: list[Request] = field(default_factory=list)
    _turn: threading.Condition = field(default_factory=threading.Condition)

    def make(self, jobs: Sequence[Callable[[], Result]]) -> list[Result]:
        """Return the results of jobs, which call `roll_out`; raises the first one's error, once all have ended."""
        self.running = len(jobs)

        def run(job: Callable[[], Result]) -> Result:
            with self._turn:
                try:
                    return job()
                finally:
                    self.running -= 1
                    self._go_on()

        with ThreadPoolExecutor(max(1, len(jobs)), "plan") as threads:
            return list(threads.map(run, jobs))

    def roll_out(self, key: Hashable, roll_out: RollOut, rows: Rows, size: int) -> Any:
        """Return results as `problem.Rollouts` do, once every job waits for them or has ended; called by a job."""
        request = Request(key, roll_out, rows, size)
        self.waiting.append(request)
        self.running -= 1
        self._go_on()
        self._turn.wait_for(lambda: request.result is not None or request.error is not None)
        if request.error is not None:
            raise request.error
        return request.result

    def _go_on(self) -> None:
        """Roll out what plans wait for, if all of them wait."""
        if self.running or not self.waiting:
            return
        requests, self.waiting = self.waiting, []
        by_key: dict[Hashable, list[Request]] = {}
        for request in requests:
            by_key.setdefault(request.key, []).append(request)
        for together in by_key.values():
            try:
                roll_out_together(together)
            except BaseException as error:
                for request in together:
                    request.error = error
        self.running = len(requests)
        self._turn.notify_all()


def roll_out_together(requests: Sequence[Request]) -> None:
    """Give requests with the same key their results."""
    size, counts = requests[0].size, [len(request.rows.knots) for request in requests]
    total, begins = sum(counts), np.cumsum([0, *counts[:-1]])
    all_rows = Rows(*(np.concatenate(leaves) for leaves in zip(*(request.rows for request in requests), strict=True)))
    # On a CPU wider programs are not faster; elsewhere there are at most log2 of the number of plans.
    chunk = size if jax.default_backend() == "cpu" else size << (-(-total // size) - 1).bit_length()
    parts = list[Any]()
    for begin in range(0, total, chunk):
        rows = np.minimum(np.arange(begin, begin + chunk), total - 1)
        parts.append(requests[0].roll_out(Rows(*(leaf[rows] for leaf in all_rows))))
    results = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    for request, begin, count in zip(requests, begins, counts, strict=True):
        rows = begin + np.minimum(np.arange(size), count - 1)
        request.result = jax.tree.map(lambda leaf, rows=rows: leaf[rows], results)

"""Normal equations of least squares over time: a block-banded matrix bordered by unknowns that all frames share."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded
from threadpoolctl import threadpool_limits


class Banded:
    """Normal equations: blocks (D, D) up to two off the diagonal, an edge of S columns, and their corner (S, S)."""

    def __init__(self, frames: int, size: int, shared: int) -> None:
        self.blocks = np.zeros((3, frames, size, size))  # of rows f + offset, columns f
        self.edge = np.zeros((frames, size, shared))
        self.corner = np.zeros((shared, shared))
        self.slope = np.zeros((frames, size)), np.zeros(shared)

    def add(self, weights: np.ndarray, residual: np.ndarray, slopes: tuple[tuple[int, np.ndarray], ...]) -> None:
        """Add residuals (F, K) of weights (F, K).

        slopes: (offset, derivatives (F, K, D + S)) by frames f + offset and the shared unknowns, offsets rising.
        """
        split, length = self.edge.shape[1], len(residual)
        for number, (offset, one) in enumerate(slopes):
            weighed = (weights[..., None] * one).swapaxes(1, 2)
            down = (weighed @ residual[..., None])[..., 0]
            self.slope[0][offset : offset + length] += down[:, :split]
            self.slope[1][:] += down[:, split:].sum(axis=0)
            for other, two in slopes[: number + 1]:
                both = weighed @ two
                common = both[:, split:, split:].sum(axis=0)
                self.blocks[offset - other, other : other + length] += both[:, :split, :split]
                self.edge[offset : offset + length] += both[:, :split, split:]
                self.corner += common
                if other < offset:
                    self.edge[other : other + length] += both[:, split:, :split].swapaxes(1, 2)
                    self.corner += common.T

    def share(self, weights: np.ndarray, values: np.ndarray) -> None:
        """Add a prior on the shared unknowns: their values (S,) as residuals, with weights (S, S)."""
        self.corner += weights
        self.slope[1][:] += weights @ values

    def solved(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of frames (F, D) and shared unknowns (S,); damping: share added to the matrix's diagonal."""
        _, frames, size, _ = self.blocks.shape
        band = np.zeros((3 * size, frames * size))
        row, column = np.indices((size, size))
        for offset in range(3):
            below = offset * size + row - column
            keep = below >= 0
            columns = np.arange(frames)[:, None] * size + column[keep]
            band[np.broadcast_to(below[keep], columns.shape), columns] = self.blocks[offset][:, row[keep], column[keep]]
        band[0] += damping * band[0] + 1e-6
        corner = self.corner + np.diag(damping * np.diag(self.corner) + 1e-9)
        edge = self.edge.reshape(frames * size, -1)
        with threadpool_limits(1):  # a band's blocks are so small that several threads take ten times as long
            factor = cholesky_banded(band, lower=True, check_finite=False), True
            inner = cho_solve_banded(factor, np.column_stack([self.slope[0].ravel(), edge]), check_finite=False)
        shared = np.linalg.solve(corner - edge.T @ inner[:, 1:], self.slope[1] - edge.T @ inner[:, 0])
        return -(inner[:, 0] - inner[:, 1:] @ shared).reshape(frames, size), -shared

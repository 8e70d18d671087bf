"""Normal equations of least squares over time: a block-banded matrix bordered by unknowns that all frames share."""

from __future__ import annotations

import numpy as np
from scipy.linalg import cho_solve_banded, cholesky_banded

from larp_model.runtime import one_blas_thread


class Banded:
    """Normal equations: blocks (D, D) up to two off the diagonal, a border of S columns, and their corner (S, S)."""

    def __init__(self, frames: int, size: int, shared: int) -> None:
        self.blocks = np.zeros((3, frames, size, size))  # of rows f + offset, columns f
        self.border = np.zeros((frames, size, shared))
        self.corner = np.zeros((shared, shared))
        self.gradient = np.zeros((frames, size)), np.zeros(shared)

    def add(self, weights: np.ndarray, residual: np.ndarray, derivatives: tuple[tuple[int, np.ndarray], ...]) -> None:
        """Add residuals (F, K) of weights (F, K).

        derivatives: (offset, values (F, K, D + S)) by frames f + offset and the shared unknowns, offsets rising.
        """
        frame_size, length = self.border.shape[1], len(residual)
        for last, (offset, first) in enumerate(derivatives):
            weighted = (weights[..., None] * first).swapaxes(1, 2)
            gradient = (weighted @ residual[..., None])[..., 0]
            self.gradient[0][offset : offset + length] += gradient[:, :frame_size]
            self.gradient[1][:] += gradient[:, frame_size:].sum(axis=0)
            for earlier, second in derivatives[: last + 1]:
                product = weighted @ second
                shared_product = product[:, frame_size:, frame_size:].sum(axis=0)
                self.blocks[offset - earlier, earlier : earlier + length] += product[:, :frame_size, :frame_size]
                self.border[offset : offset + length] += product[:, :frame_size, frame_size:]
                self.corner += shared_product
                if earlier < offset:
                    self.border[earlier : earlier + length] += product[:, frame_size:, :frame_size].swapaxes(1, 2)
                    self.corner += shared_product.T

    def add_prior(self, weights: np.ndarray, values: np.ndarray) -> None:
        """Add a prior on the shared unknowns: their values (S,) as residuals, with weights (S, S)."""
        self.corner += weights
        self.gradient[1][:] += weights @ values

    def solve(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the step of frames (F, D) and shared unknowns (S,); damping: share added to the matrix's diagonal."""
        _, frames, size, _ = self.blocks.shape
        added, added_to_corner = self._added(damping)
        band = np.zeros((3 * size, frames * size))
        row, column = np.indices((size, size))
        for offset in range(3):
            below = offset * size + row - column
            in_band = below >= 0
            columns = np.arange(frames)[:, None] * size + column[in_band]
            band[np.broadcast_to(below[in_band], columns.shape), columns] = self.blocks[offset][
                :, row[in_band], column[in_band]
            ]
        band[0] += added.ravel()
        corner = self.corner + np.diag(added_to_corner)
        border = self.border.reshape(frames * size, -1)
        with one_blas_thread():  # a band's blocks are so small that several threads take ten times as long
            factor = cholesky_banded(band, lower=True, check_finite=False), True
            eliminated = cho_solve_banded(
                factor, np.column_stack([self.gradient[0].ravel(), border]), check_finite=False
            )
        shared = np.linalg.solve(corner - border.T @ eliminated[:, 1:], self.gradient[1] - border.T @ eliminated[:, 0])
        return -(eliminated[:, 0] - eliminated[:, 1:] @ shared).reshape(frames, size), -shared

    def gain(self, step: np.ndarray, shared_step: np.ndarray, damping: float) -> float:
        """Return by how much the quadratic model expects the step of `solve` to lower the sum of weighted squares."""
        added, added_to_corner = self._added(damping)
        along_gradient = np.sum(self.gradient[0] * step) + self.gradient[1] @ shared_step
        return float(np.sum(added * step**2) + added_to_corner @ shared_step**2 - along_gradient)

    def _added(self, damping: float) -> tuple[np.ndarray, np.ndarray]:
        """Return what is added to the diagonal, of frames (F, D) and of shared unknowns (S,)."""
        diagonal = np.diagonal(self.blocks[0], axis1=1, axis2=2)
        return damping * diagonal + 1e-6, damping * np.diag(self.corner) + 1e-9

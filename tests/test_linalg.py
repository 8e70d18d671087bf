"""Contractions: the same as NumPy's, and so are their derivatives, transposes and batches."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.test_util import check_grads

from larp_model.linalg import combined, contract, rows

LEVI_CIVITA = np.zeros((3, 3, 3))
for k in range(3):
    LEVI_CIVITA[k, k - 2, k - 1], LEVI_CIVITA[k, k - 1, k - 2] = 1.0, -1.0

# Axes, shapes of the two factors, and the same sum in NumPy's notation; "B" is the batch.
CASES = {
    "matrix times vector": ("ij,j->i", (5, 2, 3, 4), (5, 3, 4), "nijB,njB->niB"),
    "product of matrices": ("ij,jk->ik", (5, 2, 3, 4), (5, 3, 6, 4), "nijB,njkB->nikB"),
    "outer product": ("i,j->ij", (5, 3, 4), (5, 2, 4), "niB,njB->nijB"),
    "inner product": ("i,i->", (5, 3, 4), (5, 3, 4), "niB,niB->nB"),
    "two axes at once": ("pnik,pk->ni", (2, 5, 3, 6, 4), (2, 6, 4), "pnikB,pkB->niB"),
    "cross product": ("x,x->x", (5, 3, 4), (5, 3, 4), "xyz,nyB,nzB->nxB"),
    "columns crossed": ("x,xk->xk", (5, 3, 4), (5, 3, 2, 4), "xyz,nyB,nzkB->nxkB"),
    "rows crossed": ("kx,x->kx", (5, 2, 3, 4), (5, 3, 4), "xyz,nkyB,nzB->nkxB"),
}


def factors(*shapes: tuple[int, ...]) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [random.standard_normal(shape) for shape in shapes]


@pytest.mark.parametrize("case", CASES)
def test_a_contraction_and_its_derivatives_are_those_of_numpys_sum(case: str) -> None:
    axes, *shapes, notation = CASES[case]
    first, second = factors(*shapes)
    with jax.enable_x64(True):
        result = jax.jit(contract, static_argnums=0)(axes, first, second)
        check_grads(lambda one, two: contract(axes, one, two), (first, second), order=2)
    operands = (LEVI_CIVITA, first, second) if notation.startswith("xyz") else (first, second)
    np.testing.assert_allclose(result, np.einsum(notation, *operands), atol=1e-12)


@pytest.mark.parametrize("axes_in", [(0, None), (None, 1), (0, 0)])
def test_a_contraction_is_batched(axes_in: tuple[int | None, int | None]) -> None:
    shapes: list[tuple[int, ...]] = [(5, 2, 3, 4), (5, 3, 6, 4)]
    shapes = [
        shape if axis is None else (*shape[:axis], 7, *shape[axis:])
        for shape, axis in zip(shapes, axes_in, strict=True)
    ]
    first, second = factors(*shapes)
    batched = jax.vmap(lambda one, two: contract("ij,jk->ik", one, two), axes_in)(first, second)
    for number in range(7):
        one, two = (
            array if axis is None else array.take(number, axis)
            for array, axis in zip((first, second), axes_in, strict=True)
        )
        np.testing.assert_allclose(batched[number], np.einsum("nijB,njkB->nikB", one, two), rtol=1e-5, atol=1e-5)


def test_a_contraction_broadcasts_leading_axes_and_the_batch() -> None:
    first, second = factors((1, 2, 3, 1), (5, 3, 4))
    result = contract("ij,j->i", jnp.asarray(first), jnp.asarray(second))
    np.testing.assert_allclose(result, np.einsum("ij,njB->niB", first[0, ..., 0], second), rtol=1e-5, atol=1e-5)


def test_rows_and_combinations_have_the_derivatives_of_products() -> None:
    (array,) = factors((4, 3, 2))
    numbers, matrix = np.array([2, 0, 0, 3, 1]), np.array([[1.0, 2.0, 0.0, 0.0], [0.0, 0.0, -1.0, 1.0]])
    with jax.enable_x64(True):
        double = jnp.asarray(array)
        np.testing.assert_array_equal(rows(double, numbers), array[numbers])
        np.testing.assert_allclose(combined(matrix, double), np.einsum("mn,nkB->mkB", matrix, array))
        check_grads(lambda values: combined(matrix, rows(values, numbers)[:4]), (array,), order=2)

"""Small vectors and matrices with the batch last: (..., 3, B) and (..., 3, 3, B), leading axes broadcast.

All products are contractions of two arrays, `contract`. It is a primitive of its own, whose derivatives and transposes
are again contractions: JAX would take each of its slices apart. Sums and stacks of slices are what XLA makes one quick
loop over the batch of; a reduction is slow there.
"""

from __future__ import annotations

from functools import partial
from itertools import product
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

Arrays = TypeVar("Arrays")


class Axes(NamedTuple):
    """Axes of the two factors and of the result of a contraction, a letter each, before the batch.

    Letters that the result lacks are summed over. Over "x", which all three have, the cross product is taken.
    """

    first: str
    second: str
    result: str


def contract(axes: str, first: Array, second: Array) -> Array:
    """Return the contraction of two arrays by axes, such as "ij,jk->ik" of (..., i, j, B) and (..., j, k, B).

    Leading axes and the batch are broadcast.
    """
    factors, result_letters = axes.split("->")
    one, two = factors.split(",")
    parsed = Axes(one, two, result_letters)
    dtype = jnp.result_type(first, second)
    arrays = [jnp.asarray(array, dtype) for array in (first, second)]
    letters = [len(letters) for letters in parsed[:2]]
    leads = [array.shape[: array.ndim - 1 - count] for array, count in zip(arrays, letters, strict=True)]
    lead, batch = np.broadcast_shapes(*leads), _common(arrays[0].shape[-1], arrays[1].shape[-1])
    first, second = (
        _broadcast(array, (*lead, *array.shape[array.ndim - 1 - count : -1], batch))
        for array, count in zip(arrays, letters, strict=True)
    )
    result: Array = CONTRACTION.bind(first, second, axes=parsed)
    return result


def _common(one: Any, two: Any) -> Any:
    """Return the size of a batch, of which one may be 1; sizes may be symbols, see `jax.export`."""
    return two if isinstance(one, int) and one == 1 else one


def _broadcast(array: Array, shape: tuple[int, ...]) -> Array:
    return array if array.shape == shape else jnp.broadcast_to(array, shape)


def _contraction(first: Array, second: Array, *, axes: Axes) -> Array:
    """Return a contraction as a sum of products of slices."""
    if "x" in axes.result:
        return _crossed(first, second, axes)
    lead = first.ndim - 1 - len(axes.first)
    summed = [letter for letter in axes.first if letter not in axes.result]
    sizes = [first.shape[lead + axes.first.index(letter)] for letter in summed]
    total = None
    for numbers in product(*map(range, sizes)):
        at = dict(zip(summed, numbers, strict=True))
        term = _slice(first, axes.first, at, axes.result) * _slice(second, axes.second, at, axes.result)
        total = term if total is None else total + term
    assert total is not None
    return total


def _slice(array: Array, letters: str, at: dict[str, int], result: str) -> Array:
    """Return a slice of an array with the axes of the result, of size 1 where the array lacks one."""
    index: list[Any] = [at.get(letter, slice(None)) for letter in letters]
    kept = [letter for letter in letters if letter not in at]
    sliced = array[(..., *index, slice(None))]
    lead = sliced.ndim - 1 - len(kept)
    order = sorted(range(len(kept)), key=lambda number: result.index(kept[number]))
    if order != list(range(len(kept))):
        sliced = jnp.transpose(sliced, (*range(lead), *(lead + number for number in order), sliced.ndim - 1))
    missing = [lead + number for number, letter in enumerate(result) if letter not in kept]
    return jnp.expand_dims(sliced, missing) if missing else sliced


def _crossed(first: Array, second: Array, axes: Axes) -> Array:
    """Return a contraction with a cross product."""
    rest = Axes(*(letters.replace("x", "") for letters in axes))
    lead = first.ndim - 1 - len(axes.first)
    one, two = (
        [jax.lax.index_in_dim(array, row, lead + letters.index("x"), keepdims=False) for row in range(3)]
        for array, letters in ((first, axes.first), (second, axes.second))
    )
    rows = [
        _contraction(one[row - 2], two[row - 1], axes=rest) - _contraction(one[row - 1], two[row - 2], axes=rest)
        for row in range(3)
    ]
    return jnp.stack(rows, axis=lead + axes.result.index("x"))


def _shape(first: Any, second: Any, *, axes: Axes) -> Any:
    """Return the shape and type of a contraction."""
    lead = first.ndim - 1 - len(axes.first)
    sizes = dict(zip(axes.second, second.shape[lead:-1], strict=True)) | dict(
        zip(axes.first, first.shape[lead:-1], strict=True)
    )
    return first.update(shape=(*first.shape[:lead], *(sizes[letter] for letter in axes.result), first.shape[-1]))


def _primitive() -> Primitive:
    """Return the primitive of contractions, with its rules."""
    primitive = Primitive("contract")

    def batched(arrays: Any, dims: Any, *, axes: Axes) -> tuple[Array, int]:
        """Return a contraction under `jax.vmap`: one more leading axis."""
        size = next(array.shape[dim] for array, dim in zip(arrays, dims, strict=True) if dim is not None)
        moved = [
            jnp.broadcast_to(array, (size, *array.shape)) if dim is None else jnp.moveaxis(array, dim, 0)
            for array, dim in zip(arrays, dims, strict=True)
        ]
        return primitive.bind(*moved, axes=axes), 0

    # The cotangents of a and b of a x b = r are b x r and r x a; in other sums the order of factors does not matter.
    def of_first(result: Array, first: Array, second: Array, axes: Axes) -> Array:
        cotangent: Array = primitive.bind(second, result, axes=Axes(axes.second, axes.result, axes.first))
        return cotangent

    def of_second(result: Array, first: Array, second: Array, axes: Axes) -> Array:
        cotangent: Array = primitive.bind(result, first, axes=Axes(axes.result, axes.first, axes.second))
        return cotangent

    primitive.def_impl(jax.jit(_contraction, static_argnames="axes"))
    primitive.def_abstract_eval(_shape)
    mlir.register_lowering(primitive, mlir.lower_fun(_contraction, multiple_results=False))
    batching.primitive_batchers[primitive] = batched
    ad.defbilinear(primitive, of_first, of_second)
    return primitive


CONTRACTION = _primitive()


def barrier(arrays: Arrays) -> Arrays:
    """Return arrays as they are; XLA computes them before it uses them, once, and moves nothing across."""
    same: Arrays = jax.lax.optimization_barrier(arrays)
    return same


def saved(arrays: Arrays) -> Arrays:
    """Return arrays as they are; reverse mode saves them, and does not compute them again (`physics.step.SAVED`)."""
    named: Arrays = checkpoint_name(arrays, "saved")
    return named


def mv(matrix: Array, vector: Array) -> Array:
    """Return matrices (..., m, k, B) times vectors (..., k, B)."""
    return contract("ij,j->i", matrix, vector)


def mm(first: Array, second: Array) -> Array:
    """Return products of matrices (..., l, k, B) and (..., k, m, B)."""
    return contract("ij,jk->ik", first, second)


def outer(first: Array, second: Array) -> Array:
    """Return outer products (..., l, m, B) of vectors (..., l, B) and (..., m, B)."""
    return contract("i,j->ij", first, second)


def combined(matrix: np.ndarray, arrays: Array) -> Array:
    """Return linear combinations (m, ..., B) of arrays (n, ..., B), by a constant matrix (m, n)."""
    return jnp.tensordot(jnp.asarray(matrix, arrays.dtype), arrays, 1, precision=jax.lax.Precision.HIGHEST)


def rows(array: Array, numbers: np.ndarray) -> Array:
    """Return rows (m, ..., B) of arrays (n, ..., B); its transpose is a product, where JAX's would be a scatter."""
    return _rows(array, tuple(numbers.tolist()))


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def _rows(array: Array, numbers: tuple[int, ...]) -> Array:
    return array[np.array(numbers, int)]


@_rows.defjvp
def _rows_jvp(numbers: tuple[int, ...], primals: tuple[Array], tangents: tuple[Array]) -> tuple[Array, Array]:
    (array,), (tangent,) = primals, tangents
    return _rows(array, numbers), combined(np.eye(len(array))[np.array(numbers, int)], tangent)


def dot(first: Array, second: Array) -> Array:
    """Return inner products (..., 1, B) of vectors (..., 3, B)."""
    return contract("i,i->", first, second)[..., None, :]


def norm(vector: Array) -> Array:
    """Return lengths (n, 1, B) of vectors (n, 3, B), with gradient zero at zero."""
    squared = dot(vector, vector)
    zero = squared < 1e-20
    return jnp.where(zero, 0.0, jnp.sqrt(jnp.where(zero, 1.0, squared)))


def cross(first: Array, second: Array) -> Array:
    """Return cross products (..., 3, B) of vectors."""
    return contract("x,x->x", first, second)


def cross_columns(vector: Array, matrix: Array) -> Array:
    """Return [v] M: each column of M (..., 3, m, B) crossed from the left with v (..., 3, B)."""
    return contract("x,xk->xk", vector, matrix)


def cross_rows(matrix: Array, vector: Array) -> Array:
    """Return M [v]: each row of M (..., m, 3, B) crossed with v (..., 3, B)."""
    return contract("kx,x->kx", matrix, vector)


def inverse_cholesky(matrix: Array) -> Array:
    """Return L^-1 (n, 3, 3, B) of positive definite matrices L L' and lower triangles L."""
    a = jax.lax.rsqrt(matrix[:, 0, 0])
    b, c = matrix[:, 1, 0] * a, matrix[:, 2, 0] * a
    d = jax.lax.rsqrt(matrix[:, 1, 1] - b * b)
    e = (matrix[:, 2, 1] - c * b) * d
    f = jax.lax.rsqrt(matrix[:, 2, 2] - c * c - e * e)
    none = jnp.zeros_like(a)
    rows = ((a, none, none), (-b * a * d, d, none), ((e * b * d - c) * a * f, -e * d * f, f))
    return barrier(jnp.stack([jnp.stack(row, axis=1) for row in rows], axis=1))


def inverse(matrix: Array) -> Array:
    """Return the inverses of regular matrices (n, 3, 3, B), by their adjugates."""
    a, b, c = matrix[:, 0], matrix[:, 1], matrix[:, 2]
    adjugate = jnp.stack([cross(b, c), cross(c, a), cross(a, b)], axis=2)
    x, y, z = (a[:, k] * adjugate[:, k, 0] for k in range(3))
    return adjugate / (x + y + z)[:, None, None]


def rotated(orientation: Array, rotation_vector: Array) -> Array:
    """Return orientations (n, 4, B) turned by rotation vectors (n, 3, B) [rad], right to the second order."""
    w, v = orientation[:, :1], orientation[:, 1:]
    half = 0.5 * rotation_vector
    real = w - dot(half, v)
    imaginary = v + w * half + cross(half, v)
    scale = jax.lax.rsqrt(real**2 + dot(imaginary, imaginary))
    return scale * jnp.concatenate([real, imaginary], axis=1)


def rotation_matrices(orientation: Array) -> Array:
    """Return the rotation matrices (n, 3, 3, B) of orientations (n, 4, B): 1 + 2 w [v] + 2 [v]^2 of (w, v)."""
    w, v = orientation[:, :1, None], orientation[:, 1:]
    unit = jnp.eye(3, dtype=orientation.dtype)[..., None]
    return (1.0 - 2.0 * dot(v, v)[:, None]) * unit + 2.0 * outer(v, v) + 2.0 * w * cross_columns(v, unit)

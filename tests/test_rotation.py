"""Rotation algebra: laws of the group, and gradients that survive every angle."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import Array
from jax.test_util import check_grads
from scipy.spatial.transform import Rotation

from larp_model import rotation

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])
UPSIDE_DOWN = np.array([0.0, 1.0, 0.0, 0.0])


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def quaternions(seed: int, count: int = 200) -> np.ndarray:
    """Random orientations (count, 4), the identity and half turns among them."""
    some = np.concatenate([np.eye(4), -np.eye(4), np.random.default_rng(seed).standard_normal((count - 8, 4))])
    return np.asarray(some / np.linalg.norm(some, axis=-1, keepdims=True))


def test_identity_and_inverse() -> None:
    q, one = jnp.asarray(quaternions(0)), jnp.asarray(IDENTITY)
    np.testing.assert_allclose(rotation.multiply(q, one), q, atol=1e-15)
    np.testing.assert_allclose(rotation.multiply(one, q), q, atol=1e-15)
    undone = rotation.multiply(q, rotation.conjugate(q))
    np.testing.assert_allclose(undone, np.broadcast_to(IDENTITY, q.shape), atol=1e-14)


def test_multiplication_is_associative() -> None:
    a, b, c = map(jnp.asarray, (quaternions(1), quaternions(2)[::-1], np.roll(quaternions(3), 70, axis=0)))
    left = rotation.multiply(rotation.multiply(a, b), c)
    np.testing.assert_allclose(left, rotation.multiply(a, rotation.multiply(b, c)), atol=1e-14)


def test_matrices_multiply_as_quaternions_do() -> None:
    a, b = jnp.asarray(quaternions(1)), jnp.asarray(quaternions(2)[::-1])
    product = rotation.matrix(rotation.multiply(a, b))
    np.testing.assert_allclose(product, rotation.matrix(a) @ rotation.matrix(b), atol=1e-14)
    np.testing.assert_allclose(
        rotation.matrix(a), Rotation.from_quat(np.asarray(a), scalar_first=True).as_matrix(), atol=1e-14
    )


@given(st.floats(0.0, np.pi - 1e-6), st.integers(0, 2**16))
def test_logarithm_undoes_exponential(angle: float, seed: int) -> None:
    axis = quaternions(seed, 9)[-1, 1:]
    vector = angle * axis / np.linalg.norm(axis)
    found = rotation.to_rotation_vector(rotation.from_rotation_vector(jnp.asarray(vector)))
    np.testing.assert_allclose(found, vector, rtol=1e-8, atol=1e-15)


def test_exponential_undoes_logarithm() -> None:
    q = quaternions(4)
    q = np.where(q[:, :1] < 0.0, -q, q)
    vectors = rotation.to_rotation_vector(jnp.asarray(q))
    assert np.linalg.norm(vectors, axis=-1).max() <= np.pi + 1e-12
    np.testing.assert_allclose(rotation.from_rotation_vector(vectors), q, atol=1e-14)


def test_both_signs_of_a_quaternion_are_one_rotation() -> None:
    q = jnp.asarray(quaternions(5)[8:])
    np.testing.assert_array_equal(rotation.to_rotation_vector(q), rotation.to_rotation_vector(-q))
    np.testing.assert_array_equal(rotation.heading(q), rotation.heading(-q))


def test_two_half_turns_are_one_whole() -> None:
    q, vector = quaternions(6), np.random.default_rng(6).standard_normal((200, 3))
    half = rotation.integrate(rotation.integrate(jnp.asarray(q), jnp.asarray(0.5 * vector)), jnp.asarray(0.5 * vector))
    np.testing.assert_allclose(rotation.integrate(jnp.asarray(q), jnp.asarray(vector)), half, atol=1e-14)
    turn = Rotation.from_rotvec(vector) * Rotation.from_quat(q, scalar_first=True)
    np.testing.assert_allclose(rotation.matrix(half), turn.as_matrix(), atol=1e-14)


def test_integration_keeps_unit_length_in_single_precision() -> None:
    with jax.enable_x64(False):
        vectors = 0.3 * jax.random.normal(jax.random.key(0), (1000, 5, 3))
        start = jnp.tile(jnp.asarray(IDENTITY, jnp.float32), (5, 1))
        end, _ = jax.lax.scan(lambda q, v: (rotation.integrate(q, v), None), start, vectors)
    np.testing.assert_allclose(np.linalg.norm(end, axis=-1), 1.0, atol=3e-7)


@given(st.floats(-10.0, 10.0))
def test_heading_turns_with_the_body(angle: float) -> None:
    q = quaternions(7)
    q = q[q[:, 0] ** 2 + q[:, 3] ** 2 > 1e-3]
    turned = rotation.multiply(rotation.from_rotation_vector(jnp.array([0.0, 0.0, angle])), q)
    cosine, sine = np.moveaxis(np.asarray(rotation.heading(jnp.asarray(q))), -1, 0)
    found = np.asarray(rotation.heading(turned))
    expected = (cosine + 1j * sine) * np.exp(1j * angle)
    np.testing.assert_allclose(found[:, 0] + 1j * found[:, 1], expected, atol=1e-12)


def test_turns_about_z_are_those_of_the_quaternion() -> None:
    angle, vectors = np.linspace(-4.0, 4.0, 50), np.random.default_rng(0).standard_normal((50, 3))
    turn = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    found = rotation.about_z(jnp.asarray(vectors), turn)
    np.testing.assert_allclose(found, Rotation.from_rotvec(angle[:, None] * [0.0, 0.0, 1.0]).apply(vectors), atol=1e-14)
    np.testing.assert_allclose(rotation.about_z(found, rotation.opposite(turn)), vectors, atol=1e-14)


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        pytest.param(rotation.from_rotation_vector, (np.array([0.3, -0.7, 0.2]),), id="exponential"),
        pytest.param(rotation.to_rotation_vector, (quaternions(8)[20],), id="logarithm"),
        pytest.param(rotation.integrate, (quaternions(8)[21], np.array([0.1, 0.4, -0.3])), id="integrate"),
        pytest.param(rotation.heading, (quaternions(8)[22],), id="heading"),
        pytest.param(rotation.matrix, (quaternions(8)[23],), id="matrix"),
    ],
)
def test_forward_reverse_and_finite_differences_agree(
    function: Callable[..., Array], arguments: tuple[np.ndarray, ...]
) -> None:
    check_grads(function, arguments, order=1, modes=("fwd", "rev"), eps=1e-5, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_gradients_of_small_angles_are_those_of_zero(derivative: Callable[..., Callable[..., Array]]) -> None:
    sizes = jnp.array([0.0, 1e-30, 1e-12, 1e-6, 0.99e-4, 1.01e-4, 1e-3])
    vectors = sizes[:, None] * jnp.array([0.6, 0.0, 0.8])
    there = jax.jit(jax.vmap(derivative(rotation.from_rotation_vector)))(vectors)
    back = jax.jit(jax.vmap(derivative(rotation.to_rotation_vector)))(rotation.from_rotation_vector(vectors))
    half = np.concatenate([np.zeros((1, 3)), 0.5 * np.eye(3)])
    assert (np.abs(there - half).max(axis=(1, 2)) <= sizes + 1e-12).all()
    assert (np.abs(back[:, :, 1:] - 2.0 * np.eye(3)).max(axis=(1, 2)) <= 3.0 * sizes + 1e-12).all()


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
@pytest.mark.parametrize("precise", [True, False], ids=["double", "single"])
def test_gradients_are_finite_where_angles_are_degenerate(
    derivative: Callable[..., Callable[..., Array]], precise: bool
) -> None:
    def everything(q: Array, vector: Array) -> Array:
        turned = rotation.integrate(q, vector)
        return jnp.concatenate([turned, rotation.to_rotation_vector(q), rotation.heading(q)])

    with jax.enable_x64(precise):
        degenerate = jnp.asarray(np.stack([IDENTITY, -IDENTITY, UPSIDE_DOWN]))
        found = jax.jit(jax.vmap(derivative(everything, argnums=(0, 1))))(degenerate, jnp.zeros((3, 3)))
    assert all(np.isfinite(part).all() for part in found)


def test_heading_of_a_body_on_its_head_is_x() -> None:
    np.testing.assert_array_equal(rotation.heading(jnp.asarray(UPSIDE_DOWN)), [1.0, 0.0])


@pytest.mark.parametrize("angle", [0.7, np.array([0.7, -2.0, 4.0])], ids=["one", "each its own"])
def test_states_turned_about_z_move_as_one_body_to_64_bits(angle: np.ndarray | float) -> None:
    random = np.random.default_rng(1)
    states = random.standard_normal((3, 5, 13))
    states[..., 3:7] = quaternions(8, 15)[:15].reshape(3, 5, 4)
    with jax.enable_x64(False):
        turned = rotation.turned_about_z(states, angle)
    turns = Rotation.from_rotvec(np.broadcast_to(angle, 3)[:, None] * (0.0, 0.0, 1.0))
    for row, turn in enumerate(turns):
        for vector in (slice(0, 3), slice(7, 10), slice(10, 13)):
            np.testing.assert_allclose(turned[row, :, vector], turn.apply(states[row, :, vector]), atol=1e-14)
        found = Rotation.from_quat(turned[row, :, 3:7], scalar_first=True)
        expected = turn * Rotation.from_quat(states[row, :, 3:7], scalar_first=True)
        np.testing.assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-14)

"""Contact: closest points of capsules and conservative advancement, with their gradients."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import Array
from jax.test_util import check_grads
from mujoco.mjx._src.collision_primitive import capsule_capsule
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.detection import ContactPoints, contact_points
from larp_model.physics import collision
from larp_model.physics.collision import CapsuleShapes, ClosestPoints
from larp_model.physics.kinematics import morphology_of
from larp_model.scene import Scene, Vector


class Segment(NamedTuple):
    """Capsules with the batch first: centre (*, 3), half (*, 3), radius (*,) [m]."""

    centre: Array
    half: Array
    radius: Array

    @property
    def capsules(self) -> CapsuleShapes:
        """Return the same as one pair's, with the batch last."""
        return CapsuleShapes(*(each.reshape(-1, size).T[None] for each, size in zip(self, (3, 3, 1), strict=True)))


def closest_points(first: Segment, second: Segment) -> ClosestPoints:
    """Return `collision.closest` with the batch first: normal (*, 3), distance (*,), point (*, 3), along (*, 2)."""
    found, batch = collision.closest(first.capsules, second.capsules), first.radius.shape
    normal, distance, point, along = (each[0].T for each in found)
    return ClosestPoints(
        normal.reshape(*batch, 3), distance.reshape(batch), point.reshape(*batch, 3), along.reshape(*batch, 2)
    )


closest = jax.jit(closest_points)


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


def segments(seed: int, count: int = 300) -> tuple[Segment, Segment]:
    """Pairs of random capsules; the first ninety are balls, parallel, crossing or concentric ones."""
    random = np.random.default_rng(seed)
    centres, halves = random.uniform(-0.5, 0.5, (2, count, 3)), random.uniform(-0.3, 0.3, (2, count, 3))
    halves[0, :20], halves[1, 10:30] = 0.0, 0.0
    halves[1, 30:50] = halves[0, 30:50] * random.uniform(-2.0, 2.0, (20, 1))
    centres[1, 50:70] = centres[0, 50:70] + 0.5 * (halves[0] + halves[1])[50:70]
    centres[1, 70:80] = centres[0, 70:80]
    halves[1, 80:90], centres[1, 80:90] = halves[0, 80:90], centres[0, 80:90]
    radii = random.uniform(0.02, 0.1, (2, count))
    return Segment(*map(jnp.asarray, (centres[0], halves[0], radii[0]))), Segment(
        *map(jnp.asarray, (centres[1], halves[1], radii[1]))
    )


def ends(first: Segment, second: Segment, found: ClosestPoints) -> tuple[Array, Array]:
    """The closest points of both axes."""
    one = first.centre + found.along[..., :1] * first.half
    return one, second.centre + found.along[..., 1:] * second.half


def apart(first: Segment, second: Segment) -> np.ndarray:
    """Return a mask of pairs whose axes do not cross, so that their normal is defined."""
    return np.asarray(closest(first, second).distance + first.radius + second.radius) > 1e-6


def skew(first: Segment, second: Segment) -> np.ndarray:
    """Return a mask of pairs that are neither parallel nor balls, so that their closest points are unique."""
    return np.asarray(np.linalg.norm(np.cross(first.half, second.half), axis=-1) > 1e-3)


def test_closest_points_are_as_close_as_sampling_finds() -> None:
    first, second = segments(0)
    found = closest(first, second)
    place = np.linspace(-1.0, 1.0, 61)[:, None]
    one = np.asarray(first.centre)[:, None] + place * np.asarray(first.half)[:, None]
    two = np.asarray(second.centre)[:, None] + place * np.asarray(second.half)[:, None]
    sampled = np.linalg.norm(one[:, :, None] - two[:, None], axis=-1).min(axis=(1, 2)) - first.radius - second.radius
    spacing = (np.linalg.norm(first.half, axis=-1) + np.linalg.norm(second.half, axis=-1)) / 60.0
    assert (found.distance <= sampled + 1e-9).all() and (found.distance >= sampled - spacing - 1e-9).all()


def test_closest_describes_itself() -> None:
    first, second = segments(1)
    found = closest(first, second)
    assert np.abs(found.along).max() <= 1.0
    one, two = ends(first, second, found)
    defined = apart(first, second)
    np.testing.assert_allclose(np.linalg.norm(found.normal, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(found.distance, np.linalg.norm(two - one, axis=-1) - first.radius - second.radius)
    reach = (found.distance + first.radius + second.radius)[:, None] * found.normal
    np.testing.assert_allclose((two - one)[defined], reach[defined], atol=1e-12)
    on_first, on_second = one + first.radius[:, None] * found.normal, two - second.radius[:, None] * found.normal
    np.testing.assert_allclose(found.point, 0.5 * (on_first + on_second), atol=1e-12)
    np.testing.assert_array_equal(found.normal[~defined], np.tile([0.0, 0.0, 1.0], (int((~defined).sum()), 1)))


def test_closest_agrees_with_mjx() -> None:
    first, second = segments(2)
    count = len(first.radius)
    turns = []
    for half in (first.half, second.half):
        size = np.linalg.norm(half, axis=-1, keepdims=True)
        axis = np.where(size > 0.0, half / np.where(size > 0.0, size, 1.0), [0.0, 0.0, 1.0])
        turns += [Rotation.align_vectors(row[None], [[0.0, 0.0, 1.0]])[0].as_matrix() for row in axis]
    radius = jnp.concatenate([first.radius, second.radius])
    length = jnp.linalg.norm(jnp.concatenate([first.half, second.half]), axis=-1)
    model = SimpleNamespace(geom_size=jnp.stack([radius, length, jnp.zeros_like(radius)], axis=-1))
    data = SimpleNamespace(
        geom_xpos=jnp.concatenate([first.centre, second.centre]), geom_xmat=jnp.asarray(np.stack(turns))
    )
    distance, point, frame = capsule_capsule(model, data, None, jnp.arange(2 * count).reshape(2, count).T)
    found = closest(first, second)
    np.testing.assert_allclose(found.distance, distance, atol=1e-5)
    defined = apart(first, second)
    unique = defined & skew(first, second)
    np.testing.assert_allclose(found.normal[unique], frame[unique, 0], atol=1e-4)
    np.testing.assert_allclose(found.point[unique], point[unique], atol=1e-4)


def test_closest_is_symmetric() -> None:
    first, second = segments(3)
    one, other = closest(first, second), closest(second, first)
    np.testing.assert_allclose(one.distance, other.distance, atol=1e-12)
    defined = apart(first, second)
    unique = defined & skew(first, second)
    np.testing.assert_allclose(one.normal[unique], -other.normal[unique], atol=1e-9)
    np.testing.assert_allclose(one.point[unique], other.point[unique], atol=1e-9)


def test_closest_moves_with_the_world() -> None:
    first, second = segments(4)
    turn, shift = Rotation.from_rotvec([0.4, -1.1, 2.0]), np.array([3.0, -2.0, 1.0])

    def move(segment: Segment) -> Segment:
        centre = turn.apply(np.array(segment.centre)) + shift
        return Segment(jnp.asarray(centre), jnp.asarray(turn.apply(np.array(segment.half))), segment.radius)

    still, moved = closest(first, second), closest(move(first), move(second))
    defined = apart(first, second)
    np.testing.assert_allclose(moved.distance, still.distance, atol=1e-10)
    np.testing.assert_allclose(moved.normal[defined], turn.apply(np.array(still.normal))[defined], atol=1e-8)
    np.testing.assert_allclose(moved.point[defined], (turn.apply(np.array(still.point)) + shift)[defined], atol=1e-8)


def test_parallel_capsules_touch_in_the_middle_of_their_overlap() -> None:
    first = Segment(jnp.zeros(3), jnp.array([0.0, 0.0, 0.5]), jnp.array(0.1))
    for sign in (1.0, -1.0):
        second = Segment(jnp.array([0.4, 0.0, 0.6]), jnp.array([0.0, 0.0, sign * 0.4]), jnp.array(0.1))
        found = closest(first, second)
        np.testing.assert_allclose(found.point, [0.2, 0.0, 0.35], atol=1e-9)
        np.testing.assert_allclose(found.distance, 0.2, atol=1e-12)


COORDINATE = st.floats(-1.0, 1.0, width=32, allow_subnormal=False)
VECTOR = st.tuples(COORDINATE, COORDINATE, COORDINATE)


@jax.jit
def closest_and_gradients(numbers: Array) -> tuple[ClosestPoints, Array, Array]:
    """Closest points of two capsules of radius 0.1 with these (4, 3) centres and halves, and their derivatives."""

    def found(numbers: Array) -> ClosestPoints:
        radius = jnp.array(0.1, numbers.dtype)
        return closest_points(Segment(numbers[0], numbers[1], radius), Segment(numbers[2], numbers[3], radius))

    def flat(numbers: Array) -> Array:
        return jnp.concatenate([part.reshape(-1) for part in found(numbers)])

    return found(numbers), jax.jacfwd(flat)(numbers), jax.jacrev(flat)(numbers)


@given(VECTOR, VECTOR, VECTOR, VECTOR)
def test_closest_and_its_gradients_are_finite_everywhere(
    centre: Vector, half: Vector, other_centre: Vector, other_half: Vector
) -> None:
    with jax.enable_x64(False):
        numbers = jnp.array([centre, half, other_centre, other_half])
        found, forward, reverse = closest_and_gradients(numbers)
    assert all(np.isfinite(part).all() for part in (*found, forward, reverse))
    assert np.linalg.norm(found.normal) == pytest.approx(1.0, abs=1e-5)
    assert found.distance <= np.linalg.norm(np.subtract(centre, other_centre)) - 0.2 + 1e-5


DEGENERATE = {
    "coincident": [(0.1, 0.2, 0.3), (0.0, 0.0, 0.2), (0.1, 0.2, 0.3), (0.0, 0.0, 0.2)],
    "coincident balls": [(0.1, 0.2, 0.3), (0.0, 0.0, 0.0), (0.1, 0.2, 0.3), (0.0, 0.0, 0.0)],
    "balls": [(0.1, 0.2, 0.3), (0.0, 0.0, 0.0), (0.4, 0.2, 0.3), (0.0, 0.0, 0.0)],
    "parallel": [(0.0, 0.0, 0.0), (0.0, 0.0, 0.2), (0.3, 0.0, 0.1), (0.0, 0.0, 0.3)],
    "collinear": [(0.0, 0.0, 0.0), (0.0, 0.0, 0.2), (0.0, 0.0, 0.9), (0.0, 0.0, -0.3)],
    "crossing": [(0.0, 0.0, 0.0), (0.0, 0.2, 0.0), (0.0, 0.0, 0.0), (0.2, 0.0, 0.0)],
    "ball on a capsule's axis": [(0.0, 0.0, 0.1), (0.0, 0.0, 0.2), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)],
}


@pytest.mark.parametrize("case", DEGENERATE)
@pytest.mark.parametrize("precise", [True, False], ids=["double", "single"])
def test_gradients_are_finite_where_capsules_are_degenerate(case: str, precise: bool) -> None:
    with jax.enable_x64(precise):
        found, forward, reverse = closest_and_gradients(jnp.array(DEGENERATE[case], float))
        np.testing.assert_allclose(forward, reverse, rtol=1e-3, atol=1e-3)
    assert all(np.isfinite(part).all() for part in (*found, forward, reverse))


def test_gradient_of_the_distance_is_the_normal() -> None:
    first, second = segments(5)
    slope = jax.jit(jax.grad(lambda centre: closest_points(first, second._replace(centre=centre)).distance.sum()))
    defined = apart(first, second)
    np.testing.assert_allclose(slope(second.centre)[defined], closest(first, second).normal[defined], atol=1e-6)


def test_forward_reverse_and_finite_differences_of_closest_agree() -> None:
    pairs = np.random.default_rng(6).uniform(-0.5, 0.5, (4, 4, 3))

    def found(numbers: Array) -> ClosestPoints:
        radius = jnp.full(len(pairs), 0.1)
        return closest_points(Segment(numbers[0], numbers[1], radius), Segment(numbers[2], numbers[3], radius))

    check_grads(jax.jit(found), (jnp.asarray(pairs.swapaxes(0, 1)),), 1, ("fwd", "rev"), 1e-5, 1e-5, eps=1e-6)


def test_moved_segments_keep_their_length() -> None:
    first, _ = segments(7)
    velocity, spin = np.random.default_rng(7).standard_normal((2, 300, 3))
    linear, angular = (jnp.asarray(each).T[None] for each in (velocity, 20.0 * spin))
    moved = collision.advanced(first.capsules, linear, angular, jnp.full((1, 1, 300), 0.01))
    np.testing.assert_allclose(np.linalg.norm(moved.half[0], axis=0), np.linalg.norm(first.half, axis=-1), atol=1e-12)
    np.testing.assert_allclose(moved.centre[0].T, first.centre + 0.01 * velocity)


def test_time_of_impact_closes_the_gap_or_is_the_limit() -> None:
    gap, approach = np.random.default_rng(8).normal(0.0, (0.05, 10.0), (500, 2)).T
    time = np.asarray(collision.time_of_impact(jnp.asarray(gap), jnp.asarray(approach), 0.01))
    assert (time >= 0.0).all() and (time <= 0.01).all()
    assert (time[gap <= 0.0] == 0.0).all()
    assert (time[(gap > 0.0) & (approach < 0.0)] == 0.01).all()
    met = (gap > 0.0) & (time < 0.01)
    np.testing.assert_allclose((approach * time)[met], gap[met])


def test_a_foot_that_crosses_the_ball_within_a_step_is_seen(scene: Scene) -> None:
    foot, ball = scene.index("human", "right_foot"), scene.index("ball", "ball")
    state = np.zeros((1, len(scene.links), packed.SIZE))
    state[..., packed.ORIENTATION] = 1.0, 0.0, 0.0, 0.0
    state[0, : len(scene.human.links), packed.POSITION] = 0.0, 0.0, 5.0
    state[0, foot, packed.POSITION] = 0.0, -0.2, 0.11  # its axis is x, it moves across
    state[0, ball, packed.POSITION] = 0.0, 0.0, 0.11
    gap = 0.2 - scene.links[foot].radius - scene.links[ball].radius

    @jax.jit
    def seen(state: Array, free: Array) -> ContactPoints:
        return contact_points(scene, state, morphology_of(scene)[None], free)[0][1]

    touches = []
    for speed in (16.0, 0.9 * gap / scene.dt):
        state[0, foot, packed.VELOCITY] = 0.0, speed, 0.0
        touches.append(seen(jnp.asarray(state), jnp.asarray(state)))
    free = state.copy()
    free[0, foot, packed.VELOCITY] *= 1.5  # it speeds up, and arrives after all
    touches.append(seen(jnp.asarray(state), jnp.asarray(free)))
    fast, slow, faster = touches
    struck = scene.pairs[0].first_links.index("right_foot")
    assert fast.near[0, struck] == 1.0 and (np.delete(np.asarray(fast.near[0]), struck) == 0.0).all()
    np.testing.assert_allclose(fast.normal[0, struck], [0.0, 1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(fast.remaining[0, struck], scene.dt - gap / 16.0, atol=1e-5)
    assert float(slow.remaining[0, struck]) == 0.0 < float(faster.remaining[0, struck])

"""Contact: closest points of capsules, conservative advancement, and the free impact, with their gradients."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax import Array
from jax.test_util import check_grads
from mujoco.mjx._src.collision_primitive import capsule_capsule
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from larp_model import contact
from larp_model import state as packed
from larp_model.bodies import BALL_SURFACE
from larp_model.contact import Closest, Segment
from larp_model.kinematics import morphology_of
from larp_model.meeting import Meeting, gatherings, meetings, within_reach
from larp_model.scene import Scene, Surface, Vector

closest = jax.jit(contact.closest)
impact = jax.jit(contact.impact, static_argnames="surface")


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


def ends(first: Segment, second: Segment, found: Closest) -> tuple[Array, Array]:
    """The closest points of both axes."""
    one = first.centre + found.along[..., :1] * first.half
    return one, second.centre + found.along[..., 1:] * second.half


def apart(first: Segment, second: Segment) -> np.ndarray:
    """Which pairs do not have crossing axes, so that their normal is defined."""
    return np.asarray(closest(first, second).distance + first.radius + second.radius) > 1e-6


def skew(first: Segment, second: Segment) -> np.ndarray:
    """Which pairs are neither parallel nor balls, so that their closest points are unique."""
    return np.linalg.norm(np.cross(first.half, second.half), axis=-1) > 1e-3


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
def closest_and_gradients(numbers: Array) -> tuple[Closest, Array, Array]:
    """Closest points of two capsules of radius 0.1 with these (4, 3) centres and halves, and their derivatives."""

    def found(numbers: Array) -> Closest:
        radius = jnp.array(0.1, numbers.dtype)
        return contact.closest(Segment(numbers[0], numbers[1], radius), Segment(numbers[2], numbers[3], radius))

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
    slope = jax.jit(jax.grad(lambda centre: contact.closest(first, second._replace(centre=centre)).distance.sum()))
    defined = apart(first, second)
    np.testing.assert_allclose(slope(second.centre)[defined], closest(first, second).normal[defined], atol=1e-6)


def test_forward_reverse_and_finite_differences_of_closest_agree() -> None:
    pairs = np.random.default_rng(6).uniform(-0.5, 0.5, (4, 4, 3))

    def found(numbers: Array) -> Closest:
        radius = jnp.full(len(pairs), 0.1)
        return contact.closest(Segment(numbers[0], numbers[1], radius), Segment(numbers[2], numbers[3], radius))

    check_grads(jax.jit(found), (jnp.asarray(pairs.swapaxes(0, 1)),), 1, ("fwd", "rev"), 1e-5, 1e-5, eps=1e-6)


def test_moved_segments_keep_their_length() -> None:
    first, _ = segments(7)
    velocity, spin = np.random.default_rng(7).standard_normal((2, 300, 3))
    moved = contact.moved(first, jnp.asarray(velocity), jnp.asarray(20.0 * spin), jnp.full(300, 0.01))
    np.testing.assert_allclose(np.linalg.norm(moved.half, axis=-1), np.linalg.norm(first.half, axis=-1), atol=1e-12)
    np.testing.assert_allclose(moved.centre, first.centre + 0.01 * velocity)


def test_time_of_impact_closes_the_gap_or_is_the_limit() -> None:
    gap, approach = np.random.default_rng(8).normal(0.0, (0.05, 10.0), (500, 2)).T
    time = np.asarray(contact.time_of_impact(jnp.asarray(gap), jnp.asarray(approach), 0.01))
    assert (time >= 0.0).all() and (time <= 0.01).all()
    assert (time[gap <= 0.0] == 0.0).all()
    assert (time[(gap > 0.0) & (approach < 0.0)] == 0.01).all()
    met = (gap > 0.0) & (time < 0.01)
    np.testing.assert_allclose((approach * time)[met], gap[met])


def test_a_foot_that_crosses_the_ball_within_a_step_is_seen(scene: Scene) -> None:
    foot, ball = scene.index("human", "right_foot"), scene.index("ball", "ball")
    state = np.zeros((1, len(scene.links), packed.SIZE))
    state[..., packed.ORIENTATION] = 1.0, 0.0, 0.0, 0.0
    state[0, : len(scene.bodies[0].links), packed.POSITION] = 0.0, 0.0, 5.0
    state[0, foot, packed.POSITION] = 0.0, -0.2, 0.11  # its axis is x, it moves across
    state[0, ball, packed.POSITION] = 0.0, 0.0, 0.11
    gap = 0.2 - scene.links[foot].radius - scene.links[ball].radius

    @jax.jit
    def seen(state: Array, free: Array) -> Meeting:
        return meetings(scene, state, morphology_of(scene)[None], free)[0][1]

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


def test_links_out_of_reach_do_not_feel_each_other(scene: Scene) -> None:
    random, count = np.random.default_rng(9), 400
    state = np.zeros((count, len(scene.links), packed.SIZE))
    state[..., packed.POSITION] = random.uniform((-0.5, -0.5, 0.5), (0.5, 0.5, 1.5), (*state.shape[:2], 3))
    state[..., packed.ORIENTATION] = (
        Rotation.random(state[..., 0].size, rng=random).as_quat().reshape(*state.shape[:2], 4)
    )
    free = state.copy()
    for each in (state, free):
        speed = random.uniform(0.0, 30.0, (count, 1, 1))
        each[..., packed.VELOCITY] = speed * random.standard_normal((*state.shape[:2], 3))
        each[..., packed.ANGULAR_VELOCITY] = 3.0 * speed * random.standard_normal((*state.shape[:2], 3))
    shape = morphology_of(scene)[None]

    def reach(one: Array, after: Array) -> Array:
        [(_, first, second)] = gatherings(scene, one, shape, after)
        return within_reach(first, second, scene.dt)

    within = np.asarray(jax.jit(reach)(jnp.asarray(state), jnp.asarray(free)))
    [(_, touch)] = meetings(scene, jnp.asarray(state), shape, jnp.asarray(free))
    felt = np.asarray(touch.near) > 0.0
    assert felt.any() and (~within).any()
    assert not (felt & ~within).any()


def integrated(
    acceleration: float, surface: Surface, depth: float, approach: float, time: float
) -> tuple[float, float]:
    """Gap [m] and its speed [m/s] after `time` by numerical integration of the equation in `contact.impact`."""
    share = contact.IMPEDANCE

    def motion(_: float, state: np.ndarray) -> list[float]:
        spring = surface.stiffness * state[0] + surface.damping * state[1]
        return [state[1], (1.0 - share) * acceleration - share * spring]

    def release(_: float, state: np.ndarray) -> float:
        return float(state[0])

    release.terminal, release.direction = True, -1.0  # type: ignore[attr-defined]
    found = solve_ivp(motion, (0.0, time), [depth, approach], events=release, rtol=1e-9, atol=1e-12, max_step=1e-4)
    free, (end_depth, end_rate) = time - found.t[-1], found.y[:, -1]
    return -end_depth - end_rate * free - 0.5 * acceleration * free**2, -end_rate - acceleration * free


SOFT = Surface.bouncing(contact_time=0.02, restitution=0.5, friction=0.5)


@pytest.mark.parametrize("surface", [BALL_SURFACE, SOFT], ids=["ball", "soft"])
@pytest.mark.parametrize("acceleration", [0.0, 9.81])
def test_impact_solves_its_equation_through_release(surface: Surface, acceleration: float) -> None:
    random = np.random.default_rng(9)
    depth = np.where(random.random(40) < 0.5, 0.0, random.uniform(0.0, 0.02, 40))
    approach, time = random.uniform(0.5, 15.0, 40), random.uniform(0.0, 0.01, 40)
    approach[depth > 0.0] -= 8.0  # some are already on their way out
    found = impact(jnp.asarray(depth), jnp.asarray(approach), acceleration, surface, jnp.asarray(time))
    rows = zip(depth, approach, time, strict=True)
    gap, speed = np.array([integrated(acceleration, surface, *row) for row in rows]).T
    np.testing.assert_allclose(found.gap, gap, atol=2e-6)
    change = speed + approach + acceleration * time
    np.testing.assert_allclose(found.change, np.maximum(change, 0.0), atol=2e-3)  # a contact never pulls
    travel = gap + depth + approach * time + 0.5 * acceleration * time**2
    pushed = change > 1e-3
    np.testing.assert_allclose((found.change * found.lag)[pushed], travel[pushed], atol=1e-5)


@pytest.mark.parametrize("restitution", [0.3, 0.6, 0.86, 1.0])
@pytest.mark.parametrize("contact_time", [0.002, 0.010, 0.030])
def test_a_surface_returns_its_restitution_within_its_contact_time(restitution: float, contact_time: float) -> None:
    surface = Surface.bouncing(contact_time, restitution, friction=0.5)
    for approach in (0.5, 10.0):
        found = impact(0.0, approach, 0.0, surface, 1.02 * contact_time)
        assert float(found.change) == pytest.approx((1.0 + restitution) * approach, rel=0.01)
        assert float(found.gap) > 0.0
        assert float(impact(0.0, approach, 0.0, surface, 0.98 * contact_time).gap) < 0.0


@pytest.mark.parametrize("share", [0.2, 0.6, 0.98, 1.0, 1.02, 1.5, 1.8])
def test_what_nearly_rests_stays_near_rest(share: float) -> None:
    sunk = (1.0 - contact.IMPEDANCE) * 9.81 / (contact.IMPEDANCE * BALL_SURFACE.stiffness)
    for time in (0.002, 0.01, 0.02):
        found = impact(share * sunk, 0.0, 9.81, BALL_SURFACE, time)
        assert float(found.change) == pytest.approx(9.81 * time, abs=1e-3)
        assert abs(-float(found.gap) - sunk) <= abs(share - 1.0) * sunk + 1e-9


@given(st.floats(0.0, 0.03), st.floats(-15.0, 15.0), st.floats(0.0, 0.01))
def test_an_impact_never_adds_energy(depth: float, approach: float, time: float) -> None:
    found = impact(depth, approach, 0.0, BALL_SURFACE, time)
    speed, spring = float(found.change) - approach, contact.IMPEDANCE * BALL_SURFACE.stiffness
    before = 0.5 * approach**2 + 0.5 * spring * depth**2
    after = 0.5 * speed**2 + 0.5 * spring * max(-float(found.gap), 0.0) ** 2
    assert after <= before + 1e-9
    assert float(found.change) >= 0.0 and 0.0 <= float(found.lag) <= time


@pytest.mark.parametrize("speed", [0.1, 1.0, 10.0])
def test_what_parts_is_free(speed: float) -> None:
    assert float(impact(0.0, -speed, 0.0, BALL_SURFACE, 0.01).gap) == pytest.approx(speed * 0.01)
    for acceleration in (0.0, 9.81):
        assert float(impact(0.0, -speed, acceleration, BALL_SURFACE, 0.01).change) == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("precise", [True, False], ids=["double", "single"])
def test_gradients_of_an_impact_are_finite_everywhere(precise: bool) -> None:
    with jax.enable_x64(precise):
        grid = jnp.meshgrid(
            jnp.array([0.0, 1e-6, 1e-3, 0.03]),
            jnp.array([-10.0, -1e-6, 0.0, 1e-6, 1.0, 15.0]),
            jnp.array([0.0, 9.81]),
            jnp.array([0.0, 1e-6, 0.01]),
        )

        def flat(depth: Array, approach: Array, acceleration: Array, time: Array) -> Array:
            return jnp.stack(contact.impact(depth, approach, acceleration, BALL_SURFACE, time))

        for derivative in (jax.jacfwd, jax.jacrev):
            found = jax.jit(jax.vmap(derivative(flat, argnums=(0, 1, 2, 3))))(*(axis.reshape(-1) for axis in grid))
            assert all(np.isfinite(part).all() for part in found)


def test_forward_reverse_and_finite_differences_of_an_impact_agree() -> None:
    depth, approach = jnp.array([0.0, 0.004, 0.001, 0.02]), jnp.array([8.0, -1.0, 12.0, 0.3])
    time = jnp.array([0.005, 0.003, 0.01, 0.01])

    def found(depth: Array, approach: Array, acceleration: Array, time: Array) -> contact.Impact:
        return contact.impact(depth, approach, acceleration, BALL_SURFACE, time)

    check_grads(jax.jit(found), (depth + 1e-5, approach, jnp.full(4, 9.81), time), 1, ("fwd", "rev"), 1e-4, 1e-4, 1e-7)

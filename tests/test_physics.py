"""Physics alone: the law of contacts, its derivatives, what it conserves, and MuJoCo's kicks with nothing learned."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from larp_model import launches
from larp_model import state as packed
from larp_model.bodies import ball, two_balls
from larp_model.physics import contact
from larp_model.physics import step as physics
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from larp_model.simulator import step as simulator_step
from larp_model.truth.mujoco import Truth
from tasks.data import random_episodes
from tasks.motions.references import Reference

FRICTION = 0.7
CONTACTS, BATCH = 3, 40
impulses_of = jax.jit(contact.impulses_of, static_argnums=2)


@pytest.fixture
def in_64_bits() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.fixture
def wanted(in_64_bits: None) -> tuple[Array, Array]:
    """Impulses (n, 3, 1) inside, outside and opposite to the friction cone, and unit normals."""
    random = np.random.default_rng(0)
    normal = random.standard_normal((200, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return jnp.asarray(random.standard_normal((200, 3, 1))), jnp.asarray(normal[..., None])


@pytest.fixture
def problem(in_64_bits: None) -> contact.ContactProblem:
    """Contacts of bodies of about 1 kg that meet at about 1 m/s, some of them open."""
    random = np.random.default_rng(0)
    factor = random.standard_normal((BATCH, 3 * CONTACTS, 3 * CONTACTS))
    whole = np.einsum("bij,bkj->bik", factor, factor).reshape(BATCH, CONTACTS, 3, CONTACTS, 3)
    velocity, reference, normal = random.standard_normal((3, CONTACTS, 3, BATCH))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    each = np.ones((CONTACTS, 1, BATCH))
    return contact.ContactProblem(
        *map(
            jnp.asarray,
            (
                velocity, whole.transpose(1, 3, 2, 4, 0), reference, 40.0 * each, normal, FRICTION * each,
                (random.random(each.shape) < 0.7) * each,
            ),
        )
    )  # fmt: skip


def test_impulses_are_the_nearest_in_the_friction_cone(wanted: tuple[Array, Array]) -> None:
    point, _ = contact.projection(*wanted, FRICTION)
    np.testing.assert_allclose(contact.projected(*wanted, FRICTION), point, atol=1e-12)
    normal, impulse = wanted[1][..., 0], point[..., 0]
    along = jnp.sum(impulse * normal, axis=1)
    across = jnp.linalg.norm(impulse - along[:, None] * normal, axis=1)
    assert (across <= FRICTION * along + 1e-6).all()
    again, _ = contact.projection(point, wanted[1], FRICTION)
    np.testing.assert_allclose(again, point, atol=1e-6)
    # What is cut off is at a right angle to what is left, and in the polar cone.
    rest = wanted[0][..., 0] - impulse
    np.testing.assert_allclose(jnp.sum(rest * impulse, axis=1), 0.0, atol=1e-6)
    outwards = jnp.sum(rest * normal, axis=1)
    assert (FRICTION * jnp.linalg.norm(rest - outwards[:, None] * normal, axis=1) <= -outwards + 1e-6).all()
    inside = np.isclose(impulse, wanted[0][..., 0], atol=1e-9).all(axis=1)
    assert inside.any() and not inside.all() and (impulse == 0.0).all(axis=1).any()


def test_slopes_of_impulses_are_their_derivatives_symmetric_and_not_negative(wanted: tuple[Array, Array]) -> None:
    def alone(one: Array, normal: Array) -> Array:
        return contact.projection(one[None, :, None], normal[None, :, None], FRICTION)[0][0, :, 0]

    _, slope = contact.projection(*wanted, FRICTION)
    derivative = jax.vmap(jax.jacfwd(alone))(wanted[0][..., 0], wanted[1][..., 0])
    np.testing.assert_allclose(slope[..., 0], derivative, atol=1e-5)
    np.testing.assert_allclose(slope, jnp.swapaxes(slope, 1, 2), atol=1e-12)
    assert np.linalg.eigvalsh(slope[..., 0]).min() > -1e-9


def test_all_contacts_obey_the_law_together(problem: contact.ContactProblem) -> None:
    impulses = impulses_of(problem, jnp.zeros_like(problem.velocity), 30)
    called = problem.wanted_impulses(problem.after(impulses))
    np.testing.assert_allclose(impulses, called, atol=1e-6)
    assert (jnp.abs(impulses).max(axis=1) > 0.01).any() and (impulses == 0.0).all(axis=1).any()


def test_impulses_have_the_derivatives_of_their_differences(problem: contact.ContactProblem) -> None:
    def impulses(share: Array) -> Array:
        moved = problem._replace(
            velocity=problem.velocity + share * problem.reference,
            admittance=problem.admittance * (1.0 + share),
            mass=problem.mass * (1.0 - share),
        )
        return impulses_of(moved, jnp.zeros_like(problem.velocity), 30)

    zero, little = jnp.zeros(()), 1e-6
    forward = jax.jacfwd(impulses)(zero)
    differences = (impulses(zero + little) - impulses(zero - little)) / (2.0 * little)
    np.testing.assert_allclose(forward, differences, atol=1e-4)
    weigh = jnp.asarray(np.random.default_rng(1).standard_normal(forward.shape))
    reverse = jax.grad(lambda share: jnp.sum(weigh * impulses(share)))(zero)
    np.testing.assert_allclose(reverse, jnp.sum(weigh * forward), rtol=1e-6)


def test_a_ball_bounces_slides_and_rolls_as_mujocos_does() -> None:
    scene = Scene((ball(),))
    states = np.zeros((4, 1, packed.SIZE))
    states[:, 0, :3], states[:, 0, 3] = (0.0, 0.0, 0.11), 1.0
    states[1:, 0, 2] = 1.0, 0.11, 0.3
    states[1:, 0, packed.VELOCITY] = (0.0, 0.0, -3.0), (4.0, 1.0, 0.0), (2.0, -5.0, -2.0)
    states[2:, 0, packed.ANGULAR_VELOCITY] = (0.0, -10.0, 0.0), (20.0, 5.0, 15.0)
    controls = np.zeros((4, 100, 0, 3))
    true, _ = Truth(scene, 4).rollout(states, controls)
    found = np.asarray(Simulator.of_physics(scene).rollout(jnp.asarray(states, jnp.float32), controls))
    np.testing.assert_allclose(found[..., packed.POSITION], true[..., packed.POSITION], atol=0.01)
    spin, known = (each[..., packed.ANGULAR_VELOCITY] for each in (found, true))
    np.testing.assert_allclose(spin, known, atol=0.3)


@pytest.fixture(scope="module")
def meeting_balls() -> np.ndarray:
    """States (6, 2, 13) of two balls far above the ground that soon touch; those of the last row do not."""
    random = np.random.default_rng(2)
    states = np.zeros((6, 2, packed.SIZE))
    states[..., 3] = 1.0
    states[:, 0, packed.POSITION] = (0.0, 0.0, 5.0)
    away = random.standard_normal((6, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    states[:, 1, packed.POSITION] = states[:, 0, packed.POSITION] + 0.24 * away
    states[:, 1, packed.VELOCITY] = -5.0 * away + random.standard_normal((6, 3))
    states[..., packed.ANGULAR_VELOCITY] = 10.0 * random.standard_normal((6, 2, 3))
    states[-1, 1, packed.POSITION] += 2.0
    return states


def test_balls_that_meet_keep_their_momentum(meeting_balls: np.ndarray) -> None:
    scene, steps = two_balls(), 4
    found = np.asarray(Simulator.of_physics(scene).rollout(meeting_balls, np.zeros((6, steps, 0, 3))))
    mass, radius = scene.morphology[0, 2], scene.morphology[0, 1]
    fallen = np.array([0.0, 0.0, -scene.gravity * scene.dt * steps])

    def momenta(states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        place, speed, spin = (states[..., each] for each in (packed.POSITION, packed.VELOCITY, packed.ANGULAR_VELOCITY))
        own = 0.4 * radius**2 * spin + np.cross(place - place.mean(axis=1, keepdims=True), speed)
        return mass * speed.sum(axis=1), mass * own.sum(axis=1)

    (linear, angular), (later, turned) = momenta(meeting_balls), momenta(found[:, -1])
    np.testing.assert_allclose(later - 2.0 * mass * fallen, linear, atol=1e-4)
    np.testing.assert_allclose(turned, angular, atol=0.02 * np.abs(angular).max())
    change = found[:, -1, :, packed.VELOCITY] - meeting_balls[..., packed.VELOCITY] - fallen
    struck = np.linalg.norm(change, axis=-1).max(axis=-1) > 1.0
    assert struck[:-1].all() and not struck[-1], "m/s"


def test_a_scene_moves_alike_alone_and_beside_others(
    meeting_balls: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulator, controls = Simulator.of_physics(two_balls()), np.zeros((6, 4, 0, 3))
    together = np.asarray(simulator.rollout(meeting_balls, controls))
    # Scenes are worked on in chunks, those that touch first.
    monkeypatch.setattr(physics, "CHUNK", 4)
    shuffled, states = [5, 0, 3, 1, 4, 2], jnp.asarray(meeting_balls, jnp.float32)
    chunked = jax.jit(
        lambda state: simulator_step(simulator.model, simulator.weights, state, jnp.asarray(controls[:, 0]))
    )
    found = chunked(chunked(chunked(chunked(states[np.array(shuffled)]))))
    np.testing.assert_allclose(found, together[shuffled, -1], atol=1e-4)
    for row in (0, 5):
        alone = np.asarray(simulator.rollout(meeting_balls[[row] * 6], controls))[0]
        np.testing.assert_allclose(together[row], alone, atol=1e-5)


def test_balls_that_meet_have_the_gradient_of_their_differences(meeting_balls: np.ndarray, in_64_bits: None) -> None:
    simulator, start = Simulator.of_physics(two_balls()), jnp.asarray(meeting_balls[:5], jnp.float64)
    random = np.random.default_rng(3)
    weigh, along = random.standard_normal(start.shape), random.standard_normal(start.shape)

    @jax.jit
    def value(state: Array) -> Array:
        return jnp.sum(weigh * simulator.rollout(state, jnp.zeros((5, 3, 0, 3)))[:, -1], axis=(1, 2))

    reverse = jnp.sum(along * jax.jit(jax.grad(lambda state: value(state).sum()))(start), axis=(1, 2))
    little = 1e-6
    differences = (value(start + little * along) - value(start - little * along)) / (2.0 * little)
    np.testing.assert_allclose(reverse, differences, rtol=1e-3, atol=1e-3)


def test_kicks_are_mujocos_though_nothing_is_learned(scene: Scene, reference: Reference) -> None:
    episodes, _ = random_episodes(scene, reference, count=128, seed=5, steps=48)
    found = launches.launches_of(Simulator.of_physics(scene), episodes, 0)
    assert len(found.error) > 30
    assert np.median(found.error) < 0.03 and np.quantile(found.error, 0.9) < 0.12

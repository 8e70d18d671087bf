"""Physics alone: the law of contacts, its derivatives, what it conserves, and MuJoCo's kicks with nothing learned."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax import Array

from larp_model import launches
from larp_model import state as packed
from larp_model.bodies import BALL_SURFACE, ball, capsule, chain, human, two_balls
from larp_model.engines.mujoco import FINE_SUBSTEPS, Truth, closed, compile_model
from larp_model.learned.residual import ResidualModel
from larp_model.networks import Weights
from larp_model.physics import contact
from larp_model.physics import step as physics
from larp_model.physics.articulated import Momenta
from larp_model.physics.collision import ContactSettings
from larp_model.physics.kinematics import kinematics
from larp_model.physics.motion import articulated_motion
from larp_model.physics.response import Gains, responses
from larp_model.scene import Body, Pair, Scene
from larp_model.simulator import Simulator
from larp_model.simulator import step as simulator_step
from tasks.episodes.around_kick import random_episodes
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
    called = problem.impulses_at(problem.after(impulses))
    np.testing.assert_allclose(impulses, called, atol=1e-6)
    assert (jnp.abs(impulses).max(axis=1) > 0.01).any() and (impulses == 0.0).all(axis=1).any()


def test_impulses_have_the_derivatives_of_their_differences(problem: contact.ContactProblem) -> None:
    def impulses(share: Array) -> Array:
        moved = problem._replace(
            velocity=problem.velocity + share * problem.reference,
            admittance=problem.admittance * (1.0 + share),
            mass=problem.mass * (1.0 - share),
        )
        return jnp.asarray(impulses_of(moved, jnp.zeros_like(problem.velocity), 30))

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


@pytest.mark.parametrize("body", [capsule(), chain(links=4), human()], ids=["capsule", "chain", "human"])
@pytest.mark.slow
def test_impulses_are_answered_at_once_as_the_engines_inertia_says(body: Body, in_64_bits: None) -> None:
    scene, links, count = Scene((body,)), len(body.links), 6
    random = np.random.default_rng(5)
    states, push = np.zeros((count, links, packed.SIZE)), random.standard_normal((count, links, 6))
    turned = random.standard_normal((count, 1, 4)) + 0.2 * random.standard_normal((count, links, 4))
    states[..., packed.ORIENTATION] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
    states[..., 2] = 10.0
    states = closed(scene, states)
    model, truth = compile_model(scene), Truth(scene, count)
    truth.reset(states)

    @jax.jit
    def gained(states: Array, push: Array) -> Gains:
        state, pushes = (jnp.moveaxis(each, 0, -1) for each in (states, push))
        sizes = jnp.broadcast_to(jnp.asarray(scene.morphology)[..., None], (links, 3, count))
        targets, still = jnp.zeros((len(body.motors), 3, count)), jnp.zeros((links, 3, count))
        _, articulation = articulated_motion(body, kinematics(scene, state, sizes), targets, still, 0.0, 1e-9)
        momenta = Momenta(*(each[:, :, None] for each in (pushes[:, 3:], pushes[:, :3])))
        kept, fading = responses(body, articulation, momenta, sizes, 0.003)
        return Gains(*(jnp.moveaxis(a + b, -1, 0)[..., 0] for a, b in zip(kept, fading, strict=True)))

    found = gained(jnp.asarray(states), jnp.asarray(push))
    data, inertia = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    for index in range(count):
        data.qpos[:] = truth.coordinates()[0][index]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        jacobians = np.zeros((links, 6, model.nv))
        for link, jacobian in zip(body.links, jacobians, strict=True):
            row = model.body(f"{body.name}/{link.name}").id
            mujoco.mj_jacBody(model, data, jacobian[:3], jacobian[3:], row)
        expected = jacobians @ np.linalg.solve(inertia, np.einsum("lkv,lk->v", jacobians, push[index]))
        scale = np.abs(expected).max()
        np.testing.assert_allclose(found.velocity[index], expected[:, :3], atol=1e-5 * scale)
        np.testing.assert_allclose(found.angular_velocity[index], expected[:, 3:], atol=1e-5 * scale)


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


@pytest.mark.slow
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_chain_that_strikes_a_ball_on_the_ground_has_the_gradient_of_its_differences(in_64_bits: None) -> None:
    pair = Pair("chain", "ball", ("link1",), ("ball",), BALL_SURFACE)
    scene, random = Scene((chain(links=2), ball()), (pair,)), np.random.default_rng(3)
    model = ResidualModel(scene, contacts=ContactSettings(iterations=40))
    states = np.zeros((3, 3, packed.SIZE))
    states[..., packed.ORIENTATION] = 1.0, 0.0, 0.0, 0.0
    states[:, 1, 2], states[:, 0, 2] = 0.25, 0.25 + scene.links[0].length + 2.0 * scene.links[0].radius
    states = closed(scene, states)
    states[:, 2, packed.POSITION] = (0.0, 0.18, 0.1101)  # where it touches neither the ground nor the chain yet
    states[:, :2, packed.VELOCITY] = (0.0, 6.0, 0.0)
    states[:, :2] += 0.05 * random.standard_normal((3, 1, packed.SIZE)) * (np.arange(packed.SIZE) > 6)
    weigh, along = random.standard_normal((2, *states.shape))

    def value(state: Array) -> tuple[Array, Array]:
        after = simulator_step(model, Weights({}, {}, {}), state, jnp.zeros((3, 0, 3)))
        return jnp.sum(weigh * after), jnp.stack([jnp.sum(weigh * after, axis=(1, 2)), after[:, 2, 8]])

    soon = {"xla_backend_optimization_level": 0}
    slope, (_, speed) = jax.jit(jax.grad(value, has_aux=True), compiler_options=soon)(states)
    assert (speed > 1.0).all(), "the ball is on its way"
    valued, little = jax.jit(lambda state: value(state)[1][0], compiler_options=soon), 1e-6
    differences = (valued(states + little * along) - valued(states - little * along)) / (2.0 * little)
    np.testing.assert_allclose(jnp.sum(along * slope, axis=(1, 2)), differences, rtol=1e-3, atol=1e-3)


@pytest.mark.slow
def test_kicks_are_those_of_mujocos_small_steps_though_nothing_is_learned(scene: Scene, reference: Reference) -> None:
    episodes, _ = random_episodes(scene, reference, count=128, seed=5, steps=48)
    start = episodes.states[:, :1]
    truth = Truth(scene, len(start), FINE_SUBSTEPS)
    after, _ = truth.rollout(start[:, 0], episodes.controls, episodes.torques)
    fine = episodes._replace(states=np.concatenate([start, after], axis=1))
    found = launches.launches_of(Simulator.of_physics(scene), fine, 0)
    assert len(found.error) > 30
    assert np.median(found.error) < 0.014 and np.quantile(found.error, 0.9) < 0.06

"""Motion of a body alone: conservation, order, agreement with the engine, the ground, symmetry, gradients."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from scipy.spatial.transform import Rotation

from larp_model import rotation
from larp_model import state as packed
from larp_model.bodies import capsule, chain, human, human_and_ball
from larp_model.engines.mujoco import Truth, closed, compile_model
from larp_model.physics import kinematics
from larp_model.physics.motion import GAMMA, BodyMotion, Constants, articulated_motion, moments
from larp_model.scene import Body, Scene
from tasks.episodes.chains import thrown_episodes, thrown_starts
from tasks.motions.references import standing_on_ground
from tasks.scenarios import scenario

BODIES = (capsule(), chain(links=2), chain(links=4), human())
FULL = human(detail="full")
COUNT, HIGH = 16, 10.0


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.fixture(params=BODIES, ids=[body.kind for body in BODIES])
def body(request: pytest.FixtureRequest) -> Body:
    found: Body = request.param
    return found


@cache
def starts(body: Body) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """States (16, n, 13) high above the ground, joints closed, with controls and torques from outside."""
    random = np.random.default_rng(0)
    links = len(body.links)
    states = np.zeros((COUNT, links, packed.SIZE))
    turned = random.standard_normal((COUNT, 1, 4)) + 0.2 * random.standard_normal((COUNT, links, 4))
    states[..., packed.ORIENTATION] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
    states[..., packed.VELOCITY] = random.standard_normal((COUNT, 1, 3))
    states[..., packed.ANGULAR_VELOCITY] = 2.0 * random.standard_normal((COUNT, links, 3))
    states[..., 2] = HIGH
    controls = 0.3 * random.standard_normal((COUNT, len(body.motors), 3))
    return closed(Scene((body,)), states), controls, 0.5 * random.standard_normal((COUNT, links, 3))


def free_motion(
    body: Body, state: Array, control: Array, torque: Array, morphology: Array, gravity: float, dt: float
) -> BodyMotion:
    """`articulated_motion` with the batch first: states (N, n, 13), morphologies (N or 1, n, 3)."""
    before, targets, outside, sizes = (jnp.moveaxis(each, 0, -1) for each in (state, control, torque, morphology))
    seen = kinematics.kinematics(Scene((body,)), before, sizes)
    motion, _ = articulated_motion(body, seen, targets, outside, gravity, dt)
    return BodyMotion(*(jnp.moveaxis(each, -1, 0) for each in motion))


def motion_of(
    body: Body, state: Array, control: Array, torque: Array, gravity: float = 9.81, dt: float = 0.01
) -> BodyMotion:
    """`free_motion` of the body as it is."""
    sizes = kinematics.morphology_of(Scene((body,)))[None]
    return free_motion(body, state, control, torque, sizes, gravity, dt)


@cache
def compiled(body: Body) -> Any:
    """`motion_of` the body, compiled once for every gravity and step."""
    options = {"xla_backend_optimization_level": 0}
    found = jax.jit(partial(motion_of, body), compiler_options=options)
    return lambda *given, gravity=9.81, dt=0.01: found(*given, gravity, dt)


def advanced(states: Array, motion: BodyMotion) -> Array:
    """States (N, n, 13) after a motion."""
    turned = rotation.integrate(packed.orientation(states), motion.rotation_vector)
    return packed.pack(packed.position(states) + motion.translation, turned, motion.velocity, motion.angular_velocity)


def moved(states: np.ndarray, motion: BodyMotion) -> np.ndarray:
    """The same, out of JAX."""
    return np.asarray(advanced(jnp.asarray(states), motion))


def momenta(body: Body, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Momentum [kg m/s] and angular momentum [kg m^2/s] about the origin, (N, 3) each."""
    shape = np.asarray(kinematics.morphology_of(Scene((body,))), float)
    along, across = (np.asarray(each)[:, None] for each in moments(*shape.T))
    matrices = np.asarray(rotation.matrix(jnp.asarray(states[..., packed.ORIENTATION])))
    axis = np.einsum("nlij,lj->nli", matrices, np.array([link.axis for link in body.links]))
    spin = states[..., packed.ANGULAR_VELOCITY]
    own = across * spin + (along - across) * np.sum(axis * spin, axis=-1, keepdims=True) * axis
    momentum = shape[:, 2:] * states[..., packed.VELOCITY]
    return momentum.sum(axis=1), (own + np.cross(states[..., :3], momentum)).sum(axis=1)


def energy(body: Body, states: np.ndarray) -> np.ndarray:
    """Energy (N,) [J] of motion and height."""
    length, radius, mass = np.asarray(kinematics.morphology_of(Scene((body,))), float).T
    along, across = (np.asarray(each) for each in moments(length, radius, mass))
    matrices = np.asarray(rotation.matrix(jnp.asarray(states[..., packed.ORIENTATION])))
    axis, spin = matrices @ np.array(body.links[0].axis), states[..., packed.ANGULAR_VELOCITY]
    turning = across * np.sum(spin**2, axis=-1) + (along - across) * np.sum(axis * spin, axis=-1) ** 2
    moving = mass * (np.sum(states[..., packed.VELOCITY] ** 2, axis=-1) + 2.0 * 9.81 * states[..., 2])
    found: np.ndarray = 0.5 * np.sum(moving + turning, axis=-1)
    return found


def test_the_centre_of_mass_falls_freely(body: Body) -> None:
    states, controls, torques = starts(body)
    after = moved(states, compiled(body)(states, controls, torques))
    mass = np.array([link.mass for link in body.links])
    before, later = (np.average(each, axis=1, weights=mass) for each in (states, after))
    np.testing.assert_allclose(later[:, 7:10], before[:, 7:10] - [0.0, 0.0, 0.0981], atol=2e-6)
    np.testing.assert_allclose(
        later[:, :3], before[:, :3] + 0.01 * before[:, 7:10] - [0.0, 0.0, 0.5 * 9.81 * 1e-4], atol=1e-7
    )


def test_momentum_is_kept_where_nothing_pulls(body: Body) -> None:
    states, controls, torques = starts(body)
    before = momenta(body, states)
    for steps in (1, 10):  # joints that come together, and turns by a tenth of a radian, leave the third order
        dt, after = 0.01 / steps, states
        for _ in range(steps):
            after = moved(after, compiled(body)(after, controls, 0.0 * torques, gravity=0.0, dt=dt))
        found = momenta(body, after)
        np.testing.assert_allclose(found[0], before[0], atol=1e-4 / steps)
        scale = np.linalg.norm(before[1] - np.cross(states[:, 0, :3], before[0]), axis=-1).mean()
        assert np.abs(found[1] - before[1]).max() < 0.02 * scale / steps


def test_halving_the_step_leaves_less_than_a_third_of_the_error() -> None:
    body = chain(links=4)
    states, controls, torques = starts(body)
    truth = Truth(Scene((body,)), COUNT, 640)
    truth.reset(states)
    true = truth.step(controls, torques)

    def error(steps: int) -> float:
        after = states
        for _ in range(steps):
            after = moved(after, compiled(body)(after, controls, torques, dt=0.01 / steps))
        return float(np.abs(after - true)[..., 7:].mean())

    assert error(2) < error(1) / 3 and error(4) < error(2) / 3


@pytest.mark.parametrize(("body", "share"), [(BODIES[0], 0.05), (BODIES[2], 0.05), (BODIES[3], 0.2), (FULL, 0.2)])
def test_a_step_is_the_engines_but_for_a_share_of_its_change(body: Body, share: float) -> None:
    states, controls, torques = starts(body)
    truth = Truth(Scene((body,)), COUNT, 80)
    truth.reset(states)
    true = truth.step(controls, torques)
    motion = compiled(body)(states, controls, torques)
    for found, columns in ((motion.velocity, packed.VELOCITY), (motion.angular_velocity, packed.ANGULAR_VELOCITY)):
        error = np.linalg.norm(found - true[..., columns], axis=-1)
        change = np.linalg.norm(true[..., columns] - states[..., columns], axis=-1)
        assert np.median(error) < share * np.median(change)


def test_turning_the_world_turns_the_motion(body: Body) -> None:
    states, controls, torques = starts(body)
    angle = jnp.linspace(-3.0, 3.0, COUNT)
    turn = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    first = compiled(body)(states, controls, torques)
    turned = (
        rotation.turn_states(jnp.asarray(states), turn),
        controls,
        rotation.about_z(jnp.asarray(torques), turn[:, None]),
    )
    for one, other in zip(first, compiled(body)(*turned), strict=True):
        np.testing.assert_allclose(rotation.about_z(one, turn[:, None]), other, atol=1e-9)


@pytest.mark.parametrize("body", BODIES[1:], ids=[body.kind for body in BODIES[1:]])
def test_a_joint_that_came_apart_closes_by_its_share(body: Body) -> None:
    states, controls, torques = starts(body)
    scene = Scene((body,))
    open_ = states.copy()
    open_[:, 1:, 0] += 1e-3 * np.arange(1, len(body.links))

    def gaps(found: np.ndarray) -> np.ndarray:
        apart = kinematics.displacement(scene, jnp.asarray(found), kinematics.morphology_of(scene))
        return np.asarray(np.linalg.norm(apart, axis=-1))

    after = moved(open_, compiled(body)(open_, controls, torques))
    before = gaps(open_)
    assert before.min() > 5e-4
    np.testing.assert_allclose(gaps(after).sum() / before.sum(), 1.0 - Constants().closing, atol=0.02)


def test_a_chain_comes_to_rest_on_the_ground_and_is_given_no_energy() -> None:
    body = chain(links=4)
    states = thrown_starts(np.random.default_rng(0), Scene((body,)), np.tile(Scene((body,)).morphology, (COUNT, 1, 1)))
    none = np.zeros((COUNT, 0, 3)), np.zeros((COUNT, len(body.links), 3))
    most = energy(body, states)
    for _ in range(300):
        states = moved(states, compiled(body)(states, *none))
        assert (energy(body, states) < most + 0.01 * np.abs(most)).all()
    assert np.abs(states[..., 7:]).max() < 1e-6
    np.testing.assert_allclose(states[..., 2], body.links[0].radius, atol=2e-4)


def test_a_standing_human_presses_on_the_ground_as_in_the_truth() -> None:
    scene = human_and_ball().only("human")
    body, stand = scene.human, np.zeros((1, len(scene.motors), 3))
    states = standing_on_ground(scene, stand, Rotation.identity(1))
    true, _ = Truth(scene).rollout(states, np.zeros((1, 20, len(scene.motors), 3)))
    for _ in range(20):
        states = moved(states, compiled(body)(states, stand, np.zeros((1, len(body.links), 3))))
    assert np.abs(states[..., :3] - true[:, -1, :, :3]).max() < 0.01
    assert np.abs(states[..., 7:10] - true[:, -1, :, 7:10]).max() < 0.1


def test_stiff_servos_do_not_throw_a_body_in_long_steps() -> None:
    body = human()
    states, _, torques = starts(body)
    controls = np.zeros((COUNT, len(body.motors), 3))
    for _ in range(40):
        states = moved(states, compiled(body)(states, controls, 0.0 * torques, dt=0.05))
    assert np.isfinite(states).all() and np.abs(states[..., packed.ANGULAR_VELOCITY]).max() < 30.0


@pytest.mark.slow
def test_forward_reverse_and_finite_difference_gradients_agree() -> None:
    body = chain(links=2)
    states, controls, torques = (each[:1] for each in starts(body))
    given = np.concatenate([states.ravel(), torques.ravel()])

    def after(given: Array) -> Array:
        state, torque = given[: states.size].reshape(states.shape), given[states.size :].reshape(torques.shape)
        return jnp.concatenate(motion_of(body, state, jnp.asarray(controls), torque), axis=-1).ravel()

    options = {"xla_backend_optimization_level": 0}
    forward, reverse = (jax.jit(way(after), compiler_options=options)(given) for way in (jax.jacfwd, jax.jacrev))
    np.testing.assert_allclose(forward, reverse, atol=1e-9)
    step = 1e-6 * np.eye(len(given))
    several = jax.jit(jax.vmap(after), compiler_options=options)
    np.testing.assert_allclose((several(given + step) - several(given - step)).T / 2e-6, forward, atol=1e-5)


def test_light_links_that_bear_on_the_ground_are_moved_alike_in_32_and_64_bits() -> None:
    body = chain(links=4)
    scene, random = Scene((body,)), np.random.default_rng(0)
    states = thrown_starts(random, scene, np.tile(scene.morphology, (COUNT, 1, 1)))
    none = np.zeros((COUNT, 0, 3)), np.zeros((COUNT, 4, 3))
    for _ in range(60):
        fine = compiled(body)(states, *none)
        with jax.enable_x64(False):
            coarse = compiled(body)(*(each.astype(np.float32) for each in (states, *none)))
        assert np.abs(coarse.velocity - fine.velocity).max() < 5e-3
        states = moved(states, fine)


def test_an_end_that_just_touches_the_ground_throws_no_body_however_that_is_rounded() -> None:
    body, rows, h = chain(links=4), 64, GAMMA * 0.01
    scene = Scene((body,))
    episodes, _ = thrown_episodes(scene, rows, seed=7, steps=80)
    states = episodes.states[:, -1]
    up, reach = np.array([0.0, 0.0, 1.0]), 0.5 * body.links[0].length
    axes = Rotation.from_quat(states[..., packed.ORIENTATION].reshape(-1, 4), scalar_first=True).apply(up)
    arms = reach * axes.reshape(rows, 4, 3) * np.array([1.0, -1.0])[:, None, None, None] - body.links[0].radius * up
    speed = states[..., packed.VELOCITY] + np.cross(states[..., packed.ANGULAR_VELOCITY], arms)
    deep = (states[..., :3] + arms)[..., 2] + h * (speed[..., 2] - h * scene.gravity)
    nearest = np.min(np.where(deep > -0.01, deep, np.inf), axis=(0, 2))  # of the ends that are not yet far in it
    states[..., 2] -= nearest[:, None]
    shifted = np.repeat(states, 16, axis=0)
    shifted[..., 2] += np.tile(np.linspace(-4e-8, 4e-8, 16), rows)[:, None]
    with jax.enable_x64(False):
        given = shifted, np.zeros((len(shifted), 0, 3)), np.zeros((len(shifted), 4, 3))
        after = jax.jit(partial(motion_of, body))(*(jnp.asarray(each, jnp.float32) for each in given))
    assert (np.linalg.norm(after.velocity - shifted[..., packed.VELOCITY], axis=-1) < 5.0).all()


def test_motors_of_other_sizes_pull_as_those_of_a_body_of_that_size() -> None:
    sizes = human(height=1.6, mass=50.0, lengths={"thigh": 1.1}).sizes
    body, other = human(), human().sized(sizes)
    assert other.motors[0][2].stiffness < 0.8 * body.motors[0][2].stiffness
    bent = standing_on_ground(Scene((other,)), 0.2 * np.ones((1, 12, 3)), Rotation.identity(1))
    states = jnp.asarray(bent)
    given = jnp.zeros((1, 12, 3)), jnp.zeros((1, 13, 3)), jnp.asarray(sizes)[None], 9.81, 0.01
    one, two = free_motion(body, states, *given), free_motion(other, states, *given)
    for a, b in zip(one, two, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("speed", [1.0, 3.0])
def test_a_capsule_that_slides_sideways_is_braked_until_it_rolls_as_in_the_truth(speed: float) -> None:
    body = capsule()
    states = np.zeros((1, 1, packed.SIZE))
    states[..., packed.ORIENTATION] = Rotation.from_euler("y", 90.0, degrees=True).as_quat(scalar_first=True)
    states[..., 2], states[..., 8] = body.links[0].radius, speed
    none = np.zeros((1, 0, 3)), np.zeros((1, 1, 3))
    true, _ = Truth(Scene((body,))).rollout(states, np.zeros((1, 40, 0, 3)))
    for _ in range(40):
        states = moved(states, compiled(body)(states, *none))
    np.testing.assert_allclose(states[..., 1], true[:, -1, :, 1], rtol=0.01)
    np.testing.assert_allclose(states[..., [8, 10]], true[:, -1, :, [8, 10]].T, rtol=0.005)


def test_a_body_moves_on_the_ground_the_same_whatever_others_need_beside_it() -> None:
    body = capsule()
    states = np.zeros((2, 1, packed.SIZE))
    states[..., packed.ORIENTATION] = Rotation.from_euler("y", 90.0, degrees=True).as_quat(scalar_first=True)
    states[..., 2] = body.links[0].radius - 1e-4
    states[1, 0, 8] = 3.0  # slides, and takes more of Newton's steps than one that lies
    none = np.zeros((2, 0, 3)), np.zeros((2, 1, 3))
    together = moved(states, compiled(body)(states, *none))
    alone = moved(states[:1], compiled(body)(states[:1], *(each[:1] for each in none)))
    np.testing.assert_allclose(together[:1], alone, rtol=0.0, atol=1e-12)


@pytest.mark.slow
def test_who_moves_on_the_ground_stays_within_five_millimetres_of_the_truth_for_a_fifth_of_a_second() -> None:
    chosen = scenario("any_human_alone")
    scene, (episodes, _) = chosen.scene, chosen.draw(48, 0)
    body, sizes = scene.human, jnp.asarray(episodes.morphology)

    def advance(state: Array, control: Array) -> tuple[Array, Array]:
        none = jnp.zeros((*state.shape[:2], 3), state.dtype)
        state = advanced(state, free_motion(body, state, control, none, sizes, scene.gravity, scene.dt))
        return state, packed.position(state)

    with jax.enable_x64(False):
        first, controls = jnp.asarray(episodes.states[:, 0]), jnp.moveaxis(jnp.asarray(episodes.controls[:, :20]), 1, 0)
        _, places = jax.jit(lambda *given: jax.lax.scan(advance, *given))(first, controls)
    apart = np.linalg.norm(np.moveaxis(places, 0, 1) - episodes.states[:, 1:21, :, :3], axis=-1)
    assert np.median(apart.mean(axis=2)[:, -1]) < 0.005


def test_capsules_have_the_engines_moments_of_inertia() -> None:
    scene = human_and_ball()
    model = compile_model(scene)
    for link in scene.links:
        body = next(f"{owner.name}/{link.name}" for owner in scene.bodies if link in owner.links)
        along, across = moments(*jnp.array([link.length, link.radius, link.mass]))
        np.testing.assert_allclose(sorted(model.body(body).inertia), sorted([along, across, across]), rtol=1e-3)

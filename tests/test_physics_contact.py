"""All contacts in one solve: MuJoCo's law, its regularisation, and its kicks, of which nothing is learned."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from jax import Array

from larp_model import state as packed
from larp_model.bodies import two_balls
from larp_model.errors import InputError
from larp_model.kinematics import morphology_of
from larp_model.launches import SLOWEST, STEPS
from larp_model.meeting import first_contacts
from larp_model.physics import contact
from larp_model.scene import Scene
from larp_model.truth.mujoco import SUBSTEPS, compile_model
from tasks.data import random_episodes
from tasks.motions.references import Reference

FRICTION = 0.7
inverse_weights = jax.jit(contact.inverse_weights, static_argnums=0)


@pytest.fixture(autouse=True)
def in_64_bits() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.fixture
def wanted() -> tuple[Array, Array]:
    """Impulses (n, 3, 1) inside, outside and opposite to the friction cone, and unit normals."""
    random = np.random.default_rng(0)
    normal = random.standard_normal((200, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return jnp.asarray(random.standard_normal((200, 3, 1))), jnp.asarray(normal[..., None])


def test_impulses_are_the_nearest_in_the_friction_cone(wanted: tuple[Array, Array]) -> None:
    point, _ = contact.projection(*wanted, FRICTION)
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


def test_inverse_weights_are_the_engines(scene: Scene) -> None:
    model = compile_model(scene)
    found = np.asarray(inverse_weights(scene, morphology_of(scene)[None].astype(float)))[:, 0]
    names = [f"{body.name}/{link.name}" for body in scene.bodies for link in body.links]
    engine = [model.body_invweight0[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name), 0] for name in names]
    np.testing.assert_allclose(found, engine, rtol=1e-5)


def test_a_scene_of_other_bodies_is_refused_by_name() -> None:
    with pytest.raises(InputError, match="scene has ball, ball, but needs an articulated body, a ball"):
        contact.require_supported(two_balls())


def test_kicks_are_mujocos_at_its_own_step_though_nothing_is_learned(scene: Scene, reference: Reference) -> None:
    episodes, _ = random_episodes(scene, reference, count=128, seed=5, steps=48)
    contacts = first_contacts(scene, episodes)
    rows = np.flatnonzero((contacts >= 0) & (contacts + STEPS <= 48))
    columns = contacts[rows][:, None] + np.arange(STEPS + 1)
    true, controls = episodes.states[rows[:, None], columns], episodes.controls[rows[:, None], columns[:, :-1]]
    sizes = morphology_of(scene)[None].astype(float)
    weights, torque = inverse_weights(scene, sizes), jnp.zeros((len(rows), len(scene.links), 3))

    @jax.jit
    def advance(state: Array, control: Array) -> Array:
        def engine_step(state: Array, nothing: None) -> tuple[Array, None]:
            return contact.step(scene, state, control, torque, sizes, weights, scene.dt / SUBSTEPS), None

        return jax.lax.scan(engine_step, state, length=SUBSTEPS)[0]

    states = [jnp.asarray(true[:, 0], float)]
    for number in range(STEPS):
        states.append(advance(states[-1], jnp.asarray(controls[:, number], float)))
    predicted = np.stack(states, axis=1)
    after_one = np.abs(predicted[:, 1] - true[:, 1])[..., packed.VELOCITY].max(axis=(1, 2))
    assert np.median(after_one) < 1e-3, "m/s, of links and ball, after one step with the impact"
    ball, ball_true = predicted[:, -1, -1, packed.VELOCITY], true[:, -1, -1, packed.VELOCITY]
    speed = np.linalg.norm(ball_true, axis=-1)
    error = (np.linalg.norm(ball - ball_true, axis=-1) / speed)[speed > SLOWEST]
    assert len(error) > 30
    assert np.median(error) < 0.001 and np.quantile(error, 0.9) < 0.06

"""How links give way: against the engine's own inertia, and the laws that any compliance obeys."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from larp_model import rotation
from larp_model import state as packed
from larp_model.bodies import chain, human_and_ball
from larp_model.compliance import compliance, invert, moments
from larp_model.kinematics import morphology_of
from larp_model.mechanics import fading
from larp_model.meeting import rows_of
from larp_model.scene import Body, Scene
from larp_model.truth.mujoco import Truth, compile_model
from tasks.motions.references import Reference


def loose_chain(links: int) -> Scene:
    """A chain whose joints nothing stiffens."""
    body = chain(links=links)
    joints = tuple(dataclasses.replace(joint, damping=0.0) for joint in body.joints)
    return Scene((Body(body.name, body.kind, body.links, joints),), (), 0.01)


def bent(scene: Scene, seed: int) -> np.ndarray:
    """A state (1, L, 13) with every joint turned somehow."""
    truth, random = Truth(scene), np.random.default_rng(seed)
    state = np.zeros((1, len(scene.links), packed.SIZE))
    state[..., packed.ORIENTATION] = Rotation.random(len(scene.links), random).as_quat(scalar_first=True)
    state[..., 2] = 5.0
    truth.reset(state)
    return truth.state()


def test_the_end_of_a_chain_gives_way_as_the_engines_inertia_says() -> None:
    scene, random = loose_chain(4), np.random.default_rng(1)
    model, truth = compile_model(scene), Truth(scene)
    data, inertia, jacobian = mujoco.MjData(model), np.zeros((model.nv, model.nv)), np.zeros((3, model.nv))
    last = model.body(f"{scene.bodies[0].name}/{scene.links[-1].name}").id
    for seed in range(5):
        state, point = bent(scene, seed), random.uniform(-0.2, 0.2, 3)
        truth.reset(state)
        data.qpos[:] = truth._batch.bind("qpos")[0]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, inertia)
        mujoco.mj_jac(model, data, jacobian, None, state[0, -1, :3] + point, last)
        matrices = rotation.matrix(packed.orientation(jnp.asarray(state)))
        shape = morphology_of(scene)[None]
        found = compliance(scene.bodies[0], np.array([3]), matrices, jnp.asarray(point)[None, None], shape)[0, 0]
        np.testing.assert_allclose(found, jacobian @ np.linalg.solve(inertia, jacobian.T), rtol=2e-3, atol=1e-3)


def test_compliance_is_symmetric_positive_and_less_than_a_free_links(scene: Scene, reference: Reference) -> None:
    state = jnp.asarray(reference.states[:40:4])
    human = scene.bodies[0]
    rows, _ = rows_of(scene.pairs[0], human, scene.bodies[1])
    matrices, shape = rotation.matrix(packed.orientation(state)), morphology_of(scene)[None]
    points = jnp.asarray(np.random.default_rng(0).uniform(-0.1, 0.1, (10, len(rows), 3)), jnp.float32)
    found = np.asarray(compliance(human, rows, matrices, points, shape))
    np.testing.assert_allclose(found, found.swapaxes(-1, -2), atol=1e-3)
    values = np.linalg.eigvalsh(found)
    assert (values > 0.0).all()
    for index, row in enumerate(rows):
        along, _ = moments(*shape[0, row])
        arm = np.sum(np.asarray(points[:, index]) ** 2, axis=-1)
        assert (values[:, index, -1] < 1.0 / scene.links[row].mass + arm / float(along)).all()


LEGS, FADES = np.array([5, 6, 7, 10, 11, 12]), (0.002, 0.01)


def given_by_the_engine(state: np.ndarray, after: int, row: int, substep: float) -> np.ndarray:
    """(3, 3) velocity that a link's centre has gained so many engine steps after a unit impulse there, each way."""
    scene = human_and_ball()
    model, truth = compile_model(scene, round(scene.dt / substep)), Truth(scene)
    model.opt.gravity[:] = 0.0
    truth.reset(state)
    position, _ = truth.coordinates()
    body = model.body(f"human/{scene.links[row].name}").id
    columns = []
    for impulse in np.concatenate([np.zeros((1, 3)), 0.01 * np.eye(3)]):
        data, jacobian, gained = mujoco.MjData(model), np.zeros((3, model.nv)), np.zeros((1, model.nv))
        data.qpos[:] = position[0]
        mujoco.mj_forward(model, data)
        mujoco.mj_jacBody(model, data, jacobian, None, body)
        mujoco.mj_solveM(model, data, gained, impulse[None] @ jacobian)
        data.qvel[:] = gained[0]
        for _ in range(after):
            mujoco.mj_step(model, data)
        mujoco.mj_forward(model, data)
        mujoco.mj_jacBody(model, data, jacobian, None, body)
        columns.append(jacobian @ data.qvel)
    return (np.array(columns[1:]) - columns[0]).T / 0.01


def faded(state: np.ndarray, after: float) -> np.ndarray:
    """(6, 3, 3) what `fading` says of thighs, shins and feet."""
    human = human_and_ball().bodies[0]
    links = slice(0, len(human.links))
    matrices = rotation.matrix(packed.orientation(jnp.asarray(state[:, links])))
    shape = morphology_of(human_and_ball())[None, links]
    lasts, *passes = fading(human, LEGS, matrices, shape, FADES)
    whole = lasts + sum(part * np.exp(-after / fade) for part, fade in zip(passes, FADES, strict=True))
    return np.asarray(whole)[0, :, :3, :3]


def test_legs_give_way_at_once_as_the_engines_inertia_says_motors_included(reference: Reference) -> None:
    for step in (10, 30, 40):
        state = reference.states[step : step + 1]
        for index, row in enumerate(LEGS):
            expected = given_by_the_engine(state, 0, int(row), 1e-4)
            np.testing.assert_allclose(faded(state, 0.0)[index], expected, rtol=2e-3, atol=2e-3)


def test_what_legs_have_gained_fades_as_their_servos_pull_them_back(reference: Reference) -> None:
    state = reference.states[30:31].copy()
    state[:, :13, 2] += 1.0  # away from the ground
    for index, row in enumerate(LEGS):
        at_once = np.linalg.norm(faded(state, 0.0)[index])
        for milliseconds in (1, 2, 5, 10):
            expected = given_by_the_engine(state, 10 * milliseconds, int(row), 1e-4)
            error = np.linalg.norm(faded(state, 1e-3 * milliseconds)[index] - expected) / at_once
            assert error < 0.1


def test_capsules_have_the_engines_moments_of_inertia() -> None:
    scene = human_and_ball()
    model = compile_model(scene)
    for link in scene.links:
        body = next(f"{owner.name}/{link.name}" for owner in scene.bodies if link in owner.links)
        along, across = moments(*jnp.array([link.length, link.radius, link.mass]))
        np.testing.assert_allclose(sorted(model.body(body).inertia), sorted([along, across, across]), rtol=1e-3)


def test_adjugates_invert() -> None:
    matrices = np.random.default_rng(0).standard_normal((20, 3, 3)) + 3.0 * np.eye(3)
    np.testing.assert_allclose(invert(jnp.asarray(matrices)), np.linalg.inv(matrices), rtol=1e-3, atol=1e-3)

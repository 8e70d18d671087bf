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

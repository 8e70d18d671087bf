"""Derivatives of a step: coordinates keep joints closed, and A and B predict what small changes do."""

from __future__ import annotations

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array
from small_problems import LEG

from larp_model.bodies import ball
from larp_model.errors import InputError
from larp_model.linearization import Coordinates
from larp_model.physics.kinematics import kinematics
from larp_model.rotation import matrix
from larp_model.scene import Pair, Scene, Surface
from larp_model.simulator import Simulator
from tasks.motions.references import Reference

STRUCK = Scene((LEG, ball()), (Pair("leg", "ball", ("lower",), ("ball",), Surface(1e4, 40.0, 0.5)),))


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    """64 bits, in which differences are good to many digits."""
    with jax.enable_x64(True):
        yield


def last(array: np.ndarray) -> Array:
    """Return an array with the batch last."""
    return jnp.moveaxis(jnp.asarray(array), 0, -1)


def states_of(reference: Reference) -> np.ndarray:
    """Return 5 states (5, L, 13) of a reference, with unit quaternions."""
    states = np.array(reference.states[:100:20], float)
    states[..., 3:7] /= np.linalg.norm(states[..., 3:7], axis=-1, keepdims=True)
    return states


def test_coordinates_are_those_of_the_change_that_they_make(scene: Scene, reference: Reference) -> None:
    states, coordinates = last(states_of(reference)), Coordinates(scene)
    sizes = last(np.repeat(scene.morphology[None].astype(float), 5, axis=0))
    values = jnp.asarray(np.random.default_rng(0).standard_normal((2 * coordinates.count, 5)))
    change = coordinates.change(states, sizes, values)
    np.testing.assert_allclose(coordinates.of(states, change), values, atol=1e-12)
    near = coordinates.difference(states + 1e-7 * change, states) / 1e-7
    np.testing.assert_allclose(near, values, atol=1e-5)


def test_coordinates_leave_joints_closed_and_their_points_moving_together(scene: Scene, reference: Reference) -> None:
    states, coordinates = last(states_of(reference)), Coordinates(scene)
    sizes = last(np.repeat(scene.morphology[None].astype(float), 5, axis=0))

    def opening(states: Array) -> tuple[Array, Array]:
        links, human = kinematics(scene, states, sizes), scene.human
        turn = matrix(jnp.moveaxis(states[:, 3:7], 1, -1))  # (L, B, 3, 3)

        def point(rows: np.ndarray, local: Array) -> Array:
            arm = jnp.einsum("nbij,njb->nib", turn[rows], local)
            return states[rows, 7:10] + jnp.cross(states[rows, 10:13], arm, axis=1)

        child = point(np.arange(1, len(human.links)), links.local_anchors.child)
        return links.displacement, child - point(human.parents, links.local_anchors.parent)

    values = jnp.asarray(np.random.default_rng(0).standard_normal((2 * coordinates.count, 5)))
    change = coordinates.change(states, sizes, values)
    for opened in jax.jvp(opening, (states,), (change,))[1]:
        np.testing.assert_allclose(opened, 0.0, atol=1e-11)


@pytest.mark.slow
def test_a_and_b_predict_what_small_changes_do_with_and_without_contact() -> None:
    simulator, coordinates, random = Simulator.of_physics(STRUCK), Coordinates(STRUCK), np.random.default_rng(0)
    states = np.zeros((2, 3, 13))
    states[..., 3], states[:, :2, 2], states[:, 2, 2] = 1.0, (0.76, 0.36), 0.111
    states[:, 2, 0], states[:, 2, 7] = (0.165, 5.0), -3.0  # it strikes the leg within the step, or is far away
    states[..., 10:13] = 0.1 * random.standard_normal((2, 3, 3))
    states[:, 1, 7:10] -= np.cross(states[:, 0, 10:13] + states[:, 1, 10:13], (0.0, 0.0, 0.2))
    controls, sizes = 0.2 * random.standard_normal((2, 1, 3)), last(np.repeat(STRUCK.morphology[None], 2, axis=0))
    by_state, by_control = simulator.linearize(states[:, None], controls[:, None])
    assert by_state.shape == (2, 1, 30, 30) and by_control.shape == (2, 1, 30, 3)
    for _ in range(3):
        values, turns = random.standard_normal((30, 2)), random.standard_normal((2, 1, 3))
        change = np.moveaxis(np.asarray(coordinates.change(last(states), sizes, jnp.asarray(values))), -1, 0)
        after = [
            last(np.asarray(simulator.step(states + sign * change, controls + sign * turns))) for sign in (1e-6, -1e-6)
        ]
        differences = np.asarray(coordinates.difference(*after)) / 2e-6
        predicted = np.einsum("bij,jb->ib", by_state[:, 0], values)
        predicted += np.einsum("bij,bj->ib", by_control[:, 0], turns[:, 0])
        scale = np.abs(differences).max(axis=0)
        assert (np.abs(predicted - differences).max(axis=0) < 1e-3 * scale).all()
    of_leg_by_ball = np.abs(by_state[:, 0, 15:24, 24:27]).max(axis=(1, 2))  # its rates, by the ball's velocity
    assert of_leg_by_ball[0] > 1e-3 > of_leg_by_ball[1] == 0.0


def test_controls_of_other_states_are_refused() -> None:
    simulator = Simulator.of_physics(STRUCK)
    with pytest.raises(InputError, match=r"controls have shape \(3, 1, 3\), but need \(2, 1, 3\)"):
        simulator.linearize(np.zeros((2, 3, 13)), np.zeros((3, 1, 3)))

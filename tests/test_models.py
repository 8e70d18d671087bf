"""The contract of models: what holds of every one in every scene, with random weights, in double precision."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from larp_model import rotation
from larp_model import state as packed
from larp_model.detection import first_contacts
from larp_model.engines.episodes import Episodes
from larp_model.learned.model import Model, initial_weights
from larp_model.learned.paper import PaperModel, Sizes
from larp_model.learned.residual import ResidualModel, changes, true_motion
from larp_model.networks import Size, Weights
from larp_model.physics.collision import ContactSettings
from larp_model.physics.kinematics import kinematics, morphology_of
from larp_model.physics.motion import BodyMotion, Constants
from larp_model.scene import Scene
from larp_model.simulator import step
from tasks.benchmarks.gradients import bounces
from tasks.scenarios import scenario

SOON = {"xla_backend_optimization_level": 0}
STEP = jax.jit(step, static_argnums=0, compiler_options=SOON)
CASES = [("residual", "human_ball"), ("paper", "human_ball"), ("residual", "chains2")]
LEAST = Size(2, 16)


class Case(NamedTuple):
    """A model with random weights, and six states (6, L, 13) in which its bodies meet, with controls (6, J, 3)."""

    model: Model
    weights: Weights
    states: np.ndarray
    controls: np.ndarray

    def after(self, states: np.ndarray | Array) -> np.ndarray:
        """The next states."""
        return np.asarray(STEP(self.model, self.weights, states, self.controls))


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def chains() -> Episodes:
    """Truth of two chains of two links."""
    with jax.enable_x64(False):
        return scenario("chains2").draw(32, 1)[0]


def made(name: str, scene: Scene) -> Model:
    """Return a model whose impulses are solved for until nothing is left, and so have the law's derivatives."""
    if name == "paper":
        return PaperModel(scene, Sizes(LEAST, LEAST, LEAST))
    return ResidualModel(scene, LEAST, Constants(iterations=40), ContactSettings(iterations=40))


@pytest.fixture(scope="module", params=CASES, ids="-".join)
def case(request: pytest.FixtureRequest, episodes: Episodes, chains: Episodes) -> Case:
    design, name = request.param
    scene, given = scenario(name).scene, episodes if name == "human_ball" else chains
    with jax.enable_x64(False):
        contacts = first_contacts(scene, given, chunk=64)
        rows = np.flatnonzero(contacts >= 0)[:6]
        before, after = (given.states[rows, contacts[rows] + later] for later in (0, 1))
        controls, torques = given.controls[rows, contacts[rows]], given.torques[rows, contacts[rows]]
        model = made(design, scene)
        sizes = morphology_of(scene)[None]
        measured = jax.jit(model.measure, compiler_options=SOON)(before, after, controls, torques, sizes)
        weights = initial_weights(model, jax.random.key(0), measured)
    states = before.astype(float)
    states[..., packed.ORIENTATION] /= np.linalg.norm(states[..., packed.ORIENTATION], axis=-1, keepdims=True)
    states[..., 2] += 1e-4  # a ball that just touches the ground has no derivative
    return Case(model, weights, states, controls.astype(float))


def moved_apart(case: Case) -> np.ndarray:
    """The states with the last body carried far away."""
    states = case.states.copy()
    states[:, case.model.scene.rows(case.model.scene.bodies[-1].name), :2] += 40.0
    return states


@pytest.mark.slow
def test_bodies_that_meet_change_each_other(case: Case) -> None:
    last = case.model.scene.rows(case.model.scene.bodies[-1].name)
    change = case.after(case.states)[..., packed.VELOCITY] - case.after(moved_apart(case))[..., packed.VELOCITY]
    for rows in (slice(0, last.start), last):
        assert np.abs(change[:, rows]).max() > 1e-4, "without contact there would be little to test"


@pytest.mark.slow
def test_neither_the_order_of_bodies_nor_one_that_can_touch_nothing_changes_the_others(case: Case) -> None:
    scene = case.model.scene
    last = scene.bodies[-1]
    crowded = replace(scene, bodies=(replace(last, name="other"), *scene.bodies[::-1]))
    order = [last, *scene.bodies[::-1]]  # the other one is in the very same place
    rows = np.concatenate([np.arange(len(scene.links))[scene.rows(body.name)] for body in order])
    motors = np.concatenate([np.arange(len(scene.motors))[scene.motor_rows(body.name)] for body in order])
    model, others = case.model.on(crowded), rows[len(last.links) :]
    found = np.asarray(STEP(model, case.weights, case.states[:, rows], case.controls[:, motors]))[:, len(last.links) :]
    np.testing.assert_allclose(found, case.after(case.states)[:, others], atol=1e-9)


@pytest.mark.slow
def test_it_does_not_matter_which_body_of_a_pair_is_named_first(case: Case) -> None:
    scene = case.model.scene
    other = case.model.on(replace(scene, pairs=tuple(pair.flipped() for pair in scene.pairs)))
    found = np.asarray(STEP(other, case.weights, case.states, case.controls))
    np.testing.assert_allclose(found, case.after(case.states), atol=1e-9)


def test_shifting_the_world_shifts_a_step(case: Case) -> None:
    shift = np.zeros(packed.SIZE)
    shift[:2] = 3.0, -7.0
    np.testing.assert_allclose(case.after(case.states + shift), case.after(case.states) + shift, atol=1e-7)


def test_turning_the_world_turns_a_step_of_what_says_so(case: Case) -> None:
    angle = np.linspace(-3.0, 3.0, len(case.states))
    turn = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    found = case.after(rotation.turn_states(jnp.asarray(case.states), turn))
    expected = np.asarray(rotation.turn_states(jnp.asarray(case.after(case.states)), turn))
    same = np.abs(np.delete(found - expected, np.s_[packed.ORIENTATION], axis=-1)).max() < 1e-7
    assert same == case.model.invariant, "what is not invariant has to be taught by turning its data"


@pytest.mark.slow
def test_forward_derivatives_of_a_step_are_those_of_differences_but_for_bounces(case: Case) -> None:
    direction = np.random.default_rng(0).standard_normal(case.states.shape)

    def moved(states: Array) -> Array:
        return step(case.model, case.weights, states, jnp.asarray(case.controls))

    slope = jax.jit(lambda s, d: jax.jvp(moved, (s,), (d,))[1], compiler_options=SOON)(case.states, direction)
    ahead, behind = (case.after(case.states + side * direction) for side in (1e-7, -1e-7))
    differences, smooth = (ahead - behind) / 2e-7, np.ones(case.states.shape[:2], bool)
    if case.model.scene.bodies[-1].is_ball:  # whose bounces have the slope of a mean: see `ball.timed`
        smooth[:, -1] = ~bounces(case.model.scene, case.states, case.after(case.states))
    assert smooth.mean() > 0.95
    np.testing.assert_allclose(differences[smooth], slope[smooth], atol=1e-4 * np.abs(slope).max())


def test_networks_change_what_physics_says(case: Case) -> None:
    silent = case.weights._replace(networks=jax.tree.map(jnp.zeros_like, case.weights.networks))
    other = np.asarray(STEP(case.model, silent, case.states, case.controls))
    assert np.abs(other - case.after(case.states)).max() > 1e-6


def test_changes_say_all_of_a_motion(episodes: Episodes) -> None:
    scene, dt = scenario("human_ball").scene.only("human"), 0.01
    before, after = (jnp.moveaxis(jnp.asarray(episodes.states[:, step, :-1], jnp.float64), 0, -1) for step in (10, 11))
    seen = kinematics(scene, before, jnp.moveaxis(jnp.asarray(episodes.morphology[:, :-1], jnp.float64), 0, -1))
    motion = true_motion(seen, after)
    velocity, spin, moved, turned = changes(seen, motion, dt)
    ends = seen.velocity + velocity, seen.angular_velocity + spin
    again = BodyMotion(
        *ends,
        0.5 * dt * (seen.velocity + ends[0]) + moved,
        0.5 * dt * (seen.angular_velocity + ends[1]) + turned,
    )
    for one, other in zip(again, motion, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    np.testing.assert_allclose(seen.position + again.translation, after[:, packed.POSITION], atol=1e-12)

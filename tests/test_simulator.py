"""LARP: symmetries, the integrator, what contact may and may not change, and gradients; all with random weights."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array, export

from larp_model import losses, rotation
from larp_model import state as packed
from larp_model.anatomy import Detail
from larp_model.bodies import BALL_SURFACE, capsule, chain, human_and_ball
from larp_model.detection import first_contacts
from larp_model.engines.episodes import Episodes
from larp_model.errors import InputError
from larp_model.learned.model import Model
from larp_model.learned.residual import ResidualModel
from larp_model.losses import LossWeights
from larp_model.networks import Size, Weights
from larp_model.physics.ball import SUBSTEPS
from larp_model.physics.kinematics import morphology_of
from larp_model.scene import Pair, Scene
from larp_model.simulator import Simulator, rollout, step

STEPS = 10


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="module")
def residual_simulator(residual: Model, residual_weights: Weights) -> Simulator:
    return Simulator.of(residual, residual_weights)


@pytest.fixture(scope="module")
def paper_simulator(paper: Model, paper_weights: Weights) -> Simulator:
    return Simulator.of(paper, paper_weights)


@pytest.fixture(params=["residual", "paper"])
def simulator(request: pytest.FixtureRequest) -> Simulator:
    simulator: Simulator = request.getfixturevalue(f"{request.param}_simulator")
    return simulator


@pytest.fixture(scope="module")
def kicks(scene: Scene, episodes: Episodes) -> tuple[np.ndarray, np.ndarray]:
    """Eight states (8, L, 13) two steps before a foot meets the ball, and controls (8, STEPS, J, 3)."""
    contacts = first_contacts(scene, episodes)
    rows = np.flatnonzero((contacts >= 2) & (contacts + STEPS < episodes.steps))[:8]
    columns = contacts[rows, None] - 2 + np.arange(STEPS)
    states = episodes.states[rows, columns[:, 0]].astype(float)
    states[..., packed.ORIENTATION] /= np.linalg.norm(states[..., packed.ORIENTATION], axis=-1, keepdims=True)
    return states, episodes.controls[rows[:, None], columns].astype(float)


# Compiling takes far longer than running here.
SOON = {"xla_backend_optimization_level": 0}
ROLL = jax.jit(rollout, static_argnums=0, compiler_options=SOON)


def roll(simulator: Simulator, states: np.ndarray, controls: np.ndarray) -> np.ndarray:
    """Predicted states; compiled once for each simulator and shape."""
    return np.asarray(ROLL(simulator.model, simulator.weights, states, controls))


def apart(first: np.ndarray, second: np.ndarray) -> float:
    """Largest difference of states, quaternions taken up to their sign."""
    signs = np.sign(np.sum(first[..., packed.ORIENTATION] * second[..., packed.ORIENTATION], axis=-1, keepdims=True))
    second = second.copy()
    second[..., packed.ORIENTATION] *= signs
    return float(np.abs(first - second).max())


@pytest.mark.slow
def test_the_ball_is_kicked(residual_simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]) -> None:
    after = roll(residual_simulator, *kicks)
    changed = np.abs(after[:, -1, -1, 7:9] - kicks[0][:, -1, 7:9]).max(axis=-1)
    assert np.median(changed) > 1.0, "without contact the tests below would show little"


def test_turning_the_world_turns_the_prediction(
    residual_simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]
) -> None:
    states, controls = kicks
    angle = np.linspace(-3.0, 3.0, len(states))
    turn = jnp.stack([jnp.cos(angle), jnp.sin(angle)], axis=-1)
    turned = np.asarray(rotation.turn_states(jnp.asarray(states), turn))
    expected = rotation.turn_states(jnp.asarray(roll(residual_simulator, states, controls)), turn[:, None])
    assert apart(roll(residual_simulator, turned, controls), np.asarray(expected)) < 1e-7


def test_shifting_the_world_shifts_the_prediction(simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]) -> None:
    states, controls = kicks
    shift = np.zeros(packed.SIZE)
    shift[:2] = 3.0, -7.0
    assert apart(roll(simulator, states + shift, controls), roll(simulator, states, controls) + shift) < 1e-7


def test_a_batch_equals_single_runs(simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]) -> None:
    states, controls = kicks
    together = roll(simulator, states, controls)
    alone = np.concatenate([roll(simulator, states[[i]], controls[[i]]) for i in range(len(states))])
    np.testing.assert_allclose(alone, together, atol=1e-9)


def test_steps_make_the_rollout(residual_simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]) -> None:
    states, controls = kicks
    step = jax.jit(residual_simulator.step, compiler_options=SOON)
    state, after = jnp.asarray(states), []
    for index in range(3):
        state = step(state, jnp.asarray(controls[:, index]))
        after.append(np.asarray(state))
    np.testing.assert_allclose(np.stack(after, axis=1), roll(residual_simulator, states, controls)[:, :3], atol=1e-9)


@pytest.mark.slow
def test_steps_that_are_not_wanted_repeat_the_last(
    residual_simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]
) -> None:
    states, controls = kicks
    rolled = jax.jit(residual_simulator.rollout, compiler_options=SOON)
    few = np.asarray(rolled(jnp.asarray(states), jnp.asarray(controls), steps=3))
    np.testing.assert_allclose(few[:, :3], roll(residual_simulator, states, controls)[:, :3], atol=1e-9)
    np.testing.assert_array_equal(few[:, 3:], np.repeat(few[:, 2:3], controls.shape[1] - 3, axis=1))


def test_orientations_stay_of_unit_length(simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]) -> None:
    after = roll(simulator, *kicks)
    np.testing.assert_allclose(np.linalg.norm(after[..., packed.ORIENTATION], axis=-1), 1.0, atol=1e-12)


def test_the_ground_never_speeds_up_a_balls_spin_about_the_vertical(
    residual_simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]
) -> None:
    states, controls = kicks[0].copy(), kicks[1]
    states[:, -1, packed.POSITION] = 30.0, 0.0, 0.11
    states[:, -1, packed.VELOCITY] = 0.0
    states[:, -1, packed.ANGULAR_VELOCITY] = np.random.default_rng(0).normal(0.0, 80.0, (len(states), 3))
    spin = np.abs(np.concatenate([states[:, None], roll(residual_simulator, states, controls)], axis=1)[:, :, -1, 12])
    assert (np.diff(spin, axis=1) <= 1e-9).all()


def test_a_ball_far_from_everything_flies_as_in_the_engines_steps(
    residual_simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]
) -> None:
    states, controls = kicks[0].copy(), kicks[1]
    states[:, -1, packed.POSITION] = 0.0, 0.0, 30.0
    states[:, -1, packed.VELOCITY] = np.random.default_rng(0).normal(0.0, 8.0, (len(states), 3))
    ball = roll(residual_simulator, states, controls)[:, :, -1]
    time = 0.01 * np.arange(1, STEPS + 1)[:, None]
    gravity, start = np.array([0.0, 0.0, -9.81]), states[:, None, -1]
    velocity = start[..., packed.VELOCITY] + gravity * time
    # Semi-implicit Euler, in the engine's steps.
    path = start[..., packed.POSITION] + start[..., packed.VELOCITY] * time
    path = path + 0.5 * gravity * time * (time + 0.01 / SUBSTEPS)
    np.testing.assert_allclose(ball[..., packed.POSITION], path, atol=1e-12)
    np.testing.assert_allclose(ball[..., packed.VELOCITY], velocity, atol=1e-12)
    spin = np.broadcast_to(start[..., packed.ANGULAR_VELOCITY], velocity.shape)
    np.testing.assert_allclose(ball[..., packed.ANGULAR_VELOCITY], spin, atol=1e-12)


def test_a_body_that_touches_nothing_changes_no_other(
    residual_simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]
) -> None:
    states, controls = kicks[0].copy(), kicks[1]
    people: list[np.ndarray] = []
    for place in ((5.0, 5.0, 0.11), (-4.0, 9.0, 3.0)):
        states[:, -1, packed.POSITION] = place
        states[:, -1, packed.VELOCITY] = place
        people.append(roll(residual_simulator, states, controls)[:, :, :-1])
    np.testing.assert_allclose(people[0], people[1], atol=1e-12)


def wide(after: Any) -> Any:
    """Return the squared distances of balls, 0.3 s ahead, from a target, summed over kicks."""
    return ((after[:, -1, -1, :3] + 0.3 * after[:, -1, -1, 7:10] - np.array([3.0, 0.5, 0.4])) ** 2).sum()


def miss(simulator: Simulator, stop_gradient: bool, states: Array, controls: Array) -> Array:
    """`wide` of a rollout."""
    states = rollout(simulator.model, simulator.weights, states, controls, stop_gradient=stop_gradient)
    return jnp.asarray(wide(states))


def test_stopping_gradients_changes_nothing_but_gradients(
    paper_simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]
) -> None:
    found = [
        jax.jit(jax.value_and_grad(partial(miss, paper_simulator, stops)), compiler_options=SOON)(*kicks)
        for stops in (True, False)
    ]
    (cost, slope), (same, other) = found
    assert float(cost) == pytest.approx(float(same)) == pytest.approx(wide(roll(paper_simulator, *kicks)))
    assert np.abs(slope).max() > 1e-6 and np.abs(slope - other).max() > 1e-9


def test_gradients_through_contact_are_finite_in_single_precision(
    paper_simulator: Simulator, kicks: tuple[np.ndarray, np.ndarray]
) -> None:
    with jax.enable_x64(False):
        states, controls = (jnp.asarray(part, jnp.float32) for part in kicks)
        states = states.at[0, -1, :3].set(states[0, 7, :3])  # the ball inside a foot
        shape = morphology_of(paper_simulator.scene)[None]

        def moved(states: Array, controls: Array, shape: Array) -> Array:
            return paper_simulator.rollout(states, controls, morphology=shape)[..., :3].sum()

        found = jax.jit(jax.grad(moved, argnums=(0, 1, 2)), compiler_options=SOON)(states, controls, shape)
    assert all(np.isfinite(part).all() for part in found)


def test_bodies_without_motors_that_strike_each_other_are_simulated() -> None:
    pair = Pair("chain", "capsule", ("link1",), ("capsule",), BALL_SURFACE)
    scene = Scene((chain(links=2), capsule()), (pair,))
    state = np.zeros((2, 3, packed.SIZE))
    state[..., 3], state[..., 2] = 1.0, 1.0
    state[:, 2, :3] = [(0.0, 0.15, 1.0), (0.0, 3.0, 1.0)]
    state[:, 2, 8] = -8.0
    struck, missed = roll(Simulator.of_physics(scene), state, np.zeros((2, 2, 0, 3)))[:, 0, :, packed.VELOCITY]
    assert (np.abs(struck - missed)[1:].max(axis=-1) > 1e-3).all()


@pytest.mark.parametrize(
    ("state", "controls", "message"),
    [
        ((14, 13), (2, 5, 12, 3), r"state has shape \(14, 13\)"),
        ((2, 13, 13), (2, 5, 12, 3), r"state has shape \(2, 13, 13\), but needs \(N, 14, 13\)"),
        ((2, 14, 13), (3, 5, 12, 3), r"controls have shape \(3, 5, 12, 3\), but need \(2, H, 12, 3\)"),
        ((2, 14, 13), (2, 12, 3), "controls have shape"),
        ((2, 14, 13), (2, 5, 11, 3), "controls have shape"),
    ],
)
def test_shapes_that_do_not_fit_are_refused(
    residual_simulator: Simulator, state: tuple[int, ...], controls: tuple[int, ...], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        residual_simulator.rollout(jnp.zeros(state), jnp.zeros(controls))


def test_rows_that_do_not_fit_into_memory_are_refused_with_how_many_would(
    residual_simulator: Simulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("larp_model.runtime.free_memory", lambda: 1e8)
    message = r"^state has 70000 rows, whose results need 0\.306 GB, but 0\.1 GB are free: take at most 22893 at a "
    with pytest.raises(InputError, match=message):
        residual_simulator.rollout(np.zeros((70000, 14, 13), np.float32), np.zeros((70000, 2, 12, 3)))


@pytest.mark.parametrize(("layers", "width", "named"), [(2, 0, "width is 0"), (0, 8, "layers is 0"), (2, 1.5, "1.5")])
def test_a_size_that_makes_no_sense_is_refused_by_name(layers: int, width: int, named: str) -> None:
    with pytest.raises(InputError, match=named):
        Size(layers, width)


def test_losses_of_the_truth_are_zero_and_grow_with_the_error(scene: Scene, episodes: Episodes) -> None:
    true = jnp.asarray(episodes.states[:4], jnp.float64)
    unit = true[..., packed.ORIENTATION] / jnp.linalg.norm(true[..., packed.ORIENTATION], axis=-1, keepdims=True)
    true = true.at[..., packed.ORIENTATION].set(unit)
    flipped = true.at[..., packed.ORIENTATION].multiply(-1.0)
    weigh = jnp.ones(len(scene.links))
    total, terms = losses.total(scene, LossWeights(), weigh, flipped, true, morphology_of(scene)[None])
    assert float(total) < 1e-9 and all(float(value) > -1e-12 for value in terms.values())
    shifted = true.at[..., -1, packed.POSITION].add(jnp.array([0.3, 0.0, -0.4]))
    np.testing.assert_allclose(losses.position(shifted, true)[..., -1], 0.25)
    turned = true.at[..., packed.ORIENTATION].set(rotation.integrate(unit, jnp.array([0.2, 0.0, 0.0])))
    np.testing.assert_allclose(losses.rotation(turned, true), 1.0 - np.cos(0.1), atol=1e-12)
    stretched = true.at[..., 0, packed.POSITION].add(jnp.array([0.0, 0.0, 0.1]))
    joints = np.asarray(losses.displacement(scene, stretched, morphology_of(scene))).reshape(-1, 12).mean(axis=0)
    on_pelvis = [parent == 0 for _, parent, _ in scene.joints()]
    np.testing.assert_allclose(joints, np.where(on_pelvis, 0.01, 0.0), atol=1e-6)


def test_emphasis_weighs_the_links_it_names(scene: Scene, episodes: Episodes) -> None:
    true = jnp.asarray(episodes.states[:4])
    shifted = true.at[..., -1, 0].add(1.0)
    even, ball = jnp.ones(len(scene.links)), jnp.ones(len(scene.links)).at[-1].set(3.0)
    sizes = morphology_of(scene)[None]
    terms = [losses.total(scene, LossWeights(), weigh, shifted, true, sizes)[1]["position"] for weigh in (even, ball)]
    assert float(terms[1]) == pytest.approx(3.0 * float(terms[0]), rel=1e-5)


def test_a_sequence_teaches_until_it_is_lost(scene: Scene, episodes: Episodes) -> None:
    true = jnp.asarray(episodes.states[:1, :6])
    strayed = true.at[:, 2:, :, 0].add(0.1).at[:, 4:, :, 0].add(5.0)

    def loss(predicted: Array) -> Array:
        weigh = jnp.ones(len(scene.links))
        return losses.total(scene, LossWeights(displacement=0.0), weigh, predicted, true, morphology_of(scene)[None])[0]

    slope = np.asarray(jax.grad(loss)(strayed))[0, :, :, 0]
    np.testing.assert_allclose(loss(strayed), 0.5 * 0.1**2, rtol=1e-4)
    assert (slope[2:4] > 0.0).all() and not slope[4:].any()


def test_an_empty_batch_gives_an_empty_answer(physics: Simulator, scene: Scene) -> None:
    links, motors = len(scene.links), len(scene.motors)
    state, controls = np.zeros((0, links, 13), np.float32), np.zeros((0, 5, motors, 3))
    assert physics.rollout(state, controls).shape == (0, 5, links, 13)
    assert physics.step(state, controls[:, 0]).shape == (0, links, 13)


def test_arguments_that_are_no_arrays_of_numbers_are_refused_by_name(physics: Simulator, scene: Scene) -> None:
    links, motors = len(scene.links), len(scene.motors)
    state, control = np.zeros((1, links, 13), np.float32), np.zeros((1, motors, 3))
    for arguments, name in (
        (([[1.0], [1.0, 2.0]], control), "state is of type list"),
        (("standing", control), "state is of type str"),
        ((state, [[1.0], [1.0, 2.0]]), "controls is of type list"),
        ((state, control, object()), "torques is of type object"),
    ):
        with pytest.raises(InputError, match=name):
            physics.step(*arguments)


@pytest.mark.parametrize("scene", [Scene((chain(links=4),)), human_and_ball()], ids=["chain", "human and ball"])
def test_a_rollout_can_be_exported_for_any_batch(scene: Scene) -> None:
    simulator = Simulator.of_physics(scene)
    links, motors = len(simulator.scene.links), len(simulator.scene.motors)
    (count,) = export.symbolic_shape("n")
    given = (
        jax.ShapeDtypeStruct((count, links, 13), jnp.float32),
        jax.ShapeDtypeStruct((count, 5, motors, 3), jnp.float32),
    )
    exported = export.export(jax.jit(simulator.rollout))(*given)
    assert exported.in_avals[0].shape == (count, links, 13)


@pytest.mark.parametrize("detail", ["lean", "full"])
def test_humans_of_other_sizes_are_simulated_by_the_same_program(detail: Detail) -> None:
    def program(height: float, mass: float) -> str:
        scene = human_and_ball(height, mass, detail=detail)
        state = jnp.zeros((2, len(scene.links), packed.SIZE), jnp.float32)
        controls = jnp.zeros((2, 3, len(scene.motors), 3), jnp.float32)
        simulator = Simulator.of_physics(scene)
        lowered = jax.jit(lambda simulator, *given: simulator.rollout(*given)).lower(simulator, state, controls)
        return str(lowered.as_text())

    assert program(1.6, 50.0) == program(1.9, 100.0)


def test_a_human_of_another_size_moves_as_its_own_model_says() -> None:
    scene = human_and_ball(1.6, 50.0).only("human")
    simulator, own = Simulator.of_physics(scene), ResidualModel(scene)
    assert simulator.model != own
    random = np.random.default_rng(0)
    state = np.zeros((1, len(scene.links), packed.SIZE))
    state[..., packed.POSITION] = random.normal(0.0, 1.0, (1, len(scene.links), 3))
    state[..., 2] += 5.0
    state[..., packed.ORIENTATION] = random.normal(size=(1, len(scene.links), 4))
    state[..., packed.ORIENTATION] /= np.linalg.norm(state[..., packed.ORIENTATION], axis=-1, keepdims=True)
    controls = random.normal(0.0, 0.3, (1, len(scene.motors), 3))
    expected = jax.jit(partial(step, own, simulator.weights))(state, controls)
    np.testing.assert_allclose(simulator.step(state, controls), expected, rtol=1e-5, atol=1e-5)

"""Links that press on each other: what follows from the law, and what the truth does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import Array

from larp_model import contact, meeting
from larp_model import state as packed
from larp_model.bodies import BALL_SURFACE, two_balls
from larp_model.designs import hybrid
from larp_model.kinematics import Kinematics, kinematics, morphology_of
from larp_model.launches import launches_of
from larp_model.meeting import Velocities
from larp_model.parts.contact import Contact, KnownContact
from larp_model.parts.impacts import FreeImpact, SoftContacts
from larp_model.scene import Scene
from larp_model.simulator import Simulator
from larp_model.soft_contact import Done, Loose, Rule, Side, press
from larp_model.truth.episodes import Episodes
from larp_model.truth.mujoco import Truth
from larp_model.vector import Vector
from tasks.data import random_episodes
from tasks.motions.references import Reference

GROUND, USUAL = two_balls().bodies[0].surface, Rule()


def balls(
    centres: np.ndarray,
    velocities: np.ndarray,
    spins: np.ndarray | float = 0.0,
    mass: tuple[float, float] = (0.43, 0.43),
) -> tuple[Side, Side]:
    """Two balls (N,) each, free but for gravity, at centres (2, N, 3) with velocities and spins (2, N, 3)."""
    count = centres.shape[1]
    gravity = np.broadcast_to([0.0, 0.0, -9.81], (count, 3))
    spins = np.broadcast_to(spins, centres.shape)

    def vector(array: np.ndarray) -> Vector:
        return Vector.of(jnp.asarray(array))

    gives = Loose(jnp.full(count, 1.0 / 0.43), jnp.full(count, 2.5 / (0.43 * 0.11**2)))
    one, two = (
        Side(
            vector(centres[i]), vector(0.0 * gravity), jnp.full(count, 0.11), vector(velocities[i]), vector(spins[i]),
            vector(gravity), vector(0.0 * gravity), gives,
        )
        for i in range(2)
    )  # fmt: skip
    return one, two


def pressed(
    sides: tuple[Side, Side], grounded: bool, time: float = 0.01, rule: Rule = USUAL
) -> tuple[Done, Done, Array]:
    """What `press` says, and the impulse on the second (N, 3)."""
    grounds = (GROUND, GROUND) if grounded else (None, None)
    times = jnp.full(sides[0].radius.shape, time)
    run = jax.jit(lambda sides: press(sides, BALL_SURFACE, grounds, times, times < 0.0, rule))
    one, two, between = run(sides)
    return one, two, between.array


def touching(count: int = 64, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Balls above the ground that begin to touch: centres, velocities and spins (2, N, 3)."""
    random = np.random.default_rng(seed)
    normal = random.standard_normal((count, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    centre = np.array([0.0, 0.0, 2.0]) + 0.0 * normal
    approach = random.uniform(2.0, 15.0, (count, 1))
    speeds = random.standard_normal((2, count, 3)) + 0.5 * approach * np.stack([normal, -normal])
    return np.stack([centre, centre + 0.2199 * normal]), speeds, 20.0 * random.standard_normal((2, count, 3))


def test_a_head_on_impact_is_the_damped_spring_of_the_closed_form() -> None:
    speeds = np.linspace(1.0, 20.0, 20)
    centres, velocities = np.zeros((2, 20, 3)), np.zeros((2, 20, 3))
    centres[1, :, 0], velocities[0, :, 0] = 0.22, speeds
    _, _, found = pressed(balls(centres, velocities), grounded=False, time=0.02)
    free = contact.impact(jnp.zeros(20), jnp.asarray(speeds), 0.0, BALL_SURFACE, jnp.full(20, 0.02))
    np.testing.assert_allclose(found[:, 0], 0.215 * np.asarray(free.change), rtol=0.02)


def test_what_the_balls_do_to_each_other_is_opposite_and_turns_neither_from_afar() -> None:
    centres, velocities, spins = touching()
    one, two, between = pressed(balls(centres, velocities, spins), grounded=False)
    np.testing.assert_allclose(two.impulse.array, between, atol=1e-6)
    np.testing.assert_allclose(one.impulse.array, -between, atol=1e-6)
    # Both are pushed at one point, midway between equal balls: the same moment about their centres.
    np.testing.assert_allclose(one.moment.array, two.moment.array, atol=2e-3)


def test_friction_stays_in_its_cone() -> None:
    centres, velocities, spins = touching()
    _, _, between = pressed(balls(centres, velocities, 10.0 * spins), grounded=False, time=1e-3)
    normal = (centres[1] - centres[0]) / 0.2199
    along = np.sum(np.asarray(between) * normal, axis=-1)
    across = np.linalg.norm(np.asarray(between) - along[:, None] * normal, axis=-1)
    assert (along > 0.0).all() and (across <= 1.02 * BALL_SURFACE.friction * along).all()
    assert (across > 0.9 * BALL_SURFACE.friction * along).any()


def test_balls_that_part_or_are_apart_do_nothing() -> None:
    centres, velocities, spins = touching()
    centres[1] += 10.0 * (centres[1] - centres[0])
    for side in pressed(balls(centres, velocities, spins), grounded=False)[:2]:
        assert not np.any(np.asarray(jax.tree.leaves(side)))


def test_four_times_as_many_substeps_change_little() -> None:
    centres, velocities, spins = touching()
    centres[..., 2] += 0.11 - centres[0, :, 2:].T  # the first lies on the ground
    above = centres[1, :, 2] > 0.11
    found = [
        np.asarray(pressed(balls(centres, velocities, spins), grounded=True, rule=rule)[2])[above]
        for rule in (USUAL, Rule(substeps=40))
    ]
    error = np.linalg.norm(found[1] - found[0], axis=-1) / np.linalg.norm(found[1], axis=-1)
    assert np.median(error) < 0.02


def known(scene: Scene, base: FreeImpact | SoftContacts, states: np.ndarray) -> KnownContact:
    """What a base knows of the contact of two balls."""
    model = hybrid(scene)
    [part] = model.pairs
    assert isinstance(part, Contact)

    @jax.jit
    def ask(states: Array) -> KnownContact:
        seen = model.each(kinematics(scene, states, morphology_of(scene)[None]))
        first, second = meeting.parties(part.pair, part.bodies, (seen[0], seen[1]), (free(seen[0]), free(seen[1])))
        return base.known(first, second, meeting.meet(part.pair, first, second, scene.dt), part)

    def free(own: Kinematics) -> Velocities:
        return Velocities.of(own.state)

    return ask(jnp.asarray(states, jnp.float32))


@pytest.mark.parametrize(("height", "most"), [(2.0, 0.02), (0.11, 0.10)], ids=["in the air", "on the ground"])
def test_a_struck_ball_moves_as_in_the_truth(height: float, most: float) -> None:
    scene, count, random = two_balls(), 64, np.random.default_rng(4)
    states = np.zeros((count, 2, packed.SIZE))
    states[..., packed.ORIENTATION] = 1.0, 0.0, 0.0, 0.0
    # The first strikes from above or the side; the second is at rest, so that it may lie on the ground.
    angle, lift = random.uniform(0.0, 2.0 * np.pi, count), random.uniform(0.1, 1.2, count)
    normal = np.stack([np.cos(angle) * np.cos(lift), np.sin(angle) * np.cos(lift), np.sin(lift)], axis=-1)
    states[:, 1, packed.POSITION] = 0.0, 0.0, height
    states[:, 0, packed.POSITION] = states[:, 1, packed.POSITION] + 0.24 * normal
    states[:, 0, packed.VELOCITY] = -random.uniform(5.0, 15.0, (count, 1)) * normal + random.standard_normal((count, 3))
    states[:, 0, packed.ANGULAR_VELOCITY] = 10.0 * random.standard_normal((count, 3))
    after, _ = Truth(scene, count).rollout(states, np.zeros((count, 1, 0, 3)))
    gained = after[:, 0, 1, packed.VELOCITY] - states[:, 1, packed.VELOCITY]
    if height > 1.0:
        gained = gained + np.array([0.0, 0.0, 9.81 * scene.dt])
    errors = {}
    for name, base in (("free", FreeImpact()), ("soft", SoftContacts())):
        impulse = np.asarray(known(scene, base, states).impulses[1])[:, 0]
        errors[name] = np.linalg.norm(impulse / 0.43 - gained, axis=-1) / np.linalg.norm(gained, axis=-1)
    assert np.median(errors["soft"]) < most and np.median(errors["soft"]) < 0.5 * np.median(errors["free"])


def test_a_kicked_ball_leaves_nearly_as_in_the_truth_though_nothing_is_learned(
    scene: Scene, reference: Reference, mechanical: Simulator
) -> None:
    episodes, _ = random_episodes(scene, reference, count=256, seed=5, steps=48)
    found = launches_of(mechanical, episodes, 0)
    assert len(found.error) > 50 and np.median(found.error) < 0.05
    assert found.by.any(axis=1).all(), "of every launch it is known which links pushed the ball"
    assert found.links[found.by.sum(axis=0).argmax()] == "right_foot"
    kinds = found.summary["kinds"]
    assert kinds["ball on the ground"]["count"] + kinds["ball in the air"]["count"] == len(found.error)


def test_a_ball_that_slides_loses_its_slip_to_the_ground_as_in_the_truth_though_nothing_is_learned(
    scene: Scene, episodes: Episodes, mechanical: Simulator
) -> None:
    count, random = 64, np.random.default_rng(6)
    states = np.repeat(episodes.states[:1, 0].astype(np.float64), count, axis=0)
    ball = states[:, -1]
    ball[:, packed.POSITION] = 9.0, 0.0, 0.11
    ball[:, packed.VELOCITY] = random.uniform([-6.0, -6.0, -4.0], [6.0, 6.0, 0.0], (count, 3))
    ball[:, packed.ANGULAR_VELOCITY] = 20.0 * random.standard_normal((count, 3))
    resting = episodes.controls[:1, :1].repeat(count, axis=0)
    truth = Truth(scene, count).rollout(states, resting.astype(np.float64))[0][:, 0, -1]
    predicted = np.asarray(mechanical.rollout(jnp.asarray(states, jnp.float32), jnp.asarray(resting)))[:, 0, -1]
    for part, most in ((packed.VELOCITY, 0.04), (packed.ANGULAR_VELOCITY, 0.06)):
        gained, error = truth[:, part] - ball[:, part], predicted[:, part] - truth[:, part]
        relative = np.linalg.norm(error[:, :2], axis=-1) / np.linalg.norm(gained[:, :2], axis=-1)
        assert np.median(relative) < most


def test_the_oddest_starts_leave_values_and_gradients_finite() -> None:
    centres, velocities, spins = touching(8)
    centres[1, 0] = centres[0, 0]  # coincide
    centres[1, 1] = centres[0, 1] + [0.0, 0.0, 1e-4]
    velocities[:, 2] *= 1e3
    spins[:, 3] *= 1e3
    velocities[:, 4], spins[:, 4] = 0.0, 0.0

    still = balls(centres, velocities, spins)

    def pushed(velocities: Array, time: Array) -> Array:
        first, second = (side._replace(velocity=Vector.of(each)) for side, each in zip(still, velocities, strict=True))
        times = jnp.broadcast_to(time, 8)
        one, two, _ = press((first, second), BALL_SURFACE, (GROUND, GROUND), times, times < 0.0)
        return jnp.stack([jnp.sum(each) for each in jax.tree.leaves((one, two))]).sum()

    slopes = jax.jit(jax.value_and_grad(pushed))
    for time in (0.0, 1e-9, 0.01):
        value, slope = slopes(jnp.asarray(velocities), jnp.asarray(time))
        assert np.isfinite(value) and np.isfinite(slope).all()

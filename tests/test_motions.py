"""The generator of motions and bodies keeps what it promises of every one of them."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from larp_model import state as packed
from larp_model.bodies import human, human_and_ball
from larp_model.detection import first_contacts
from larp_model.engines.mujoco import Truth
from larp_model.physics import kinematics
from larp_model.scene import Body
from tasks.episodes.any_motion import any_episodes, states_in_motion, with_planted_foot
from tasks.episodes.people import BUILD, HEIGHT, MASS, VARIED, random_people
from tasks.motions import angles, references, styles
from tasks.motions.details import in_detail
from tasks.motions.references import clearance
from tasks.pose.reconstruction import angles_of

SCENE = human_and_ball()
FULL = human_and_ball(detail="full")
ROWS = SCENE.rows("human")
HUMAN = SCENE.body("human")
COUNT, STEPS = 60, 30


@pytest.fixture(scope="module")
def reference() -> references.Reference:
    return references.embedded(SCENE)


@pytest.fixture(scope="module")
def people() -> np.ndarray:
    return random_people(np.random.default_rng(1), SCENE, 500)


@pytest.fixture(scope="module")
def full_reference() -> references.Reference:
    return references.embedded(FULL)


def test_people_are_as_tall_and_as_heavy_as_is_said(people: np.ndarray) -> None:
    usual = human(height=1.0, mass=1.0).sizes
    mass = people[:, ROWS, 2].sum(axis=1)
    height = people[:, ROWS, 0] / usual[:, 0]
    assert ((mass >= MASS[0] - 1e-6) & (mass <= MASS[1] + 1e-6)).all()
    assert (height >= HEIGHT[0] * (1.0 - VARIED)).all() and (height <= HEIGHT[1] * (1.0 + VARIED)).all()
    assert np.ptp(mass) > 0.8 * np.ptp(MASS) and np.ptp(height.mean(axis=1)) > 0.8 * np.ptp(HEIGHT)
    tall = height.mean(axis=1) / (1.0 - VARIED)
    assert (mass >= BUILD[0] * (height.min(axis=1) / (1.0 + VARIED)) ** 2).all() and (mass <= BUILD[1] * tall**2).all()


def test_people_are_alike_on_both_sides_and_leave_the_ball_as_it_is(people: np.ndarray) -> None:
    for name in ("thigh", "shin", "foot", "upper_arm", "lower_arm"):
        left, right = (people[:, SCENE.index("human", f"{side}_{name}")] for side in ("left", "right"))
        np.testing.assert_array_equal(left, right)
    assert (people[:, -1] == SCENE.morphology[-1]).all()


@given(arrays(float, (12, 3), elements=st.floats(-1.5, 1.5)))
def test_in_detail_a_body_turns_its_head_and_limbs_as_the_lean_one_does(targets: np.ndarray) -> None:
    full = human(detail="full")
    lean_turns, full_turns = (world_turns(body, in_detail(body, targets)) for body in (human(), full))
    for name in ("pelvis", "head", "left_lower_arm", "right_upper_arm", "left_shin", "right_foot"):
        assert (lean_turns[name].inv() * full_turns[name]).magnitude() < 1e-6, name
    chest, torso = full_turns["chest"], lean_turns["torso"]
    assert (torso.inv() * chest).magnitude() < 1e-6
    np.testing.assert_array_equal(in_detail(human(), targets), targets)


def world_turns(body: Body, targets: np.ndarray) -> dict[str, Rotation]:
    """Return the rotations of a body's links, by name, with its joints at targets (J, 3) [rad]."""
    found = {body.links[0].name: Rotation.identity()}
    for (child, joint, _), turn in zip(body.motors, targets, strict=True):
        parent = body.links[joint.parent].name
        found[body.links[child].name] = found[parent] * Rotation.from_rotvec(turn)
    return found


def test_in_detail_mirrored_targets_are_mirrored(reference: references.Reference) -> None:
    full, targets = human(detail="full"), reference.controls[:40]
    mirrored = styles.mirrored(full, in_detail(full, targets))
    np.testing.assert_allclose(mirrored, in_detail(full, styles.mirrored(HUMAN, targets)), atol=1e-12)


def test_the_full_human_performs_the_embedded_kick(
    reference: references.Reference, full_reference: references.Reference
) -> None:
    strike = reference.strike
    assert abs(full_reference.strike - strike) <= 2
    for name in ("pelvis", "left_foot", "right_shin"):
        lean, full = (
            each.states[strike, scene.index("human", name), :3]
            for each, scene in ((reference, SCENE), (full_reference, FULL))
        )
        assert np.linalg.norm(lean - full) < 0.15, name
    ball = full_reference.states[full_reference.strike + 10, -1, packed.VELOCITY]
    assert ball[0] > 8.0 and abs(ball[1]) < 0.2 * ball[0]


def test_full_humans_come_in_any_size_and_motion(full_reference: references.Reference) -> None:
    episodes, dropped = any_episodes(FULL, full_reference, 32, 7, 30)
    apart = kinematics.displacement(FULL, jnp.asarray(episodes.states), jnp.asarray(episodes.morphology)[:, None])
    assert len(episodes.states) + dropped == 32 and dropped <= 1
    assert float(jnp.abs(apart).max()) < 1e-5
    assert np.abs(episodes.states[..., packed.ANGULAR_VELOCITY]).max() < 120.0, "no thumb spins like a top"
    masses = episodes.morphology[:, FULL.rows("human"), 2].sum(axis=1)
    assert np.ptp(masses) > 20.0


def test_mirroring_twice_changes_nothing_and_once_is_what_the_other_foot_does(reference: references.Reference) -> None:
    targets = reference.controls[:50]
    np.testing.assert_array_equal(styles.mirrored(HUMAN, styles.mirrored(HUMAN, targets)), targets)
    rows = styles.rows_of(HUMAN)
    once = styles.mirrored(HUMAN, targets)
    np.testing.assert_array_equal(once[:, rows["left_foot"], 1], targets[:, rows["right_foot"], 1])
    np.testing.assert_array_equal(once[:, rows["left_foot"], 2], -targets[:, rows["right_foot"], 2])
    states = reference.states[:50, ROWS]
    np.testing.assert_array_equal(styles.reflected(HUMAN, styles.reflected(HUMAN, states)), states)


def test_a_reflected_human_is_moved_by_mirrored_targets_as_the_other_in_a_mirror(
    reference: references.Reference,
) -> None:

    alone = SCENE.only("human")
    states, targets = reference.states[None, 20, ROWS], reference.controls[None, 20:30]
    after, _ = Truth(alone).rollout(states, targets)
    mirrored, _ = Truth(alone).rollout(styles.reflected(HUMAN, states), styles.mirrored(HUMAN, targets))
    np.testing.assert_allclose(
        mirrored[..., packed.POSITION], styles.reflected(HUMAN, after)[..., packed.POSITION], atol=1e-6
    )


@pytest.mark.parametrize("style", ["kicks", "gaits", "moves"])
def test_every_style_stays_within_what_the_joints_can_do_and_moves_smoothly(style: str) -> None:
    random = np.random.default_rng(3)
    if style == "kicks":
        targets = styles.kicks(random, HUMAN, random.integers(0, 100, COUNT), STEPS, SCENE.dt)
    else:
        targets = getattr(styles, style)(random, HUMAN, COUNT, STEPS, SCENE.dt)
    lower, upper = HUMAN.limits
    assert targets.shape == (COUNT, STEPS, len(SCENE.motors), 3)
    assert (targets >= lower).all() and (targets <= upper).all()
    assert np.abs(np.diff(targets, axis=1)).max() < 0.5
    assert np.ptp(targets, axis=0).mean() > 0.02  # no two alike


def test_humans_in_motion_are_whole_and_stand_on_the_ground_or_above(reference: references.Reference) -> None:
    random = np.random.default_rng(5)
    sizes = random_people(random, SCENE, COUNT)
    states, _ = states_in_motion(random, SCENE, reference, sizes, STEPS)
    apart = kinematics.displacement(SCENE, jnp.asarray(states), jnp.asarray(sizes))
    above = clearance(HUMAN, states[:, ROWS], sizes[:, ROWS])
    assert float(jnp.abs(apart).max()) < 1e-5
    assert above.min() > -1e-9 and (above < 1e-9).mean() > 0.3


def test_a_planted_foot_rests(reference: references.Reference) -> None:
    states = np.repeat(reference.states[25:26, ROWS], 200, axis=0)
    found = with_planted_foot(np.random.default_rng(0), HUMAN, states)
    feet = found[:, [HUMAN.link("left_foot"), HUMAN.link("right_foot")]]
    lower = feet[np.arange(200), np.argmin(feet[..., 2], axis=1)]
    slow = np.linalg.norm(lower[:, packed.VELOCITY], axis=-1) < 0.8
    assert 0.6 < slow.mean() < 1.0


def test_any_episodes_come_true_with_their_own_bodies_and_balls_that_are_struck(
    reference: references.Reference,
) -> None:
    episodes, dropped = any_episodes(SCENE, reference, 48, 7, STEPS)
    assert len(episodes.states) + dropped == 48 and dropped <= 2
    apart = kinematics.displacement(SCENE, jnp.asarray(episodes.states), jnp.asarray(episodes.morphology)[:, None])
    assert float(jnp.abs(apart).max()) < 1e-5
    assert len(np.unique(episodes.morphology[:, 0, 2])) == len(episodes.states)
    assert (first_contacts(SCENE, episodes) >= 0).mean() > 0.2


def test_the_same_seed_draws_the_same_episodes(reference: references.Reference) -> None:
    one, other = (any_episodes(SCENE, reference, 4, 9, 8)[0] for _ in range(2))
    np.testing.assert_array_equal(one.states, other.states)
    np.testing.assert_array_equal(one.controls, other.controls)


def test_the_ball_of_a_captured_kick_lies_where_only_the_kicking_foot_reaches(reference: references.Reference) -> None:
    """Our own kick, captured: where its foot would push hardest, the standing leg is."""
    motion = angles.motion(**angles_of(reference.states, HUMAN, SCENE.dt))
    captured = references.captured(motion, SCENE)
    states, _ = Truth(SCENE).rollout(captured.states[None, 0], captured.controls[None])
    speed = np.linalg.norm(states[0, :, -1, packed.VELOCITY], axis=-1)
    assert speed[: captured.strike - 1].max() < 0.01
    assert speed[captured.strike + 5] > 11.0

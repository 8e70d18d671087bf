"""Scene descriptions: hashable, scaled as promised, and loud about nonsense."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from larp_model.anatomy import ANATOMIES, Detail
from larp_model.bodies import ball, capsule, chain, detail_of, human, human_and_ball, standing_height, usual
from larp_model.errors import InputError
from larp_model.physics import kinematics
from larp_model.scene import Body, Joint, Link, Motor, Pair, Scene, Surface, anchor

NAN, INFINITY = math.nan, math.inf
LINK, SURFACE = Link("link", 0.3, 0.05, 1.0), Surface(1e4, 10.0, 0.5)
MOTOR = Motor(100.0, 5.0, 50.0, (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
JOINT = Joint(0, (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
PAIR = Pair("human", "ball", ("left_foot",), ("ball",), SURFACE)


@pytest.mark.parametrize(
    ("description", "field", "value"),
    [
        (LINK, "length", -0.1),
        (LINK, "length", NAN),
        (LINK, "radius", 0.0),
        (LINK, "radius", INFINITY),
        (LINK, "mass", 0.0),
        (LINK, "mass", -1.0),
        (LINK, "axis", (0.0, 0.0, 2.0)),
        (LINK, "axis", (0.0, 1.0)),
        (LINK, "axis", (NAN, 0.0, 1.0)),
        (MOTOR, "stiffness", 0.0),
        (MOTOR, "damping", -1.0),
        (MOTOR, "torque_limit", 0.0),
        (MOTOR, "lower", (2.0, 0.0, 0.0)),
        (MOTOR, "upper", (1.0, INFINITY, 1.0)),
        (JOINT, "parent_anchor", (0.0, 0.0)),
        (JOINT, "child_anchor", (0.0, 0.0, NAN)),
        (JOINT, "damping", -0.1),
        (SURFACE, "stiffness", 0.0),
        (SURFACE, "damping", -1.0),
        (SURFACE, "friction", -0.5),
        (human_and_ball(), "dt", 0.0),
        (human_and_ball(), "dt", NAN),
        (human_and_ball(), "gravity", -9.81),
    ],
)
def test_a_description_refuses_nonsense_by_field(description: Link, field: str, value: object) -> None:
    with pytest.raises(InputError, match=rf"\.{field} is .*but must ") as caught:
        dataclasses.replace(description, **{field: value})  # type: ignore[arg-type]
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Body("b", "b", ()), "'b' has no links"),
        (lambda: Body("b", "b", (LINK,), (JOINT,)), "'b' has 1 joints"),
        (lambda: Body("b", "b", (LINK, dataclasses.replace(LINK, name="x")), (dataclasses.replace(JOINT, parent=1),)),
         "parent of link 1 is 1"),
        (lambda: Body("b", "b", (LINK, LINK), (JOINT,)), "link names"),
        (lambda: Scene(()), "scene.bodies"),
        (lambda: Scene((ball(), ball())), "scene.bodies"),
        (lambda: Scene((human(), ball()), (dataclasses.replace(PAIR, first="robot"),)), "no body 'robot'"),
        (lambda: Scene((human(), ball()), (dataclasses.replace(PAIR, first_links=("paw",)),)), "no link 'paw'"),
        (lambda: Scene((human(), ball()), (dataclasses.replace(PAIR, second_links=()),)), "'ball', but needs some"),
        (lambda: Scene((human(), ball()), (dataclasses.replace(PAIR, second_links=("ball", "ball")),)), "each once"),
        (lambda: Scene((human(), ball()), (PAIR, Pair("ball", "human", ("ball",), ("head",), SURFACE))), "together"),
        (lambda: Scene((ball(),), (Pair("ball", "ball", ("ball",), ("ball",), SURFACE),)), "'ball' .* are one link"),
        (lambda: Scene((human(),), (Pair("human", "human", ("head",), ("torso",), SURFACE),)), "'head' and 'torso'"),
        (lambda: human_and_ball().only("robot"), "no body 'robot'"),
        (lambda: human_and_ball().index("human", "paw"), "no link 'paw'"),
        (lambda: Surface.bouncing(0.0, 0.8, 0.5), "contact_time is 0.0"),
        (lambda: Surface.bouncing(0.01, 1.2, 0.5), "restitution is 1.2"),
        (lambda: Surface.bouncing(0.01, 0.1, 0.5), "restitution is 0.1, but must be in .0.135, 1."),
        (lambda: ball(radius=-0.1), "radius is -0.1"),
        (lambda: ball(mass=NAN), "mass is nan"),
        (lambda: capsule(length=0.0), "length is 0.0"),
        (lambda: chain(links=0), "links is 0"),
        (lambda: chain(links=1.5), "links is 1.5"),  # type: ignore[arg-type]
        (lambda: human(height=-1.75), "height is -1.75"),
        (lambda: human(mass=0.0), "mass is 0.0"),
        (lambda: human(lengths={"tail": 1.0}), "lengths is 'tail'"),
        (lambda: human(radii={"shin": 0.0}), "radii"),
        (lambda: human(lengths={"toes": 1.0}), "lengths is 'toes'"),
        (lambda: human(motors={"tail": 1.0}), "motors is 'tail'"),
        (lambda: human(detail="fine"), "detail is 'fine', but must be one of lean, full"),  # type: ignore[arg-type]
        (lambda: detail_of(ball()), "'ball' is a ball, but must be one of human, full_human"),
        (lambda: human_and_ball(dt=-0.01), "dt is -0.01"),
    ],
)  # fmt: skip
def test_a_builder_refuses_nonsense_by_name(build: Callable[[], object], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        build()
    assert "\n" not in str(caught.value)


def test_equal_descriptions_are_one_key() -> None:
    assert human_and_ball() == human_and_ball() and hash(human_and_ball()) == hash(human_and_ball())
    scenes = {human_and_ball(): 1, human_and_ball(mass=71.0): 2, human_and_ball(dt=0.005): 3}
    assert scenes[human_and_ball()] == 1 and len(scenes) == 3
    with pytest.raises(dataclasses.FrozenInstanceError):
        human_and_ball().dt = 0.02  # type: ignore[misc]


def test_rows_of_bodies_tile_the_state_and_the_control() -> None:
    scene = Scene((chain("first"), human(), ball(), chain("last", links=2)))
    for rows, total in ((scene.rows, len(scene.links)), (scene.motor_rows, len(scene.motors))):
        covered = [row for body in scene.bodies for row in range(total)[rows(body.name)]]
        assert covered == list(range(total))
    for row, link in enumerate(scene.links[4:17], start=4):
        assert scene.index("human", link.name) == row
    for child, parent, joint in scene.joints():
        assert parent < child and joint in next(b for b in scene.bodies if scene.links[child] in b.links).joints


def test_contacts_of_a_body_with_itself_are_told_from_those_of_two() -> None:
    scene, without = human_and_ball(self_contact=True), human_and_ball()
    assert scene.between == without and without.within.pairs == ()
    [legs] = scene.within.pairs
    assert legs.of_itself and set(legs.first_links) == {"left_shin", "left_foot"}
    assert scene.only("human").pairs == (legs,) and scene.only("ball").pairs == ()


def test_only_keeps_the_bodies_named_and_their_pairs() -> None:
    scene = human_and_ball()
    assert scene.only("human", "ball") == scene
    alone = scene.only("human")
    assert alone.bodies == (human(),) and alone.pairs == ()
    assert (alone.dt, alone.gravity) == (scene.dt, scene.gravity)


IN_DETAIL = pytest.mark.parametrize("detail", ANATOMIES)
FACTOR = st.floats(0.5, 2.0)


@given(FACTOR, FACTOR)
def test_anchors_scale_with_the_morphology(length: float, radius: float) -> None:
    for link, point in ((Link("pelvis", 0.14, 0.1, 5.0, (0.0, 1.0, 0.0)), (0.1, 1.25, -0.3)), (LINK, (0.4, 0.5, 1.0))):
        still = anchor(point, np.array(link.length), np.array(link.radius), link.axis)
        scaled = anchor(point, np.array(length * link.length), np.array(radius * link.radius), link.axis)
        along = np.abs(link.axis) > 0.5
        np.testing.assert_allclose(scaled, np.where(along, length, radius) * still, atol=1e-12)
        sizes = jnp.array([[length * link.length, radius * link.radius, link.mass]])[..., None]
        local = kinematics.local_anchors(Scene((Body("one", "one", (link,)),)), np.array([0]), [point], sizes)
        np.testing.assert_allclose(local[0, :, 0], scaled, atol=1e-6)


@IN_DETAIL
@given(st.floats(1.2, 2.2), st.floats(30.0, 150.0))
def test_a_human_has_its_mass_and_stands_on_its_height(detail: Detail, height: float, mass: float) -> None:
    body = human(height=height, mass=mass, detail=detail)
    assert sum(link.mass for link in body.links) == pytest.approx(mass, rel=1e-3)
    assert standing_height(body) == pytest.approx(standing_height(human()) * height / 1.75)
    assert 0.5 * height < standing_height(body) < 0.6 * height


def joint_heights(body: Body) -> dict[str, float]:
    """Height of each link's joint above the ground in the rest pose [m], and of the top of the head."""
    centres, heights = [standing_height(body)], {}
    for child, joint in enumerate(body.joints, start=1):
        link, parent = body.links[child], body.links[joint.parent]
        up = anchor(joint.parent_anchor, np.array(parent.length), np.array(parent.radius), parent.axis)
        down = anchor(joint.child_anchor, np.array(link.length), np.array(link.radius), link.axis)
        heights[link.name] = centres[joint.parent] + up[2]
        centres.append(heights[link.name] - down[2])
    head = body.links[body.link("head")]
    return heights | {"top": centres[body.link("head")] + 0.5 * head.length + head.radius}


@IN_DETAIL
def test_a_human_is_as_tall_as_it_says(detail: Detail) -> None:
    assert joint_heights(human(height=1.9, detail=detail))["top"] == pytest.approx(1.9, rel=0.005)


@IN_DETAIL
def test_joints_are_at_the_heights_of_drillis_and_contini(detail: Detail) -> None:
    heights = joint_heights(human(height=1.75, detail=detail))
    published = {"left_upper_arm": 0.818, "left_thigh": 0.530, "left_shin": 0.285, "left_foot": 0.039}
    published["left_lower_arm"] = 0.818 - 0.186
    for name, share in published.items():
        assert heights[name] == pytest.approx(share * 1.75, abs=0.01), name


def test_a_full_human_has_26_links_and_what_the_lean_one_has_at_the_same_places() -> None:
    lean, full = human(), human(detail="full")
    assert len(lean.links) == 13 and len(full.links) == 26
    assert {link.name for link in lean.links} < {link.name for link in full.links}
    heights, others = joint_heights(lean), joint_heights(full)
    for name in ("left_upper_arm", "left_lower_arm", "left_thigh", "left_shin", "left_foot", "top"):
        assert others[name] == pytest.approx(heights[name], abs=1e-3), name
    for parts, whole in (
        (("abdomen", "torso", "chest", "left_collar", "right_collar"), ("torso",)),
        (("neck", "head"), ("head",)),
        (("left_lower_arm", "left_hand", "left_fingers", "left_thumb"), ("left_lower_arm",)),
        (("left_foot", "left_toes"), ("left_foot",)),
    ):
        weights = [
            sum(body.links[body.link(name)].mass for name in names) for body, names in ((full, parts), (lean, whole))
        ]
        assert weights[0] == pytest.approx(weights[1], rel=1e-3)


@IN_DETAIL
def test_the_right_side_mirrors_the_left(detail: Detail) -> None:
    body = human(detail=detail)
    for child, joint, motor in body.motors:
        name = body.links[child].name
        if not name.startswith("left_"):
            continue
        other = body.link(name.replace("left_", "right_"))
        twin = body.joints[other - 1]
        assert twin.motor is not None
        assert dataclasses.replace(body.links[other], name=name) == body.links[child]
        np.testing.assert_allclose(twin.parent_anchor, np.multiply(joint.parent_anchor, (1.0, -1.0, 1.0)))
        np.testing.assert_allclose(twin.motor.lower, [-motor.upper[0], motor.lower[1], -motor.upper[2]])


@IN_DETAIL
@given(FACTOR)
def test_segments_are_scaled_by_name(detail: Detail, factor: float) -> None:
    body = human(detail=detail)
    scaled = human(lengths={"thigh": factor}, radii={"foot": factor}, detail=detail)
    for before, after in zip(body.links, scaled.links, strict=True):
        assert after.length == pytest.approx(before.length * (factor if before.name.endswith("thigh") else 1.0))
        assert after.radius == pytest.approx(before.radius * (factor if before.name.endswith("foot") else 1.0))
        assert after.mass == before.mass


@IN_DETAIL
@given(FACTOR)
def test_motors_are_scaled_by_name_beyond_their_proportion(detail: Detail, factor: float) -> None:
    body, scaled = human(height=1.6, detail=detail), human(height=1.6, motors={"shin": factor}, detail=detail)
    assert scaled.links == body.links
    for (child, _, motor), (_, _, before) in zip(scaled.motors, body.motors, strict=True):
        shin = body.links[child].name.endswith("shin")
        assert motor == (before.times(factor) if shin else before)


def test_humans_that_differ_in_sizes_alone_have_one_usual_size() -> None:
    assert usual(human(height=1.6, mass=50.0, lengths={"foot": 1.1})) == usual(human()) == human()
    assert usual(human(height=1.6, detail="full")) == human(detail="full")
    stronger = human(height=1.6, motors={"foot": 2.0})
    assert usual(stronger) == stronger and usual(ball(radius=0.2)) == ball(radius=0.2)


def test_a_ball_is_the_only_body_without_a_direction() -> None:
    assert ball().is_ball and not capsule().is_ball and not chain(links=1).is_ball and not human().is_ball


def test_the_pose_of_angles_has_these_angles() -> None:
    body, random = human(), np.random.default_rng(0)
    angles = random.uniform(-1.0, 1.0, (5, len(body.motors), 3))
    root = Rotation.random(5, rng=random).as_quat(scalar_first=True)
    orientations = body.pose(root, angles)
    np.testing.assert_allclose(orientations[:, 0], root, atol=1e-12)
    np.testing.assert_allclose(body.angles(orientations), angles, atol=1e-12)


def test_a_pose_turns_children_with_their_parents() -> None:
    body = human()
    angles, no_turn = np.zeros((1, len(body.motors), 3)), np.array([[1.0, 0.0, 0.0, 0.0]])
    torso = [child for child, _, _ in body.motors].index(body.link("torso"))
    angles[0, torso] = 0.3, -0.2, 0.5
    orientations, turn = body.pose(no_turn, angles)[0], Rotation.from_rotvec(angles[0, torso])
    for name in ("torso", "head", "left_upper_arm"):
        turned = Rotation.from_quat(orientations[body.link(name)], scalar_first=True)
        np.testing.assert_allclose(turned.as_matrix(), turn.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(orientations[body.link("left_foot")], no_turn[0], atol=1e-12)


def test_the_human_of_a_scene_is_first_and_its_ball_last() -> None:
    scene = human_and_ball()
    assert (scene.human.name, scene.ball.name) == ("human", "ball")
    with pytest.raises(InputError, match=r"begin with 'ball'.*human with motors"):
        _ = scene.only("ball").human
    with pytest.raises(InputError, match=r"end with 'human'.*ball"):
        _ = scene.only("human").ball

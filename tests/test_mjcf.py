"""Humanoids from MJCF: what is said in our links and joints is the same human, all else is refused by name."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from larp_model.bodies import ball, human, kicking, standing_height
from larp_model.engines.mujoco import Truth
from larp_model.errors import InputError
from larp_model.mjcf import humanoid, usual_name
from larp_model.physics.kinematics import displacement
from larp_model.scene import Body, Link, anchor
from tasks.motions.references import standing_on_ground

MUJOCOS = Path(mujoco.__file__).parent / "mjx/test_data/humanoid/humanoid.xml"
# The arms as they are, and stretched out to the sides.
POSES: dict[str, dict[str, Sequence[float]]] = {
    "hanging": {},
    "T": {"left_upper_arm": (np.pi / 2, 0.0, 0.0), "right_upper_arm": (-np.pi / 2, 0.0, 0.0)},
}


def place(link: Link, point: tuple[float, float, float]) -> np.ndarray:
    return anchor(point, np.asarray(link.length), np.asarray(link.radius), link.axis)


def said(numbers: np.ndarray) -> str:
    return " ".join(f"{number:.9g}" for number in numbers)


def mjcf(
    body: Body, turned: Mapping[str, Sequence[float]] = MappingProxyType({}), change: tuple[str, str] = ("", "")
) -> str:
    """A body as MJCF, its limbs turned about their joints by rotation vectors [rad], one text changed for another."""

    def of(row: int) -> str:
        link = body.links[row]
        reach = 0.5 * link.length * np.array(link.axis)
        name = "_".join(reversed(link.name.split("_", 1))) if link.name[:4] in ("left", "righ") else link.name
        at, turn, joint = np.zeros(3), Rotation.from_rotvec(turned.get(link.name, (0.0, 0.0, 0.0))), "<freejoint/>"
        if row:
            tie = body.joints[row - 1]
            own = place(link, tie.child_anchor)
            at = place(body.links[tie.parent], tie.parent_anchor) - turn.apply(own)
            joint = f'<joint name="{name}" type="ball" pos="{said(own)}"/>'
        inner = "".join(of(child) for child, tie in enumerate(body.joints, start=1) if tie.parent == row)
        return (
            f'<body name="{name}" pos="{said(at)}" quat="{said(turn.as_quat(scalar_first=True))}">{joint}'
            f'<geom type="capsule" fromto="{said(-reach)} {said(reach)}" size="{link.radius}" mass="{link.mass}"/>'
            f"{inner}</body>"
        )

    return f"<mujoco><worldbody>{of(0)}</worldbody></mujoco>".replace(*change)


@pytest.mark.parametrize("pose", POSES)
def test_our_own_human_is_read_as_itself_however_its_arms_are_held(pose: str, tmp_path: Path) -> None:
    ours = human(height=1.6, mass=55.0, lengths={"thigh": 1.1}, radii={"torso": 0.9})
    (tmp_path / "ours.xml").write_text(mjcf(ours, POSES[pose]))
    found = humanoid(tmp_path / "ours.xml")
    np.testing.assert_allclose(found.sizes, ours.sizes, rtol=1e-6)
    for one, other in zip(found.joints, ours.joints, strict=True):
        assert one.parent == other.parent
        np.testing.assert_allclose(one.parent_anchor, other.parent_anchor, atol=1e-5)
        np.testing.assert_allclose(one.child_anchor, other.child_anchor, atol=1e-5)
        assert one.motor is not None and other.motor is not None
        assert one.motor.stiffness == pytest.approx(other.motor.stiffness, rel=1e-6)


@pytest.mark.parametrize("turn", [(0, 0, 90), (0, 0, 180), (0, 90, 0), (-90, 0, 0), (90, 90, 0), (0, 0, 35)])
def test_a_humanoid_is_read_alike_wherever_it_faces_and_if_it_lies(
    turn: tuple[float, float, float], tmp_path: Path
) -> None:
    (tmp_path / "turned.xml").write_text(mjcf(human(), {"pelvis": np.radians(turn).tolist()}))
    found, ours = humanoid(tmp_path / "turned.xml"), human()
    np.testing.assert_allclose(found.sizes, ours.sizes, rtol=1e-5)
    for one, other in zip(found.joints, ours.joints, strict=True):
        np.testing.assert_allclose(one.parent_anchor, other.parent_anchor, atol=1e-5)
        np.testing.assert_allclose(one.child_anchor, other.child_anchor, atol=1e-5)


def test_exchanged_sides_are_refused(tmp_path: Path) -> None:
    content = re.sub("_(left|right)", lambda side: {"_left": "_right", "_right": "_left"}[side[0]], mjcf(human()))
    (tmp_path / "exchanged.xml").write_text(content)
    with pytest.raises(InputError, match="has feet that point backwards: its left and right are exchanged"):
        humanoid(tmp_path / "exchanged.xml")


def test_mujocos_own_humanoid_keeps_mass_bones_and_volume_and_stands() -> None:
    model, found = mujoco.MjModel.from_xml_path(str(MUJOCOS)), humanoid(MUJOCOS)
    assert sum(link.mass for link in found.links) == pytest.approx(model.body_mass.sum())
    thigh, shin = found.links[found.link("left_thigh")], found.link("left_shin")
    hip, knee = found.joints[found.link("left_thigh") - 1], found.joints[shin - 1]
    bone = place(thigh, knee.parent_anchor) - place(thigh, hip.child_anchor)
    assert np.linalg.norm(bone) == pytest.approx(np.hypot(0.01, 0.38), abs=1e-6)  # 0.4 m, the knee 2 cm above its end
    foot = found.links[found.link("left_foot")]
    volume = np.pi * foot.radius**2 * (foot.length + 4.0 / 3.0 * foot.radius)
    one = np.pi * 0.027**2 * (np.hypot(0.21, 0.02) + 4.0 / 3.0 * 0.027)
    assert volume == pytest.approx(2.0 * one, rel=1e-6)
    assert found.joints[found.link("head") - 1].motor.upper == (0.0, 0.0, 0.0)  # type: ignore[union-attr]  # welded
    scene = kicking(found, ball())
    truth = Truth(scene)
    truth.reset(standing_on_ground(scene, np.zeros((1, len(scene.motors), 3)), Rotation.identity(1)))
    assert (
        np.abs(np.asarray(displacement(scene, jnp.asarray(truth.state()), jnp.asarray(scene.morphology)))).max() < 1e-6
    )
    assert truth.state()[0, 0, 2] == pytest.approx(standing_height(found), abs=1e-6)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (('name="head"', 'name="skull"'), "has no body for 'head', but needs one; it has pelvis, torso, skull"),
        (('name="thigh_left"', 'name="upper_leg_right"'), "no body for 'left_thigh'"),
        (('name="thigh_left"', 'name="a&#10;b"'), "no body for 'left_thigh', but needs one; it has .*a b"),
        (('<joint name="shin_left" type="ball"', '<joint name="shin_left" type="slide"'), "'shin_left' is a slide"),
        (('<geom type="capsule"', '<geom size="1e9"/><geom type="capsule"'), r"'pelvis' reaches to 1e.09 m"),
        (('<geom type="capsule"', '<geom type="cylinder"'), "a geom of 'pelvis' is a cylinder, but must be a capsule"),
        (
            ("</worldbody>", '</worldbody><equality><joint joint1="a" joint2="b"/></equality>'),
            "is no MJCF file that MuJoCo reads",
        ),
        (
            ("</worldbody>", '</worldbody><equality><weld body1="head" body2="pelvis"/></equality>'),
            "has 1 equality constraints, but only joints can tie links",
        ),
        (("<worldbody>", '<worldbody><body name="cart"><geom size="1"/></body>'), "'cart' is none of a human's links"),
    ],
)
def test_what_is_no_human_of_ours_is_refused_by_name(change: tuple[str, str], complaint: str, tmp_path: Path) -> None:
    (tmp_path / "other.xml").write_text(mjcf(human(), change=change))
    with pytest.raises(InputError, match=complaint) as caught:
        humanoid(tmp_path / "other.xml")
    assert "\n" not in str(caught.value)


def test_bodies_of_any_name_can_be_said_to_be_our_links(tmp_path: Path) -> None:
    (tmp_path / "other.xml").write_text(mjcf(human(), change=('name="head"', 'name="skull"')))
    assert humanoid(tmp_path / "other.xml", {"head": "skull"}).sizes == pytest.approx(human().sizes)
    with pytest.raises(InputError, match=r"names is 'haed', .* did you mean 'head'\?"):
        humanoid(tmp_path / "other.xml", {"haed": "skull"})


@pytest.mark.parametrize(
    ("theirs", "ours"),
    [
        ("L_Thigh", "left_thigh"),
        ("rightUpperArm", "right_upper_arm"),
        ("lower_arm_left", "left_lower_arm"),
        ("right_uarm", "right_upper_arm"),
        ("calf_r", "right_shin"),
        ("Hips", "pelvis"),
        ("thigh", None),
        ("left_pelvis", None),
        ("waist_lower", None),
    ],
)
def test_names_of_bodies_are_understood(theirs: str, ours: str | None) -> None:
    assert usual_name(theirs) == ours


def test_a_file_that_is_no_text_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "other.xml").write_bytes(
        mjcf(human()).replace("head", "\N{LATIN SMALL LETTER E WITH ACUTE}").encode("latin1")
    )
    with pytest.raises(InputError, match=r"other\.xml is no MJCF file that MuJoCo reads: 'utf-8' codec") as caught:
        humanoid(tmp_path / "other.xml")
    assert "\n" not in str(caught.value)

"""Motions from elsewhere: skeletons of other names, without a T-pose, with positions, and joint angles as arrays."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation
from test_bvh import CLIPS, STANDING, swing, text, with_clips

from larp_model.bodies import human
from larp_model.errors import InputError
from larp_model.scene import Scene
from tasks.motions import angles, bvh, joint_names, references, rest_pose, skeleton
from tasks.motions.skeleton import Motion

LINKS = [human().links[child].name for child, _, _ in human().motors]
LOWER, UPPER = (np.array([getattr(motor, end) for _, _, motor in human().motors]) for end in ("lower", "upper"))


def renamed(content: str, table: dict[str, str]) -> str:
    """The BVH text with its joints called otherwise."""
    words = {f"{kind} {ours}\n": f"{kind} {theirs}\n" for ours, theirs in table.items() for kind in ("ROOT", "JOINT")}
    for old, new in words.items():
        content = content.replace(old, new)
    return content


def written(folder: Path, content: str) -> Path:
    path = folder / "clip.bvh"
    path.write_text(content)
    return path


def retargeted(motion: Motion) -> np.ndarray:
    return skeleton.retarget(motion, human(), 0.01)[1]


MIXAMO = {name: f"mixamorig:{name}" for name in skeleton.NEEDED}
OWN = {"Hips": "pelvis", "RightFoot": "r_ankle", "LeftArm": "Hips"}


@pytest.mark.parametrize("table", [*joint_names.SKELETONS.values(), MIXAMO], ids=[*joint_names.SKELETONS, "Mixamo"])
def test_known_skeletons_move_as_ours_and_are_mirrored(tmp_path: Path, table: dict[str, str]) -> None:
    ours = bvh.load(written(tmp_path, text(*swing(10, "Left"))))
    theirs = bvh.load(written(tmp_path, renamed(text(*swing(10, "Left")), table)))
    np.testing.assert_array_equal(retargeted(theirs), retargeted(ours))
    assert skeleton.kicking_side(theirs) == "Left" and skeleton.kicking_side(skeleton.mirrored(theirs)) == "Right"


def test_ones_own_table_says_what_joints_are_called(tmp_path: Path) -> None:
    plain = text(*swing(10))
    ours, path = bvh.load(written(tmp_path, plain)), written(tmp_path, renamed(plain, OWN))
    np.testing.assert_array_equal(retargeted(bvh.load(path, OWN)), retargeted(ours))
    (tmp_path / "names.json").write_text(json.dumps(OWN))
    assert joint_names.names_in(tmp_path / "names.json") == OWN


@pytest.mark.parametrize(
    ("names", "complaint"),
    [
        (None, "clip.bvh has no joints Hips, RightFoot, but needs them"),
        (
            {"Hips": "pelvis", "RightFoot": "r_foot"},
            "has no joints r_foot, .* calls RightFoot: it has pelvis, Spine",
        ),
        ({"Pelvis": "pelvis"}, "names has Pelvis, but needs a file's names of Hips"),
        ({"LeftLeg": "knee", "RightLeg": "knee"}, "names has 'knee' for LeftLeg and RightLeg"),
    ],
)
def test_joints_that_are_not_there_are_named(tmp_path: Path, names: dict[str, str] | None, complaint: str) -> None:
    path = written(tmp_path, renamed(text(*swing(10)), {"Hips": "pelvis", "RightFoot": "r_ankle"}))
    with pytest.raises(InputError, match=complaint) as refusal:
        bvh.load(path, names)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("content", ["{", "[]", '{"Hips": 3}'])
def test_a_table_that_is_none_is_refused_in_one_line(tmp_path: Path, content: str) -> None:
    path = tmp_path / "names.json"
    path.write_text(content)
    with pytest.raises(InputError, match=r"^names: names\.json (is no JSON file|needs an object)"):
        joint_names.names_in(path)
    with pytest.raises(InputError, match="no such file"):
        joint_names.names_in(tmp_path / "none.json")


def test_joints_may_have_positions_too(tmp_path: Path) -> None:
    plain = text(*swing(10))
    motion = bvh.load(written(tmp_path, plain))
    head = plain.replace(
        "OFFSET 0 45 0\nCHANNELS 3 Zrotation", "OFFSET 0 45 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation"
    )
    hierarchy, rows = head.split("Frame Time: 0.01\n")
    # The head follows the root and the spine: three channels before its own, after nine.
    rows = "\n".join(" ".join([*row.split()[:9], "0", "45", "0", *row.split()[9:]]) for row in rows.splitlines())
    same = bvh.load(written(tmp_path, f"{hierarchy}Frame Time: 0.01\n{rows}\n"))
    np.testing.assert_allclose(same.positions, motion.positions, atol=1e-12)
    np.testing.assert_array_equal(retargeted(same), retargeted(motion))


def reframed(motion: Motion, turns: Rotation) -> Motion:
    """The same motion, each joint's frame turned in its own way: no pose of it looks like a T-pose any more."""
    own = [motion.rotation(name) * turn for name, turn in zip(motion.names, turns, strict=True)]
    return replace(motion, orientations=np.stack([each.as_quat(scalar_first=True) for each in own], axis=1))


def rested(motion: Motion) -> Motion:
    """The motion in the frames that it is told to have in a T-pose."""
    rest = rest_pose.rest_orientations(motion)
    own = [motion.rotation(name) * turn.inv() for name, turn in zip(motion.names, rest, strict=True)]
    return replace(motion, orientations=np.stack([each.as_quat(scalar_first=True) for each in own], axis=1))


def walking(frames: int) -> list[dict[str, tuple[float, float, float]]]:
    """Knees and elbows bend, and the person leans neither way."""
    phase = np.linspace(0.0, 4.0 * np.pi, frames)
    return [
        STANDING
        | {
            f"{side}{joint}": tuple(np.array(axis) * size * (1.0 + sign * np.sin(now)) / 2.0)
            for side, sign in (("Left", 1.0), ("Right", -1.0))
            for joint, axis, size in (
                ("UpLeg", (0, 0, 1), -40.0),
                ("Leg", (0, 0, 1), 60.0),
                ("ForeArm", (0, -sign, 0), 70.0),
            )
        }
        for now in phase
    ]


@given(seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_without_a_t_pose_a_skeleton_moves_as_with_one(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    path = written(tmp_path_factory.mktemp("walk"), text({}, *walking(60)))
    motion = bvh.load(path)
    turns = Rotation.random(len(motion.names), random_state=seed)
    found, expected = retargeted(rested(reframed(motion, turns))), retargeted(motion)
    assert np.degrees(np.abs(found - expected)).max() < 2.0


def test_too_few_frames_make_no_rest_pose(tmp_path: Path) -> None:
    lying = {"Hips": (90.0, 0.0, 0.0), "LeftArm": (80.0, 0.0, 0.0)}
    path = written(tmp_path, text(lying, *[lying] * 5).replace("OFFSET 28 0 0", "OFFSET 0 0 28"))
    with pytest.raises(InputError, match=r"has no rest pose: .* 6 frames are too few"):
        bvh.load(path)


@with_clips
@pytest.mark.parametrize("name", ["10_01", "10_04"])
def test_without_a_t_pose_captured_legs_move_as_with_one(name: str) -> None:
    motion = bvh.load(CLIPS / f"{name}.bvh")
    turns = Rotation.random(len(motion.names), random_state=1)
    apart = np.degrees(np.abs(retargeted(rested(reframed(motion, turns))) - retargeted(motion)))
    middle = dict(zip(LINKS, np.median(apart, axis=0).max(axis=-1), strict=True))
    for side in ("left", "right"):
        assert middle[f"{side}_thigh"] < 4.0 and middle[f"{side}_shin"] < 1.0 and middle[f"{side}_foot"] < 8.0


@given(
    share=arrays(float, (12, 12, 3), elements=st.floats(0.0, 1.0)),
    turns=st.integers(0, 1000),
    mixed=st.permutations(range(12)),
)
@settings(max_examples=20, deadline=None)
def test_joint_angles_come_back_as_they_were(share: np.ndarray, turns: int, mixed: list[int]) -> None:
    given_angles = LOWER + share * (UPPER - LOWER)
    # A turn by more than half a circle comes back as the shorter one.
    given_angles *= np.minimum(1.0, 3.0 / np.maximum(np.linalg.norm(given_angles, axis=-1, keepdims=True), 1e-9))
    root = Rotation.random(12, random_state=turns)
    joints = [LINKS[row] for row in mixed]
    made = angles.motion(100.0, np.zeros((12, 3)), root.as_quat(scalar_first=True), given_angles[:, mixed], joints)
    orientation, found = skeleton.retarget(made, human(), 0.01)
    np.testing.assert_allclose(found, given_angles, atol=1e-9)
    assert (Rotation.from_quat(orientation, scalar_first=True).inv() * root).magnitude().max() < 1e-7
    for child, parent in enumerate(made.parents[1:], start=1):
        bone = made.rotation(made.names[parent]).apply(made.offsets[child])
        np.testing.assert_allclose(made.positions[:, child], made.positions[:, parent] + bone, atol=1e-9)


def fields(frames: int = 20) -> dict[str, np.ndarray]:
    return {
        "rate": np.array(100.0),
        "position": np.zeros((frames, 3)),
        "orientation": np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1)),
        "angles": np.zeros((frames, 12, 3)),
    }


def test_an_npz_file_is_a_motion_and_its_left_foot_may_kick(tmp_path: Path) -> None:
    given_fields, left, right = fields(), LINKS.index("left_thigh"), LINKS.index("right_thigh")
    given_fields["angles"][:, left, 1] = -1.5 * np.linspace(0.0, 1.0, 20) ** 2
    np.savez(tmp_path / "kick.npz", **given_fields)  # type: ignore[arg-type]
    motion = angles.load(tmp_path / "kick.npz")
    assert skeleton.kicking_side(motion) == "Left"
    found = retargeted(skeleton.mirrored(motion))
    np.testing.assert_allclose(found[:, right], given_fields["angles"][:, left], atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "complaint"),
    [
        ({"angles": None}, "has no angles: it needs rate, position, orientation, angles"),
        ({"angles": np.zeros((20, 11, 3))}, r"angles has shape \(20, 11, 3\), but needs \(T, 12, 3\)"),
        ({"position": np.zeros((19, 3))}, "orientation has shape"),
        ({"position": np.full((20, 3), np.nan)}, "position holds numbers that are not finite"),
        ({"orientation": np.ones((20, 4))}, "orientation holds quaternions that are not of length 1"),
        ({"rate": np.array(3.0)}, "rate is 3, but must be from 10 to 1000"),
        ({"joints": np.array(["left_wing"])}, "joints are left_wing, but must be torso, head"),
        ({"angles": np.array([{}])}, "is no npz file of numbers and names"),
    ],
)
def test_arrays_that_are_no_motion_are_refused_in_one_line(
    tmp_path: Path, changed: dict[str, np.ndarray | None], complaint: str
) -> None:
    kept = {name: value for name, value in (fields() | changed).items() if value is not None}
    np.savez(tmp_path / "kick.npz", **kept)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=complaint) as refusal:
        angles.load(tmp_path / "kick.npz")
    assert "\n" not in str(refusal.value) and "kick.npz" in str(refusal.value)


def kicking(before: int, lying: bool = False) -> Motion:
    """One who stands, or lies, and swings the right leg, fastest after so many of 40 frames."""
    given_fields, thigh = fields(), LINKS.index("right_thigh")
    for name in ("position", "orientation", "angles"):
        given_fields[name] = np.repeat(given_fields[name][:1], 40, axis=0)
    given_fields["angles"][:, thigh, 1] = -np.tanh((np.arange(40) - before) / 8.0)
    if lying:
        given_fields["orientation"][:] = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
    return angles.motion(**given_fields)  # type: ignore[arg-type]


def test_a_kick_that_begins_with_its_strike_or_of_one_who_lies_is_refused_before_it_is_performed(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    class PerformedError(Exception):
        pass

    def perform(*arguments: object) -> None:
        raise PerformedError

    monkeypatch.setattr(references, "Tracker", perform)
    with pytest.raises(PerformedError):
        references.captured(kicking(20), scene)
    with pytest.raises(InputError, match=r"the motion begins 0\.0\d s before its strike, but needs 0\.11 s"):
        references.captured(kicking(1), scene)
    with pytest.raises(InputError, match=r"no kick of one who stands: .*is the file's up axis another one\?"):
        references.captured(kicking(20, lying=True), scene)

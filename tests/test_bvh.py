"""BVH files: forward kinematics, refusals, mirroring, retargeting; with captured clips where they are at hand."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from larp_model.bodies import human
from larp_model.errors import InputError
from larp_model.scene import Scene
from tasks.benchmarks import reference as benchmark
from tasks.motions import angles, bvh, skeleton
from tasks.motions.references import MOST_BEYOND, captured

CLIPS = Path(__file__).parents[2] / "shared" / "mocap"
with_clips = pytest.mark.skipif(not CLIPS.is_dir(), reason="no captured clips in ../shared/mocap")

# A skeleton in centimetres, y up, facing z: joint, parent, offset.
SKELETON = [
    ("Hips", None, (0, 0, 0)),
    ("Spine", "Hips", (0, 15, 0)),
    ("Head", "Spine", (0, 45, 0)),
    *(
        joint
        for side, x in (("Left", 1), ("Right", -1))
        for joint in (
            (f"{side}Arm", "Spine", (18 * x, 35, 0)),
            (f"{side}ForeArm", f"{side}Arm", (28 * x, 0, 0)),
            (f"{side}Hand", f"{side}ForeArm", (25 * x, 0, 0)),
            (f"{side}UpLeg", "Hips", (9 * x, -8, 0)),
            (f"{side}Leg", f"{side}UpLeg", (0, -40, 0)),
            (f"{side}Foot", f"{side}Leg", (0, -42, 0)),
            (f"{side}ToeBase", f"{side}Foot", (0, -5, 14)),
        )
    ),
]
NAMES = [name for name, _, _ in SKELETON]
THIGH, SHIN = 0.40, 0.42
Turns = dict[str, tuple[float, float, float]]


def text(*frames: Turns, place: tuple[float, float, float] = (0.0, 95.0, 0.0)) -> str:
    """The skeleton as BVH; a frame gives joints' angles about z, y, x [deg], in this order."""

    def branch(name: str) -> str:
        offset = next(offset for joint, _, offset in SKELETON if joint == name)
        position = "" if name != "Hips" else "Xposition Yposition Zposition "
        children = [joint for joint, parent, _ in SKELETON if parent == name]
        inner = "".join(f"JOINT {child}\n{branch(child)}" for child in children)
        inner = inner or "End Site\n{\nOFFSET 0 0 5\n}\n"
        channels = f"CHANNELS {6 if position else 3} {position}Zrotation Yrotation Xrotation\n"
        return f"{{\nOFFSET {' '.join(map(str, offset))}\n{channels}{inner}}}\n"

    hierarchy = f"HIERARCHY\nROOT Hips\n{branch('Hips')}"
    order = [word for word in hierarchy.split() if word in NAMES]
    rows = [
        " ".join(map(str, (*place, *(angle for name in order for angle in frame.get(name, (0, 0, 0))))))
        for frame in frames
    ]
    return f"{hierarchy}MOTION\nFrames: {len(rows)}\nFrame Time: 0.01\n" + "\n".join(rows) + "\n"


# Arms down at the sides: the human's rest pose.
STANDING: Turns = {"LeftArm": (-90, 0, 0), "RightArm": (90, 0, 0)}


@pytest.fixture
def load(tmp_path: Path) -> Callable[[str], skeleton.Motion]:
    """Reads a motion from text."""

    def from_text(content: str) -> skeleton.Motion:
        path = tmp_path / "clip.bvh"
        path.write_text(content, encoding="utf-8")
        return bvh.load(path)

    return from_text


def swing(frames: int, side: str = "Right") -> list[Turns]:
    """Somebody whose thigh swings forwards, fastest in the middle; first the T-pose."""
    angles = 60.0 * np.tanh(np.linspace(-3.0, 3.0, frames))
    return [{}, *(STANDING | {f"{side}UpLeg": (0.0, 0.0, -angle), f"{side}Leg": (0.0, 0.0, 20.0)} for angle in angles)]


@given(thigh=st.floats(-90, 90), roll=st.floats(-40, 40), shin=st.floats(0, 120), heading=st.floats(-180, 180))
def test_forward_kinematics_of_a_leg(
    tmp_path_factory: pytest.TempPathFactory, thigh: float, roll: float, shin: float, heading: float
) -> None:
    path = tmp_path_factory.mktemp("leg") / "leg.bvh"
    frame = {"Hips": (0.0, heading, 0.0), "LeftUpLeg": (roll, 0.0, thigh), "LeftLeg": (0.0, 0.0, shin)}
    path.write_text(text({}, frame, place=(30.0, 95.0, -20.0)))
    motion = bvh.load(path)
    pelvis = Rotation.from_euler("z", heading, degrees=True)
    hip = np.array([-0.20, 0.30, 0.95]) + pelvis.apply([0.0, 0.09, -0.08])
    upper = pelvis * Rotation.from_euler("XY", [roll, thigh], degrees=True)
    knee = hip + upper.apply([0.0, 0.0, -THIGH])
    ankle = knee + (upper * Rotation.from_euler("y", shin, degrees=True)).apply([0.0, 0.0, -SHIN])
    assert motion.rate == pytest.approx(100.0)
    for joint, expected in (("LeftUpLeg", hip), ("LeftLeg", knee), ("LeftFoot", ankle)):
        np.testing.assert_allclose(motion.path(joint), [expected], atol=1e-9)


def test_positions_follow_from_orientations_and_offsets(load: Callable[[str], skeleton.Motion]) -> None:
    motion = load(text(*swing(20)))
    for child, parent in enumerate(motion.parents[1:], start=1):
        bone = motion.rotation(motion.names[parent]).apply(motion.offsets[child])
        np.testing.assert_allclose(motion.positions[:, child], motion.positions[:, parent] + bone, atol=1e-9)


def test_first_frame_is_left_out_only_if_it_is_a_t_pose(load: Callable[[str], skeleton.Motion]) -> None:
    assert len(load(text({}, STANDING, STANDING)).positions) == 2
    assert len(load(text(STANDING, STANDING, STANDING)).positions) == 3


@pytest.mark.parametrize("heading", [0.0, 70.0])
def test_rest_pose_may_face_anywhere(load: Callable[[str], skeleton.Motion], heading: float) -> None:
    turned = {"Hips": (0.0, heading, 0.0)}
    motion = load(text(turned, turned | STANDING))
    expected = Rotation.from_euler("z", heading, degrees=True).as_matrix()
    np.testing.assert_allclose(motion.rotation("Hips").as_matrix(), [expected], atol=1e-12)


GOOD = text({}, STANDING, STANDING)


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "HIERARCHY"),
        ("a picture\n", "HIERARCHY"),
        (GOOD.replace("MOTION", "NOTION"), "MOTION"),
        (GOOD.replace("Frames: 3", "Frames: many"), "frames"),
        (GOOD.replace("Frames: 3", "Frames: 5"), "3 frames, but announces 5"),
        (GOOD[: GOOD.index("Frame Time")] + "Frame Time: 0.01\n", "no frames"),
        (text({}), "no frames but the T-pose"),
        (GOOD.replace("0.01", "0"), "Frame Time"),
        (GOOD.replace("95.0", "nan", 1), "not finite"),
        (GOOD.replace("95.0", "1e300", 1), "not finite"),
        (GOOD.replace("95.0", "up", 1), "not a number"),
        (GOOD.replace("95.0", "", 1), "columns"),
        (GOOD.replace("OFFSET 0 15 0", "OFFSET 0 15"), "Spine"),
        (GOOD.replace("Xposition", "Xscale"), "channels"),
        (GOOD.replace("Zrotation Yrotation", "Zrotation Zrotation", 1), "channels"),
        (GOOD.replace("CHANNELS 3", "CHANNELS 6", 1), "channels"),
        (GOOD.replace("RightToeBase", "RightToes"), "RightToeBase"),
        (GOOD.replace("LeftUpLeg", "LeftThigh").replace("Head", "Hat"), "Head, LeftUpLeg"),
        (GOOD.replace("}", "", 1), "HIERARCHY"),
        (GOOD.replace("Hips", "x").replace("LeftArm", "Hips").replace("x", "LeftArm", 1), "no chest"),
        (GOOD.replace("RightHand", "LeftHand"), "two joints of one name"),
        (GOOD.replace("OFFSET 0 -40 0", "OFFSET 0 -400 0"), "units"),
        (text({"Hips": (90, 0, 0)}, {}).replace("OFFSET 28 0 0", "OFFSET 0 0 28"), "T-pose"),
    ],
)
def test_refused_in_one_line(load: Callable[[str], skeleton.Motion], content: str, expected: str) -> None:
    with pytest.raises(InputError, match=expected) as refusal:
        load(content)
    assert str(refusal.value).startswith("clip.bvh ") and "\n" not in str(refusal.value)


def axes_exchanged(content: str, order: tuple[int, int, int], signs: tuple[int, int, int]) -> str:
    """The text in other axes: its numbers x, y, z in this order and with these signs."""
    names = np.array(["X", "Y", "Z"])[list(order)]
    hierarchy, frames = content.split("Frame Time: 0.01\n")
    lines = []
    for line in hierarchy.splitlines():
        words = line.split()
        if words and words[0] == "OFFSET":
            values = np.array(words[1:], float)[list(order)] * signs
            line = "OFFSET " + " ".join(map(str, values))
        elif words and words[0] == "CHANNELS":
            line = " ".join(
                "XYZ"[list(names).index(word[0])] + word[1:] if word[0] in "XYZ" else word for word in words
            )
        lines.append(line)
    handed = np.prod(signs) * (1 if order in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) else -1)
    channels = [word for line in content.splitlines() if line.startswith("CHANNELS") for word in line.split()[2:]]
    factor = [
        signs[list(names).index(channel[0])] * (1 if channel.endswith("position") else handed) for channel in channels
    ]
    rows = [" ".join(map(str, np.array(row.split(), float) * factor)) for row in frames.splitlines()]
    return "\n".join(lines) + "\nFrame Time: 0.01\n" + "\n".join(rows) + "\n"


SWING = text(*swing(20))


@pytest.mark.parametrize(
    ("order", "signs"), [((0, 2, 1), (1, -1, 1)), ((1, 2, 0), (1, 1, 1)), ((0, 1, 2), (1, -1, -1))]
)
def test_the_axis_along_which_the_head_is_above_the_feet_is_up(
    load: Callable[[str], skeleton.Motion], order: tuple[int, int, int], signs: tuple[int, int, int]
) -> None:
    motion, other = load(SWING), load(axes_exchanged(SWING, order, signs))
    for name in ("Head", "RightToeBase"):
        np.testing.assert_allclose(other.path(name)[:, 2], motion.path(name)[:, 2], atol=1e-9)
    (_, expected), (_, vectors) = (skeleton.retarget(each, human(), 0.01) for each in (motion, other))
    np.testing.assert_allclose(vectors, expected, atol=1e-6)


def test_left_handed_axes_are_refused_in_one_line(load: Callable[[str], skeleton.Motion]) -> None:
    with pytest.raises(InputError, match="has feet that point backwards: its axes are left-handed") as refusal:
        load(axes_exchanged(SWING, (0, 1, 2), (-1, 1, 1)))
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("unit", [0.01, 0.0254, 0.001, 0.3048, 1.0])
def test_the_length_of_the_legs_tells_the_unit(load: Callable[[str], skeleton.Motion], unit: float) -> None:
    factor = 0.01 / unit
    lines = [
        "OFFSET " + " ".join(str(factor * float(word)) for word in line.split()[1:])
        if line.startswith("OFFSET")
        else line
        for line in SWING.splitlines()
    ]
    assert load("\n".join(lines) + "\n").hip_height == pytest.approx(load(SWING).hip_height, rel=1e-6)


@pytest.mark.parametrize(
    "changed",
    [
        "\ufeff" + SWING,
        SWING.replace("\n", "\r\n"),
        SWING.replace("Frames: 21", "Frames:21").replace("Frame Time: ", "Frame Time:"),
        SWING.replace("Frames: 21", "Frames: 20"),
        SWING.replace("Frames: 21", "Frames: 22"),
        *(
            SWING.replace("ROOT ", f"ROOT {prefix}").replace("JOINT ", f"JOINT {prefix}")
            for prefix in ("Character1_", "Bip01_", "mixamorig:", "a_b_", "Bip01 ", "my own_rig ")
        ),
    ],
)
def test_what_writers_do_differently_changes_nothing(load: Callable[[str], skeleton.Motion], changed: str) -> None:
    motion, other = load(SWING), load(changed)
    assert other.names == motion.names
    np.testing.assert_array_equal(other.orientations, motion.orientations)


BIPED = {"UpLeg": "Thigh", "Leg": "Calf", "Foot": "Foot", "ToeBase": "Toe0", "Arm": "UpperArm", "ForeArm": "Forearm"}


def test_names_with_spaces_are_those_of_a_biped(load: Callable[[str], skeleton.Motion]) -> None:
    content = SWING
    for joint in NAMES:
        side = next((side for side in ("Left", "Right") if joint.startswith(side)), "")
        part = joint.removeprefix(side)
        own = f"{side[0]} {BIPED.get(part, part)}" if side else {"Hips": "Pelvis"}.get(part, part)
        content = re.sub(rf"(ROOT|JOINT) {joint}\n", rf"\1 Bip01 {own}\n", content)
    motion, other = load(SWING), load(content)
    assert other.names == motion.names
    np.testing.assert_array_equal(other.orientations, motion.orientations)


@pytest.mark.parametrize("counted", [False, True])
def test_the_offset_of_the_root_counts_where_the_feet_are_nearer_to_the_ground_then(
    load: Callable[[str], skeleton.Motion], counted: bool
) -> None:
    """Some files count the root's positions from its offset, others repeat the offset in them."""
    moved = SWING.replace("OFFSET 0 0 0\n", "OFFSET 0 95 0\n", 1)
    if counted:
        moved = re.sub(r"^0.0 95.0 0.0 ", "0.0 0.0 0.0 ", moved, flags=re.MULTILINE)
    np.testing.assert_allclose(load(moved).positions, load(SWING).positions, atol=1e-9)


@pytest.mark.parametrize("slant", [-20.0, -8.0, 0.0, 8.0, 20.0])
def test_feet_that_slant_with_the_legs_of_the_t_pose_are_level_where_the_person_stands(
    load: Callable[[str], skeleton.Motion], slant: float
) -> None:
    """The leg with its foot is turned about the axis ahead in the pose without rotations, and back in every frame."""
    content = text(*swing(20)[1:])
    for sign in (1, -1):
        turn = Rotation.from_euler("z", sign * slant, degrees=True)
        for offset in ((0, -40, 0), (0, -42, 0), (0, -5, 14)):
            for side in ("Left", "Right")[::sign][:1]:
                begin = content.index(f"JOINT {side}UpLeg")
                slanted = " ".join(f"{value:.9f}" for value in turn.apply(offset))
                leg = content[begin:].replace(f"OFFSET {' '.join(map(str, offset))}\n", f"OFFSET {slanted}\n", 1)
                content = content[:begin] + leg
    order = re.findall(r"(?:ROOT|JOINT) (\w+)", content)
    hierarchy, frames = content.split("Frame Time: 0.01\n")
    rows = []
    for line in frames.splitlines():
        values = np.array(line.split(), float)
        for sign, side in ((1, "Left"), (-1, "Right")):
            turn = Rotation.from_euler("z", sign * slant, degrees=True)
            for joint in ("UpLeg", "Leg", "Foot", "ToeBase"):
                column = 3 + 3 * order.index(side + joint)
                own = Rotation.from_euler("ZYX", values[column : column + 3], degrees=True)
                local = own * turn.inv() if joint == "UpLeg" else turn * own * turn.inv()
                values[column : column + 3] = local.as_euler("ZYX", degrees=True)
        rows.append(" ".join(map(str, values)))
    other = load(hierarchy + "Frame Time: 0.01\n" + "\n".join(rows) + "\n")
    (_, expected), (_, vectors) = (
        skeleton.retarget(each, human(), 0.01) for each in (load(text(*swing(20)[1:])), other)
    )
    np.testing.assert_allclose(vectors, expected, atol=1e-6)


@pytest.mark.parametrize(
    ("order", "signs", "up"),
    [
        ((0, 1, 2), (1, 1, 1), "y"),
        ((0, 2, 1), (1, -1, 1), "z"),
        ((1, 2, 0), (1, 1, 1), "x"),
        ((0, 1, 2), (1, -1, -1), "-y"),
    ],
)
def test_what_a_file_was_taken_for_is_said(
    load: Callable[[str], skeleton.Motion], order: tuple[int, int, int], signs: tuple[int, int, int], up: str
) -> None:
    assert load(axes_exchanged(SWING, order, signs)).read == f"{up} up, in cm, rest pose: T-pose first"


def test_a_leg_that_is_turned_in_the_rest_pose_shows_in_a_knee_beyond_its_bounds(
    load: Callable[[str], skeleton.Motion],
) -> None:
    bent = [frame | {"RightLeg": (0.0, 0.0, 40.0)} for frame in swing(20)[1:]]
    beyond = {
        turn: skeleton.beyond_bounds(load(text({"RightUpLeg": (0.0, turn, 0.0)}, *bent)), human(), 0.01)
        for turn in (0.0, 180.0)
    }
    assert max(beyond[0.0].values()) < 0.1
    assert beyond[180.0]["right_shin"] > MOST_BEYOND


def test_conventions_can_be_said_instead(tmp_path: Path) -> None:
    path = tmp_path / "clip.bvh"
    path.write_text(SWING)
    said = bvh.load(path, {"up": "y", "unit": "cm", "rest": "T-pose"})
    assert said.read == "y up, in cm, rest pose: T-pose"
    assert len(said.positions) == len(bvh.load(path).positions) + 1
    for names, message in (
        ({"up": "w"}, "names: up is 'w', but must be one of y, -y, z"),
        ({"unit": "mm"}, "has legs 82 units long, but needs 0.6 to 1.2 m in mm"),
        ({"rest": "A-pose"}, "names: rest is 'A-pose', but must be one of T-pose first, T-pose, arms down, estimated"),
    ):
        with pytest.raises(InputError, match=message):
            bvh.load(path, names)


CLASSIC = {"UpLeg": "Hip", "Leg": "Knee", "Foot": "Ankle", "Arm": "Shoulder", "ForeArm": "Elbow", "Hand": "Wrist"}


def with_toes_at_end_sites(content: str, names: dict[str, str]) -> str:
    """The text without joints at the toes, where the feet end instead; names: of joints without their sides."""
    for side in ("Left", "Right"):
        begin = content.index(f"JOINT {side}ToeBase")
        end = content.index("}\n}\n", begin) + 4
        offset = content[content.index("OFFSET", begin) : content.index("CHANNELS", begin)]
        content = content[:begin] + f"End Site\n{{\n{offset}}}\n" + content[end:]
    hierarchy, frames = content.split("Frame Time: 0.01\n")
    for own, other in names.items():
        for side in ("Left", "Right"):
            hierarchy = hierarchy.replace(f"JOINT {side}{own}\n", f"JOINT {side}{other}\n")
    order = [name for name in re.findall(r"(?:ROOT|JOINT) (\w+)", SWING)]
    columns = [0, 1, 2] + [
        3 + 3 * row + axis for row, name in enumerate(order) if "ToeBase" not in name for axis in range(3)
    ]
    rows = [" ".join(np.array(row.split())[columns]) for row in frames.splitlines()]
    return hierarchy + "Frame Time: 0.01\n" + "\n".join(rows) + "\n"


@pytest.mark.parametrize("names", [{}, CLASSIC], ids=["ours", "Biovision's"])
def test_toes_without_a_joint_are_where_the_foot_ends(
    load: Callable[[str], skeleton.Motion], names: dict[str, str]
) -> None:
    motion, other = load(SWING), load(with_toes_at_end_sites(SWING, names))
    assert other.names == motion.names
    for name in ("LeftToeBase", "RightToeBase", "RightForeArm"):
        np.testing.assert_allclose(other.path(name), motion.path(name), atol=1e-9)


def hanging(content: str) -> str:
    """The text with arms that hang where the T-pose's are level, and turned as much less."""
    for sign in (1, -1):
        for length in (28, 25):
            content = content.replace(f"OFFSET {sign * length} 0 0\n", f"OFFSET 0 {-length} 0\n")
    return content


def test_a_pose_without_rotations_in_which_all_limbs_hang_is_the_rest_pose(
    load: Callable[[str], skeleton.Motion],
) -> None:
    straight = [{"RightUpLeg": (0.0, 0.0, -angle)} for angle in np.linspace(-20.0, 40.0, 20)]
    level = load(text({}, *(STANDING | frame for frame in straight)))
    down = load(hanging(text(*straight)))
    (_, expected), (_, vectors) = (skeleton.retarget(each, human(), 0.01) for each in (level, down))
    np.testing.assert_allclose(vectors, expected, atol=1e-6)


@given(frames=st.integers(2, 300), rate=st.floats(5.0, 1000.0), dt=st.sampled_from([0.004, 0.01, 0.02, 1.0 / 60.0]))
def test_sampled_times_reach_from_the_first_frame_to_the_last_and_not_beyond(
    frames: int, rate: float, dt: float
) -> None:
    times, last = skeleton.sampled_times(frames, rate, dt), (frames - 1) / rate
    assert times[0] == 0.0 and times[-1] <= last < times[-1] + dt * (1.0 + 1e-9)


def test_a_film_of_whole_steps_is_sampled_to_its_end() -> None:
    assert len(skeleton.sampled_times(100, 60.0, 0.01)) == 166


def test_what_is_written_is_read_again(tmp_path: Path) -> None:
    random, body = np.random.default_rng(0), human()
    turns = 0.6 * random.standard_normal((20, len(body.motors), 3))
    root = Rotation.from_rotvec(0.4 * random.standard_normal((20, 3))).as_quat(scalar_first=True)
    motion = angles.motion(60.0, random.standard_normal((20, 3)), root, turns)
    path = tmp_path / "written.bvh"
    path.write_text(bvh.dumps(motion))
    again = bvh.load(path)
    assert again.rate == pytest.approx(60.0, abs=1e-4)
    rows = [again.names.index(name) for name in motion.names]  # a file goes down limb by limb
    np.testing.assert_allclose(again.offsets[rows], motion.offsets, atol=1e-6)
    np.testing.assert_allclose(again.positions[:, rows], motion.positions, atol=1e-5)
    for name in motion.names:
        assert (again.rotation(name) * motion.rotation(name).inv()).magnitude().max() < 1e-5


def test_missing_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"path is .*none\.bvh.* no such file"):
        bvh.load(tmp_path / "none.bvh")


@pytest.fixture(scope="module")
def damaged(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("damaged") / "clip.bvh"


def load_or_refuse(path: Path, content: bytes) -> None:
    path.write_bytes(content)
    try:
        motion = bvh.load(path)
    except InputError:
        return
    assert np.isfinite(motion.positions).all() and np.isfinite(motion.orientations).all()


@given(end=st.integers(0, len(GOOD)))
def test_truncated_files_are_read_or_refused(damaged: Path, end: int) -> None:
    load_or_refuse(damaged, GOOD.encode()[:end])


@given(bits=st.lists(st.integers(0, 8 * len(GOOD) - 1), min_size=1, max_size=8))
def test_files_with_flipped_bits_are_read_or_refused(damaged: Path, bits: list[int]) -> None:
    content = bytearray(GOOD.encode())
    for bit in bits:
        content[bit // 8] ^= 1 << bit % 8
    load_or_refuse(damaged, bytes(content))


def test_mirroring_twice_changes_nothing(load: Callable[[str], skeleton.Motion]) -> None:
    motion = load(text(*swing(10)))
    again = skeleton.mirrored(skeleton.mirrored(motion))
    assert again.names == motion.names
    for field in ("offsets", "positions", "orientations"):
        np.testing.assert_array_equal(getattr(again, field), getattr(motion, field))


def test_mirroring_a_right_swing_gives_the_left_one(load: Callable[[str], skeleton.Motion]) -> None:
    right, left = load(text(*swing(10))), load(text(*swing(10, "Left")))
    assert (skeleton.kicking_side(right), skeleton.kicking_side(left)) == ("Right", "Left")
    mirrored = skeleton.mirrored(left)
    for name in NAMES:
        np.testing.assert_allclose(mirrored.path(name), right.path(name), atol=1e-9)
    (_, expected), (_, vectors) = (skeleton.retarget(motion, human(), 0.01) for motion in (right, mirrored))
    np.testing.assert_allclose(vectors, expected, atol=1e-9)


def test_standing_retargets_to_no_rotation(load: Callable[[str], skeleton.Motion]) -> None:
    root, vectors = skeleton.retarget(load(text({}, *[STANDING] * 5)), human(), 0.01)
    assert root.shape == (5, 4) and vectors.shape == (5, 12, 3)
    np.testing.assert_allclose(np.abs(root), [[1.0, 0.0, 0.0, 0.0]] * 5, atol=1e-9)
    np.testing.assert_allclose(vectors, 0.0, atol=1e-9)


@pytest.mark.parametrize(
    ("joint", "angles", "link", "expected"),
    [
        ("RightLeg", (0, 0, 50), "right_shin", (0.0, np.radians(50), 0.0)),
        ("LeftUpLeg", (0, 0, -40), "left_thigh", (0.0, -np.radians(40), 0.0)),
        ("LeftForeArm", (0, -60, 0), "left_lower_arm", (0.0, -np.radians(60), 0.0)),
        ("RightForeArm", (0, 60, 0), "right_lower_arm", (0.0, -np.radians(60), 0.0)),
        ("RightFoot", (0, 0, 20), "right_foot", (0.0, np.radians(20), 0.0)),
        ("Spine", (0, 30, 0), "torso", (0.0, 0.0, np.radians(30))),
    ],
)
def test_a_turned_joint_turns_its_link_alone(
    load: Callable[[str], skeleton.Motion],
    joint: str,
    angles: tuple[float, float, float],
    link: str,
    expected: tuple[float, float, float],
) -> None:
    body, frame = human(), STANDING | {joint: angles}
    _, vectors = skeleton.retarget(load(text({}, frame, frame)), body, 0.01)
    wanted = np.zeros((12, 3))
    wanted[body.link(link) - 1] = expected
    np.testing.assert_allclose(vectors, [wanted] * 2, atol=1e-9)


def test_joint_targets_stay_within_the_motors_bounds(load: Callable[[str], skeleton.Motion]) -> None:
    bent = STANDING | {"RightLeg": (0.0, 0.0, 170.0), "LeftUpLeg": (0.0, 0.0, 120.0)}
    _, vectors = skeleton.retarget(load(text({}, bent, bent)), human(), 0.01)
    for row, (_, _, motor) in enumerate(human().motors):
        assert (vectors[:, row] >= motor.lower).all() and (vectors[:, row] <= motor.upper).all()


@pytest.mark.parametrize("dt", [0.004, 0.01, 0.02])
def test_retargeting_resamples(load: Callable[[str], skeleton.Motion], dt: float) -> None:
    _, vectors = skeleton.retarget(load(text(*swing(41))), human(), dt)
    assert len(vectors) == round(0.4 / dt) + 1


def test_strike_is_where_the_toe_is_fastest(load: Callable[[str], skeleton.Motion]) -> None:
    motion = load(text(*swing(61)))
    assert skeleton.strike(motion) == 30
    radius = np.linalg.norm((motion.path("RightToeBase") - motion.path("RightUpLeg"))[30])
    rate = np.radians(60.0) * 6.0 / 60.0 * motion.rate  # slope of 60 tanh(x) at 0, x from -3 to 3 in 60 frames
    assert skeleton.toe_speed(motion).max() == pytest.approx(radius * rate, rel=0.03)


def test_speeds_need_frames(load: Callable[[str], skeleton.Motion]) -> None:
    with pytest.raises(InputError, match="frames"):
        skeleton.toe_speed(load(GOOD))


def test_a_motion_without_a_kick_is_no_reference(tmp_path: Path, scene: Scene) -> None:
    path = tmp_path / "standing.bvh"
    path.write_text(text({}, *[STANDING] * 20))
    with pytest.raises(InputError, match="is no kick"):
        captured(path, scene)
    with pytest.raises(InputError, match="seconds_before"):
        captured(path, scene, seconds_before=0.0)


def test_benchmark_compares_clips_with_the_embedded_kick(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # where RESULTS.md and runs/ are written
    with pytest.raises(InputError, match="clips is"):
        benchmark.main(clips=tmp_path)
    assert not list(tmp_path.iterdir())
    (tmp_path / "swing.bvh").write_text(text(*swing(121, "Left")))
    with pytest.raises(InputError, match="publish is set"):
        benchmark.main(clips=tmp_path, publish=True)
    Path("RESULTS.md").write_text("# Results\n")
    benchmark.main(clips=tmp_path)
    assert Path("RESULTS.md").read_text() == "# Results\n"
    benchmark.main(clips=tmp_path, publish=True)
    found = json.loads(Path("runs/benchmarks/reference.json").read_text())
    assert [(row["name"], row["kind"]) for row in found["rows"]] == [("embedded", "kick"), ("swing", "walk")]
    assert found["rows"][1]["knee_strike_deg"] == pytest.approx(20.0)
    assert Path("runs/benchmarks/reference.png").stat().st_size > 10_000
    assert "| swing | walk |" in Path("RESULTS.md").read_text()


# Peak speeds of the right toe [m/s]: from frame to frame, and smoothed. Where they differ much, a marker jumps.
CAPTURED = {"10_01": (11.4, 10.9), "10_02": (12.8, 12.3), "10_05": (15.6, 11.4), "10_04": (6.1, 4.2)}


@with_clips
@pytest.mark.parametrize("name", CAPTURED)
def test_captured_toe_speeds(name: str) -> None:
    raw, smooth = CAPTURED[name]
    motion = bvh.load(CLIPS / f"{name}.bvh")
    steps = np.linalg.norm(np.diff(motion.path("RightToeBase"), axis=0), axis=-1)
    assert motion.rate == pytest.approx(120.0, rel=1e-3) and skeleton.kicking_side(motion) == "Right"
    assert motion.hip_height == pytest.approx(1.0, rel=0.1)
    assert steps.max() * motion.rate == pytest.approx(raw, rel=0.1)
    assert skeleton.toe_speed(motion).max() == pytest.approx(smooth, rel=0.1)


@with_clips
def test_a_captured_kick_strikes_the_ball(scene: Scene) -> None:
    reference = captured(CLIPS / "10_01.bvh", scene, seconds_before=0.6, seconds_after=0.2)
    steps = len(reference.controls)
    assert reference.states.shape == (steps + 1, len(scene.links), 13)
    before, after = reference.states[reference.strike, -1], reference.states[reference.strike + 5, -1]
    np.testing.assert_allclose(before[:3], reference.ball_spot, atol=0.01)
    assert after[7] > 5.0 and abs(after[8]) < 0.1 * after[7]
    assert reference.ball_spot[1] == pytest.approx(0.0)

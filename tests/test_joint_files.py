"""Files of joints in space: one motion in every form, unit and axis is the same, and what is no person is refused."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from pathlib import Path

import c3d
import jax.numpy as jnp
import numpy as np
import pytest

from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from tasks.motions.references import embedded
from tasks.motions.skeleton import Motion
from tasks.pose import figure as figures
from tasks.pose import joint_files, joint_motion, physical, sources, synthetic_film
from tasks.pose.figure import SHARED
from tasks.pose.points import POINTS, Keypoints
from tasks.pose.space import Space
from tasks.pose.views import Viewpoint, Views, places_in_all

# Names of our points in Pose2Sim's files, and in those of motion capture with joint centres.
POSE2SIM = ["Nose", "LEar", "REar"] + [
    side + limb
    for limb in ("Shoulder", "Elbow", "Wrist", "Hip", "Knee", "Ankle", "Heel", "BigToe")
    for side in ("L", "R")
]
CENTRES = ["nose", "LEAR", "REAR"] + [
    f"Subject:{side}{limb}" for limb in ("SJC", "EJC", "WJC", "HJC", "KJC", "AJC", "HEE", "TOE") for side in ("L", "R")
]
RATE = 50.0


@pytest.fixture(scope="module")
def states() -> np.ndarray:
    """States (T, L, 13) of the human in the embedded kick, until after the strike."""
    reference = embedded(human_and_ball())
    return reference.states[: reference.strike + 40 : 2, : len(figures.figure().body.links)].astype(np.float32)


@pytest.fixture(scope="module")
def kick(states: np.ndarray) -> np.ndarray:
    """Points (T, P, 3) [m] of the embedded kick."""
    figure = figures.figure()
    return np.asarray(physical.BodyPoints(figure.body, figure, np.zeros(SHARED)).points(states), float)


def trc(folder: Path, points: np.ndarray, labels: list[str], unit: str = "m") -> Path:
    head = "PathFileType\t4\t(X/Y/Z)\tkick.trc\nDataRate\tNumFrames\tNumMarkers\tUnits\n"
    head += f"{RATE}\t{len(points)}\t{len(labels)}\t{unit}\n"
    head += "Frame#\tTime\t" + "\t\t\t".join(labels) + "\t\t\n\t\tX1\tY1\tZ1\n"
    rows = [
        f"{frame + 1}\t{frame / RATE:.3f}\t" + "\t".join("" if np.isnan(value) else f"{value:.6f}" for value in row)
        for frame, row in enumerate(points.reshape(len(points), -1))
    ]
    (folder / "kick.trc").write_text(head + "\n".join(rows) + "\n")
    return folder / "kick.trc"


def c3d_file(folder: Path, points: np.ndarray, labels: list[str], unit: str = "m") -> Path:
    writer = c3d.Writer(point_rate=RATE, point_units=unit.ljust(4), point_scale=-1.0)
    for frame in points:
        values = np.zeros((len(labels), 5))
        values[:, :3] = np.nan_to_num(frame)
        values[:, 3] = np.where(np.isnan(frame[:, 0]), -1.0, 0.0)
        writer.add_frames([(values, np.zeros((0, 1)))])
    if labels[0]:
        writer.set_point_labels(labels)
    with (folder / "kick.c3d").open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is nothing but points
        writer.write(file)
    return folder / "kick.c3d"


def npz(folder: Path, points: np.ndarray, labels: list[str], unit: str = "m") -> Path:
    np.savez(folder / "kick.npz", names=np.array(labels), positions=points, rate=RATE)
    return folder / "kick.npz"


FORMS: dict[str, Callable[..., Path]] = {"TRC": trc, "C3D": c3d_file, "npz": npz}


@pytest.mark.parametrize("form", FORMS)
def test_a_motion_is_the_same_in_every_form(form: str, kick: np.ndarray, tmp_path: Path) -> None:
    hidden = kick.copy()
    hidden[3, 4:7] = np.nan
    joints = joint_files.load(FORMS[form](tmp_path, hidden, list(POINTS)))
    assert joints.keypoints.rate == RATE and joints.notes[1] == "z up, in m"
    np.testing.assert_allclose(joints.keypoints.places, hidden, atol=1e-5)
    np.testing.assert_array_equal(joints.keypoints.detected, np.isfinite(hidden[..., 0]))


@pytest.mark.parametrize(
    ("unit", "scale"), [("mm", 1e3), ("cm", 1e2), ("m", 1.0), ("m", 1e3), ("mm", 1.0), ("", 39.37)]
)
@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_units_and_axes_are_found_from_the_person_where_the_file_is_wrong(
    unit: str, scale: float, axes: tuple[int, int, int], kick: np.ndarray, tmp_path: Path
) -> None:
    joints = joint_files.load(trc(tmp_path, scale * kick[..., axes], POSE2SIM, unit))
    np.testing.assert_allclose(joints.keypoints.places, kick, atol=1e-3)
    up = "xyz"[axes.index(2)]
    assert joints.notes[1] == f"{up} up, in {({1e3: 'mm', 1e2: 'cm', 1.0: 'm', 39.37: 'in'})[scale]}"


def test_a_person_on_their_head_is_turned_and_ground_elsewhere_is_moved(kick: np.ndarray, tmp_path: Path) -> None:
    below = (kick + np.array([0.0, 0.0, 0.3])) * (1.0, -1.0, -1.0)
    joints = joint_files.load(npz(tmp_path, below, list(POINTS)))
    np.testing.assert_allclose(joints.keypoints.places, kick, atol=0.02)
    assert "-z up" in joints.notes[1] and "the ground at 0.29 m" in joints.notes[1]
    raw = joint_files.load(tmp_path / "kick.npz", grounded=False)
    np.testing.assert_allclose(raw.keypoints.places, kick + np.array([0.0, 0.0, 0.3]), atol=1e-9)


@pytest.mark.parametrize(
    "labels",
    [
        POSE2SIM,
        CENTRES,
        [point.upper().replace("_TOE", "_FOOT_INDEX") for point in POINTS],
        ["".join(part.capitalize() for part in point.split("_")) for point in POINTS],
    ],
    ids=["Pose2Sim", "joint centres", "MediaPipe", "words"],
)  # fmt: skip
def test_names_of_the_usual_tools_are_understood(labels: list[str], kick: np.ndarray, tmp_path: Path) -> None:
    joints = joint_files.load(npz(tmp_path, kick, labels))
    np.testing.assert_allclose(joints.keypoints.places, kick, atol=1e-9)


def test_where_a_skeleton_has_arms_its_shoulders_are_not_those_joints(kick: np.ndarray, tmp_path: Path) -> None:
    labels = [label.replace("Shoulder", "Arm") for label in POSE2SIM] + ["LShoulder", "RShoulder"]
    points = np.concatenate([kick, kick[:, 3:5] + 0.1], axis=1)
    joints = joint_files.load(npz(tmp_path, points, labels))
    np.testing.assert_allclose(joints.keypoints.places, kick, atol=1e-9)


def test_names_can_be_given(kick: np.ndarray, tmp_path: Path) -> None:
    labels = [f"M{row:02d}" for row in range(len(POINTS))]
    path = npz(tmp_path, kick, labels)
    with pytest.raises(
        InputError, match=r"kick.npz has no left_shoulder among its points \(M00, .* \.\.\.\): say which"
    ):
        joint_files.load(path)
    joints = joint_files.load(path, names=dict(zip(POINTS, labels, strict=True)))
    np.testing.assert_allclose(joints.keypoints.places, kick, atol=1e-9)
    with pytest.raises(InputError, match=r"kick.npz with names whose label of nose is 'M7', but must be one of M00"):
        joint_files.load(path, names={"nose": "M7"})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda points: points * (1.0, -1.0, 1.0), "has left and right exchanged, or one axis mirrored"),
        (lambda points: points * 7.0, "has legs of a length of"),
        (lambda points: points @ np.array([[0.0, 0.8, 0.6], [1.0, 0.0, 0.0], [0.0, -0.6, 0.8]]).T, "has nobody who"),
        (lambda points: points[:0], "has 0 frames, but needs from 1 to 100000"),
        (lambda points: np.full_like(points, np.nan), "has no frame with a whole leg"),
    ],
)  # fmt: skip
def test_what_is_no_person_is_refused(
    change: Callable[[np.ndarray], np.ndarray], message: str, kick: np.ndarray, tmp_path: Path
) -> None:
    with pytest.raises(InputError, match=f"^kick.npz {message}") as refused:
        joint_files.load(npz(tmp_path, change(kick), list(POINTS)))
    assert "\n" not in str(refused.value)


def test_c3d_without_labels_is_refused(kick: np.ndarray, tmp_path: Path) -> None:
    path = c3d_file(tmp_path, kick, [""] * len(POINTS))
    with pytest.raises(InputError, match=r"^kick.c3d has no labels of its points .POINT:LABELS., but needs them$"):
        joint_files.load(path)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("kick.trc", b"PathFileType 4\n", "is no whole TRC file"),
        ("kick.trc", b"\xff\xfe\x00", "is no whole TRC file"),
        ("kick.c3d", b"no C3D", "is no whole C3D file"),
        ("kick.c3d", b"", "is no whole C3D file"),
    ],
)
def test_a_damaged_file_is_refused(name: str, content: bytes, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=f"^{name} {message}") as refused:
        joint_files.load(tmp_path / name)
    assert "\n" not in str(refused.value)


def test_points_in_space_need_no_camera_and_no_second_file(kick: np.ndarray, tmp_path: Path) -> None:
    path = npz(tmp_path, kick, list(POINTS))
    loaded = sources.load((path,))
    assert loaded.views.in_space and loaded.position_known and len(loaded.views) == len(kick)
    with pytest.raises(InputError, match="cameras is set, but points in space are one file, and need no camera"):
        sources.load((path,), camera_files=(path,))
    with pytest.raises(InputError, match="keypoints are 2 files, but points in space are one file"):
        sources.load((path, path))


def test_a_motion_from_points_goes_where_they_go(kick: np.ndarray, tmp_path: Path) -> None:
    noisy = kick + 0.005 * np.random.default_rng(0).standard_normal(kick.shape)
    path = trc(tmp_path, 1e3 * noisy[..., [1, 2, 0]], POSE2SIM, "mm")
    motion = joint_motion.source_of(path)
    assert isinstance(motion, Motion) and motion.rate == RATE and "y up, in mm" in motion.read
    for joint, point in (("LeftFoot", "left_ankle"), ("RightForeArm", "right_elbow"), ("RightLeg", "right_knee")):
        assert np.linalg.norm(motion.path(joint) - kick[:, POINTS.index(point)], axis=-1).mean() < 0.03
    assert joint_motion.source_of(tmp_path / "other.bvh") == tmp_path / "other.bvh"


@pytest.mark.parametrize("kind", ["images", "space"])
def test_a_human_whose_points_are_where_they_were_seen_costs_nothing(
    kind: str, states: np.ndarray, kick: np.ndarray
) -> None:
    figure, frames = figures.figure(), len(kick)
    cameras: tuple[Viewpoint, ...] = (Space(),)
    if kind == "images":
        cameras = tuple(synthetic_film.camera_around(np.random.default_rng(seed), kick) for seed in (0, 1))
    places = places_in_all(cameras, kick)
    films = tuple(Keypoints(places[:, view], np.ones(kick.shape[:2]), RATE) for view in range(len(cameras)))
    body_points = physical.BodyPoints(figure.body, figure, np.zeros(SHARED))
    image, *_ = physical.terms_of(body_points, cameras, Views(films, cameras).sigma, 1.0 / RATE)
    context = physical.FilmedMotion(
        states,
        np.zeros((frames, 12, 3)),
        places.astype(np.float32),
        np.ones(places.shape[:3]),
        np.zeros((frames, 4)),
    )
    residual = image.residual(jnp.asarray(states), jnp.zeros((frames, 12, 3)), context)
    assert residual.shape == (frames, places[0].size) and abs(np.asarray(residual)).max() < 0.01
    moved = states.copy()
    moved[..., 0] += 0.1
    assert abs(np.asarray(image.residual(jnp.asarray(moved), jnp.zeros((frames, 12, 3)), context))).max() > 1.0

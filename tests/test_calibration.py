"""Files of camera calibrations: the same camera in every form sees the same, and what is damaged is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from tasks.pose import camera as cameras
from tasks.pose import sources
from tasks.pose.points import POINTS, Keypoints

SIZE = (1920.0, 1080.0)
FOCAL, CENTRE = np.array([1500.0, 1480.0]), np.array([940.0, 560.0])
DISTORTION = np.array([-0.12, 0.05, 0.001, -0.002, 0.01])
# A camera that is rolled by 15 degrees, 5 m from the person, 1.5 m high.
TURN = Rotation.from_euler("z", 15.0, degrees=True) * Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
POSITION = np.array([-5.0, 0.3, 1.5])
MATRIX = np.array([[FOCAL[0], 0.0, CENTRE[0]], [0.0, FOCAL[1], CENTRE[1]], [0.0, 0.0, 1.0]])


def persons_points() -> np.ndarray:
    """Points (4, P, 3) [m] around the origin."""
    points: np.ndarray = np.random.default_rng(0).uniform((-0.5, -0.7, 0.0), (0.5, 0.7, 1.8), (4, len(POINTS), 3))
    return points


def seen(points: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """Places [px] of points, by the model of OpenCV's documentation."""
    x, y, z = np.moveaxis(TURN.apply((points - POSITION).reshape(-1, 3)).reshape(points.shape), -1, 0)
    x, y = x / z, y / z
    k1, k2, p1, p2, k3 = distortion
    square = x**2 + y**2
    radial = 1.0 + k1 * square + k2 * square**2 + k3 * square**3
    bent_x = x * radial + 2.0 * p1 * x * y + p2 * (square + 2.0 * x**2)
    bent_y = y * radial + p1 * (square + 2.0 * y**2) + 2.0 * p2 * x * y
    places: np.ndarray = np.stack([bent_x, bent_y], axis=-1) * FOCAL + CENTRE
    return places


def opencv_matrix(array: Any) -> str:
    rows, columns = np.atleast_2d(array).shape
    data = ", ".join(map(repr, np.ravel(array).tolist()))
    return f"!!opencv-matrix\n   rows: {rows}\n   cols: {columns}\n   dt: d\n   data: [ {data} ]\n"


def ours(folder: Path) -> str:
    fields = {"size": SIZE, "focal": FOCAL.tolist(), "centre": CENTRE.tolist(), "distortion": DISTORTION.tolist(),
              "position": POSITION.tolist(), "rotation": TURN.as_rotvec().tolist()}  # fmt: skip
    (folder / "camera.json").write_text(json.dumps(fields))
    return "camera.json"


def opencv_yaml(folder: Path) -> str:
    content = f"%YAML:1.0\n---\nimage_width: 1920\nimage_height: 1080\ncamera_matrix: {opencv_matrix(MATRIX)}"
    (folder / "lens.yml").write_text(f"{content}distortion_coefficients: {opencv_matrix(DISTORTION)}")
    return "lens.yml"


def opencv_json(folder: Path) -> str:
    matrices = {
        name: {"type_id": "opencv-matrix", "rows": len(array), "cols": np.size(array) // len(array), "dt": "d",
               "data": np.ravel(array).tolist()}
        for name, array in (("camera_matrix", MATRIX), ("distortion_coefficients", DISTORTION))
    }  # fmt: skip
    (folder / "lens.json").write_text(json.dumps({"image_width": 1920, "image_height": 1080, **matrices}))
    return "lens.json"


def easymocap(folder: Path) -> str:
    translation = -TURN.apply(POSITION)
    inner = '%YAML:1.0\n---\nnames:\n  - "cam1"\n  - "cam2"\nH_cam2: 1080\nW_cam2: 1920\n'
    inner += f"K_cam1: {opencv_matrix(np.eye(3))}"
    inner += f"K_cam2: {opencv_matrix(MATRIX)}dist_cam2: {opencv_matrix(DISTORTION)}"
    outer = f"%YAML:1.0\n---\nRot_cam2: {opencv_matrix(TURN.as_matrix())}T_cam2: {opencv_matrix(translation[:, None])}"
    (folder / "intri.yml").write_text(inner)
    (folder / "extri.yml").write_text(outer)
    return "intri.yml:cam2"


def pose2sim(folder: Path) -> str:
    cameras_of_file = ""
    for name, matrix in (("cam_01", np.eye(3)), ("cam_02", MATRIX)):
        cameras_of_file += (
            f'[{name}]\nname = "{name}"\nsize = [ 1920.0, 1080.0,]\nmatrix = {matrix.tolist()}\n'
            f"distortions = {DISTORTION[:4].tolist()}\nrotation = {TURN.as_rotvec().tolist()}\n"
            f"translation = {(-TURN.apply(POSITION)).tolist()}\nfisheye = false\n\n"
        )
    (folder / "calib.toml").write_text(cameras_of_file + "[metadata]\nadjusted = false\nerror = 0.0\n")
    return "calib.toml:cam_02"


def colmap(folder: Path) -> str:
    numbers = " ".join(map(repr, [*FOCAL.tolist(), *CENTRE.tolist(), *DISTORTION[:4].tolist()]))
    (folder / "cameras.txt").write_text(f"# Camera list\n3 OPENCV 1920 1080 {numbers}\n")
    return "cameras.txt"


def colmap_world(folder: Path) -> str:
    """Lens and place in two files; every other line of images.txt lists what an image shows, or nothing."""
    x, y, z, w = TURN.as_quat()
    place = " ".join(map(repr, [*map(float, (w, x, y, z)), *(-TURN.apply(POSITION)).tolist()]))
    images = f"# Image list\n1 1 0 0 0 0.5 1.5 4 3 cam_01/0001.png\n\n2 {place} 3 cam_02/0001.png\n7.5 8.5 -1\n"
    (folder / "images.txt").write_text(images)
    return f"{colmap(folder)}:cam_02"


def qualisys(folder: Path, right: int = 1919) -> str:
    """The camera in mm and 1/64 px, its axes to the right, up and back, as the lower right part of its sensor."""
    rows = TURN.as_matrix() * [[1.0], [-1.0], [-1.0]]
    turn = " ".join(f'r{row + 1}{column + 1}="{float(rows[row, column])!r}"' for row in range(3) for column in range(3))
    k1, k2, p1, p2, k3 = DISTORTION
    x, y, z = 1000.0 * POSITION
    (u, v), (focal_u, focal_v) = 64.0 * (CENTRE + np.array([80.0, 8.0])), 64.0 * FOCAL
    camera = f"""<camera active="1" serial="{{serial}}" model="{{model}}" viewrotation="0">
        <fov_video left="80" top="8" right="{right + 80}" bottom="1087"/><transform x="{x}" y="{y}" z="{z}" {turn}/>
        <intrinsic focallength="9.27" sensorMinU="0.0" sensorMaxU="127999.0" sensorMinV="0.0" sensorMaxV="69631.0"
        focalLengthU="{focal_u}" focalLengthV="{focal_v}" centerPointU="{u}" centerPointV="{v}" skew="0.0"
        radialDistortion1="{k1}" radialDistortion2="{k2}" radialDistortion3="{k3}" tangentalDistortion1="{p1}"
        tangentalDistortion2="{p2}"/></camera>"""
    marked = camera.format(serial="11111", model="Miqus M3"), camera.format(serial="26578", model="Miqus Video")
    content = f"<?xml version='1.0' encoding='UTF-8'?>\n<calibration><cameras>{''.join(marked)}</cameras></calibration>"
    (folder / "lab.qca.txt").write_text(content)
    return "lab.qca.txt"


# How each form is written, how many distortion coefficients it has, and whether it says where the camera is.
FORMS: dict[str, tuple[Callable[[Path], str], int, bool]] = {
    "ours": (ours, 5, True),
    "OpenCV, YAML": (opencv_yaml, 5, False),
    "OpenCV, JSON": (opencv_json, 5, False),
    "EasyMocap": (easymocap, 5, True),
    "Pose2Sim": (pose2sim, 4, True),
    "COLMAP": (colmap, 4, False),
    "COLMAP, with places": (colmap_world, 4, True),
    "Qualisys": (qualisys, 5, True),
}


@pytest.mark.parametrize("form", FORMS)
def test_a_camera_sees_the_same_points_in_every_form(tmp_path: Path, form: str) -> None:
    write, coefficients, placed = FORMS[form]
    camera, lens, size, position_known = cameras.load(tmp_path / write(tmp_path))
    assert (size, position_known) == (SIZE, placed)
    distortion = np.where(np.arange(5) < coefficients, DISTORTION, 0.0)
    points = persons_points()
    film = Keypoints(seen(points, distortion), np.ones(points.shape[:2]), 30.0, SIZE)
    straightened = lens.straightened(film).places
    pinhole = cameras.Camera(FOCAL[0], CENTRE, TURN.as_matrix(), POSITION)
    np.testing.assert_allclose(straightened, pinhole.project(points), atol=0.01)
    assert abs(straightened - film.places).max() > 3.0
    if placed:
        np.testing.assert_allclose(camera.project(points), pinhole.project(points), atol=1e-6)


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_images_that_were_turned_show_the_same_points(tmp_path: Path, degrees: int) -> None:
    points, (width, height) = persons_points(), SIZE
    x, y = np.moveaxis(seen(points, DISTORTION), -1, 0)
    turned_places = {90: (height - y, x), 180: (width - x, height - y), 270: (y, width - x)}[degrees]
    loaded = cameras.load(tmp_path / ours(tmp_path)).turned(degrees)
    assert loaded.size == (SIZE if degrees == 180 else SIZE[::-1])
    film = Keypoints(np.stack(turned_places, axis=-1), np.ones(points.shape[:2]), 30.0, loaded.size)
    np.testing.assert_allclose(loaded.lens.straightened(film).places, loaded.camera.project(points), atol=0.01)


def test_a_camera_that_is_held_by_hand_stays_upright_when_its_images_are_turned(tmp_path: Path) -> None:
    loaded = cameras.load(tmp_path / opencv_yaml(tmp_path))
    np.testing.assert_array_equal(loaded.turned(90).camera.turn, loaded.camera.turn)
    assert loaded.turned(90).camera.focal == FOCAL[1]


def test_images_of_another_format_than_the_cameras_ask_how_they_were_turned(tmp_path: Path) -> None:
    path, film = tmp_path / ours(tmp_path), tmp_path / "film.npz"
    places = np.full((12, len(POINTS), 2), 500.0)
    np.savez(film, names=np.array(POINTS), places=places, rate=30.0, size=np.array([1080.0, 1920.0]))
    with pytest.raises(InputError, match=r"turned is 0, but images of 1080 x 1920 px need 90 or 270 for camera\.json"):
        sources.load((film,), camera_files=(path,))
    assert sources.load((film,), camera_files=(path,), turned=90).position_known


def test_points_that_a_lens_cannot_show_are_lost() -> None:
    places = np.full((1, len(POINTS), 2), (900.0, 600.0))
    places[0, 3] = 1900.0, 1070.0
    film = Keypoints(places, np.ones(places.shape[:2]), 30.0, SIZE)
    lens = cameras.Lens(np.array([500.0, 500.0]), 0.5 * np.array(SIZE), np.array([-0.6, 0.0, 0.0, 0.0, 0.0]))
    straightened = lens.straightened(film)
    assert np.flatnonzero(~straightened.detected[0]).tolist() == [3]
    assert np.isnan(straightened.places[0, 3]).all()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("calib.toml", "[cam_01\n", "calib.toml is no whole calibration file"),
        ("calib.toml", "[metadata]\nerror = 0.0\n", "calib.toml has no camera"),
        ("calib.toml", "[a]\nmatrix = [[1, 0], [0, 1]]\nrotation = [0, 0, 0]\ntranslation = [0, 0, 0]\n", "shape"),
        ("calib.toml", "[a]\nfisheye = true\nmatrix = 1\n", "a is a fisheye's, but only OpenCV's usual distortion"),
        ("lens.yml", "%YAML:1.0\n---\ncamera_matrix: [", "lens.yml is no whole calibration file"),
        ("lens.yml", "%YAML:1.0\n---\nimage_width: 3\n", "lens.yml is no whole calibration file .KeyError: 'camera_ma"),
        ("lens.yml", "- 1\n", "lens.yml needs an object of a camera's fields"),
        ("lens.yml", "!!python/object/apply:os.getpid []\n", "lens.yml is no whole calibration file"),
        ("cameras.txt", "1 FISHEYE 3 4 5\n", "the model of a lens is 'FISHEYE', but must be one of SIMPLE_PINHOLE"),
        ("cameras.txt", "1 PINHOLE 3 4 5\n", "PINHOLE has 1 numbers, but needs 4"),
        ("lab.qca.txt", "<calibration><cameras>", "lab.qca.txt is no whole calibration file .ParseError"),
        ("lab.qca.txt", "<calibration/>", "lab.qca.txt has no camera"),
        ("lab.qca.txt", '<c><cameras><camera serial="7"/></cameras></c>', "7 has no transform or no intrinsic"),
        ("lab.qca.txt", '<!DOCTYPE c [<!ENTITY a "b">]><c/>', "entities of its own is no calibration"),
        ("camera.json", '{"focal": [1, 2, 3], "size": [4, 5]}', "focal is .1, 2, 3., but needs 2 finite numbers"),
        ("camera.json", '{"distortion": [1], "size": [4, 5]}', "distortion is .1., but needs 4 finite numbers"),
        ("camera.json", '{"rotation": [0, 0, 0], "size": [4, 5]}', "has rotation, but needs both or neither"),
    ],
)  # fmt: skip
def test_a_calibration_that_is_not_understood_is_refused(tmp_path: Path, name: str, content: str, message: str) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=f"^camera: .*{message}") as refusal:
        cameras.load(tmp_path / name)
    assert "\n" not in str(refusal.value)


def test_one_of_several_cameras_is_named(tmp_path: Path) -> None:
    pose2sim(tmp_path)
    with pytest.raises(InputError, match=r"calib.toml has several: cam_01, cam_02; give one as calib.toml:cam_01"):
        cameras.load(tmp_path / "calib.toml")
    with pytest.raises(InputError, match=r"the name of one in calib.toml is 'cam_2', .* did you mean 'cam_02'"):
        cameras.load(f"{tmp_path / 'calib.toml'}:cam_2")
    with pytest.raises(InputError, match=r"no such file exists"):
        cameras.load(tmp_path / "none.toml:cam_01")


def test_a_camera_that_moves_is_refused(tmp_path: Path) -> None:
    colmap(tmp_path)
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 4 3 cam/1.png\n\n2 1 0 0 0 1 0 4 3 cam/2.png\n\n")
    with pytest.raises(InputError, match=r"^camera: cam moves from image to image, but has to stand still$"):
        cameras.load(tmp_path / "cameras.txt")


def test_images_of_another_width_than_is_said_have_the_size_of_the_sensor(tmp_path: Path) -> None:
    """Some tools write the first pixel that is no longer filmed as the last one."""
    assert cameras.load(tmp_path / qualisys(tmp_path, right=1920)).size == SIZE

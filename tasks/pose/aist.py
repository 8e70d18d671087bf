"""Reader of AIST++, dancers recorded by nine cameras, from its annotations (CC BY 4.0), in our frame.

Of the distributed folder, keypoints2d/, keypoints3d/, cameras/ and ignore_list.txt are read. They hold keypoints that a
detector gave for each camera's images, and joint positions estimated from all nine together. Lengths are in centimetres
and y points up, both as accurately as the cameras were calibrated, from the dancers alone. The ground's height was not
measured: here it is set so that the ankles are as high above it as our figure's when it stands.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from larp_model.names import meant, require_file
from tasks.pose import safe_pickle
from tasks.pose.camera import Camera, Lens
from tasks.pose.point_orders import ORDERS
from tasks.pose.points import POINTS, Keypoints

# Frames a second, of all films; how many cameras there are.
RATE, CAMERAS = 60.0, 9
# Height of our figure's ankles where its feet stand [m]; share of the lowest ankles that are taken for errors [%].
ANKLE_HEIGHT, GROUND_PERCENTILE = 0.067, 5.0
# Cameras that AIST++ leaves out itself: one that is not in time with the others, one with smaller images.
UNUSABLE = {"gBR_sBM_cAll_d04_mBR0_ch01": 4, "gJB_sBM_cAll_d07_mJB3_ch05": 6}
# Fields of a camera: size and matrix [px], rotation vector from the world, translation [cm], distortion coefficients.
FIELDS = {"size": (2,), "matrix": (3, 3), "rotation": (3,), "translation": (3,), "distortions": (5,)}
# Rotation from its world, y up, to ours.
TO_OUR_AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
_COUNT, _NAMES = ORDERS["coco"]
_OUR_ROWS = [row for row, name in enumerate(POINTS) if name in _NAMES]
_AIST_ROWS = [_NAMES.index(POINTS[row]) for row in _OUR_ROWS]
_ANKLE_ROWS = [POINTS.index("left_ankle"), POINTS.index("right_ankle")]


class Dance(NamedTuple):
    """Film with its keypoints, its camera, and the true `POINTS` (T, P, 3) [m], NaN where not known.

    Heels and toes are never known.
    """

    keypoints: Keypoints
    camera: Camera
    points: np.ndarray


def sequences(folder: Path) -> dict[str, str]:
    """Return the camera setting of each sequence, by name, without the sequences that AIST++ lists as faulty."""
    mapping, ignored = folder / "cameras" / "mapping.txt", folder / "ignore_list.txt"
    if not folder.is_dir():
        raise InputError(f"aist is {str(folder)!r}, but must be the folder of AIST++'s annotations")
    require_file("aist", mapping)
    rows = [line.split() for line in mapping.read_text(encoding="utf-8").splitlines() if line.strip()]
    if not rows or any(len(row) != 2 for row in rows):
        raise InputError("aist: mapping.txt needs a sequence and its setting in every line")
    faulty = set(ignored.read_text(encoding="utf-8").split()) if ignored.is_file() else set()
    return {sequence: setting for sequence, setting in rows if sequence not in faulty}


def sequence_and_camera(name: str) -> tuple[str, int | None]:
    """Return the sequence of a video and its camera, from 0; None for a sequence's own name, with cAll."""
    match = re.search(rf"_c0([1-{CAMERAS}])_", name)
    return (name.replace(match[0], "_cAll_", 1), int(match[1]) - 1) if match else (name, None)


def video(sequence: str, camera: int) -> str:
    """Return the name of the video of a sequence by one camera, from 0."""
    return sequence.replace("_cAll_", f"_c{camera + 1:02}_")


def load(folder: Path, sequence: str, camera: int) -> Dance:
    """Return the `Dance` of one camera, from 0, of a sequence; an InputError names what is missing or damaged.

    Keypoints are corrected for lens distortion and for a focal length that differs between x and y, so that the camera
    has neither.
    """
    settings = sequences(folder)
    if sequence not in settings:
        raise InputError(
            f"sequences has {sequence!r}, but mapping.txt in aist has no such sequence, or ignore_list.txt has it too"
            f"{meant(sequence, settings)}"
        )
    if camera not in range(CAMERAS):
        raise InputError(f"camera is {camera}, but must be from 0 to below {CAMERAS}")
    if UNUSABLE.get(sequence) == camera:
        raise InputError(f"sequences has {video(sequence, camera)!r}, a camera that AIST++ leaves out itself")
    detections = _array(folder / "keypoints2d" / f"{sequence}.pkl", "keypoints2d", (CAMERAS, None, _COUNT, 3))[camera]
    true_points = _array(folder / "keypoints3d" / f"{sequence}.pkl", "keypoints3d_optim", (None, _COUNT, 3))
    if len(detections) != len(true_points):
        raise InputError(
            f"aist: {sequence} has {len(detections)} frames in keypoints2d and {len(true_points)} in keypoints3d"
        )

    points = np.full((len(true_points), len(POINTS), 3), np.nan)
    points[:, _OUR_ROWS] = 0.01 * true_points[:, _AIST_ROWS] @ TO_OUR_AXES.T
    lowest_ankles = points[:, _ANKLE_ROWS, 2].min(axis=1)
    if np.isnan(lowest_ankles).all():
        raise InputError(f"aist: {sequence}.pkl has no frame in keypoints3d_optim with both ankles")
    ground = np.array([0.0, 0.0, float(np.nanpercentile(lowest_ankles, GROUND_PERCENTILE)) - ANKLE_HEIGHT])

    calibration = _camera(folder / "cameras" / f"{settings[sequence]}.json", camera)
    (width, height), focal_lengths, centre = (
        calibration["size"],
        calibration["matrix"][[0, 1], [0, 1]],
        calibration["matrix"][:2, 2],
    )
    turn, focal = Rotation.from_rotvec(calibration["rotation"]).as_matrix(), float(focal_lengths[0])
    position = -0.01 * TO_OUR_AXES @ turn.T @ calibration["translation"]

    places, confidence = np.full((len(detections), len(POINTS), 2), np.nan), np.zeros((len(detections), len(POINTS)))
    places[:, _OUR_ROWS] = detections[:, _AIST_ROWS, :2]
    confidence[:, _OUR_ROWS] = np.nan_to_num(detections[:, _AIST_ROWS, 2]).clip(0.0, 1.0)
    confidence[np.isnan(places).any(axis=-1)] = 0.0
    places[confidence == 0.0] = np.nan
    film = Keypoints(places, confidence, RATE, (float(width), float(height)))
    return Dance(
        Lens(focal_lengths, centre, calibration["distortions"]).straightened(film),
        Camera(focal, centre, turn @ TO_OUR_AXES.T, position - ground),
        points - ground,
    )


def _camera(path: Path, camera: int) -> dict[str, np.ndarray]:
    """Return the arrays of `FIELDS` of one camera, from 0, of a setting's file."""
    require_file("aist", path)
    try:
        cameras = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        raise InputError(f"aist: {path.name} is no JSON file") from None
    if not isinstance(cameras, list) or len(cameras) != CAMERAS or not isinstance(cameras[camera], dict):
        raise InputError(f"aist: {path.name} needs a list of {CAMERAS} cameras")
    arrays = {}
    for field, shape in FIELDS.items():
        try:
            arrays[field] = np.array(cameras[camera].get(field), float)
        except (TypeError, ValueError, OverflowError):
            arrays[field] = np.array(np.nan)
        if arrays[field].shape != shape or not np.isfinite(arrays[field]).all():
            shape_text = " x ".join(map(str, shape))
            raise InputError(f"aist: {path.name}, camera {camera}: {field} needs {shape_text} finite numbers")
    if not ((arrays["size"] > 0.0).all() and (arrays["matrix"][[0, 1], [0, 1]] > 0.0).all()):
        raise InputError(f"aist: {path.name}, camera {camera}: size and the matrix' focal lengths must be above 0")
    return arrays


def _array(path: Path, name: str, shape: tuple[int | None, ...]) -> np.ndarray:
    require_file("aist", path)
    content: Any = safe_pickle.load(path)
    array = content.get(name) if isinstance(content, dict) else None
    shape_text = ", ".join("T" if length is None else str(length) for length in shape)
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f":
        raise InputError(f"aist: {path.name} needs {name}, floats ({shape_text})")
    if array.ndim != len(shape) or not all(
        expected in (None, actual) for expected, actual in zip(shape, array.shape, strict=True)
    ):
        raise InputError(f"aist: {path.name} has {name} {array.shape}, but needs ({shape_text})")
    if np.isinf(array).any():
        raise InputError(f"aist: {path.name} has {name} with numbers that are infinite")
    return array.astype(float)

"""Files of camera calibrations, as the fields of our own camera file; see `camera.load`.

| file | holds | of which is read |
|---|---|---|
| our JSON | the fields themselves | all |
| OpenCV's YAML or JSON | one camera: `camera_matrix`, `distortion_coefficients`, `image_width`, ... | the lens |
| EasyMocap's `intri.yml`, with `extri.yml` beside it | several cameras, by name | lens and place |
| Pose2Sim's TOML | several cameras, by name | lens and place |
| Qualisys' calibration (`.qca.txt`) | several cameras, by serial number | lens and place |
| COLMAP's `cameras.txt` | several cameras, by number | the lens |
| COLMAP's, with `images.txt` beside it | several cameras, by their images' folder or name | lens and place |

Places count from a world with z up, the ground at 0, and metres, as EasyMocap, Pose2Sim and Qualisys (in mm) have it;
COLMAP's may be any, and has to be brought there, for instance by its `model_aligner`.
"""

from __future__ import annotations

import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from larp_model.errors import InputError
from larp_model.names import require_file, require_known

Fields = dict[str, Any]

# COLMAP's models of lenses: how many focal lengths come first, before the centre, and our places of what comes after it
# among k1, k2, p1, p2, k3.
_COLMAP = {
    "SIMPLE_PINHOLE": (1, ()),
    "PINHOLE": (2, ()),
    "SIMPLE_RADIAL": (1, (0,)),
    "RADIAL": (1, (0, 1)),
    "OPENCV": (2, (0, 1, 2, 3)),
}
# Qualisys' numbers in a pixel, and its axes of a camera, to the right, up, back, in ours: to the right, down, ahead.
_SUBPIXELS, _QUALISYS = 64.0, np.diag([1.0, -1.0, -1.0])
_QUALISYS_DISTORTION = (("radial", 1), ("radial", 2), ("tangental", 1), ("tangental", 2), ("radial", 3))
# Errors that readers raise on damaged files; that of XML is a SyntaxError.
_DAMAGE = (ValueError, KeyError, TypeError, IndexError, AttributeError, RecursionError, yaml.YAMLError, SyntaxError)


def fields_of(path: str | Path) -> tuple[str, Fields]:
    """Return the name of a camera's file, and its fields as our own camera files have them, unchecked.

    path: of the file, in files of several cameras FILE:NAME. An InputError names what is not understood.
    """
    file, _, name = str(path).rpartition(":")
    path, name = (Path(path), "") if not file or Path(path).exists() else (Path(file), name)
    cameras = _cameras_of(path)
    if name:
        require_known(f"camera: the name of one in {path.name}", name, cameras)
    elif len(cameras) > 1:
        names = ", ".join(cameras)
        raise InputError(f"camera: {path.name} has several: {names}; give one as {path.name}:{next(iter(cameras))}")
    return path.name, cameras[name] if name else next(iter(cameras.values()))


def names_of(path: str | Path) -> list[str]:
    """Return the names of the cameras of a file, in its order."""
    return list(_cameras_of(Path(path)))


def _cameras_of(path: Path) -> dict[str, Fields]:
    require_file("camera", path)
    try:
        cameras = _cameras(path)
    except _DAMAGE as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"camera: {path.name} is no whole calibration file ({_line(error)})") from None
    if not cameras:
        raise InputError(f"camera: {path.name} has no camera")
    return cameras


def _line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:100]


def _cameras(path: Path) -> dict[str, Fields]:
    """Return the fields of each camera of a file, by its name."""
    match path.suffix.lower():
        case ".toml":
            return _pose2sim(tomllib.loads(path.read_text("utf-8")))
        case ".yml" | ".yaml":
            content = _opencv_yaml(path)
            if "names" not in content:
                return {"camera": _opencv(content)}
            other = path.with_name(path.name.replace("intri", "extri"))
            return _easymocap(content, _opencv_yaml(other) if other != path and other.is_file() else {})
        case ".txt" | ".qca" | ".xml":
            text = path.read_text("utf-8-sig")
            if text.lstrip().startswith("<"):
                return _qualisys(text)
            other = path.with_name("images.txt")
            images = other.read_text("utf-8") if other != path and other.is_file() else ""
            return _colmap(text, images)
    try:
        content = json.loads(path.read_bytes())
    except (ValueError, RecursionError):
        raise InputError(f"camera: {path.name} is no JSON file") from None
    if not isinstance(content, dict):
        raise InputError(f"camera: {path.name} needs an object of a camera's fields")
    return {"camera": _opencv(content) if "camera_matrix" in content else content}


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Loader of YAML with OpenCV's matrices, which runs nothing."""

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        """Return the content of a node; a matrix of OpenCV's as an array."""
        if node.tag == "tag:yaml.org,2002:opencv-matrix":
            return _matrix(self.construct_mapping(node, deep=True))
        return super().construct_object(node, deep)


def _matrix(content: Mapping[str, Any]) -> np.ndarray:
    """Return a matrix as OpenCV stores it."""
    return np.array(content["data"], float).reshape(int(content["rows"]), int(content["cols"]))


def _opencv_yaml(path: Path) -> dict[str, Any]:
    """Return the content of a YAML file of OpenCV, whose first line is no YAML."""
    lines = path.read_text("utf-8").splitlines()
    content = yaml.load("\n".join(line for line in lines if not line.startswith("%YAML")), _Loader)
    if not isinstance(content, dict):
        raise InputError(f"camera: {path.name} needs an object of a camera's fields")
    return content


def _lens(matrix: Any, distortion: Any) -> Fields:
    matrix, distortion = np.array(matrix, float), np.ravel(np.array(distortion, float))
    if matrix.shape != (3, 3):
        raise InputError(f"camera: its matrix has shape {matrix.shape}, but needs (3, 3)")
    fields = {"focal": [matrix[0, 0], matrix[1, 1]], "centre": [matrix[0, 2], matrix[1, 2]]}
    return _plain(fields | {"distortion": distortion})


def _place(rotation: Any, translation: Any) -> Fields:
    """Return rotation vector and position of a camera that sees x at R x + t."""
    rotation, translation = np.array(rotation, float), np.ravel(np.array(translation, float))
    turn = Rotation.from_matrix(rotation) if rotation.shape == (3, 3) else Rotation.from_rotvec(np.ravel(rotation))
    return _plain({"rotation": turn.as_rotvec(), "position": -turn.inv().apply(translation)})


def _plain(fields: Mapping[str, Any]) -> Fields:
    """Return fields as JSON has them."""
    return {name: np.asarray(value, float).tolist() for name, value in fields.items()}


def _opencv(content: Mapping[str, Any]) -> Fields:
    matrix, distortion = content["camera_matrix"], content.get("distortion_coefficients", np.zeros(5))
    arrays = [_matrix(array) if isinstance(array, dict) else np.array(array) for array in (matrix, distortion)]
    size = {"size": [content["image_width"], content["image_height"]]} if "image_width" in content else {}
    return _lens(*arrays) | size


def _easymocap(inner: Mapping[str, Any], outer: Mapping[str, Any]) -> dict[str, Fields]:
    cameras = {}
    for name in map(str, inner["names"]):
        height, width = inner.get(f"H_{name}"), inner.get(f"W_{name}")
        size = {"size": [float(width), float(height)]} if height and width else {}
        place = _place(outer[f"Rot_{name}"], outer[f"T_{name}"]) if f"Rot_{name}" in outer else {}
        cameras[name] = _lens(inner[f"K_{name}"], inner.get(f"dist_{name}", np.zeros(5))) | size | place
    return cameras


def _pose2sim(content: Mapping[str, Any]) -> dict[str, Fields]:
    cameras = {}
    for key, camera in content.items():
        if not (isinstance(camera, dict) and "matrix" in camera):
            continue
        if camera.get("fisheye"):
            raise InputError(f"camera: {key} is a fisheye's, but only OpenCV's usual distortion is understood")
        place = _place(camera["rotation"], camera["translation"])
        name = str(camera.get("name", key))
        cameras[name] = _lens(camera["matrix"], camera.get("distortions", np.zeros(5))) | place
        cameras[name]["size"] = np.array(camera["size"], float).tolist()
    return cameras


def _qualisys(text: str) -> dict[str, Fields]:
    if "<!ENTITY" in text:
        raise InputError("camera: an XML file with entities of its own is no calibration")
    found = ElementTree.fromstring(text).findall("cameras/camera")
    films = [camera for camera in found if "video" in camera.get("model", "").lower()]  # the others see markers alone
    return {camera.attrib["serial"]: _qualisys_camera(camera) for camera in films or found}


def _qualisys_camera(camera: ElementTree.Element) -> Fields:
    place, lens, view = (camera.find(name) for name in ("transform", "intrinsic", "fov_video"))
    if place is None or lens is None:
        raise InputError(f"camera: {camera.get('serial')} has no transform or no intrinsic, but needs both")
    u, v, focal_u, focal_v = (
        float(lens.attrib[name]) / _SUBPIXELS
        for name in ("centerPointU", "centerPointV", "focalLengthU", "focalLengthV")
    )
    first, last = np.zeros(2), np.array([(float(lens.attrib[f"sensorMax{axis}"]) + 1.0) // _SUBPIXELS for axis in "UV"])
    if view is not None:  # the part of the sensor that is filmed, its last pixel included
        first = np.array([float(view.attrib[side]) for side in ("left", "top")])
        last = np.minimum(last, [float(view.attrib[side]) + 1.0 for side in ("right", "bottom")])
    distortion = [f"{kind}Distortion{number}" for kind, number in _QUALISYS_DISTORTION]
    turn = _QUALISYS @ [[float(place.attrib[f"r{row}{column}"]) for column in "123"] for row in "123"]
    position = np.array([float(place.attrib[axis]) for axis in "xyz"]) / 1000.0
    matrix = np.array([[focal_u, 0.0, u - first[0]], [0.0, focal_v, v - first[1]], [0.0, 0.0, 1.0]])
    inner = _lens(matrix, [float(lens.get(name, 0.0)) for name in distortion])
    return inner | _plain({"size": last - first}) | _place(turn, -turn @ position)


def _colmap(text: str, images: str) -> dict[str, Fields]:
    lenses = _colmap_lenses(text)
    lines = [line for line in images.splitlines() if not line.startswith("#")]
    cameras: dict[str, Fields] = {}
    for line in filter(str.strip, lines[::2]):  # every other line is of what an image shows
        _, *numbers, lens, path = line.split(maxsplit=9)
        w, x, y, z, *translation = map(float, numbers)
        name = Path(path).parts[0] if "/" in path else Path(path).stem
        camera = lenses[lens] | _place(Rotation.from_quat([x, y, z, w]).as_matrix(), translation)
        if not np.allclose(cameras.setdefault(name, camera)["position"], camera["position"], atol=0.05):
            raise InputError(f"camera: {name} moves from image to image, but has to stand still")
    return cameras or lenses


def _colmap_lenses(text: str) -> dict[str, Fields]:
    cameras = {}
    for line in text.splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        name, model, *numbers = line.split()
        require_known("camera: the model of a lens", model, _COLMAP)
        focals, places = _COLMAP[model]
        width, height, *values = map(float, numbers)
        if len(values) != focals + 2 + len(places):
            raise InputError(f"camera: {model} has {len(values)} numbers, but needs {focals + 2 + len(places)}")
        distortion = np.zeros(5)
        distortion[list(places)] = values[focals + 2 :]
        matrix = np.array([[values[0], 0.0, values[focals]], [0.0, values[focals - 1], values[focals + 1]], [0, 0, 1]])
        cameras[name] = _lens(matrix, distortion) | {"size": [width, height]}
    return cameras

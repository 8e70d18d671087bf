"""Files of joints or markers in space: TRC of OpenSim and Pose2Sim, C3D of motion capture systems, and npz of our own.

A point's name says which of `POINTS` it is, in the words of the usual tools: `LKnee`, `left_knee`, `LEFT_KNEE`, `LKJC`,
`lKnee`, `Subject:LeftLeg`. What a file does not say, or says wrongly, is found from the person: the unit from the
length of the legs, the axis that is up from how the person stands, and the ground from the feet.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import c3d
import numpy as np

from larp_model.errors import InputError
from larp_model.files import arrays_of
from larp_model.names import require_file, require_known
from tasks.pose.figure import SOLE_HEIGHT
from tasks.pose.points import FEET, POINTS, SIDES, Keypoints, require_rate

SUFFIXES = (".trc", ".c3d")
# Words for our points, without their side; of several that a file has, the first one here is taken. A word for a link
# names the joint at its upper end.
WORDS = {
    "shoulder": ("arm", "upperarm", "uparm", "sjc", "shoulder", "acromion"),
    "elbow": ("elbow", "ejc", "forearm", "lowerarm"),
    "wrist": ("wrist", "wjc", "hand"),
    "hip": ("hip", "hjc", "upleg", "upperleg", "thigh"),
    "knee": ("knee", "kjc", "leg", "lowerleg", "shin", "calf"),
    "ankle": ("ankle", "ajc", "foot"),
    "heel": ("heel", "hee", "calcaneus"),
    "toe": ("bigtoe", "footindex", "hallux", "toetip", "toeend", "toe", "toes"),
    "ear": ("ear",),
}
NEEDED = tuple(f"{side}_{limb}" for limb in ("shoulder", "hip", "knee", "ankle") for side in SIDES)
UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "in": 0.0254}
# Length of a leg from the hip to the ankle [m].
LEGS = (0.55, 1.2)
# Share of the way from the ankles to the shoulders that is upwards, in half of the frames.
UPRIGHT = 0.75
# Height of an ankle above the sole, as a share of the leg from the hip to the ankle.
ANKLE_HEIGHT = 0.1
# Ground that is nearer to 0 than this stays where it is [m].
GROUND = 0.02
MAX_FRAMES = 100_000
# Numbers beyond this are no place in any unit.
FAR = 1e7


class _Recording(NamedTuple):
    """Points (T, N, 3) of a file by their labels, NaN where they are missing, frames per second, and the unit."""

    labels: list[str]
    points: np.ndarray
    rate: float | None
    unit: str


class Joints(NamedTuple):
    """Points of a person in space, as `Keypoints` of three coordinates, and notes of how the file was read."""

    keypoints: Keypoints
    notes: tuple[str, ...]


def is_joint_file(path: str | Path) -> bool:
    """Return whether a path is that of a file of points in space, and not of keypoints or joint angles."""
    path = Path(path)
    if path.suffix.lower() != ".npz" or not path.is_file():
        return path.suffix.lower() in SUFFIXES
    try:
        return {"names", "positions"} <= arrays_of(path).keys()
    except Exception:  # each part of an archive is damaged in its own way, and its reader says so
        return False


def load(
    path: str | Path, rate: float | None = None, names: Mapping[str, str] | None = None, grounded: bool = True
) -> Joints:
    """Read a person's points; an InputError of one line names what is missing, damaged or not understood.

    path: TRC, C3D, or an npz file with names (N,), positions (T, N, 3), NaN where unknown, and rate. rate: frames per
    second, in the place of the file's. names: the file's labels of some of `POINTS`. grounded: move the points so that
    the lowest feet are on the ground, if they are not.
    """
    path = Path(path)
    name = path.absolute().name
    require_file("path", path)
    try:
        recording = _READERS.get(path.suffix.lower(), _npz)(path)
        labels = ["".join(letter for letter in label if letter.isprintable()).strip() for label in recording.labels]
        rows = _rows(labels, names or {})
        places = np.full((len(recording.points), len(POINTS), 3), np.nan)
        places[:, list(rows)] = recording.points[:, list(rows.values())]
        places[~(abs(places) < FAR).all(axis=-1)] = np.nan
        with np.errstate(invalid="ignore"):
            places, unit = _in_metres(places, recording.unit)
            places, up = _upright(places)
            places, ground = _on_ground(places) if grounded else (places, "")
    except InputError as error:
        raise InputError(f"{name} {error}") from None
    rate = require_rate(recording.rate if rate is None else rate, name)
    known = np.isfinite(places[..., 0]).astype(float)
    notes = (
        f"{len(rows)} points: {', '.join(labels[row] for row in rows.values())}",
        f"{up} up, in {unit}{ground}",
    )
    return Joints(Keypoints(places, known, rate), notes)


def _rows(labels: list[str], names: Mapping[str, str]) -> dict[int, int]:
    """Return the row of the file's points for each row of ours that it has; names: labels by our names."""
    for point, label in names.items():
        require_known("with names for a point that", point, POINTS)
        require_known(f"with names whose label of {point}", label, labels)
    meanings = [(*meaning, row) for row, label in enumerate(labels) if (meaning := _meaning(label)) is not None]
    by_words = {point: row for point, _, row in sorted(meanings, key=lambda meaning: -meaning[1])}
    by_name = by_words | {point: labels.index(label) for point, label in names.items()}
    rows = {row: by_name[point] for row, point in enumerate(POINTS) if point in by_name}
    if missing := [point for point in NEEDED if POINTS.index(point) not in rows]:
        known = ", ".join(labels[:12]) + (" ..." if len(labels) > 12 else "")
        raise InputError(f"has no {missing[0]} among its points ({known}): say which in a file of names")
    return rows


def _meaning(label: str) -> tuple[str, int] | None:
    """Return which of `POINTS` a label means, and the number of its word, if any."""
    letters = re.sub("[^a-z]", "", label.rpartition(":")[2].lower())
    if letters == "nose":
        return "nose", 0
    for side in SIDES:
        for marked in (side, side[0]):
            word = letters.removeprefix(marked) if letters.startswith(marked) else letters.removesuffix(marked)
            for limb, words in WORDS.items():
                if word != letters and word in words:
                    return f"{side}_{limb}", words.index(word)
    return None


def _trc(path: Path) -> _Recording:
    """Read a TRC file: lines of its kind, of the names of its properties and of their values, and of the labels."""
    try:
        lines = path.read_text("utf-8-sig").splitlines()
        header = dict(zip(lines[1].split(), lines[2].split(), strict=False))
        labels = [cell.strip() for cell in lines[3].split("\t")[2:] if cell.strip()]
        rows = [line.split("\t") for line in lines[5:] if line.strip()]
        width = 2 + 3 * len(labels)
        values = [[_number(cell) for cell in (row + [""] * width)[2:width]] for row in rows]
        points = np.array(values, float).reshape(len(rows), len(labels), 3)
        rate = float(header["DataRate"])
    except (ValueError, IndexError, KeyError) as error:
        raise InputError(f"is no whole TRC file ({type(error).__name__}: {error})") from None
    _require_some(points)
    return _Recording(labels, points, rate, header.get("Units", ""))


def _number(cell: str) -> float:
    return float(cell) if cell.strip() else np.nan


def _c3d(path: Path) -> _Recording:
    try:
        with path.open("rb") as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of what has nothing to do with points
            reader = c3d.Reader(file)
            parameters = reader.get("POINT")
            if parameters is None or "LABELS" not in parameters or not any(map(str.strip, reader.point_labels)):
                raise InputError("has no labels of its points (POINT:LABELS), but needs them")
            labels = [label.strip() for label in reader.point_labels]
            unit = parameters.get_string("UNITS").strip() if "UNITS" in parameters else ""
            frames = [points[:, :4].copy() for _, points, _ in reader.read_frames()]
            rate = float(reader.point_rate)
    except InputError:
        raise
    except Exception as error:  # the reader fails in many ways on what is damaged
        reason = " ".join(f"{type(error).__name__}: {error}".split())[:80]
        raise InputError(f"is no whole C3D file ({reason})") from None
    if not frames or len(labels) < frames[0].shape[0]:
        raise InputError(
            f"has {len(labels)} labels of {len(frames[0]) if frames else 0} points, but needs one for each"
        )
    values = np.array(frames, float)
    missing = values[..., 3:] < 0.0  # a residual below 0 says so
    points = np.where(missing, np.nan, values[..., :3])
    _require_some(points)
    return _Recording(labels[: points.shape[1]], points, rate if np.isfinite(rate) else None, unit)


def _npz(path: Path) -> _Recording:
    try:
        content = arrays_of(path)
    except Exception:  # each part of an archive is damaged in its own way
        raise InputError("is no whole npz file of numbers and names") from None
    if not {"names", "positions"} <= content.keys():
        raise InputError("is npz without names and positions")
    labels, points = [str(name) for name in content["names"].ravel()], np.asarray(content["positions"])
    if points.dtype.kind not in "fiu" or points.ndim != 3 or points.shape[1:] != (len(labels), 3):
        raise InputError(f"has positions {points.shape}, but needs numbers (T, {len(labels)}, 3)")
    rate = content.get("rate", np.nan)
    if np.shape(rate) or np.asarray(rate).dtype.kind not in "fiu":
        raise InputError("has a rate that is not one number")
    _require_some(points)
    return _Recording(labels, points.astype(float), float(rate) if "rate" in content else None, "m")


_READERS = {".trc": _trc, ".c3d": _c3d}


def _require_some(points: np.ndarray) -> None:
    if not 1 <= len(points) <= MAX_FRAMES:
        raise InputError(f"has {len(points)} frames, but needs from 1 to {MAX_FRAMES}")


def _of_both_sides(places: np.ndarray, limb: str) -> np.ndarray:
    """Return the places (T, 2, 3) of a limb's points, left and right."""
    return places[:, [POINTS.index(f"{side}_{limb}") for side in SIDES]]


def leg_length(places: np.ndarray) -> float:
    """Return the length of the legs of a person's points (T, P, 3), in their unit; NaN if no leg is whole."""
    hips, knees, ankles = (_of_both_sides(places, limb) for limb in ("hip", "knee", "ankle"))
    lengths = np.linalg.norm(hips - knees, axis=-1) + np.linalg.norm(knees - ankles, axis=-1)
    return float(np.median(lengths[np.isfinite(lengths)])) if np.isfinite(lengths).any() else np.nan


def upwards(places: np.ndarray) -> np.ndarray:
    """Return the direction (3,) from ankles to shoulders of a person's points (T, P, 3), NaN if never seen."""
    ways = (_of_both_sides(places, "shoulder") - _of_both_sides(places, "ankle")).mean(axis=1)
    known = ways[np.isfinite(ways).all(axis=-1)]
    shares: np.ndarray = known / np.linalg.norm(known, axis=-1, keepdims=True)
    return np.median(shares, axis=0) if len(known) else np.full(3, np.nan)


def axis_along(direction: np.ndarray) -> str | None:
    """Return the axis along which a direction (3,) mostly points, such as "z" or "-y"; None if there is none."""
    axis = int(abs(direction).argmax())
    if not abs(direction[axis]) > UPRIGHT:
        return None
    return f"{'-' if direction[axis] < 0.0 else ''}{'xyz'[axis]}"


def _in_metres(places: np.ndarray, unit: str) -> tuple[np.ndarray, str]:
    """Return the places [m], and the unit they were in: the file's if the legs are a person's in it, else another."""
    length = leg_length(places)
    if not np.isfinite(length):
        raise InputError("has no frame with a whole leg")
    for candidate in sorted(UNITS, key=lambda other: other != unit.lower()):
        if LEGS[0] <= length * UNITS[candidate] <= LEGS[1]:
            return places * UNITS[candidate], candidate
    raise InputError(f"has legs of a length of {length:.3g} {unit}, which no person has in m, mm, cm or inches")


def _upright(places: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the places with z up, and the name of the axis that was up: the one along which people stand."""
    share = upwards(places)
    if not np.isfinite(share).all():
        raise InputError("has no frame with both shoulders and ankles")
    along = axis_along(share)
    if along is None:
        raise InputError("has nobody who stands: which way is up is not known")
    turned = np.roll(places, 2 - "xyz".index(along[-1]), axis=-1)  # axes keep their order, and with it left and right
    if along.startswith("-"):
        turned = turned * (1.0, -1.0, -1.0)
    _require_own_sides(turned)
    return turned, along


def _require_own_sides(places: np.ndarray) -> None:
    """Raise InputError where a person with toes has left and right exchanged."""
    ahead = (_of_both_sides(places, "toe") - _of_both_sides(places, "ankle")).mean(axis=1)
    left, right = _of_both_sides(places, "hip").swapaxes(0, 1)
    turn = ahead[:, 0] * (left - right)[:, 1] - ahead[:, 1] * (left - right)[:, 0]
    if np.isfinite(turn).any() and np.mean(turn[np.isfinite(turn)] > 0.0) < 0.2:
        raise InputError("has left and right exchanged, or one axis mirrored")


def _on_ground(places: np.ndarray) -> tuple[np.ndarray, str]:
    """Return the places with the lowest feet on the ground, and what was found, if they were elsewhere."""
    lowest = places[:, FEET, 2] - SOLE_HEIGHT
    if not np.isfinite(lowest).any():
        ankles, hips = (_of_both_sides(places, limb)[..., 2] for limb in ("ankle", "hip"))
        lowest = ankles - ANKLE_HEIGHT * float(np.nanmax(hips - ankles))
    lowest = np.where(np.isfinite(lowest), lowest, np.inf).min(axis=1)
    height = float(np.percentile(lowest[np.isfinite(lowest)], 5.0))
    if abs(height) < GROUND:
        return places, ""
    return places - (0.0, 0.0, height), f", the ground at {height:.2f} m"

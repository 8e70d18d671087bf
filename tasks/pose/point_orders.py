"""Orders in which detectors list a person's points, and which of them a film's points are in."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from larp_model.errors import InputError
from tasks.pose.points import POINTS, SIDES


def _pairs(*parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for part in parts for side in SIDES)


def _sides(first: str, second: str, *parts: str) -> tuple[str, ...]:
    return tuple(f"{side}_{part}" for side in (first, second) for part in parts)


_ARM, _LEG, _FOOT = ("shoulder", "elbow", "wrist"), ("hip", "knee", "ankle"), ("toe", "small_toe", "heel")
_ARMS, _LEGS = _sides("right", "left", *_ARM), _sides("right", "left", *_LEG)
_FEET = _sides("left", "right", *_FOOT)
_HEAD = ("right_eye", "left_eye", "right_ear", "left_ear")
_COCO = ("nose", *_pairs("eye", "ear", *_ARM, *_LEG))
_HALPE = (*_COCO, "head", "neck", "pelvis", *_pairs(*_FOOT))
# How many points a person has in an order, and the names of the first of them: whole bodies go on with faces and hands.
ORDERS: dict[str, tuple[int, tuple[str, ...]]] = {
    "coco": (17, _COCO),
    "h36m": (17, ("pelvis", *_LEGS, "spine", "thorax", "neck", "head", *_sides("left", "right", *_ARM))),
    "openpose_coco": (18, ("nose", "neck", *_ARMS, *_LEGS, *_HEAD)),
    "body_25": (25, ("nose", "neck", *_ARMS, "pelvis", *_LEGS, *_HEAD, *_FEET)),
    "body_25b": (25, (*_COCO, "neck", "head", *_FEET)),
    "halpe_26": (26, _HALPE),
    "mediapipe": (
        33,
        (
            "nose",
            *_sides("left", "right", "inner_eye", "eye", "outer_eye"),
            *_pairs("ear", "mouth", *_ARM, "little_finger", "index_finger", "thumb", *_LEG, "heel", "toe"),
        ),
    ),
    "coco_wholebody": (133, (*_COCO, *_FEET)),
    "halpe_136": (136, _HALPE),
}
COUNTS = sorted({count for count, _ in ORDERS.values()})

# Lengths between points [m], of an adult; by side, but for the two across.
_LENGTHS = {
    ("shoulder", "elbow"): 0.29, ("elbow", "wrist"): 0.26, ("shoulder", "hip"): 0.5, ("hip", "knee"): 0.42,
    ("knee", "ankle"): 0.41, ("ankle", "heel"): 0.09, ("heel", "toe"): 0.22, ("nose", "ear"): 0.14,
}  # fmt: skip
_WIDTHS = {"shoulder": 0.36, "hip": 0.22}
# Of the lengths over a film, the one that counts: limbs look shorter where they point at the camera.
_QUANTILE = 0.75
# Over 300 synthetic films of 5 motions, seen from all around, the right order is at most 0.48 from a person; other
# orders are farther in 99 %. In single frames the right one is 0.43 away in the median, 2 at worst.
_LARGEST, _CLEARLY = 0.6, 0.75
_LEAST_LIMBS = 4


def order_of(people: Sequence[np.ndarray], name: str | None = None) -> tuple[str, tuple[str, ...]]:
    """Return the name of the order that a film's people (N, 3), places and confidence, are in, and the points' names.

    name: of the order, one of `ORDERS`, if it is known. Of several orders with as many points, the one is taken in
    which the points make a person: limbs have a person's proportions.
    """
    counts = {len(person) for person in people}
    candidates = [
        order for order, (count, _) in ORDERS.items() if (name is None and {count} == counts) or order == name
    ]
    for count in sorted(counts - {ORDERS[order][0] for order in candidates}):
        needed = ", ".join(map(str, COUNTS)) if name is None else f"{ORDERS[name][0]}, as {name} has"
        several = f", the same in all frames; it has {sorted(counts)}" if len(counts) > 1 else ""
        raise InputError(f"has a person of {count} points, but needs {needed}{several}")
    distances = {order: distance_from_person(np.stack(people), ORDERS[order][1]) for order in candidates}
    if np.inf in distances.values():  # too little is seen to tell
        return candidates[0], ORDERS[candidates[0]][1]
    best, *others = sorted(candidates, key=lambda order: distances[order])
    if others and distances[best] > min(_LARGEST, _CLEARLY * distances[others[0]]):
        count, options = len(people[0]), " or ".join(candidates)
        raise InputError(f"has {count} points a person, but in which order is not clear: give points, {options}")
    return best, ORDERS[best][1]


def distance_from_person(rows: np.ndarray, names: Sequence[str]) -> float:
    """Return how far points (T, N, 3), named in this order, are from a person's.

    The sum of two means over limbs, weighted by an adult's lengths: |log| of their lengths, relative to those and to
    the median limb, and |log| of left over right. Infinite where fewer than four limbs were detected.
    """
    pairs = [[(f"left_{end}", f"right_{end}", length)] for end, length in _WIDTHS.items()] + [
        [(first if first == "nose" else f"{side}_{first}", f"{side}_{last}", length) for side in SIDES]
        for (first, last), length in _LENGTHS.items()
    ]
    limbs = [limb for pair in pairs for limb in pair]
    lengths, usual = np.array([_length(rows, names, *limb) for limb in limbs]), np.array([limb[-1] for limb in limbs])
    asymmetries = abs(np.diff(lengths[len(_WIDTHS) :].reshape(-1, 2)))[:, 0]
    if np.isfinite(lengths).sum() < _LEAST_LIMBS or not np.isfinite(asymmetries).any():
        return np.inf
    deviations = abs(lengths - np.nanmedian(lengths))
    return _mean(deviations, usual) + _mean(asymmetries, usual[len(_WIDTHS) :: 2])


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    known = np.isfinite(values)
    return float(np.average(values[known], weights=weights[known]))


def _length(rows: np.ndarray, names: Sequence[str], first: str, last: str, usual: float) -> float:
    """Return the log of a length [px] in units of the usual one [m], NaN where it was not detected."""
    if first not in names or last not in names:
        return np.nan
    ends = rows[:, [names.index(first), names.index(last)]]
    seen = ends[(ends[..., 2] > 0.0).all(axis=1), :, :2]
    lengths = np.linalg.norm(seen[:, 0] - seen[:, 1], axis=-1)
    return float(np.log(np.maximum(np.quantile(lengths, _QUANTILE), 1e-3) / usual)) if len(seen) else np.nan


def in_our_order(rows: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Return places [px] and confidence of `POINTS` (P, 3) from rows (N, 3) so named; NaN and 0 where not detected."""
    detected = np.zeros((len(POINTS), 3))
    for row, name in zip(rows, names, strict=False):
        if name in POINTS:
            detected[POINTS.index(name)] = row
    detected[:, 2] = detected[:, 2].clip(0.0, 1.0)
    detected[detected[:, 2] == 0.0, :2] = np.nan
    return detected

"""Strict parser of BVH files: joints with their offsets and channels, and the channels' values in every frame."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice, takewhile

import numpy as np

from larp_model.errors import InputError

_LARGEST = 1e6
END = " (end)"  # of the name of an end site
PREFIX = re.compile(r"^(.*:|mixamorig\d*_)")  # of a whole skeleton, as in mixamorig:Hips
_FRAMES, _FRAME_TIME = re.compile(r"Frames:\s*(\d+)"), re.compile(r"Frame Time:\s*(\S+)")


@dataclass(frozen=True)
class BvhJoint:
    """A joint, or the end site of one, which has no channels."""

    name: str
    parent: int
    offset: list[float]
    channels: list[str]


def parse(lines: list[str]) -> tuple[list[BvhJoint], float, np.ndarray]:
    """Return the joints, seconds per frame and channels (T, C) of a file, in its own unit and axes."""
    rows = [(number, line.split()) for number, line in enumerate(lines, start=1) if line.strip()]
    start = next((index for index, (_, words) in enumerate(rows) if words == ["MOTION"]), None)
    if start is None or rows[0][1] != ["HIERARCHY"]:
        raise InputError("is no BVH file: it needs a line HIERARCHY first and a line MOTION later")
    joints = _hierarchy(word for _, words in rows[1:start] for word in words)
    head = [" ".join(words) for _, words in rows[start + 1 : start + 3]]
    matches = [pattern.fullmatch(line) for pattern, line in zip((_FRAMES, _FRAME_TIME), head, strict=False)]
    if len(matches) < 2 or matches[0] is None or matches[1] is None:
        raise InputError("has no frames: it needs lines 'Frames: N' and 'Frame Time: SECONDS' after MOTION")
    count, seconds = (match[1] for match in matches if match)
    (duration,) = _numbers([seconds], 1, "has a Frame Time that")
    if not 0.0 < duration <= 0.1:
        raise InputError(f"has a Frame Time of {duration:g} s, but needs one above 0 and up to 0.1 s")
    columns = sum(len(joint.channels) for joint in joints)
    data = [_numbers(words, columns, f"has a line, {number}, that") for number, words in rows[start + 3 :]]
    # Some writers count one frame too many or too few.
    if not data or abs(len(data) - int(count[:9])) > 1:
        raise InputError(f"has {len(data) or 'no'} frames, but announces {count[:9]}")
    return joints, duration, np.array(data)


def _numbers(words: list[str], count: int, place: str) -> list[float]:
    if len(words) != count:
        raise InputError(f"{place} has {len(words)} columns, but needs {count}")
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise InputError(f"{place} holds something that is not a number") from None
    if not all(abs(value) < _LARGEST for value in values):
        raise InputError(f"{place} holds a number that is not finite, or not below {_LARGEST:g}")
    return values


def _hierarchy(words: Iterator[str]) -> list[BvhJoint]:
    """Return the tree of joints and end sites, parents first."""
    joints: list[BvhJoint] = []
    ancestors: list[int] = []

    def expect(*expected: str) -> None:
        for word in expected:
            if (actual := next(words, "its end")) != word:
                raise InputError(f"has {actual[:40]!r} in its HIERARCHY, but needs {word!r} there")

    for word in words:
        if word == "}" and ancestors:
            ancestors.pop()
        elif word == "End" and ancestors:
            expect("Site", "{", "OFFSET")
            offset = _numbers(list(islice(words, 3)), 3, "has an End Site that")
            expect("}")
            joints.append(BvhJoint(_end_name(joints, ancestors[-1]), ancestors[-1], offset, []))
        elif word == ("JOINT" if ancestors else "ROOT") and (ancestors or not joints):
            name = PREFIX.sub("", " ".join(takewhile(lambda part: part != "{", words)))
            expect("OFFSET")
            offset = _numbers(list(islice(words, 3)), 3, f"has a joint, {name}, that")
            expect("CHANNELS")
            count = next(words, "")
            kinds = ("rotation",) if ancestors and count != "6" else ("position", "rotation")
            expected = [axis + kind for kind in kinds for axis in "XYZ"]
            channels = list(islice(words, len(expected)))
            if count != str(len(expected)) or sorted(channels) != sorted(expected):
                raise InputError(f"has a joint, {name}, with other channels than {', '.join(expected)}, each once")
            joints.append(BvhJoint(name, ancestors[-1] if ancestors else -1, offset, channels))
            ancestors.append(len(joints) - 1)
        else:
            raise InputError(f"has {word[:40]!r} in its HIERARCHY, where it does not belong")
    names = [joint.name for joint in joints]
    if ancestors or len(set(names)) != len(names):
        raise InputError("has a HIERARCHY with " + ("braces left open" if ancestors else "two joints of one name"))
    return joints


def _end_name(joints: list[BvhJoint], parent: int) -> str:
    """Return a name for one more end site of a joint."""
    return joints[parent].name + END * (1 + sum(joint.parent == parent and not joint.channels for joint in joints))

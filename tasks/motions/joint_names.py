"""Names of joints in BVH files: tables of known skeletons, a user's own, and which of them a file follows."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import shorten

from larp_model.errors import InputError
from larp_model.names import require_file
from tasks.motions.bvh_file import END, PREFIX, BvhJoint
from tasks.motions.skeleton import NEEDED, SIDES

# The bones of the Carnegie Mellon database's own ASF files, each named at the joint where it begins.
BONES = {
    "Arm": "humerus",
    "ForeArm": "radius",
    "Hand": "wrist",
    "UpLeg": "femur",
    "Leg": "tibia",
    "Foot": "foot",
    "ToeBase": "toes",
}
ASF = {"Head": "head", **{side + name: side[0].lower() + bone for side in SIDES for name, bone in BONES.items()}}
# Joints of Biovision's and Xsens' files.
_JOINTS = {
    "Arm": "Shoulder", "ForeArm": "Elbow", "Hand": "Wrist", "UpLeg": "Hip", "Leg": "Knee", "Foot": "Ankle",
    "ToeBase": "Toe",
}  # fmt: skip
# Joints of 3ds Max's biped.
_BIPED = {
    "Arm": "UpperArm", "ForeArm": "Forearm", "Hand": "Hand", "UpLeg": "Thigh", "Leg": "Calf", "Foot": "Foot",
    "ToeBase": "Toe0",
}  # fmt: skip
# Names of the needed joints in the files of each known skeleton; Mixamo's names are MotionBuilder's, prefixed.
SKELETONS = {
    "MotionBuilder": {name: name for name in NEEDED},
    "LAFAN1": {name: name.replace("ToeBase", "Toe") for name in NEEDED},
    "ASF": {"Hips": "root", **ASF},
    "Biovision": {name: name for name in ("Hips", "Head")}
    | {side + name: side + own for side in SIDES for name, own in _JOINTS.items()},
    "Biped": {"Hips": "Pelvis", "Head": "Head"}
    | {side + name: side[0] + own for side in SIDES for name, own in _BIPED.items()},
}


def names_in(path: Path) -> dict[str, str]:
    """Return the table of joint names in a JSON file, for `bvh.load`."""
    require_file("names", path)
    try:
        names = json.loads(path.read_bytes())
    except ValueError:
        raise InputError(f"names: {path.name} is no JSON file") from None
    if not (isinstance(names, dict) and all(isinstance(name, str) for name in names.values())):
        raise InputError(f'names: {path.name} needs an object such as {{"Hips": "pelvis", "LeftLeg": "l_knee"}}')
    return names


def table_of(names: Mapping[str, str]) -> dict[str, str]:
    """Return a user's table completed with our names; InputError where it has unknown joints or one name twice."""
    if unknown := [str(name) for name in names if name not in NEEDED]:
        raise InputError(f"names has {', '.join(unknown)}, but needs a file's names of {', '.join(NEEDED)}")
    table = {name: _spaceless(PREFIX.sub("", names.get(name, name))) for name in NEEDED}
    if len(set(table.values())) < len(table):
        repeated = next(file_name for file_name in table.values() if list(table.values()).count(file_name) > 1)
        our_names = " and ".join(name for name, file_name in table.items() if file_name == repeated)
        raise InputError(f"names has {repeated!r} for {our_names}, but needs another joint for each")
    return table


def _spaceless(name: str) -> str:
    """Return a joint's name without spaces, which those of end sites keep."""
    own = name.removesuffix(END)
    return own.replace(" ", "") + name[len(own) :]


@dataclass(frozen=True)
class _FileNames:
    """Names of a file's joints and end sites, in its order, without spaces and what all of them begin with."""

    names: tuple[str, ...]
    sites: frozenset[str]
    prefix: str

    @classmethod
    def of(cls, joints: list[BvhJoint]) -> _FileNames:
        """Return those of a file's joints."""
        prefix = _prefix_of([joint.name for joint in joints])
        names = tuple(_spaceless(joint.name.removeprefix(prefix)) for joint in joints)
        sites = frozenset(name for name, joint in zip(names, joints, strict=True) if not joint.channels)
        return cls(names, sites, _spaceless(prefix))

    def completed(self, table: dict[str, str]) -> dict[str, str]:
        """Return a table of these names: without the prefix, and with feet's end sites for toes that are not there."""
        table = {name: own.removeprefix(self.prefix) for name, own in table.items()}
        ends = {side + "ToeBase": table[side + "Foot"] + END for side in SIDES}
        return table | {name: end for name, end in ends.items() if table[name] not in self.names and end in self.sites}

    def missing(self, table: dict[str, str]) -> dict[str, str]:
        """Return the part of a table whose names are not there."""
        return {name: own for name, own in table.items() if own not in self.names}


def _prefix_of(names: list[str]) -> str:
    """Return what all names begin with, up to an underscore or a space, as in Character1_Hips; a root may be it."""
    rest = sorted(name for name in names if not all(other.startswith(name) for other in names))
    first, last = (rest[0], rest[-1]) if rest else ("", "")
    same = next((place for place, pair in enumerate(zip(first, last, strict=False)) if len({*pair}) > 1), 0)
    return first[: max(first.rfind(separator, 0, same) for separator in "_ ") + 1]


def renamed(joints: list[BvhJoint], tables: list[dict[str, str]]) -> list[BvhJoint]:
    """Return the joints, the needed ones renamed to ours by the first table with the fewest missing.

    End sites are left out that are no toes.
    """
    file_names = _FileNames.of(joints)
    table = min(map(file_names.completed, tables), key=lambda table: len(file_names.missing(table)))
    if missing := file_names.missing(table):
        present = ", ".join(name for name in file_names.names if name not in file_names.sites)
        raise InputError(
            f"has no joints {', '.join(missing.values())}, but needs them, or names that say what it calls"
            f" {', '.join(missing)}: it has {shorten(present, 600)}"
        )
    our_name = {file_name: name for name, file_name in table.items()}
    rows = [row for row, name in enumerate(file_names.names) if name not in file_names.sites or name in our_name]
    return [
        replace(joints[row], name=_name(file_names.names[row], our_name), parent=_row(rows, joints[row].parent))
        for row in rows
    ]


def _name(name: str, our_name: dict[str, str]) -> str:
    """Return our name of a joint; another joint of the file may have a name that is one of ours."""
    return our_name.get(name, f"{name} (other)" if name in NEEDED else name)


def _row(rows: list[int], parent: int) -> int:
    return rows.index(parent) if parent >= 0 else -1

"""Files of all kinds that are read, damaged at random: each is read, or refused in one line.

Bytes are cut, flipped, repeated or replaced; numbers become extreme ones; values in JSON and arrays in npz become
others.
"""

from __future__ import annotations

import json
import re
import resource
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import chdir
from dataclasses import dataclass, fields, is_dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import c3d
import mujoco
import numpy as np
from rich.table import Table

from larp_model import weights
from larp_model.bodies import chain, human
from larp_model.engines import episodes
from larp_model.errors import InputError
from larp_model.learned.residual import ResidualModel
from larp_model.mjcf import humanoid
from larp_model.networks import Weights
from larp_model.scene import Scene
from tasks.benchmarks import report
from tasks.command import run
from tasks.kick import Kick
from tasks.live import load_recording
from tasks.motions import angles, bvh, key_poses
from tasks.pose import camera, formats, joint_files, safe_pickle
from tasks.pose.figure import SHARED, Pose, figure
from tasks.pose.points import POINTS

# Files of a job, after which a run that was cut off goes on.
CHUNK = 250
HUMANOID = Path(mujoco.__file__).parent / "mjx/test_data/humanoid/humanoid.xml"
NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
EXTREME = (b"nan", b"inf", b"-1", b"0", b"1e400", b"1e38", b"99999999999", b"-", b"", b"\xff", b"0x10", b"true")
VALUES: tuple[Any, ...] = (None, True, -1, 0, 1e38, 10**30, "", "text", [], {}, [[[]]], float("nan"), float("inf"))
ARRAYS: tuple[Any, ...] = (
    np.zeros(0), np.zeros((0, 3)), np.array(np.nan), np.array("text"), np.full((3, 3), np.inf), np.zeros((2, 3, 4, 5)),
    np.array([b"x"]), np.zeros(3, complex), np.array(10**18), np.array([True]), np.array(-1), np.zeros((1, 1, 1)),
)  # fmt: skip


@dataclass(frozen=True)
class FileKind:
    """A kind of file: how a whole one is written into a folder, its name there, and how it is read."""

    write: Callable[[Path], None]
    name: str
    read: Callable[[Path], Any]


# Whole files.


def _motion(seed: int = 0) -> Any:
    random, joints, frames = np.random.default_rng(seed), len(human().motors), 12
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (frames, 1))
    return 60.0, np.full((frames, 3), (0.0, 0.0, 0.95)), upright, 0.2 * random.standard_normal((frames, joints, 3))


def _write_weights(folder: Path) -> None:
    weights.save(folder, "model", ResidualModel(Scene((chain(links=2),))), Weights({}, {}, {}), {})


def _write_episodes(folder: Path) -> None:
    links, count, steps = 2, 3, 4
    states = np.zeros((count, steps + 1, links, 13), np.float32)
    zeros = np.zeros((count, steps, links, 3), np.float32)
    recorded = episodes.Episodes(states, zeros[:, :, :0], zeros, np.ones((count, links, 3), np.float32))
    episodes.save(folder / "episodes.npz", Scene((chain(links=2),)), recorded)


def _write_motion(folder: Path) -> None:
    np.savez(folder / "motion.npz", **dict(zip(angles.FIELDS, _motion(), strict=True)))


def _write_keypoints(folder: Path) -> None:
    places = np.random.default_rng(0).uniform(100.0, 600.0, (8, len(POINTS), 2))
    np.savez(
        folder / "film.npz", names=np.array(POINTS), places=places, rate=np.array(30.0), size=np.array([1280, 720])
    )


def _write_detections(folder: Path) -> None:
    random = np.random.default_rng(0)
    people = [
        {
            "image_id": f"{frame}.jpg",
            "category_id": 1,
            "keypoints": random.uniform(1.0, 500.0, 51).tolist(),
            "score": 2.5,
        }
        for frame in range(4)
    ]
    (folder / "results.json").write_text(json.dumps(people))


def _write_labels(folder: Path) -> None:
    random = np.random.default_rng(0)
    for frame in range(4):
        numbers = [0, 0.5, 0.5, 0.3, 0.8, *random.uniform(0.1, 0.9, 51)]
        _write_text(folder / f"film_{frame}.txt", " ".join(f"{number:.5f}" for number in numbers) + "\n")


def _write_camera(folder: Path) -> None:
    fields = {"size": [1280, 720], "field_of_view": 60.0, "position": [0.0, -4.0, 1.5], "look_at": [0.0, 0.0, 1.0]}
    (folder / "camera.json").write_text(json.dumps(fields))


def _write_opencv_lens(folder: Path) -> None:
    matrix = "!!opencv-matrix {rows: 3, cols: 3, dt: d, data: [900., 0., 640., 0., 900., 360., 0., 0., 1.]}"
    distortion = "!!opencv-matrix {rows: 1, cols: 5, dt: d, data: [-0.1, 0.05, 0.001, 0.002, 0.01]}"
    text = f"%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\ncamera_matrix: {matrix}\n"
    _write_text(folder / "lens.yml", f"{text}distortion_coefficients: {distortion}\n")


def _write_pose2sim_camera(folder: Path) -> None:
    matrix = "[[900.0, 0.0, 640.0], [0.0, 900.0, 360.0], [0.0, 0.0, 1.0]]"
    lens = f'name = "a"\nsize = [1280.0, 720.0]\nmatrix = {matrix}\ndistortions = [-0.1, 0.05, 0.001, 0.002]\n'
    place = "rotation = [1.2, -1.2, 1.2]\ntranslation = [0.0, 1.4, 4.0]\nfisheye = false\n"
    _write_text(folder / "calib.toml", f"[a]\n{lens}{place}")


def _write_qualisys_camera(folder: Path) -> None:
    place = 'x="0" y="-4000" z="1500" r11="1" r12="0" r13="0" r21="0" r22="0" r23="1" r31="0" r32="-1" r33="0"'
    lens = 'sensorMaxU="81919" sensorMaxV="46079" focalLengthU="57600" focalLengthV="57600" centerPointU="40960"'
    inner = f'<transform {place}/><intrinsic {lens} centerPointV="23040" radialDistortion1="-0.1"/>'
    text = f'<calibration><cameras><camera serial="7" model="Video">{inner}</camera></cameras></calibration>'
    _write_text(folder / "lab.qca.txt", text)


def _write_colmap_camera(folder: Path) -> None:
    _write_text(folder / "cameras.txt", "1 OPENCV 1280 720 900 900 640 360 -0.1 0.05 0.001 0.002\n")
    _write_text(folder / "images.txt", "1 0.7071 0.7071 0 0 0 1.5 4 1 a/1.png\n\n")


def _write_kept_kick(folder: Path, kick: Kick) -> None:
    states = np.repeat(kick.start()[None], 4, axis=0)
    figures = dict.fromkeys(("model_error_m", "ball_speed_m_s", "reference_deviation_m"), 0.1)
    gap = dict.fromkeys(("launch_error", "links_m")) | {"contact_s": {"truth": None}, "landing_m": {"truth": None}}
    said = {"target": [4.0, 0.0, 0.5], "dynamics": "larp", "preset": "fast", "fell": False, "reachable": True}
    said |= {"expected_errors": {"begin_s": 0.0, "steps_m": [1e-4, 5e-4]}}
    (folder / "summary.json").write_text(json.dumps({**said, **figures, "metrics": {}, "gap": gap}))
    np.savez(folder / "kick.npz", states=states, predicted_states=states[1:], plan_step=np.array(0))


def _joint_places() -> np.ndarray:
    """Return places (8, P, 3) [m] of somebody who stands."""
    pose = Pose(np.full((8, 3), (0.0, 0.0, 1.0)), np.tile(np.eye(3), (8, 1, 1)), np.zeros((8, figure().joints, 3)))
    return figure().all_points(pose, np.zeros(SHARED))


def _write_trc(folder: Path) -> None:
    labels = "\t\t\t".join(POINTS)
    head = f"PathFileType\t4\t(X/Y/Z)\tjoints.trc\nDataRate\tUnits\n60\tm\nFrame#\tTime\t{labels}\n\tX1\n"
    rows = [
        f"{frame}\t{frame / 60.0:.3f}\t" + "\t".join(f"{value:.4f}" for value in places.ravel())
        for frame, places in enumerate(_joint_places())
    ]
    _write_text(folder / "joints.trc", head + "\n".join(rows) + "\n")


def _write_c3d(folder: Path) -> None:
    writer = c3d.Writer(point_rate=60.0, point_units="m   ", point_scale=-1.0)
    writer.add_frames([(np.pad(places, ((0, 0), (0, 2))), np.zeros((0, 1))) for places in _joint_places()])
    writer.set_point_labels(list(POINTS))
    with (folder / "joints.c3d").open("wb") as file, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that there is nothing but points
        writer.write(file)


def _write_joints(folder: Path) -> None:
    np.savez(folder / "joints.npz", names=np.array(POINTS), positions=_joint_places(), rate=np.array(60.0))


def _write_pickle(folder: Path) -> None:
    (folder / "dance.pkl").write_bytes(np.arange(600.0).reshape(100, 3, 2).dumps())


def _copy(source: Path, folder: Path) -> None:
    (folder / source.name).write_bytes(source.read_bytes())


def kinds() -> dict[str, FileKind]:
    """Return all kinds of files by name."""
    two_links, kick = Scene((chain(links=2),)), Kick.standard()
    return {
        "weights' manifest": FileKind(_write_weights, "model.json", weights.load),
        "weights": FileKind(_write_weights, "model.safetensors", lambda path: weights.load(path.with_suffix(".json"))),
        "episodes": FileKind(_write_episodes, "episodes.npz", lambda path: episodes.load(path, two_links)),
        "motion, BVH": FileKind(
            lambda folder: _write_text(folder / "motion.bvh", bvh.dumps(angles.motion(*_motion()))),
            "motion.bvh",
            bvh.load,
        ),
        "motion, npz": FileKind(_write_motion, "motion.npz", angles.load),
        "humanoid, MJCF": FileKind(partial(_copy, HUMANOID), HUMANOID.name, humanoid),
        "keypoints, npz": FileKind(_write_keypoints, "film.npz", formats.load),
        "keypoints, JSON": FileKind(_write_detections, "results.json", partial(formats.load, rate=30.0, points="coco")),
        "keypoints, labels": FileKind(
            _write_labels,
            "film_1.txt",
            lambda path: formats.load(path.parent, rate=30.0, size=(1280.0, 720.0), points="coco"),
        ),
        "camera, JSON": FileKind(_write_camera, "camera.json", camera.load),
        "camera, YAML": FileKind(_write_opencv_lens, "lens.yml", camera.load),
        "camera, TOML": FileKind(_write_pose2sim_camera, "calib.toml", camera.load),
        "camera, XML": FileKind(_write_qualisys_camera, "lab.qca.txt", camera.load),
        "camera, text": FileKind(
            _write_colmap_camera, "images.txt", lambda path: camera.load(path.with_name("cameras.txt"))
        ),
        "joints, TRC": FileKind(_write_trc, "joints.trc", joint_files.load),
        "joints, C3D": FileKind(_write_c3d, "joints.c3d", joint_files.load),
        "joints, npz": FileKind(_write_joints, "joints.npz", joint_files.load),
        "key poses": FileKind(partial(_copy, key_poses.FILE), key_poses.FILE.name, key_poses.load),
        "kept kick, arrays": FileKind(
            partial(_write_kept_kick, kick=kick), "kick.npz", lambda path: load_recording(kick, path.parent)
        ),
        "kept kick, summary": FileKind(
            partial(_write_kept_kick, kick=kick), "summary.json", lambda path: load_recording(kick, path.parent)
        ),
        "pickled arrays": FileKind(_write_pickle, "dance.pkl", safe_pickle.load),
    }


def _write_text(path: Path, text: str) -> None:
    path.write_text(text)


# Damage.


def damaged_bytes(random: np.random.Generator, content: bytes, others: list[bytes]) -> bytes:
    """Return the bytes of a file after one kind of damage; others: files of other kinds."""
    begin, end = sorted(random.integers(0, len(content) + 1, 2).tolist())
    end = min(end, begin + int(10 ** random.uniform(0.0, 4.0)))
    before, part, after = content[:begin], content[begin:end], content[end:]
    numbers = [match.span() for match in NUMBER.finditer(content)] or [(0, 0)]
    first, last = numbers[random.integers(len(numbers))]
    replaced = content[:first] + EXTREME[random.integers(len(EXTREME))] + content[last:]
    flipped = bytearray(content)
    for bit in random.integers(0, 8 * len(content), random.integers(1, 9)):
        flipped[bit // 8] ^= 1 << bit % 8
    same = bytes([random.choice([0, 255, 32, 10])]) * len(part)
    other = [b"", *others][random.integers(len(others) + 1)]
    damages = (
        *(before, before + after, before + part + part + after, before + same + after, bytes(flipped), replaced, other),
        before + random.bytes(len(part)) + after,
    )
    return damages[random.integers(len(damages))]


def damaged_json(random: np.random.Generator, content: bytes) -> bytes:
    """Return JSON of which one value is another."""
    whole: Any = json.loads(content)
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        for key in node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ():
            places.append((node, key))
            visit(node[key])

    visit(whole)
    node, key = places[random.integers(len(places))]
    if random.random() < 0.2:
        del node[key]
    else:
        node[key] = VALUES[random.integers(len(VALUES))]
    return json.dumps(whole).encode()


def damage_arrays(random: np.random.Generator, path: Path) -> None:
    """Change one array of an npz file into another one, or one of its numbers; or leave it out."""
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    name = [*arrays][random.integers(len(arrays))]
    array = arrays.pop(name)
    if random.random() < 0.4 and array.size and array.dtype.kind == "f":
        array = array.copy()
        array.flat[random.integers(array.size)] = random.choice([np.nan, np.inf, 1e38, -1e38, 0.0])
        arrays[name] = array
    elif random.random() < 0.8:
        arrays[name] = ARRAYS[random.integers(len(ARRAYS))]
    np.savez(path, **arrays)


def is_finite(value: Any, depth: int = 0) -> bool:
    """Return whether all arrays of floating-point numbers in a result are finite."""
    if isinstance(value, np.ndarray):
        return value.dtype.kind not in "fc" or bool(np.isfinite(value).all())
    if depth > 4 or isinstance(value, str | bytes):
        return True
    if is_dataclass(value):
        return all(is_finite(getattr(value, field.name), depth + 1) for field in fields(value))
    if isinstance(value, Mapping):
        return all(is_finite(part, depth + 1) for part in value.values())
    return not isinstance(value, tuple | list) or all(is_finite(part, depth + 1) for part in value)


# Where not a number says that nothing was detected; and what reads any arrays.
ANY_NUMBERS = (
    *("keypoints, npz", "keypoints, JSON", "keypoints, labels", "joints, TRC", "joints, C3D", "joints, npz"),
    *("pickled arrays", "kept kick, arrays"),
)


def read_damaged(name: str, count: int, seed: int) -> report.Row:
    """Return how many of so many damaged files of a kind were read and refused, and what else happened."""
    all_kinds = kinds()
    kind, random = all_kinds[name], np.random.default_rng((seed, [*all_kinds].index(name)))
    row: report.Row = {"kind": name, "files": count, "read": 0, "refused": 0, "faults": [], "slowest_ms": 0.0}
    # MuJoCo writes its warnings into the folder in which it is.
    with TemporaryDirectory() as temporary, chdir(temporary):
        folder = Path(temporary)
        others = []
        for number, other in enumerate(all_kinds.values()):
            (own := folder / str(number)).mkdir()
            other.write(own)
            others.append((own / other.name).read_bytes())
        kind.write(folder)
        path = folder / kind.name
        kind.read(path)
        whole = path.read_bytes()
        for _ in range(count):
            path.write_bytes(whole)
            if path.suffix == ".npz" and random.random() < 0.5:
                damage_arrays(random, path)
            elif path.suffix == ".json" and random.random() < 0.5:
                path.write_bytes(damaged_json(random, whole))
            else:
                path.write_bytes(damaged_bytes(random, whole, others))
            begin = time.monotonic()
            try:
                result = kind.read(path)
                row["read"] += 1
                if name not in ANY_NUMBERS and not is_finite(result):
                    row["faults"].append("read numbers that are not finite")
            except InputError as error:
                row["refused"] += 1
                if "\n" in str(error):
                    row["faults"].append(f"refused in several lines: {str(error)[:200]!r}")
            except Exception as error:
                row["faults"].append(f"{type(error).__name__}: {str(error)[:200]}")
            row["slowest_ms"] = max(row["slowest_ms"], 1e3 * (time.monotonic() - begin))
    row["faults"] = row["faults"][:5] + [f"and {len(row['faults']) - 5} more"] * (len(row["faults"]) > 5)
    return row | {"memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024}


def table_of(rows: list[report.Row], title: str) -> Table:
    """Return a table with one line a kind of file."""
    table = Table("kind of file", "files", "read", "refused in one line", "neither", "slowest", "memory", title=title)
    for name in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == name]
        files, read, refused = (sum(row[key] for row in own) for key in ("files", "read", "refused"))
        faults = [fault for row in own for fault in row["faults"]]
        table.add_row(
            name, str(files), str(read), str(refused), f"{len(faults)}" + (f": {faults[0]}" if faults else ""),
            f"{max(row['slowest_ms'] for row in own):.0f} ms", f"{max(row['memory_mb'] for row in own):.0f} MB",
        )  # fmt: skip
    return table


def main(
    files: int = 10_000, seed: int = 0, json: Path = Path("runs/benchmarks/damaged_files.json"), publish: bool = False
) -> None:
    """Read damaged files of all kinds: each is read, or refused in one line.

    Args:
        files: how many, shared evenly by the kinds.
        seed: of the damage.
        json: where the figures go.
        publish: put the table into RESULTS.md.
    """
    names = [*kinds()]
    if files < len(names):
        raise InputError(f"files is {files}, but must be at least {len(names)}, one of each kind")
    report.ready(json, publish)
    command = f"python -m tasks.benchmarks.damaged_files --files {files} --seed {seed}"
    share = -(-files // len(names))
    jobs = {
        f"{name}, from {begin}": partial(read_damaged, name, min(CHUNK, share - begin), seed + begin)
        for name in names
        for begin in range(0, share, CHUNK)
    }
    rows = report.collect(json, command, jobs)
    report.write_json(json, {"command": command, "hardware": report.hardware(), "rows": rows})
    title = f"Damaged files: {sum(len(row['faults']) for row in rows)} of {share * len(names)} neither read nor refused"
    report.show(table := table_of(rows, title))
    if publish:
        report.publish("damaged_files", title, command, table)


if __name__ == "__main__":
    run(main)

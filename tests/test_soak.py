"""Longer runs than the suite's: random scenes and damaged files by thousands, random films by hundreds; `make soak`."""

from __future__ import annotations

import json
from pathlib import Path

import keypoint_files
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from larp_model.bodies import human_and_ball
from larp_model.errors import InputError
from larp_model.simulator import Simulator
from mpc.loop import DivergenceError
from tasks.benchmarks import damaged_files, random_scenes
from tasks.motions.references import embedded
from tasks.pose import command, physical, synthetic_film
from tasks.pose import figure as figures
from tasks.pose.figure import SHARED
from tasks.pose.points import interpolated

pytestmark = pytest.mark.soak

# Shared out evenly among the kinds.
STATES, STATES_PER_SCENE, FILES = 5000, 20, 10_000
FILMS, LONGEST = 200, 10.0  # s


@pytest.mark.parametrize("kind", random_scenes.KINDS)
def test_random_scenes_end_in_a_result_or_a_flag(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the engine logs a divergence into the working directory
    scenes = -(-STATES // (STATES_PER_SCENE * len(random_scenes.KINDS)))
    model = Simulator.of_physics(random_scenes.scene_of_kind(kind, None))
    tally = random_scenes.random_scenes(kind, model, scenes, STATES_PER_SCENE, steps=10, seed=1)
    assert (tally.states, tally.crashes, tally.silent) == (scenes * STATES_PER_SCENE, [], 0)


@pytest.mark.parametrize("kind", damaged_files.kinds())
def test_damaged_files_are_read_or_refused_in_one_line(kind: str) -> None:
    files = -(-FILES // len(damaged_files.kinds()))
    row = damaged_files.read_damaged(kind, files, seed=2)
    assert row["read"] + row["refused"] == files and not row["faults"]


@pytest.fixture(scope="module")
def kick() -> np.ndarray:
    """Points (T, P, 3) [m] of the embedded kick and then of it backwards, 100 frames a second."""
    reference, figure = embedded(human_and_ball()), figures.figure()
    body_points = physical.BodyPoints(figure.body, figure, np.zeros(SHARED))
    states = reference.states[:, : len(figure.body.links)].astype(np.float32)
    points = np.asarray(body_points.points(states), float)
    return np.concatenate([points, points[-2:0:-1]])


@pytest.mark.parametrize("seed", range(FILMS))
def test_random_films_end_in_a_motion_or_one_line(seed: int, kick: np.ndarray, tmp_path: Path) -> None:
    """From 1 to 300 frames, 5 to 1000 a second, in any format, with gaps at either end, by a known camera or not."""
    random = np.random.default_rng((2026, seed))
    rate = float(np.round(np.exp(random.uniform(np.log(5.0), np.log(1000.0))), 2))
    frames = int(min(float(random.integers(1, 301)), max(1.0, LONGEST * rate)))
    times = random.uniform(0.0, 1.0) + np.arange(frames) / rate
    turn = Rotation.from_euler("z", random.uniform(0.0, 2.0 * np.pi))
    points = interpolated(np.resize(kick, (2500, *kick.shape[1:])), 100.0, times) @ turn.as_matrix().T
    camera = synthetic_film.camera_around(random, points)
    noise = synthetic_film.Noise(random.uniform(0.0, 10.0), random.uniform(0.0, 0.3), random.uniform(0.0, 0.1))
    shown = synthetic_film.detected(random, camera, points, rate, noise)
    scale = min(keypoint_files.SIZE) / max(synthetic_film.SIZE)
    people = np.dstack([scale * np.nan_to_num(shown.places), shown.confidence])
    first, last = (int(random.integers(0, frames // 3 + 1)) if random.random() < 0.5 else 0 for _ in range(2))
    film = [[person] if first <= frame < frames - last else [] for frame, person in enumerate(people)]
    write, _ = keypoint_files.FORMATS[random.choice(list(keypoint_files.FORMATS))]
    (tmp_path / "film").mkdir()
    path, cameras = write(tmp_path / "film", film), []
    if random.random() < 0.5:
        fields = {"focal": scale * camera.focal, "centre": (scale * camera.centre).tolist(),
                  "size": keypoint_files.SIZE, "position": camera.position.tolist(),
                  "look_at": (camera.position + 3.0 * camera.turn[2]).tolist()}  # fmt: skip
        cameras = [tmp_path / "camera.json"]
        cameras[0].write_text(json.dumps(fields))
    try:
        command.main(
            (path,), (rate,), tuple(cameras), size=keypoint_files.SIZE, preset="fast", out=tmp_path, quiet=True
        )
    except (InputError, DivergenceError) as refusal:
        print("refused:", refusal)
        assert "\n" not in str(refusal)
    else:
        summary = json.loads((tmp_path / "summary.json").read_text())
        assert np.isfinite(summary["height_m"]) and (tmp_path / "pose.bvh").is_file()

"""Longer runs than the suite's: thousands of random scenes, and of damaged files; `make soak`."""

from __future__ import annotations

from pathlib import Path

import pytest

from larp_model.simulator import Simulator
from tasks.benchmarks import damaged_files, random_scenes

pytestmark = pytest.mark.soak

# Shared out evenly among the kinds.
STATES, STATES_PER_SCENE, FILES = 5000, 20, 10_000


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

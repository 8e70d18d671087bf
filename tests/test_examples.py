"""The examples run, and what each says of itself holds."""

from __future__ import annotations

import json
import runpy
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from larp_model.runtime import prepare_compiler

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.slow
def test_a_task_from_outside_meets_its_goals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(EXAMPLES / "pass_to_runner.py"))["main"](count=1)
    assert (tmp_path / "runs/pass/pass.html").is_file()


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("own_cost", ()),
        ("own_reference", ()),
        ("own_world", ()),
        ("own_clock", ()),
        ("own_model", ()),
        ("own_human", ()),
        ("own_scene", (1e-4, 40)),
    ],
)
@pytest.mark.slow
def test_what_an_example_says_of_itself_holds(
    name: str, given: tuple[float, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    prepare_compiler()  # they plan with the same planners
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(EXAMPLES)
    runpy.run_path(str(EXAMPLES / f"{name}.py"))["main"](*given)


@pytest.mark.slow
def test_kicks_of_a_worker_that_dies_are_planned_by_another(tmp_path: Path) -> None:
    path = tmp_path / "kicks.npz"
    batch = subprocess.Popen([sys.executable, EXAMPLES / "batch.py", "--count=3", f"--path={path}", "--workers=2"])
    while not (busy := busy_workers(batch.pid)):
        assert batch.poll() is None
        time.sleep(0.1)
    busy[0].kill()
    assert batch.wait() == 0
    with np.load(path, allow_pickle=False) as kicks:
        assert kicks["states"].shape[0] == len(np.unique(kicks["targets"], axis=0)) == 3


def busy_workers(pid: int) -> list[psutil.Process]:
    """Return the workers of a batch that have imported what they need, and compile or plan."""
    busy = []
    for child in psutil.Process(pid).children():
        with suppress(psutil.NoSuchProcess):  # it has ended meanwhile
            if "spawn_main" in " ".join(child.cmdline()) and child.cpu_times().user > 4.0:
                busy.append(child)
    return busy


def test_the_notebook_runs_and_shows_its_replay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare_compiler()
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    cells = [cell for cell in json.loads((EXAMPLES / "kick.ipynb").read_text())["cells"] if cell["cell_type"] == "code"]
    for cell in cells:
        exec(compile("".join(cell["source"]), "kick.ipynb", "exec"), names)
    assert "".join(cells[2]["source"]) == "run"
    assert names["run"].truth_error_m < 0.1
    assert names["run"]._repr_html_().startswith("<iframe srcdoc=")


def test_every_example_is_run() -> None:
    own = {f"own_{name}" for name in ("cost", "reference", "world", "clock", "model", "human", "scene")}
    assert {path.stem for path in EXAMPLES.glob("*.py")} == own | {"pass_to_runner", "batch"}


def test_examples_are_short() -> None:
    for path in EXAMPLES.glob("*.py"):
        assert len(path.read_text().splitlines()) <= (90 if path.stem == "pass_to_runner" else 60), path.name

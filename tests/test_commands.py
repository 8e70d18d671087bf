"""The installed commands, and what is told of names that were mistyped."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import entry_points, version
from pathlib import Path

import pytest

import larp_model
from larp_model import Simulator, commands, human
from larp_model.names import require_file
from tasks.presets import preset_of
from tasks.scenarios import scenario


def test_every_installed_command_exists_and_the_version_is_the_packages() -> None:
    found = {each.name: each.load() for each in entry_points(group="console_scripts") if each.name.startswith("larp-")}
    assert {name: each.__module__ for name, each in found.items()} == dict.fromkeys(
        ("larp-kick", "larp-train", "larp-adapt", "larp-pose", "larp-bench"), "larp_model.commands"
    )
    assert version("larp-mpc") == larp_model.__version__


def test_another_package_called_tasks_is_named_where_it_hides_ours(tmp_path: Path) -> None:
    assert commands.hidden() is None
    (tmp_path / "tasks").mkdir()
    (tmp_path / "tasks" / "__init__.py").touch()
    program = f"import sys; sys.path.insert(0, {str(tmp_path)!r}); from larp_model import commands; commands.kick()"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=commands.HOME)
    assert ended.returncode == 1
    assert ended.stderr.count("\n") == 1 and f"'tasks' is at {tmp_path / 'tasks'}, another project's" in ended.stderr


def test_a_mistyped_name_is_answered_with_the_nearest(tmp_path: Path) -> None:
    (tmp_path / "kick.bvh").touch()
    for mistyped, meant in (
        (lambda: preset_of("balancd"), "balanced"),
        (lambda: scenario("any_humn"), "any_human"),
        (lambda: Simulator.load("human_bal"), "human_ball"),
        (lambda: human(lengths={"thig": 1.1}), "thigh"),
        (lambda: require_file("reference", tmp_path / "kik.bvh"), "kick.bvh"),
    ):
        with pytest.raises(ValueError, match=f"did you mean '{meant}'"):
            mistyped()  # type: ignore[no-untyped-call]

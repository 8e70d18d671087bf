"""Style, format and types: ruff and mypy, configured in pyproject.toml, have nothing to say."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "command", [["ruff", "check", "--no-fix"], ["ruff", "format", "--check"], ["mypy"]], ids=["lint", "format", "mypy"]
)
def test_checker_is_content(command: list[str]) -> None:
    result = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, f"{' '.join(command)} says:\n{result.stdout}{result.stderr}"

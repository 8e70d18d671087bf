"""What the README says in Python is run as it stands there."""

import re
from pathlib import Path

import pytest

README = Path(__file__).parents[1] / "README.md"


def test_the_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", README.read_text(), re.DOTALL)
    assert len(blocks) >= 2
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), names)
    names["page"].close()  # type: ignore[attr-defined]
    assert names["run"].truth_error_m < 0.1  # type: ignore[attr-defined]
    assert {path.name for path in (tmp_path / "runs/mine").iterdir()} > {"kick.html", "summary.json"}
    assert names["predicted"].shape == (1, 30, 14, 13)  # type: ignore[attr-defined]
    assert names["joint_targets"].shape[1:] == (12, 3)  # type: ignore[attr-defined]

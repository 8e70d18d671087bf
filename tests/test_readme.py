"""The documents are true: the README's Python runs as it stands there, commands take what they are given."""

from __future__ import annotations

import re
import shlex
from collections.abc import Callable
from functools import wraps
from importlib import import_module
from pathlib import Path

import pytest
import tyro

from tasks.benchmarks.__main__ import NAMED

ROOT = Path(__file__).parents[1]
README, CONTRIBUTING = ROOT / "README.md", ROOT / "CONTRIBUTING.md"
INSTALLED = {"larp-kick": "tasks.kick", "larp-train": "tasks.train", "larp-adapt": "tasks.adapt"}
FENCED = re.compile(r"```[a-z]*\n(.*?)```", re.DOTALL)
TEXT = README.read_text()
LINES = [
    shlex.split(line, comments=True)
    for text in (TEXT, CONTRIBUTING.read_text())
    for block in [*FENCED.findall(text), *re.findall(r"`([^`]+)`", FENCED.sub("", text))]
    for line in block.splitlines()
    if re.match(r"larp-(kick|train|adapt|bench) |\S*python -m tasks\.", line)
]


def idle(main: Callable[..., None]) -> Callable[..., None]:
    """A command that takes what the other takes, and does nothing."""

    @wraps(main)
    def nothing(*arguments: object, **named: object) -> None: ...

    return nothing


@pytest.mark.parametrize("line", LINES, ids=" ".join)
def test_every_command_of_the_documents_takes_what_it_is_given(line: list[str]) -> None:
    module, given = (line[2], line[3:]) if line[1] == "-m" else (INSTALLED[line[0]], line[1:])
    if module.startswith("tasks.benchmarks"):
        given = [module.rpartition(".")[2], *given]
        tyro.extras.subcommand_cli_from_dict({name: idle(main) for name, main in NAMED.items()}, args=given)
    elif given not in (["--help"], ["--tyro-print-completion", "bash"]):
        module = {"tasks.pose": "tasks.pose.command"}.get(module, module)
        tyro.cli(idle(import_module(module).main), args=given)


@pytest.mark.parametrize("document", [README, CONTRIBUTING], ids=lambda path: path.name)
def test_every_file_that_a_document_links_exists(document: Path) -> None:
    for name in re.findall(r"\]\(([^)#]+)\)", document.read_text()):
        assert (ROOT / name).exists(), name


def test_every_file_that_contributors_are_sent_to_exists() -> None:
    rooms = (ROOT, ROOT / "larp_model", ROOT / "larp_model/physics", ROOT / "tasks")
    for name in re.findall(r"`([\w/]+(?:\.py|/))`", CONTRIBUTING.read_text()):
        assert any((room / name).exists() for room in rooms), name


def test_the_python_of_the_readme_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    blocks = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    assert len(blocks) >= 2
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, str(README), "exec"), names)
    names["page"].close()  # type: ignore[attr-defined]
    assert names["run"].truth_error_m < 0.1  # type: ignore[attr-defined]
    assert {path.name for path in (tmp_path / "runs/mine").iterdir()} > {"kick.html", "summary.json"}
    assert names["predicted"].shape == (1, 30, 14, 13)  # type: ignore[attr-defined]
    assert names["joint_targets"].shape[1:] == (12, 3)  # type: ignore[attr-defined]

"""The documents are true: their Python runs, commands take what they are given, links resolve, the site builds."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import wraps
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from pkgutil import resolve_name
from typing import Any

import pytest
import tyro

from tasks.benchmarks.__main__ import NAMED

ROOT = Path(__file__).parents[1]
README, CONTRIBUTING, QUICKSTART = ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "docs/quickstart.md"
PAGES = sorted((ROOT / "docs").rglob("*.md"))
DOCUMENTS = [README, CONTRIBUTING, *PAGES]
INSTALLED = {"larp-kick": "kick", "larp-train": "train", "larp-adapt": "adapt", "larp-pose": "pose"}
FENCED = re.compile(r"^ *```[a-z]*\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
SITE = all(find_spec(name) for name in ("mkdocs", "material", "mkdocstrings"))


def snippets(document: Path) -> list[str]:
    """Lines of a document's blocks of code, and what it puts in backticks elsewhere."""
    text = document.read_text()
    blocks = [*FENCED.findall(text), *re.findall(r"`([^`]+)`", FENCED.sub("", text))]
    return [line.strip() for block in blocks for line in block.splitlines()]


def blocks(document: Path, language: str) -> list[str]:
    """Blocks of code in a language."""
    return re.findall(rf"^```{language}\n(.*?)^```", document.read_text(), re.DOTALL | re.MULTILINE)


SNIPPETS = list(dict.fromkeys(line for document in DOCUMENTS for line in snippets(document)))
COMMAND = re.compile(r"larp-(kick|train|adapt|pose|bench) |\S*python -m tasks\.")
LINES = [shlex.split(line, comments=True) for line in SNIPPETS if COMMAND.match(line)]


def idle(main: Callable[..., None]) -> Callable[..., None]:
    """A command that takes what the other takes, and does nothing."""

    @wraps(main)
    def nothing(*arguments: object, **named: object) -> None: ...

    return nothing


@pytest.mark.parametrize("line", LINES, ids=" ".join)
def test_every_command_of_the_documents_takes_what_it_is_given(line: list[str]) -> None:
    module, given = (line[2], line[3:]) if line[1] == "-m" else (f"tasks.{INSTALLED[line[0]]}", line[1:])
    if module.startswith("tasks.benchmarks"):
        given = [module.rpartition(".")[2], *given]
        tyro.extras.subcommand_cli_from_dict({name: idle(main) for name, main in NAMED.items()}, args=given)
    elif given not in (["--help"], ["--tyro-print-completion", "bash"]):
        module = {"tasks.pose": "tasks.pose.command", "tasks.experiments": "tasks.experiments.runner"}.get(
            module, module
        )
        tyro.cli(idle(import_module(module).main), args=given)


def test_every_target_of_make_in_the_documents_exists() -> None:
    targets = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    assert {match[1] for line in SNIPPETS if (match := re.match(r"make (\w+)", line))} <= targets


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_file_that_a_document_links_exists(document: Path) -> None:
    for name in re.findall(r"\]\((?!\w+:)([^)#]+)", FENCED.sub("", document.read_text())):
        assert (document.parent / name).exists(), name


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_source_file_that_a_document_names_exists(document: Path) -> None:
    rooms = (ROOT, ROOT / "larp_model", ROOT / "larp_model/physics", ROOT / "tasks")
    suffix = r"\.py|/" if document == CONTRIBUTING else r"\.py"
    for name in re.findall(rf"`([\w/]+(?:{suffix}))`", document.read_text()):
        assert any((room / name).exists() for room in rooms), name


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_every_python_name_that_a_document_gives_in_full_exists(document: Path) -> None:
    directives = re.findall(r"^::: ([\w.]+)", document.read_text(), re.MULTILINE)
    named = re.findall(r"`((?:larp_model|mpc|viewer|tasks)(?:\.\w+)+)(?:\([^`]*\))?`", document.read_text())
    for name in [*directives, *named]:
        resolve_name(name)


def test_the_readme_is_short() -> None:
    assert len(README.read_text().splitlines()) <= 150
    [first, planner] = blocks(README, "python")
    assert len([line for line in first.splitlines() if line]) == 5
    assert len([line for line in planner.splitlines() if line]) <= 5
    [task] = blocks(ROOT / "docs/task.md", "python")
    assert len(task.splitlines()) == 49 and "49 lines" in README.read_text()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder in which the Python of the documents runs."""
    folder = tmp_path_factory.mktemp("documents")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


@pytest.fixture(scope="module")
def names(folder: Path) -> dict[str, Any]:
    """Names that the README and the quickstart define, on which all pages build."""
    names: dict[str, Any] = {}
    for block in dict.fromkeys([*blocks(README, "python"), *blocks(QUICKSTART, "python")]):
        exec(compile(block, "README.md", "exec"), names)
    names["page"].close()
    return names


@pytest.mark.slow
def test_the_python_of_the_readme_runs(names: dict[str, Any], folder: Path) -> None:
    assert names["run"].truth_error_m < 0.1
    assert {path.name for path in (folder / "runs/mine").iterdir()} > {"kick.html", "summary.json"}
    assert names["joint_targets"].shape[1:] == (12, 3)


@pytest.mark.parametrize(
    "page", [page for page in PAGES if page != QUICKSTART and blocks(page, "python")], ids=lambda path: path.name
)
@pytest.mark.slow
def test_the_python_of_a_page_runs(page: Path, names: dict[str, Any]) -> None:
    names = dict(names)
    for block in blocks(page, "python"):
        exec(compile(block, str(page), "exec"), names)
    if page.name == "simulator.md":
        assert names["predicted"].shape == (1, 30, 14, 13)


def test_python_that_needs_files_of_the_reader_compiles_and_imports_what_there_is() -> None:
    found = [block for document in DOCUMENTS for block in blocks(document, "py")]
    assert found
    for block in found:
        tree = ast.parse(block)
        tree.body = [node for node in tree.body if isinstance(node, ast.Import | ast.ImportFrom)]
        exec(compile(tree, "imports", "exec"), {})


@pytest.mark.skipif(not SITE, reason="the packages of the extra docs are not installed")
def test_the_site_builds_without_a_warning_and_loads_nothing_from_elsewhere(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    result = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
    for page in tmp_path.rglob("*.html"):
        assert not re.findall(
            r'<(?:script|link|img|iframe)\b[^>]*(?:src|href)="(?:https?:)?//[^"]*', page.read_text()
        ), page

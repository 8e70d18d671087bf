"""Hooks of the site's builder: pages made of files outside docs/, and links to those files.

In the repository, a page links the file itself (`../RESULTS.md`, `../examples/own_cost.py`); in the site, that link
leads to the page made of it.
"""

from __future__ import annotations

import ast
import json
import posixpath
import re
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
# Pages made of files at the top level, by the file's name; the overview stands for the README.
PAGES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "RESULTS.md": "results.md"}
SOURCES = {page: name for name, page in PAGES.items()}
EXAMPLES = "examples.md"
LINK = re.compile(r"\]\((?!\w+:|#)([^)#\s]+)(#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that are made of files outside docs/."""
    for name, page in PAGES.items():
        files.append(File.generated(config, page, content=(ROOT / name).read_text()))
    files.append(File.generated(config, EXAMPLES, content=examples()))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return the page with links to files of the repository turned into links to the pages made of them."""
    here = page.file.src_uri
    folder = posixpath.dirname(SOURCES.get(here, f"docs/{here}"))

    def linked(match: re.Match[str]) -> str:
        file, anchor = posixpath.normpath(posixpath.join(folder, match[1])), match[2] or ""
        if file == "README.md":
            file = "index.md"
        elif file in PAGES:
            file = PAGES[file]
        elif file.startswith("examples/"):
            file, anchor = EXAMPLES, f"#{Path(file).stem}"
        elif file.startswith("docs/"):
            file = file.removeprefix("docs/")
        else:
            return match[0]
        return f"]({posixpath.relpath(file, posixpath.dirname(here) or '.')}{anchor})"

    return LINK.sub(linked, markdown)


def examples() -> str:
    """Return the page of all examples: what each says of itself, and its source."""
    parts = ["# Examples", "Each program asserts its own outcome. All are run by the tests."]
    for path in sorted((ROOT / "examples").glob("*.py")):
        source = path.read_text()
        text = ast.get_docstring(ast.parse(source)) or ""
        code = source.split('"""', 2)[2].strip()
        parts += [f"## {path.name} {{ #{path.stem} }}", text, f"```python\n{code}\n```"]
    for path in sorted((ROOT / "examples").glob("*.ipynb")):
        cells = json.loads(path.read_text())["cells"]
        code = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
        text = "\n\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
        parts += [f"## {path.name} {{ #{path.stem} }}", text.lstrip("# "), f"```python\n{code}\n```"]
    return "\n\n".join(parts) + "\n"

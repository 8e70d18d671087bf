"""Checks of names and paths: an error of one line with the name, the options, and the nearest of them."""

from __future__ import annotations

from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path

from larp_model.errors import InputError


def require_known(argument: str, name: str, options: Iterable[str]) -> None:
    """Raise InputError for a name that is none of the options."""
    names = [str(option) for option in options]
    if name not in names:
        raise InputError(f"{argument} is {name!r}, but must be one of {', '.join(names)}{meant(name, names)}")


def require_file(argument: str, path: str | Path) -> None:
    """Raise InputError for a path without a file."""
    path = Path(path)
    if not path.is_file():
        siblings = [entry.name for entry in path.parent.iterdir()] if path.parent.is_dir() else []
        raise InputError(f"{argument} is {str(path)!r}, but no such file exists{meant(path.name, siblings)}")


def meant(name: str, names: Iterable[str]) -> str:
    """Return the nearest of the names as a question; an empty text if none is near."""
    near = get_close_matches(str(name), list(names), n=1)
    return f"; did you mean {near[0]!r}?" if near else ""

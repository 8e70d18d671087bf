"""Files that are written whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from larp_model.errors import InputError


@contextmanager
def written_whole(path: str | Path) -> Iterator[IO[bytes]]:
    """A file to write to, which takes its name, in its folder made for it, only when all went well.

    The OSError of a write that fails, on a full disk say, names the path.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.name}.", delete=False) as file:
            try:
                os.chmod(file.name, 0o644)  # temporary files are born private
                yield file
                file.close()
                os.replace(file.name, path)
            except BaseException:
                os.unlink(file.name)
                with suppress(OSError):  # closing it would write what it still holds, and fail again
                    file.close()
                raise
    except OSError as error:
        if error.errno is None:
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_whole(path: str | Path, data: bytes) -> None:
    """Write data to a file."""
    with written_whole(path) as file:
        file.write(data)


def require_writable(folder: str | Path, argument: str) -> None:
    """Refuses, under the argument's name, a folder that is not there and cannot be made, or cannot be written."""
    nearest = Path(folder).absolute()
    while not nearest.exists():
        nearest = nearest.parent
    if not (nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)):
        raise InputError(f"{argument} needs the folder {str(folder)!r}, but {str(nearest)!r} cannot be written to")

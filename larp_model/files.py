"""Files that are written whole or not at all, and arrays that are read without running anything."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

import numpy as np

from larp_model.errors import InputError


@contextmanager
def written_whole(path: str | Path) -> Iterator[IO[bytes]]:
    """Open a file to write to that gets its name, in a folder made for it, only if no error is raised.

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
    """Raise InputError, with the argument's name, for a folder that can be neither found nor made, or not written."""
    nearest = Path(folder).absolute()
    while not nearest.exists():
        nearest = nearest.parent
    if not (nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)):
        raise InputError(f"{argument} needs the folder {str(folder)!r}, but {str(nearest)!r} cannot be written to")


def arrays_of(path: str | Path) -> dict[str, np.ndarray]:
    """Return the arrays of an npz file by name; pickled ones are refused.

    NumPy and zipfile raise many kinds of errors for a damaged file. None is caught here.
    """
    # numpy does not close a file itself that is damaged.
    with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as arrays:
        return dict(arrays)

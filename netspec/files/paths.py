"""Paths that are written to: relative to others, and inside folders with netspec's own files."""

from __future__ import annotations

import os
from pathlib import Path

from netspec.errors import SpecError, Where


def relative(path: str | Path, folder: str | Path = os.curdir) -> str:
    """Return a path relative to a folder, with slashes."""
    return Path(os.path.relpath(path, folder)).as_posix()


def inside(folder: str | Path, *names: str) -> Path:
    """Return the path of a file or folder to write, below one of netspec's own folders.

    The folder itself can be a symbolic link. Raises SpecError if a path below it is one: the folder may come from
    another person, and the link could lead to the user's files.
    """
    path = Path(folder)
    for name in names:
        path = path / name
        if path.is_symlink():
            raise SpecError("is a symbolic link, which is not followed for writing; move it away", Where(str(path)))
    return path

"""Folders with netspec's own files, such as a map or a cache. Symbolic links in them are not followed.

Such a folder may come from another person, and a symbolic link in it could lead to the user's files, which must not be
overwritten or removed.
"""

from __future__ import annotations

from pathlib import Path

from netspec.errors import SpecError, Where


def inside(folder: str | Path, *names: str) -> Path:
    """Return the path of a file or folder to write, below one of netspec's own folders.

    The folder itself can be a symbolic link. Raises SpecError if a path below it is one.
    """
    path = Path(folder)
    for name in names:
        path = path / name
        if path.is_symlink():
            raise SpecError("is a symbolic link, which is not followed for writing; move it away", Where(str(path)))
    return path

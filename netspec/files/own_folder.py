"""Folders that netspec keeps files of its own in, such as a map or a cache: no link in them is followed.

Such a folder may come from somebody else. A symbolic link in it could lead to files of the user, which must neither be
overwritten nor removed.
"""

from __future__ import annotations

from pathlib import Path

from netspec.errors import SpecError, Where


def inside(folder: str | Path, *names: str) -> Path:
    """Return the path of a file or folder to write, below a folder of our own.

    The folder itself may be a link. Raises SpecError where a name below it is one.
    """
    path = Path(folder)
    for name in names:
        path = path / name
        if path.is_symlink():
            raise SpecError("is a symbolic link, which is not followed for writing; move it away", Where(str(path)))
    return path

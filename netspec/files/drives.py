"""Paths relative to others. On Windows, two paths can be on different drives and then have no common folder."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from netspec.errors import SpecError


def relative(path: str | Path, folder: str | Path = os.curdir) -> str:
    """Return a path relative to a folder, with slashes; the absolute path if it is on another drive."""
    try:
        found = os.path.relpath(path, folder)
    except ValueError:
        found = os.path.abspath(path)
    return Path(found).as_posix()


def common_folder(paths: Sequence[Path]) -> Path:
    """Return the innermost folder that contains all of the paths, which are absolute.

    Raises SpecError if they are on different drives.
    """
    try:
        return Path(os.path.commonpath(paths))
    except ValueError:
        named = ", ".join(map(str, dict.fromkeys(paths)))
        raise SpecError(f"{named}: are on different drives, so they have no common folder; move one of them") from None

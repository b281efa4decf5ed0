"""Removes the files of a map from its folder, and no others."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path


def remove_own(folder: str | Path, names: Iterable[str]) -> None:
    """Remove the regular files with these names from a folder, and then the folder if it is empty.

    All else stays: other files, links, what lies behind a link, and a folder that is a link itself.
    """
    folder = Path(folder)
    if os.unlink not in os.supports_dir_fd:  # Windows
        if folder.is_dir() and not folder.is_symlink():
            for path in (folder / name for name in names):
                if path.is_file() and not path.is_symlink():
                    path.unlink()
            with suppress(OSError):  # it is not empty
                folder.rmdir()
        return
    try:
        held = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    except OSError:  # missing, or a link
        return
    try:
        for name in names:
            with suppress(OSError):  # missing
                if stat.S_ISREG(os.stat(name, dir_fd=held, follow_symlinks=False).st_mode):
                    os.unlink(name, dir_fd=held)
    finally:
        os.close(held)
    with suppress(OSError):  # it is not empty, or it became a link meanwhile
        folder.rmdir()

"""A folder of models, by key: bounded in size, each entry there whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

LIMIT = 4 * 2**30  # bytes
ABOUT = "about.json"  # of an entry: what its maker says, and the sizes and times of its files
UNFINISHED = ".unfinished-"
ABANDONED = 24 * 3600  # seconds after which an unfinished entry is taken to be that of a dead process

Maker = Callable[[Path], Mapping[str, Any]]  # fills an empty folder; returns what is to be known about it


def entry(folder: Path, key: str, make: Maker, limit: int = LIMIT) -> tuple[Path, dict[str, Any], bool]:
    """Return an entry's folder, what is known about it, and whether it was made: it was missing or changed.

    Beyond ``limit`` bytes the least recently used entries go. Raises OSError where the folder cannot be written.
    """
    place = folder / key
    if about := read_about(place):
        with suppress(OSError):
            os.utime(place / ABOUT)
        return place, about, False
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=folder))
    try:
        about = fill(unfinished, make)
        if not read_about(place):  # another process may have made it meanwhile, and that one is as good
            _remove(place)
            with suppress(OSError):
                unfinished.rename(place)
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)
    _trim(folder, place, limit)
    return place, read_about(place) or about, True


def fill(folder: Path, make: Maker) -> dict[str, Any]:
    """Make an entry in an empty folder; return what is known about it."""
    about = {**make(folder), "files": {path.name: _stamp(path) for path in folder.iterdir()}}
    for path in folder.iterdir():
        with path.open("rb") as file:
            os.fsync(file.fileno())
    note(folder, about)
    return about


def note(folder: Path, about: Mapping[str, Any]) -> None:
    """Write what is known about an entry."""
    with tempfile.NamedTemporaryFile("w", dir=folder, prefix=UNFINISHED, delete=False) as file:
        json.dump(about, file)
    os.replace(file.name, folder / ABOUT)


def read_about(place: Path) -> dict[str, Any] | None:
    """Return what is known about an entry; None where it is missing or its files are not as they were made."""
    with suppress(OSError, ValueError, KeyError, AttributeError, TypeError):
        about = json.loads((place / ABOUT).read_text())
        if all(_stamp(place / name) == stamp for name, stamp in about["files"].items()):
            return about
    return None


def _stamp(path: Path) -> list[int]:
    found = path.stat()
    return [found.st_size, found.st_mtime_ns]


def _remove(place: Path) -> None:
    """Remove an entry at once: nobody sees a part of it."""
    aside = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=place.parent))
    with suppress(FileNotFoundError):
        place.rename(aside / place.name)
    shutil.rmtree(aside, ignore_errors=True)


def _trim(folder: Path, newest: Path, limit: int) -> None:
    """Remove what was not used for longest, until the rest is within the limit; ``newest`` stays."""
    found = []
    for place in folder.iterdir():
        with suppress(OSError):
            used = (place / ABOUT if (place / ABOUT).exists() else place).stat().st_mtime
            if not place.name.startswith(UNFINISHED) or time.time() - used > ABANDONED:
                found.append((used, sum(path.stat().st_size for path in place.iterdir()), place))
    total = sum(size for _, size, _ in found)
    for _, size, place in sorted(found):
        if place != newest and (total > limit or place.name.startswith(UNFINISHED)):
            _remove(place)
            total -= size

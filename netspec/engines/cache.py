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


class Cache:
    """Entries are folders in ``folder``, named by their key.

    Beyond ``limit`` bytes the least recently used entries go.
    """

    def __init__(self, folder: Path, limit: int = LIMIT) -> None:
        self.folder, self.limit = folder, limit

    def entry(self, key: str, make: Maker) -> tuple[Path, dict[str, Any], bool]:
        """Return an entry's folder, what is known about it, and whether it was made: it was missing or damaged.

        Raises OSError where the folder cannot be written.
        """
        place = self.folder / key
        about = read_about(place)
        if about is not None:
            with suppress(OSError):
                os.utime(place / ABOUT)
            return place, about, False
        self.folder.mkdir(parents=True, exist_ok=True)
        unfinished = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=self.folder))
        try:
            about = fill(unfinished, make)
            self._put(unfinished, place)
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        self._trim(place)
        return place, about, True

    def _put(self, unfinished: Path, place: Path) -> None:
        """Move a finished entry to its place; one that another process put there meanwhile is as good."""
        if read_about(place) is None:
            self._remove(place)
        try:
            unfinished.rename(place)
        except OSError:
            if read_about(place) is None:
                raise

    def _remove(self, place: Path) -> None:
        """Remove an entry in one step: no reader finds a part of it."""
        aside = Path(tempfile.mkdtemp(prefix=UNFINISHED, dir=self.folder))
        with suppress(FileNotFoundError):
            place.rename(aside / place.name)
        shutil.rmtree(aside, ignore_errors=True)

    def _trim(self, newest: Path) -> None:
        """Remove what was not used for longest, until the rest is within the limit; ``newest`` stays."""
        now, entries = time.time(), []
        for place in self.folder.iterdir():
            with suppress(OSError):
                if place.name.startswith(UNFINISHED):
                    if now - place.stat().st_mtime > ABANDONED:
                        shutil.rmtree(place, ignore_errors=True)
                elif (place / ABOUT).is_file():
                    size = sum(path.stat().st_size for path in place.iterdir())
                    entries.append(((place / ABOUT).stat().st_mtime, size, place))
        total = sum(size for _, size, _ in entries)
        for _, size, place in sorted(entries):
            if total > self.limit and place != newest:
                self._remove(place)
                total -= size


def fill(folder: Path, make: Maker) -> dict[str, Any]:
    """Make an entry in an empty folder; return what is known about it."""
    about = {**make(folder), "files": {}}
    for path in folder.iterdir():
        with path.open("rb") as file:
            os.fsync(file.fileno())
        about["files"][path.name] = _stamp(path)
    note(folder, about)
    return about


def note(folder: Path, about: Mapping[str, Any]) -> None:
    """Write what is known about an entry."""
    with tempfile.NamedTemporaryFile("w", dir=folder, prefix=UNFINISHED, delete=False) as file:
        json.dump(about, file)
    os.replace(file.name, folder / ABOUT)


def read_about(place: Path) -> dict[str, Any] | None:
    """Return what is known about an entry; None where it is missing or its files are not as they were made."""
    try:
        about = json.loads((place / ABOUT).read_text())
        if all(_stamp(place / name) == stamp for name, stamp in about["files"].items()):
            return about
    except (OSError, ValueError, KeyError, AttributeError, TypeError):
        pass
    return None


def _stamp(path: Path) -> list[int]:
    found = path.stat()
    return [found.st_size, found.st_mtime_ns]

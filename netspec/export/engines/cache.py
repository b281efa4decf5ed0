"""A folder of models: a folder for each key, there whole or not at all. Nothing in it is ever removed."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path


def entry(folder: Path, key: str, make: Callable[[Path], None]) -> tuple[Path, bool]:
    """Return the folder of a key, and whether it was made: ``make`` fills an empty folder where it is missing.

    Raises OSError where the folder cannot be written.
    """
    place = folder / key
    if place.is_dir():
        return place, False
    folder.mkdir(parents=True, exist_ok=True)
    unfinished = Path(tempfile.mkdtemp(prefix=".unfinished-", dir=folder))
    try:
        make(unfinished)
        for path in unfinished.iterdir():
            with path.open("rb") as file:
                os.fsync(file.fileno())
        try:
            unfinished.rename(place)
        except OSError:
            if not place.is_dir():  # another process may have made it meanwhile, and that one is as good
                raise
    finally:
        shutil.rmtree(unfinished, ignore_errors=True)  # what this call made
    return place, True

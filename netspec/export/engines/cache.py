"""The cache of exported models: one folder for each key, which is complete or does not exist.

A key is a hash of everything that determines a model. Nothing is ever removed from the cache.
"""

from __future__ import annotations

import hashlib
import json
import secrets
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from netspec import log
from netspec.errors import SpecError, Where
from netspec.files.kinds import unreadable
from netspec.files.paths import inside
from netspec.files.version import version
from netspec.files.whole_file import whole_folder
from netspec.proto.forks import forks

DIGESTS = "digests.json"  # of the files of an entry, by name
EXPORTER = 4  # another number wherever exported models change between versions


def key_of(files: Sequence[str | Path], options: Mapping[str, Any]) -> str:
    """Return a key of 64 hexadecimal digits for the bytes of files, the options, and the version of netspec.

    Raises SpecError for a file that cannot be read.
    """
    dialects = [[name, digest(file) if file else source] for name, file, source in forks().sources()]
    parts = {"version": [version(), EXPORTER], "files": [*map(digest, files)], "dialects": dialects, "options": options}
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


def digest(path: str | Path) -> str:
    """Return the SHA-256 of a file. Raises SpecError if it cannot be read."""
    try:
        found = hashlib.sha256()
        with open(path, "rb") as file:
            while part := file.read(2**20):
                found.update(part)
        return found.hexdigest()
    except OSError as fault:
        raise SpecError(unreadable(path, fault), Where(str(path))) from None


def entry(folder: Path, key: str, make: Callable[[Path], None]) -> Path:
    """Return the folder of a key. A missing one is created, and filled by ``make``.

    An entry with damaged files is renamed, with a warning, and created again. Raises OSError if the folder
    cannot be written, and SpecError if the entry is a link.
    """
    path = inside(folder, key)
    if path.is_dir():
        if _is_whole(path):
            return path
        aside = folder / f".damaged-{secrets.token_hex(4)}"
        log.logger.warning(f"{path}: was damaged and is being recreated; the damaged one was renamed to {aside.name}")
        with suppress(FileNotFoundError):  # another process moved it
            path.rename(aside)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with whole_folder(path) as unfinished:
            make(unfinished)
            digests = {file.name: digest(file) for file in unfinished.iterdir()}
            (unfinished / DIGESTS).write_text(json.dumps(digests), "utf-8")
    except OSError:
        if not path.is_dir():  # another process may have made the same entry
            raise
    return path


def _is_whole(path: Path) -> bool:
    """Return whether the files of an entry are unchanged. Files that were added later are ignored."""
    try:
        digests = json.loads((path / DIGESTS).read_bytes())
        return all(digest(path / name) == known for name, known in digests.items())
    except (OSError, ValueError, AttributeError, SpecError):
        return False

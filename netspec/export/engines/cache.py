"""The cache of exported models: one folder for each key, which is complete or does not exist.

A key is a hash of everything that determines a model. Nothing is ever removed from the cache.
"""

from __future__ import annotations

import hashlib
import json
import platform
import secrets
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

from netspec import log
from netspec.errors import SpecError, Where
from netspec.files.kinds import unreadable
from netspec.files.paths import inside
from netspec.files.whole_file import whole_folder
from netspec.proto.forks import forks

# The packages that determine an exported model.
_PACKAGES = ("dialects", "exact", "export", "graph", "layers", "net", "proto")
DIGESTS = "digests.json"  # of the files of an entry, by name


def key_of(files: Sequence[str | Path], options: Mapping[str, Any]) -> str:
    """Return a key of 64 hexadecimal digits for the content of files, for options, and for netspec's own code.

    Raises SpecError for a file that cannot be read.
    """
    digests = [_digest(path) for path in files]
    dialects = [[name, _digest(file) if file else source] for name, file, source in forks().sources()]
    parts = {"code": _code(), "files": digests, "dialects": dialects, "options": options}
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


@cache
def processor() -> str:
    """Return a description of the processor, for models that are optimized for it."""
    machine = platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8", "replace").partition("\n\n")[0].splitlines()
    except OSError:
        return f"{machine} {platform.processor()}"
    return " ".join([machine, *(line for line in lines if line.startswith(("model", "flags", "Features", "CPU part")))])


@cache
def _code() -> str:
    """Return a digest of the source of netspec that exports."""
    folder = Path(__file__).parents[2]
    found = hashlib.sha256()
    for package in _PACKAGES:
        for path in sorted((folder / package).rglob("*.py")):
            found.update(f"{path.relative_to(folder)}\0".encode())
            found.update(path.read_bytes())
    return found.hexdigest()


def _digest(path: str | Path) -> str:
    try:
        with open(path, "rb") as file:
            found = hashlib.sha256()
            while part := file.read(2**20):
                found.update(part)
    except OSError as fault:
        raise SpecError(unreadable(path, fault), Where(str(path))) from None
    return found.hexdigest()


def entry(folder: Path, key: str, make: Callable[[Path], None]) -> tuple[Path, bool]:
    """Return the folder of a key, and whether it is new. A missing folder is created and filled by ``make``.

    An entry with damaged files is renamed, with a warning, and created again. Raises OSError if the folder
    cannot be written, and SpecError if the entry is a link.
    """
    path = inside(folder, key)
    if path.is_dir():
        if _is_whole(path):
            return path, False
        aside = folder / f".damaged-{secrets.token_hex(4)}"
        log.logger.warning(f"{path}: was damaged and is being recreated; the damaged one was renamed to {aside.name}")
        with suppress(FileNotFoundError):  # another process moved it
            path.rename(aside)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with whole_folder(path) as unfinished:
            make(unfinished)
            digests = {file.name: _digest(file) for file in unfinished.iterdir()}
            (unfinished / DIGESTS).write_text(json.dumps(digests), "utf-8")
    except OSError:
        if not path.is_dir():  # another process may have made the same entry
            raise
    return path, True


def _is_whole(path: Path) -> bool:
    """Return whether the files of an entry are unchanged. Files that were added later are ignored."""
    try:
        digests = json.loads((path / DIGESTS).read_bytes())
        return all(_digest(path / name) == digest for name, digest in digests.items())
    except (OSError, ValueError, AttributeError, SpecError):
        return False

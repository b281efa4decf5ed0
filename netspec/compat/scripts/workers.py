"""Processes that a program starts by ``spawn`` or ``forkserver``: they are prepared as the program's own process was.

Python starts them anew, and they import the program from its file.
"""

from __future__ import annotations

from typing import Any

from netspec.compat.scripts import finder, old_names
from netspec.compat.scripts.sources import MAIN, Reader


def prepare(reader: Reader, shadow: bool, quiet: bool = False) -> None:
    """Make this process, and those that it starts, one in which old programs run."""
    old_names.install({"multiprocessing.spawn": lambda spawn: _hand_on(spawn, reader, shadow)}, quiet)
    reader.install()
    finder.install(shadow)  # the last is asked first


def _hand_on(spawn: Any, reader: Reader, shadow: bool) -> None:
    own = spawn.get_preparation_data

    def get_preparation_data(name: str) -> dict[str, Any]:
        data = own(name)
        if data.get("init_main_from_path") == reader.main:
            del data["init_main_from_path"]  # as Python reads it
            data["init_main_from_name"] = MAIN
        return {"netspec": _Prepared(reader, shadow), **data}

    spawn.get_preparation_data = get_preparation_data


class _Prepared:
    """Prepares the process that unpickles it, which happens before that imports the program."""

    def __init__(self, reader: Reader, shadow: bool) -> None:
        self._arguments = reader, shadow

    def __reduce__(self) -> Any:
        return _prepare_worker, self._arguments


def _prepare_worker(reader: Reader, shadow: bool) -> None:
    reader.quiet = True  # the program's own process has said it
    prepare(reader, shadow, quiet=True)

"""A source of batches that each process opens for itself."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import Any

from netspec.data.sources import Source

Opened = tuple[Source, tuple[str, ...]]  # and the names of its tops


class PerProcess:
    """Calls ``open_it`` once in each process that uses it: files and locks must not cross into a worker.

    A forked worker keeps what its parent opened, unused: to close it there could disturb the parent.
    """

    def __init__(self, open_it: Callable[[], Opened]) -> None:
        self._open = open_it
        self._opened: dict[int, Opened] = {}

    def __call__(self) -> Opened:
        """Return what was opened in this process."""
        process = os.getpid()
        if process not in self._opened:
            self._opened[process] = self._open()
        return self._opened[process]

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_opened": {}}

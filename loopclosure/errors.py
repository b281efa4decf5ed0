"""The error that this package raises for a fault of the user, printed as compilers print theirs."""

from __future__ import annotations

import os

from netspec.errors import SpecError, Where


class InputError(SpecError):
    """A fault of a user's file or choice: what was found, what was expected, what to do, and where.

    ``str(error)`` is one line: ``file:line:column: message``; ``file: message`` if no line is known (line 0); the
    message alone if the fault is not in a file.
    """

    def __init__(self, message: str, file: str | os.PathLike[str] = "", line: int = 0, column: int = 0) -> None:
        super().__init__(message, Where(os.fspath(file), line, column) if os.fspath(file) else None)

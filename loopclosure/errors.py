"""The error that this package raises for a fault of the user, printed as compilers print theirs."""

from __future__ import annotations

import os


class InputError(ValueError):
    """A fault of a user's file or choice: what was found, what was expected, what to do, and where.

    ``str(error)`` is one line: ``file:line:column: message``; ``file: message`` if no line is known (line 0); the
    message alone if the fault is not in a file.
    """

    def __init__(self, message: str, file: str | os.PathLike[str] = "", line: int = 0, column: int = 0) -> None:
        self.message = message
        self.file = os.fspath(file)
        self.line = line
        self.column = column
        place = f"{self.file}:{line}:{column}" if line else self.file
        super().__init__(f"{place}: {message}" if place else message)

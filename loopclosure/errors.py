"""The error that this package raises for a fault of the user, printed as compilers print theirs."""

from __future__ import annotations

import os


def printable(text: str) -> str:
    """Return a text in one line that moves no cursor: control characters are written as escapes.

    Names come from files of strangers; raw, they could forge lines of a log, or talk to the terminal. Bytes of a file's
    name that are not UTF-8 are escaped too: nothing could write them.
    """
    return text.translate(_ESCAPES)


# C0 and C1 controls, separators of lines, marks that turn the direction of writing, and what no file may hold: halves
# of characters, and two that are none.
_CONTROLS = [
    *(code for code in range(32) if chr(code) != "\t"),
    *range(127, 160),
    0x2028,
    0x2029,
    *range(0x202A, 0x202F),
    *range(0x2066, 0x206A),
    *range(0xD800, 0xE000),
    0xFFFE,
    0xFFFF,
]
_ESCAPES = {code: repr(chr(code))[1:-1] for code in _CONTROLS}


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
        super().__init__(printable(f"{place}: {message}" if place else message))

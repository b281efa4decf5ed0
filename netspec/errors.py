"""The type of all errors in a user's files, printed in the format of compilers."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Any


@dataclass(frozen=True, slots=True)  # a large net has millions
class Where:
    """A position in a file: ``file:line:column``, or only the file if no line is known (line 0).

    ``layer`` and ``type`` name the layer that the position belongs to, if any.
    """

    file: str
    line: int = 0
    column: int = 0
    layer: str = ""
    type: str = ""

    def __str__(self) -> str:
        position = f"{self.file}:{self.line}:{self.column}" if self.line else self.file
        if self.layer or self.type:
            kind = f" ({self.type})" if self.type else ""
            return f'{position}: layer "{self.layer}"{kind}'
        return position


def printable(text: str) -> str:
    """Return a text as one line, with control characters written as escapes.

    Names come from files of other people. Unescaped, they could forge lines of a log or control the terminal.
    Bytes of a file name that are not UTF-8 are escaped too, since they cannot be encoded.
    """
    return text.translate(_ESCAPES)


# C0 and C1 controls, line separators, marks of the direction of writing, lone surrogates, and two noncharacters.
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


class Code(Enum):
    """What an error is, for code that must tell it from others. Sentences are for people, and may change."""

    UNKNOWN_TYPE = auto()  # details: the layer type
    UNKNOWN_BOTTOM = auto()  # details: the blob
    UNWRITABLE = auto()  # details: the reason


class SpecError(ValueError):
    """An error in a user's file: what was found, what was expected, what to do, and where.

    ``str(error)`` is one line that begins with ``file:line:column: `` (``file: `` if there is no line). ``code`` is
    None for an error that no code asks for.
    """

    def __init__(
        self, message: str, where: Where | None = None, code: Code | None = None, details: tuple[object, ...] = ()
    ) -> None:
        self.message = message
        self.where = where
        self.code = code
        self.details = details
        super().__init__(printable(f"{where}: {message}" if where else message))


class InputError(SpecError):
    """An error in a user's data or options. ``file`` is "" if it is in no file, ``line`` is 0 if none is known."""

    def __init__(self, message: str, file: str | os.PathLike[str] = "", line: int = 0, column: int = 0) -> None:
        super().__init__(message, Where(os.fspath(file), line, column) if os.fspath(file) else None)


Report = Callable[[SpecError], None]  # receives an error, and raises or collects it


def raise_fault(fault: SpecError) -> None:
    """Raise the error, the default where errors are not collected."""
    raise fault


class ForkFault(SpecError):
    """A field or a layer type that Caffe does not have.

    ``what`` says which of the two it is, ``name`` is its name, and ``dialects`` are the known dialects that have it.
    ``owner`` is the message that lacks a field, e.g. "PoolingParameter".
    """

    def __init__(
        self, message: str, where: Where | None, what: str, name: str, dialects: tuple[str, ...], owner: str = ""
    ) -> None:
        super().__init__(message, where)
        self.owner = owner
        self.what = what
        self.name = name
        self.dialects = dialects


class UnknownShape(SpecError):
    """A blob whose shape is known only from data that was not opened."""


def check_choice(what: str, found: object, known: Sequence[str]) -> None:
    """Raise SpecError if ``found`` is not one of the known words."""
    if found not in known:
        hint = did_you_mean(found, list(known)) if isinstance(found, str) else ""
        raise SpecError(f"found {what} {found!r}, expected {', '.join(map(repr, known))}{hint}")


def several(given: Any) -> tuple[Any, ...]:
    """Return a tuple of what a caller gave: None, one value, or several. A string or a path is one value."""
    if given is None:
        return ()
    return tuple(given) if isinstance(given, Iterable) and not isinstance(given, (str, bytes)) else (given,)


_ENDINGS = ("_param", "parameter", "loss", "data")  # common endings do not make names similar


def did_you_mean(word: str, known: Iterable[str], near: bool = False) -> str:
    """Return ``; did you mean "x"?`` for the closest known word, or an empty string.

    With ``near``, only typing errors are corrected: the first letter and the digits must be equal, because layer types
    that differ in them mean something else. The same holds for names with a common ending.
    """
    import difflib

    word = word.lower()
    ending = next((each for each in _ENDINGS if word.endswith(each) and word != each), "")
    stems = {name.lower().removesuffix(ending): name for name in known if name.lower().endswith(ending)}
    stem = word.removesuffix(ending)
    for close in difflib.get_close_matches(stem, stems, n=3, cutoff=0.75 if near else 0.7 if ending else 0.6):
        if not (near or ending) or (close[:1], _digits(close)) == (stem[:1], _digits(stem)):
            return f'; did you mean "{stems[close]}"?'
    return ""


def _digits(word: str) -> str:
    return "".join(filter(str.isdigit, word))


def check_blobs(wanted: Iterable[str], known: Iterable[str], file: str) -> None:
    """Raise SpecError for the first of the blobs that a net, read from ``file``, does not have."""
    blobs = list(dict.fromkeys(known))
    for name in wanted:
        if name not in blobs:
            hint = did_you_mean(name, blobs) or ";"
            raise SpecError(f'no blob "{name}" in this net{hint} it has: {", ".join(blobs)}', Where(file))

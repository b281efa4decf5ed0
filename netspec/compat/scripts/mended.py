"""What a program does that Python 3, or NumPy since 2.4, refuses: done once more, as it was meant.

Only what has failed is done again, and only with other arguments, so that nothing else is changed: text is given as the
bytes of the file that it came from where bytes are asked for, and bytes as text; an array of one element as a number,
and 2.0 as 2 where an integer is asked for.
"""

from __future__ import annotations

import codecs
import functools
import numbers
import operator
import re
from collections.abc import Callable
from typing import Any

from netspec.compat.scripts.as_python2 import Py2Bytes, py2_bytes, py2_text

MENDED = "__netspec_{}__"  # the names of the builtins below
TRANSLATED: set[str] = set()  # the files of Python 2 in this process
_ASKS_FOR_BYTES = re.compile(
    r"bytes-like object is required|expected bytes, str found|must be a bytes object|Strings must be encoded"
    r"|string argument without an encoding|bytes(-like object)?,? (expected|not '?str)|but 'str'|not 'str'"
)
_ASKS_FOR_TEXT = re.compile(r"(not|got|found) '?(bytes|Py2Bytes)|string pattern on a bytes|strings and bytes|Py2Bytes")
_ASKS_FOR_INTEGER = re.compile(r"as an integer|must be integers|integer argument|sequence of integers|single integer")
_OF_BYTES = ("hex", "base64", "zlib", "bz2", "quopri", "uu")  # codecs from bytes to bytes


def _format(text: str, values: Any) -> str:
    """Return text % values; arrays of one element are numbers, as they were before NumPy 2.4."""
    try:
        return text % values
    except TypeError:
        given = values if isinstance(values, tuple) else (values,)
        changed = tuple(map(_number, given))
        if all(number is value for number, value in zip(changed, given, strict=True)):
            raise
        return text % changed


def _call(function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Return function(...), called again with what it was meant to get where it refuses an argument's type."""
    try:
        return function(*arguments, **named)
    except Exception as fault:
        trace = fault.__traceback__
        while trace := trace.tb_next if trace else None:
            if trace.tb_frame.f_code.co_filename in TRANSLATED:
                raise  # a function of the program, whose own calls were done again where that helps
        again = _meant(str(fault), isinstance(fault, TypeError), arguments, named)
        if again is None:
            raise
        arguments, named = again
    result = function(*arguments, **named)
    return py2_text(result) if type(result) is bytes else result


def _meant(said: str, of_type: bool, arguments: tuple[Any, ...], named: dict[str, Any]) -> Any:
    """Return the arguments that were meant, and those by name; None where they are as they should be."""
    if of_type and ("sort() takes" in said or "'cmp'" in said or said.startswith("sorted expected")):
        others: list[Any] = [*arguments, *([named["cmp"]] if "cmp" in named else [])]
        comes: Any = others.pop()
        rest = {name: value for name, value in named.items() if name != "cmp"}
        return (others, {**rest, "key": functools.cmp_to_key(comes)}) if callable(comes) else None  # pyright: ignore
    if _ASKS_FOR_BYTES.search(said):
        change = _as_bytes
    elif of_type and _ASKS_FOR_TEXT.search(said):
        change = _as_text
    elif of_type and said.startswith("unsupported format string"):
        change = _as_shown
    elif of_type and _ASKS_FOR_INTEGER.search(said):
        change = _integer
    elif of_type:
        change = _number
    else:
        return None
    changed = [change(value) for value in arguments]
    changed_named = {name: change(value) for name, value in named.items()}
    before, after = (*arguments, *named.values()), (*changed, *changed_named.values())
    return None if all(map(operator.is_, before, after)) else (changed, changed_named)


def _as_bytes(value: Any) -> Any:
    return py2_bytes(value) if isinstance(value, str) else getattr(value, "buffer", value)


def _as_text(value: Any) -> Any:
    if isinstance(value, list):
        return [_as_text(element) for element in value]
    return value.decode("utf-8", "surrogateescape") if isinstance(value, bytes) else value


def _as_shown(value: Any) -> Any:
    return str(value) if type(value).__format__ is object.__format__ else value


def _number(value: Any) -> Any:
    """Return the element of an array that has one; everything else as it is."""
    is_array = hasattr(value, "dtype") and getattr(value, "ndim", 0) > 0 and value.size == 1
    return value.item() if is_array else value


def _integer(value: Any) -> Any:
    """Return a number with a point as an integer, as NumPy took it for an index or a size until 1.12."""
    if isinstance(value, (tuple, list)) and any(_integer(element) is not element for element in value):
        return type(value)(map(_integer, value))
    value = _number(value)
    return int(value) if isinstance(value, float) or getattr(value, "dtype", None) == "float32" else value


def _decode(value: Any, *codec: Any) -> Any:
    """Return value.decode(...); text from a file is decoded already."""
    if codec and isinstance(value, (str, bytes)) and codec[0] in _OF_BYTES:
        return Py2Bytes(codecs.decode(py2_bytes(value), *codec))
    return value if isinstance(value, str) else value.decode(*codec)


def _encode(value: Any, *codec: Any) -> Any:
    """Return value.encode(...), as bytes that are shown as text."""
    if codec and isinstance(value, (str, bytes)) and codec[0] in _OF_BYTES:
        value, codec = codecs.encode(py2_bytes(value), *codec), ()
    encoded = value if isinstance(value, bytes) else value.encode(*codec)
    return Py2Bytes(encoded) if isinstance(encoded, bytes) else encoded


def _comparing(compare: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a comparison that has an order of unlike types too: None, numbers, and others by their types' names."""

    def compared(left: Any, right: Any) -> Any:
        try:
            return compare(left, right)
        except TypeError:
            ranks = _rank(left), _rank(right)
            if None in ranks or ranks[0] == ranks[1]:
                raise
            return compare(*ranks)

    return compared


def _equality(compare: Callable[[Any, Any], Any], otherwise: bool) -> Callable[[Any, Any], Any]:
    """Return == or !=; one answer for an array beside None or another length of list, as before NumPy 1.13."""

    def compared(left: Any, right: Any) -> Any:
        if right is None:
            return compare(left is None, True)
        try:
            return compare(left, right)
        except ValueError:
            return otherwise

    return compared


def _rank(value: Any) -> tuple[int, str] | None:
    if value is None:
        return 0, ""
    if isinstance(value, numbers.Real):
        return 1, ""
    return (2, type(value).__name__) if isinstance(value, (str, list, tuple, dict)) else None


BUILTINS: dict[str, Callable[..., Any]] = {
    **{"format": _format, "call": _call, "decode": _decode, "encode": _encode, "index": _integer},
    **{"eq": _equality(operator.eq, False), "noteq": _equality(operator.ne, True)},
    **{name: _comparing(getattr(operator, name)) for name in ("lt", "le", "gt", "ge")},
}

"""Operations as they are in Python 2, or in NumPy before 2.4, where Python 3 or a newer NumPy refuses or changes them.

netspec/compat/scripts/sources.py replaces operations in a program by calls of these functions. Each function converts
its arguments and then runs the operation once. It converts text to bytes where bytes are needed (the bytes of the file
that the text was read from), an array of one element to a number, and 2.0 to 2 where an index or a size is needed.
"""

from __future__ import annotations

import codecs
import functools
import numbers
import operator
import re
import string
from collections.abc import Callable
from types import ModuleType
from typing import Any

from netspec.compat.scripts.as_python2 import Py2Bytes, py2_bytes, py2_text

REPLACEMENT = "__netspec_{}__"  # the name under which a program calls one of BUILTINS
TRANSLATED: set[str] = set()  # the files that were translated from Python 2 in this process
_OF_BYTES = ("hex", "base64", "zlib", "bz2", "quopri", "uu")  # codecs from bytes to bytes
_CONVERSION = re.compile(r"%(?:\((?P<name>.*?)\))?[-#0 +]*(?P<width>\*|\d*)(?:\.(?P<digits>\*|\d*))?[hlL]?(?P<kind>.)")


def _number(value: Any) -> Any:
    """Return the element of an array of one element. Return everything else unchanged."""
    is_array = hasattr(value, "dtype") and getattr(value, "ndim", 0) > 0 and value.size == 1
    return value.item() if is_array else value


def _integer(value: Any) -> Any:
    """Return a float as an integer. NumPy accepted floats as indices and sizes until 1.12."""
    if isinstance(value, (tuple, list)):
        return type(value)(map(_integer, value)) if type(value) in (tuple, list) else value
    value = _number(value)
    is_float32 = getattr(value, "dtype", None) == "float32" and value.ndim == 0
    return int(value) if isinstance(value, float) or is_float32 else value


def _sized(function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Return function(...). In calls of NumPy and Pillow, and of reshape in pycaffe, sizes become integers."""
    name, library = getattr(function, "__name__", ""), _library(function)
    if library in ("numpy", "PIL"):
        named = {key: _integer(value) if key in ("shape", "size") else value for key, value in named.items()}
    first, last = 0, 0  # the arguments that are sizes
    if name in ("reshape", "resize") and library in ("numpy", "PIL", "netspec"):
        first = int(getattr(function, "__module__", None) == "numpy")  # np.reshape(array, sizes)
        last = len(arguments) if name == "reshape" else first + 1
    elif name in ("empty", "ones", "zeros") and library == "numpy":
        last = 1
    return function(*arguments[:first], *map(_integer, arguments[first:last]), *arguments[last:], **named)


def _library(function: Any) -> str:
    """Return the name of the package that a function is from, or the object that a method belongs to."""
    owner = getattr(function, "__self__", None)
    of = function if owner is None or isinstance(owner, ModuleType) else type(owner)
    return str(getattr(of, "__module__", "")).partition(".")[0]


class _Sliced:
    """An object in ``object[a:b]``. If it is an array, floats are allowed as ``a`` and ``b``."""

    def __init__(self, whole: Any) -> None:
        self._whole = whole
        is_array = any(base.__module__ == "numpy" for base in type(whole).__mro__)
        self._bound = _integer if is_array else _number

    def __getitem__(self, key: Any) -> Any:
        return self._whole[self._converted(key)]

    def __setitem__(self, key: Any, value: Any) -> None:
        self._whole[self._converted(key)] = value

    def __delitem__(self, key: Any) -> None:
        del self._whole[self._converted(key)]

    def _converted(self, key: Any) -> Any:
        if isinstance(key, tuple):
            return tuple(map(self._converted, key))
        return slice(*map(self._bound, (key.start, key.stop, key.step))) if isinstance(key, slice) else key


def _percent(text: str, values: Any) -> str:
    """Return text % values. An array of one element counts as a number for %d, %f and the like."""
    given = values if isinstance(values, tuple) else (values,)
    if isinstance(values, dict) or not any(hasattr(value, "dtype") for value in given):
        return text % values
    kinds: list[str] = []
    for found in _CONVERSION.finditer(text):
        kinds += ["d" for part in (found["width"], found["digits"]) if part == "*"]
        kinds += [found["kind"]] if found["kind"] != "%" else []
    if len(kinds) != len(given):
        return text % values
    return text % tuple(_number(v) if kind in "diouxXeEfFgG" else v for kind, v in zip(kinds, given, strict=True))


class _Formatter(string.Formatter):
    """Formats like str.format. Objects that define no format, such as None or a list, are formatted as their text."""

    def format_field(self, value: Any, format_spec: str) -> str:
        return format(str(value) if type(value).__format__ is object.__format__ else value, format_spec)


def _format(text: Any, *arguments: Any, **named: Any) -> Any:
    """Return text.format(...)."""
    if not isinstance(text, str):
        return text.format(*arguments, **named)
    return _Formatter().vformat(text, arguments, named)


def _with_bytes(function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Return function(...), where function takes bytes. Text in the arguments becomes the bytes it was in Python 2."""
    result = function(*map(py2_bytes, arguments), **{name: py2_bytes(value) for name, value in named.items()})
    return py2_text(result) if type(result) is bytes else result


def _sort(function: Callable[..., Any], *arguments: Any, **named: Any) -> Any:
    """Return function(...). For sorted and list.sort, cmp, key and reverse may be positional, and cmp becomes a key."""
    first = 1 if function is sorted else 0
    if not first and not isinstance(getattr(function, "__self__", None), list):
        return function(*arguments, **named)  # the sort of NumPy, for example
    named.update(zip(("cmp", "key", "reverse"), arguments[first:], strict=False))
    compare, key = named.pop("cmp", None), named.get("key")
    if compare is not None:
        compared = functools.cmp_to_key(compare)
        named["key"] = compared if key is None else lambda value: compared(key(value))
    return function(*arguments[:first], **named)


def _decode(value: Any, *codec: Any) -> Any:
    """Return value.decode(...). Text from a file is already decoded, and is returned unchanged."""
    if codec and isinstance(value, (str, bytes)) and codec[0] in _OF_BYTES:
        return Py2Bytes(codecs.decode(py2_bytes(value), *codec))
    return value if isinstance(value, str) else value.decode(*codec)


def _encode(value: Any, *codec: Any) -> Any:
    """Return value.encode(...), as bytes that print like text."""
    if codec and isinstance(value, (str, bytes)) and codec[0] in _OF_BYTES:
        value, codec = codecs.encode(py2_bytes(value), *codec), ()
    encoded = value if isinstance(value, bytes) else value.encode(*codec)
    return Py2Bytes(encoded) if isinstance(encoded, bytes) else encoded


def _comparing(compare: Callable[[Any, Any], Any]) -> Callable[[Any, Any], Any]:
    """Return a comparison that also orders different types: None, numbers, and others by the names of their types."""

    def compared(left: Any, right: Any) -> Any:
        ranks = _rank(left), _rank(right)
        return compare(left, right) if None in ranks or ranks[0] == ranks[1] else compare(*ranks)

    return compared


def _rank(value: Any) -> tuple[int, str] | None:
    if value is None:
        return 0, ""
    if isinstance(value, numbers.Real):
        return 1, ""
    return next(((2, kind.__name__) for kind in (dict, list, str, tuple) if isinstance(value, kind)), None)


def _equality(compare: Callable[[Any, Any], Any], otherwise: bool) -> Callable[[Any, Any], Any]:
    """Return == or !=, with a single result for an array and None, or a list of another length (NumPy before 1.13)."""

    def compared(left: Any, right: Any) -> Any:
        if right is None:
            return compare(left is None, True)
        try:
            return compare(left, right)
        except ValueError:
            return otherwise

    return compared


BUILTINS: dict[str, Callable[..., Any]] = {
    **{"number": _number, "sliced": _Sliced, "percent": _percent, "format": _format, "bytes": _with_bytes},
    **{"sort": _sort, "decode": _decode, "encode": _encode, "sized": _sized},
    **{"eq": _equality(operator.eq, False), "noteq": _equality(operator.ne, True)},
    **{name: _comparing(getattr(operator, name)) for name in ("lt", "le", "gt", "ge")},
}

"""Operations with arrays as they were in NumPy before 2.4, or 1.13, where a newer NumPy refuses or changes them.

netspec/compat/scripts/sources.py replaces operations in a program by calls of these functions. Each function converts
its arguments and then runs the operation once.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable
from typing import Any

REPLACEMENT = "__netspec_{}__"  # the name under which a program calls one of BUILTINS
TRANSLATED: set[str] = set()  # the files that were translated from Python 2 in this process
_CONVERSION = re.compile(r"%(?:\((?P<name>.*?)\))?[-#0 +]*(?P<width>\*|\d*)(?:\.(?P<digits>\*|\d*))?[hlL]?(?P<kind>.)")


def _number(value: Any) -> Any:
    """Return the element of an array of one element. Return everything else unchanged."""
    is_array = hasattr(value, "dtype") and getattr(value, "ndim", 0) > 0 and value.size == 1
    return value.item() if is_array else value


def _bound(value: Any) -> Any:
    """Return the bound of a slice: a float as an integer, which NumPy did until 1.12."""
    value = _number(value)
    is_float32 = getattr(value, "dtype", None) == "float32" and value.ndim == 0
    return int(value) if isinstance(value, float) or is_float32 else value


class _Sliced:
    """An object in ``object[a:b]``. If it is an array, floats are allowed as ``a`` and ``b``."""

    def __init__(self, whole: Any) -> None:
        self._whole = whole
        is_array = any(base.__module__ == "numpy" for base in type(whole).__mro__)
        self._convert = _bound if is_array else _number

    def __getitem__(self, key: Any) -> Any:
        return self._whole[self._converted(key)]

    def __setitem__(self, key: Any, value: Any) -> None:
        self._whole[self._converted(key)] = value

    def __delitem__(self, key: Any) -> None:
        del self._whole[self._converted(key)]

    def _converted(self, key: Any) -> Any:
        if isinstance(key, tuple):
            return tuple(map(self._converted, key))
        return slice(*map(self._convert, (key.start, key.stop, key.step))) if isinstance(key, slice) else key


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
    "number": _number,
    "percent": _percent,
    "sliced": _Sliced,
    "eq": _equality(operator.eq, False),
    "noteq": _equality(operator.ne, True),
}

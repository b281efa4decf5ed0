"""Functions for programs translated from Python 2, where Python 3 differs. `--write-py3` copies them from here."""

import builtins
import decimal
import io
import math
import numbers
from functools import reduce as reduce
from importlib import reload as reload
from sys import intern as intern


def py2_div(left, right):
    """Return left / right, rounded down where both are whole numbers or arrays of them."""
    return left // right if py2_is_whole(left) and py2_is_whole(right) else left / right


class py2_divisor:
    """The right side of ``target /= value``: Python evaluates the target once, and lets this class divide."""

    def __init__(self, value):
        self.value = value

    def __rtruediv__(self, left):
        if py2_is_whole(left) and py2_is_whole(self.value):
            left //= self.value
        else:
            left /= self.value
        return left

    def __array_ufunc__(self, ufunc, method, left, *others, **named):
        """Do the same for NumPy's arrays and numbers."""
        return self.__rtruediv__(left)


def py2_is_whole(value):
    """Return whether a value is a whole number, or an array of whole numbers."""
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    return kind in "iub" if kind else isinstance(value, numbers.Integral)


def round(number, ndigits=0):
    """Return a number rounded to ``ndigits`` digits, halves away from zero, as a float."""
    number, most = float(number), 400  # digits that a float can have before or behind its point
    if not math.isfinite(number) or ndigits > most:
        return number
    unit = decimal.Decimal(1).scaleb(-max(ndigits, -most))
    exact = decimal.Context(prec=2 * most + 10)
    return float(decimal.Decimal(number).quantize(unit, decimal.ROUND_HALF_UP, exact))


def py2_bytes(data):
    """Return a text as the bytes of the file that it was read from; everything else as it is."""
    return data.encode("utf-8", "surrogateescape") if isinstance(data, str) else data


class py2_writer(io.BufferedWriter):
    """A file for writing bytes that takes text too."""

    def write(self, data):
        """Write text or bytes."""
        return super().write(py2_bytes(data))


class StringIO(io.BytesIO):
    """A file of bytes in memory that takes text too; programs keep images in it."""

    def __init__(self, data=b""):
        super().__init__(py2_bytes(data))

    def write(self, data):
        """Write text or bytes."""
        return super().write(py2_bytes(data))


def open(name, mode="r", buffering=-1, *arguments, **named):
    """Open a file. As text, lines end as they do in the file, unless the mode has a U, and any bytes can be read."""
    if mode in ("ab", "wb") and buffering != 0:
        return py2_writer(io.FileIO(name, mode))
    if "b" in mode or arguments or named:
        return builtins.open(name, mode, buffering, *arguments, **named)
    newline = None if "U" in mode else "\n"
    mode = mode.replace("U", "") or "r"
    return builtins.open(name, mode, buffering or 1, encoding="utf-8", errors="surrogateescape", newline=newline)


file = open

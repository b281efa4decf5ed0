"""What programs translated from Python 2 call, where Python 3 computes otherwise. `--write-py3` copies it from here."""

import builtins
import math
import numbers


def py2_div(left, right):
    """Return left / right, rounded down where both are whole numbers or arrays of them."""
    return left // right if py2_is_whole(left) and py2_is_whole(right) else left / right


def py2_idiv(left, right):
    """Do left /= right as Python 2 does, and return the result; an array is changed in place."""
    if py2_is_whole(left) and py2_is_whole(right):
        left //= right
    else:
        left /= right
    return left


def py2_is_whole(value):
    """Say whether a value is a whole number, or an array of them."""
    kind = getattr(getattr(value, "dtype", None), "kind", "")
    return kind in "iub" if kind else isinstance(value, numbers.Integral)


def round(number, ndigits=0):
    """Return a number rounded to so many digits, halves away from zero, as a float."""
    scale = 10.0**ndigits
    return math.copysign(math.floor(abs(number) * scale + 0.5) / scale, number)


def cmp(left, right):
    """Return -1, 0 or 1."""
    return (left > right) - (left < right)


def open(file, mode="r", *arguments, **named):
    """Open a file; text may have any bytes in it."""
    if "b" not in mode and not arguments and not named:
        named = {"encoding": "utf-8", "errors": "surrogateescape"}
    return builtins.open(file, mode, *arguments, **named)


file = open

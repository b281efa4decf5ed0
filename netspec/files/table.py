"""Tables in text files: cells separated by semicolons, commas or blanks, and the names of their columns."""

from __future__ import annotations

import csv
import re
from dataclasses import dataclass
from pathlib import Path

from netspec.errors import InputError
from netspec.files.kinds import unreadable
from netspec.files.limits import read_bytes

UNITS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}  # of time, in seconds
TIME = r"%?time.*|(?:.*[._])?(?:time)?stamp.*|ts(?:_.*)?|t|n?secs?"
_UNIT = re.compile(r"\s*[\[(]\s*([^\])]*?)\s*[\])]")
_TIME_UNIT = re.compile(r"[\[(_ ](n|u|m)?s(?:ec)?[\])]?$")
_OF_ROSTOPIC = re.compile(r"%time|field\..*stamp")  # rostopic echo -p writes nanoseconds


@dataclass(frozen=True)
class Row:
    """A line of a file: its number from 1, and its cells."""

    line: int
    cells: list[str]


@dataclass(frozen=True)
class Table:
    """The rows of a file, and its ``lines`` without comments, with their numbers.

    names  of the columns, in lower case and with their units; empty if there are none
    named  whether the names are the first line, and not a comment
    """

    path: Path
    lines: list[tuple[int, str]]
    names: list[str]
    rows: list[Row]
    named: bool

    def column(self, pattern: str) -> int | None:
        """Return the first column whose name, without its unit, is of this pattern; None if there is none."""
        return next((i for i, name in enumerate(self.names) if re.fullmatch(pattern, _UNIT.sub("", name))), None)

    def unit(self, column: int) -> str:
        """Return the unit of time, a key of UNITS, that the name of a column has; empty if it has none."""
        name = self.names[column] if self.names else ""
        found = _TIME_UNIT.search(name)
        return "ns" if _OF_ROSTOPIC.fullmatch(name) else f"{found[1] or ''}s" if found else ""


def text_lines(path: str | Path) -> list[tuple[int, str]]:
    """Return the lines of a text file that are not blank, with their numbers from 1.

    Raises OSError if it cannot be read, and ValueError if it is not UTF-8 or has a NUL character.
    """
    text = read_bytes(path).decode("utf-8-sig")
    if "\0" in text:
        raise ValueError("a NUL character")
    return [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]


def read_table(path: str | Path, expected: str) -> Table:
    """Read a table. Empty lines are ignored, and so are lines that begin with #, except that the last one before the
    first row may have the names of the columns.

    Raises InputError if it cannot be read as text.
    """
    path = Path(path)
    try:
        told = text_lines(path)
    except OSError as fault:
        raise InputError(unreadable(path, fault, expected), path) from fault
    except ValueError as fault:
        raise InputError(f"is not a text file; expected {expected}", path) from fault
    numbered = [(number, line) for number, line in told if not line.lstrip().startswith("#")]
    separator = next((each for each in ";," if numbered and each in numbered[0][1]), "")
    rows = [Row(number, _cells(line, separator)) for number, line in numbered]
    if rows and not any(map(is_number, rows[0].cells)):
        return Table(path, numbered, _names(numbered[0][1], separator), rows[1:], True)
    before = [line for number, line in told if line.lstrip().startswith("#") and rows and number < rows[0].line]
    names = _names(before[-1].lstrip("# "), separator) if before else []
    return Table(path, numbered, names if rows and len(names) <= len(rows[0].cells) else [], rows, False)


def is_number(text: str) -> bool:
    """Return whether a cell is a number."""
    try:
        float(text)
    except ValueError:
        return False
    return True


def _names(line: str, separator: str) -> list[str]:
    joined = line if separator else re.sub(r"\s+(?=[\[(])", "", line)
    return [name.lower() for name in _cells(joined, separator)]


def _cells(line: str, separator: str) -> list[str]:
    if not separator:
        return line.split()
    return [
        cell.strip()
        for cell in next(csv.reader([line.rstrip(separator)], delimiter=separator, skipinitialspace=True), [])
    ]

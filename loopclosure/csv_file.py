"""Tables as CSV files, whose cells neither a spreadsheet nor a terminal takes for commands."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from pathlib import Path

from netspec.errors import printable
from netspec.files.whole_file import write_whole

_UNSEEN = re.compile(r"[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f]")  # control characters except tabs and line ends
_FORMULA = tuple("=+-@\t\r\n")  # first characters of formulas in spreadsheets


def write_csv(path: str | Path, head: Sequence[str], rows: Iterable[Sequence[object]], errors: str = "strict") -> None:
    """Write a table as CSV, with the cells of :func:`safe_cell`; ``errors`` as in :func:`write_whole`."""
    text = io.StringIO()
    csv.writer(text).writerows([head, *([safe_cell(value) for value in row] for row in rows)])
    write_whole(path, text.getvalue(), errors)


def safe_cell(value: object) -> object:
    """Return the cell of a table for a value. A string that a spreadsheet would evaluate gets an apostrophe.

    Control characters, which could control a terminal, are escaped. Bytes that are not UTF-8 are kept.
    """
    if not isinstance(value, str):
        return value
    text = _UNSEEN.sub(lambda found: printable(found[0]), value)
    if text[:1] not in _FORMULA:
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text

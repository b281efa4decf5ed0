"""CSV tables that name images, and image names below a root folder."""

from __future__ import annotations

import csv
from pathlib import Path

from loopclosure.errors import InputError
from netspec.files.image_list import IMAGE_ENDINGS


def read_table(path: Path, images: int) -> tuple[list[tuple[int, dict[str, str]]], list[str]]:
    """Read a CSV table: rows with their line numbers, and the names of the ``images`` columns with image names."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.DictReader(stream, restval="")
            rows = [(reader.line_num, row) for row in reader]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        reason = error.strerror if isinstance(error, OSError) else "not a table"
        raise InputError(f"cannot be read ({reason}); expected a CSV table with a header line", path) from error
    if not rows:
        raise InputError("has no row below its header line", path)
    columns = [name for name, text in rows[0][1].items() if str(text).lower().endswith(IMAGE_ENDINGS)]
    if len(columns) != images:
        raise InputError(
            f"has {len(columns)} column{'s'[len(columns) == 1 :]} of image names ({', '.join(columns) or 'none'}); "
            f"expected {images}",
            path,
            1,
            1,
        )
    return rows, columns


def cell(path: Path, line: int, row: dict[str, str], column: str) -> str:
    """Return what a row has in a column. Raises InputError if it is empty."""
    if column not in row:
        raise InputError(f'has no column "{column}"; there are: {", ".join(map(str, row))}', path, 1, 1)
    if not row[column]:
        raise InputError(f"column {column} is empty", path, line, 1)
    return row[column]


def as_number(path: Path, line: int, row: dict[str, str], column: str) -> float:
    """Return the number that a row has in a column. Raises InputError if there is no number."""
    text = cell(path, line, row, column)
    try:
        return float(text)
    except ValueError:
        raise InputError(f'expected a number in column {column}, found "{text}"', path, line, 1) from None


def relative(path: Path, root: Path) -> str:
    """Return the path relative to the root, with slashes. Raises InputError if it is not below the root."""
    try:
        return path.resolve().relative_to(root.resolve()).as_posix()
    except ValueError:
        raise InputError(f"is not below the root folder {root}; give another --root", path) from None

"""Splits a file of poses into rows and finds its form: the separators, the header, the unit of time, the order of w.

A row that has no usable pose is left out and remembered; whoever reads the file says how many there are.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from loopclosure.errors import InputError
from loopclosure.places.trajectory import NORM_TOLERANCE, content_lines, number

EXPECTED = (
    "a file of poses: TUM (timestamp tx ty tz qx qy qz qw), KITTI (twelve numbers of a matrix), or EuRoC "
    "(timestamp,px,py,pz,qw,qx,qy,qz)"
)
COLUMNS = {"tum": 8, "euroc": 8, "kitti": 12}
EUROC_COLUMNS = 17  # of state_groundtruth_estimate0: the pose, the velocity and the biases of the sensors
# A rotation matrix in text has at least four decimals.
MATRIX_TOLERANCE = 0.02
_DECIMAL_COMMA = re.compile(r"[+-]?\d+(,\d+)?([eE][+-]?\d+)?")
_QUATERNION = re.compile(r"\b(?:q|quat|quaternion|rot|rotation|orientation)[._]?\w*?[._]?([wxyz])\b", re.IGNORECASE)
UNITS = (1e-3, 1e-6, 1e-9)  # of time, other than seconds
YEAR_1990, YEAR_2100 = 6.3e8, 4.1e9  # in seconds since 1970


@dataclass(frozen=True)
class Row:
    """A line of the file: its number from 1, and its fields, each with its column from 1."""

    line: int
    fields: Sequence[str]
    columns: Sequence[int]
    separated: bool = False  # by commas or semicolons


@dataclass(frozen=True)
class Lines:
    """The rows of a file, and what precedes them: comments, and a line of names without ``#``."""

    rows: list[Row]
    header: str

    @property
    def separated(self) -> bool:
        """Whether commas or semicolons separate the fields."""
        return any(row.separated for row in self.rows)

    @property
    def order(self) -> str:
        """The order of the quaternion that the header names; empty if it names none."""
        found = "".join(_QUATERNION.findall(self.header)).lower()
        return {"wxyz": "w-first", "xyzw": "w-last"}.get(found, "")


@dataclass(frozen=True)
class Faults:
    """The rows without a usable pose: how many of ``rows``, and the first as an error with its line and column."""

    count: int
    rows: int
    first: InputError

    def __str__(self) -> str:
        have, line = "has" if self.count == 1 else "have", self.first.where.line if self.first.where else 0
        return f"{self.count} of {self.rows} rows {have} no usable pose; line {line}: {self.first.message}"


def read_lines(path: str | os.PathLike[str]) -> Lines:
    """Read a file of poses. Raises InputError if it cannot be read, or has no row."""
    rows, comments, header = [], [], ""
    for line_number, line in content_lines(path, EXPECTED, comments):
        row = _row(line_number, line)
        if not rows:
            if not any(map(_is_number, row.fields)):
                comments.append(line)
                continue
            header = comments[-1] if comments else ""
        rows.append(row)
    if not rows:
        raise InputError("holds no pose", path)
    return Lines(rows, header)


def form_of(lines: Lines, order: str, path: str | os.PathLike[str]) -> str:
    """Return the form, "tum", "kitti" or "euroc", that the rows of a file have.

    Raises InputError if they have none, or if two are possible.
    """
    counts = [len(row.fields) for row in lines.rows]
    count = max(set(counts), key=lambda each: (counts.count(each), -counts.index(each)))
    first = lines.rows[counts.index(count)]
    if count == COLUMNS["kitti"] and not lines.order:
        return "kitti"
    known = order or lines.order
    if count >= COLUMNS["tum"] and lines.separated and (known or count == EUROC_COLUMNS):
        return "tum" if known == "w-last" else "euroc"
    if count == COLUMNS["tum"] and not lines.separated:
        return "tum"
    if count == COLUMNS["tum"]:
        raise InputError(
            "the last four columns may be qx,qy,qz,qw as in TUM's form or qw,qx,qy,qz as in EuRoC's; name the columns "
            "in the first line, or say pose-form=tum or pose-form=euroc",
            path,
            first.line,
            first.columns[4],
        )
    raise InputError(f"has {count} numbers in a row; expected {EXPECTED}", path, first.line, 1)


def numbers_of(lines: Lines, form: str, order: str, path: str | os.PathLike[str]) -> tuple[np.ndarray, Faults | None]:
    """Return the first numbers of each row (N, 8 or 12), and what is wrong in rows without a usable pose.

    Such rows are NaN, except their time.
    Raises InputError (file:line:column) if no row has a usable pose.
    """
    table, faults = np.full((len(lines.rows), COLUMNS[form]), np.nan), []
    for values, row in zip(table, lines.rows, strict=True):
        try:
            values[:] = _numbers(row, form, order, path)
        except InputError as fault:
            faults.append(fault)
            if form != "kitti" and _is_number(row.fields[0]):
                values[0] = float(row.fields[0])
    if len(faults) == len(table):
        raise faults[0]
    return table, Faults(len(faults), len(table), faults[0]) if faults else None


def seconds_of(stamps: np.ndarray) -> np.ndarray:
    """Return stamps (N,) in seconds. Dates may be in s, ms, us or ns since 1970; their size tells which."""
    usual = float(np.median(stamps)) if len(stamps) else 0.0
    for unit in UNITS:
        if YEAR_1990 < usual * unit < YEAR_2100 and usual > YEAR_2100:
            return stamps * unit
    return stamps


def matrix_fault(matrix: np.ndarray) -> str:
    """Return why the first three columns (3, 3) of a pose are not a rotation; empty if they are."""
    difference = float(np.abs(matrix.T @ matrix - np.eye(3)).max()) if np.abs(matrix).max() < 2 else np.inf
    if not difference <= MATRIX_TOLERANCE:
        return f"its first three columns are not a rotation: M^T M differs from the identity by {difference:.3g}"
    reflected = np.linalg.det(matrix) < 0
    return "its first three columns are a reflection (determinant -1), not a rotation" if reflected else ""


def _row(line_number: int, line: str) -> Row:
    """Split a line at commas or semicolons, or else at spaces. Numbers may have a decimal comma."""
    words = list(re.finditer(r"[^\s;]+", line))
    decimal = "," in line and len(words) >= COLUMNS["tum"] and all(_DECIMAL_COMMA.fullmatch(word[0]) for word in words)
    separated = ";" in line or ("," in line and not decimal)
    if separated and not decimal:
        cells = re.finditer(r"([^,;]*)(?:[,;]|$)", line.rstrip(" \t\r,;"))
        fields = [(cell.start() + 1 + _indent(cell[1]), cell[1].strip()) for cell in cells if cell[0]]
    else:
        fields = [(word.start() + 1, word[0].replace(",", ".")) for word in words]
    return Row(line_number, [text for _, text in fields], [column for column, _ in fields], separated)


def _indent(text: str) -> int:
    return len(text) - len(text.lstrip())


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def _numbers(row: Row, form: str, order: str, path: str | os.PathLike[str]) -> list[float]:
    """Return the numbers of a row. Raises InputError if they are not a pose."""
    count, exact = COLUMNS[form], not row.separated or form == "kitti"
    if len(row.fields) < count or (exact and len(row.fields) > count):
        words = "a pose of a matrix has 12" if form == "kitti" else f"a pose of {form.upper()}'s form has {count}"
        raise InputError(f"has {len(row.fields)} numbers, {words}", path, row.line, 1)
    names = [f"column {i + 1}" for i in range(count)]
    if form != "kitti":
        turn = ("qw", "qx", "qy", "qz") if order == "w-first" else ("qx", "qy", "qz", "qw")
        names = ["the time", "tx", "ty", "tz", *turn]
    values = [number(row.fields[i], names[i], path, row.line, row.columns[i]) for i in range(count)]
    if form == "kitti":
        if fault := matrix_fault(np.array(values).reshape(3, 4)[:, :3]):
            raise InputError(fault, path, row.line, row.columns[0])
    elif not abs((length := float(np.linalg.norm(values[4:]))) - 1) <= NORM_TOLERANCE:
        fault = f"{' '.join(names[4:])} have length {length:.4g}, a rotation has length 1"
        raise InputError(fault, path, row.line, row.columns[4])
    return values

"""Writes the figures in ``benchmarks/results`` into the pages: ``tools/bench pages``.

A line ``<!-- table: NAME -->`` starts a table with the rows of ``results/NAME.json``, up to ``<!-- end -->``.
``<!-- figure: ... -->`` within a line marks one cell. The name can be followed by ``; COLUMN, COLUMN as TITLE``, which
selects columns (default: all), and by ``; COLUMN=VALUE, OTHER!=VALUE``, which selects rows. ``COLUMN: OTHER`` as the
last column makes a pivot table: each value of COLUMN becomes a column with the values of OTHER.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from netspec.errors import SpecError

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
PAGES = tuple(page for pattern in ("README.md", "*/README.md", "docs/*.md") for page in sorted(ROOT.glob(pattern)))
MARKED = re.compile(r"(<!-- (table|figure): (.+?) -->)(.*?)<!-- end -->", re.DOTALL)


def updated(text: str, folder: Path = RESULTS) -> str:
    """Return the text of a page with the current figures. Raises SpecError for a marker that matches no figure."""

    def written(found: re.Match[str]) -> str:
        rows, columns = _chosen(found[3], folder)
        if found[2] == "figure":
            if len(rows) != 1 or len(columns) != 1:
                raise SpecError(f"{found[1]}: {len(rows)} rows and {len(columns)} columns where one cell is wanted")
            return f"{found[1]}{rows[0][0]}<!-- end -->"
        lines = [columns, ["---"] * len(columns), *rows]
        return "\n".join([found[1], *(f"| {' | '.join(line)} |" for line in lines), "<!-- end -->"])

    return MARKED.sub(written, text)


def write(pages: Sequence[Path] = PAGES) -> list[Path]:
    """Write all pages again; return those that changed."""
    changed = []
    for page in pages:
        old = page.read_text(encoding="utf-8")
        new = updated(old)
        if new != old:
            page.write_text(new, encoding="utf-8")
            changed.append(page)
    return changed


def _chosen(words: str, folder: Path) -> tuple[list[list[str]], list[str]]:
    name, wanted, conditions = ([part.strip() for part in words.split(";")] + ["", ""])[:3]
    path = folder / f"{name}.json"
    if not path.is_file():
        raise SpecError(f"there is no {path}")
    rows: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["rows"]
    needs = [condition.strip().rpartition("=") for condition in conditions.split(",") if condition]
    columns = [column.strip() for column in wanted.split(",")] if wanted else list(rows[0])
    try:
        for column, _, value in needs:
            other = column.endswith("!")
            rows = [row for row in rows if (str(row[column.rstrip("!")]) == value) != other]
        if ": " in columns[-1]:
            rows = _spread(rows, columns[:-1], *columns.pop().split(": "))
            columns = list(rows[0])
        titles = {}
        for column in columns:
            name, _, title = column.partition(" as ")
            titles[name] = title or name
        decimals = {column: max(_decimals(row[column]) for row in rows) for column in titles}
        cells = [[_cell(row[column], column, decimals[column]) for column in titles] for row in rows]
    except KeyError as missing:
        raise SpecError(f"{path.name} has no column {missing}") from None
    return cells, list(titles.values())


def _spread(rows: list[dict[str, Any]], keys: list[str], column: str, other: str) -> list[dict[str, Any]]:
    found: dict[tuple[Any, ...], dict[str, Any]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), {key: row[key] for key in keys})[row[column]] = row[other]
    columns = dict.fromkeys(name for row in found.values() for name in row)
    return [{name: row.get(name) for name in columns} for row in found.values()]


def _decimals(value: Any) -> int:
    return len(repr(value).partition(".")[2]) if isinstance(value, float) else 0


def _cell(value: Any, column: str, most: int) -> str:
    """Format a number: three significant digits, with the column's number of decimals; two decimals for a ratio."""
    if value is None:
        return ""
    if not isinstance(value, float):
        return f"{value:,}" if isinstance(value, int) and value >= 10000 else str(value)
    by_size = 3 if abs(value) < 1 else 2 if abs(value) < 10 else 1 if abs(value) < 100 else 0
    return f"{value:.{min(most, 2 if '/ ' in column else by_size)}f}"

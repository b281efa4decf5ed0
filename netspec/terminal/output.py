"""What a command shows: bars while it works, doubts about the user's files, tables."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from typing import TypeVar

from netspec.errors import printable

Item = TypeVar("Item")


def bar(items: Iterable[Item], stage: str, total: int | None = None, unit: str = "") -> Iterable[Item]:
    """Return the items; on a terminal, a bar named ``stage`` shows how far the caller is in them."""
    from tqdm import tqdm  # commands that show no bar do not load it

    return tqdm(items, desc=stage, total=total, disable=None, leave=False, unit=unit)


def warn(doubt: str) -> None:
    """Print a doubt about the user's files."""
    print(printable(f"warning: {doubt}"), file=sys.stderr)


def in_columns(rows: Sequence[Sequence[str]], left: int = 1, spans: Sequence[tuple[str, int]] = ()) -> list[str]:
    """Return rows of cells as lines; the first ``left`` columns begin at their left, the others end at their right.

    ``spans``, where given, are headings above these others: a text, and over how many columns it stands.
    """
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = []
    if spans:
        over, at = " " * (sum(widths[:left]) + 2 * (left - 1)), left
        for name, columns in spans:
            over += f"  {f' {name} ':-^{sum(widths[at : at + columns]) + 2 * (columns - 1)}}"
            at += columns
        lines.append(over)
    for row in rows:
        cells = zip(row, widths, strict=True)
        lines.append("  ".join(c.ljust(w) if k < left else c.rjust(w) for k, (c, w) in enumerate(cells)))
    return lines

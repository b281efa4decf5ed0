"""Tables in a terminal."""

from __future__ import annotations

from collections.abc import Sequence


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

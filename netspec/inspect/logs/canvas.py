"""A small plot of characters: each is a Braille pattern of 2 x 4 dots."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from netspec.inspect.logs.curve import shown_range
from netspec.log import number

_EMPTY = 0x2800
_DOTS = ((0x01, 0x02, 0x04, 0x40), (0x08, 0x10, 0x20, 0x80))  # of a column, from the top
_MARK = "o"
_LABEL = 9  # characters left of the plot
_MOST_MARKS = 15


def plot_lines(
    curve: tuple[np.ndarray, np.ndarray],
    marks: tuple[np.ndarray, np.ndarray],
    width: int,
    height: int,
) -> list[str]:
    """Return the lines of a plot, ``width`` x ``height`` characters: a curve of dots, and an ``o`` for each mark.

    Curve and marks are x and y, float64 (n,); values that are not finite are left out. Of the values that share a
    column of dots, the mean is drawn; of many marks some are.
    """
    points, others = _finite(*curve), _finite(*marks)
    others = tuple(each[:: -(-len(each) // _MOST_MARKS) or 1] for each in others)
    together = np.concatenate([points[1], others[1]])
    if not len(together):
        return []
    places = np.concatenate([points[0], others[0]])
    x0, x1 = float(places.min()), float(places.max())
    y0, y1 = shown_range([points[1], others[1]]) or (0.0, 0.0)
    y0, y1 = (y0, y1) if y1 > y0 else (y0 - 0.5, y0 + 0.5)
    columns, rows = max(10, width - _LABEL), max(2, height - 1)
    codes = np.full((rows, columns), _EMPTY)
    _draw(codes, points, (x0, x1, y0, y1))
    cells = [[chr(code) if code != _EMPTY else " " for code in line] for line in codes]
    for x, y in zip(*others, strict=True):
        down = rows - 1 - int(_scaled(np.array([np.clip(y, y0, y1)]), y0, y1, rows)[0])
        cells[down][int(_scaled(np.array([x]), x0, x1, columns)[0])] = _MARK
    return [*_with_labels(cells, y0, y1), _foot(x0, x1, columns)]


def _draw(codes: np.ndarray, points: tuple[np.ndarray, np.ndarray], ranges: tuple[float, float, float, float]) -> None:
    """Draw a line through the points into the characters' codes (rows, columns)."""
    rows, columns = codes.shape
    x0, x1, y0, y1 = ranges
    across = _scaled(points[0], x0, x1, 2 * columns)
    there = np.unique(across)
    if not len(there):
        return
    means = [points[1][across == column].mean() for column in there]
    line = np.arange(there[0], there[-1] + 1)
    heights = _scaled(np.clip(np.interp(line, there, means), y0, y1), y0, y1, 4 * rows)
    before = heights[0]
    for column, height in zip(line, heights, strict=True):
        for step in range(min(before, height), max(before, height) + 1) if abs(before - height) > 1 else (height,):
            down = 4 * rows - 1 - step
            codes[down // 4, column // 2] |= _DOTS[column % 2][down % 4]
        before = height


def bar(share: float, width: int) -> str:
    """Return a bar of ``width`` characters, of which ``share`` (0 to 1) is full."""
    full = round(min(max(share, 0.0), 1.0) * width)
    return "█" * full + "░" * (width - full)


def _finite(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    known = np.isfinite(y)
    return x[known], y[known]


def _scaled(values: np.ndarray, low: float, high: float, count: int) -> np.ndarray:
    """Return which of ``count`` cells each value falls into."""
    share = (values - low) / ((high - low) or 1.0)
    return np.minimum((share * count).astype(int), count - 1)


def _with_labels(cells: Sequence[Sequence[str]], low: float, high: float) -> list[str]:
    lines = []
    for row, line in enumerate(cells):
        value = high - (high - low) * (row + 0.5) / len(cells)
        named = row in (0, len(cells) // 2, len(cells) - 1)
        label = number(float(f"{value:.3g}")) if named else ""
        lines.append(f"{label:>{_LABEL - 2}} │" + "".join(line).rstrip())
    return lines


def _foot(first: float, last: float, columns: int) -> str:
    left, right = f"{first:,.0f}", f"{last:,.0f}"
    return " " * _LABEL + left + right.rjust(columns - len(left))

"""A built net as a table of text."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Sequence
from itertools import islice, zip_longest

from netspec.errors import printable
from netspec.graph.plan import Plan
from netspec.graph.splits import is_split
from netspec.layers.contract.base import Layer

_HEAD = ("layer", "type", "bottoms", "tops", "shapes", "parameters", "MiB", "multiply-adds")
_LISTS = (2, 3, 4)  # columns of lists, which may take several lines
_OMITTED = ("tops", "MiB", "bottoms", "type", "multiply-adds")  # columns that a narrow table omits, in this order
_NARROWEST = 16  # characters: lists and names are made this narrow before a column is omitted
MOST_BLOBS = 20  # of one layer that are listed
_TEXT_COLUMNS = 5  # aligned left; the columns after them have numbers
_Row = tuple[list[str], ...]  # the lines of each cell


def table(plan: Plan, layers: Sequence[Layer], width: int | None = None) -> str:
    """Return one line per layer: its name and type, its blobs, the shapes of its tops and its costs; and totals.

    Costs are the number of learnable values ("shared" if an earlier layer owns them), the memory of its tops, and the
    multiply-adds of one forward pass. Splits are omitted: a reader of a copy is shown as a reader of the blob. So that
    the table fits into ``width`` characters, lists take several lines. If that is not enough, columns are omitted, and
    the last line names them.
    """
    rows: list[_Row] = []
    totals = [0, 0, 0]
    counted: set[int] = set()
    origin: dict[int, int] = {}  # copy of a blob -> the blob
    for node, layer in zip(plan.nodes, layers, strict=True):
        bottoms = [origin.get(v, v) for v in node.bottoms]
        if is_split(node.name, node.type):
            origin.update(dict.fromkeys(node.tops, bottoms[0]))
            continue
        parameters = sum(blob.numel() for blob in layer.blobs if id(blob) not in counted)
        shared = len(layer.blobs) > 0 and parameters == 0
        counted.update(id(blob) for blob in layer.blobs)
        memory, work = 4 * sum(map(math.prod, layer.top_shapes)), layer.multiply_adds()
        totals = [total + cost for total, cost in zip(totals, (parameters, memory, work), strict=True)]
        lists = (
            _listed(printable(plan.blobs[v]) for v in bottoms),
            _listed(printable(plan.blobs[v]) for v in node.tops),
            _listed("x".join(map(str, shape)) or "scalar" for shape in layer.top_shapes),
        )
        costs = _printed(parameters, memory, work, shared)
        rows.append(([printable(node.name)], [printable(node.type)], *lists, *([cost] for cost in costs)))
    costs = _printed(totals[0], totals[1], totals[2])
    rows.append((["total"], [], [], [], [], *([cost] for cost in costs)))
    rows.insert(0, tuple([head] for head in _HEAD))
    return "\n".join(_lines(rows, width))


def _listed(blobs: Iterable[str]) -> list[str]:
    """Return the words of a list with commas: at most MOST_BLOBS, and how many more there are."""
    rest = iter(blobs)
    words = list(islice(rest, MOST_BLOBS))
    more = sum(1 for _ in rest)
    if more:
        words.append(f"and {more:,} more")
    if not words:
        return ["-"]
    return [*(f"{word}," for word in words[:-1]), words[-1]]


def _printed(parameters: int, memory: int, work: int, shared: bool = False) -> tuple[str, str, str]:
    count = "shared" if shared else f"{parameters:,}" if parameters else ""
    return count, f"{memory / 2**20:.2f}", f"{work:,}" if work else ""


def _lines(rows: Sequence[_Row], width: int | None) -> list[str]:
    """Return the lines of the table, which fit into ``width``, if there is one."""
    columns = list(range(len(_HEAD)))
    whole = [max(len(" ".join(row[k])) for row in rows) for k in columns]
    omitted_next = [_HEAD.index(name) for name in _OMITTED]
    widths = list(whole)
    while width is not None and (over := sum(widths) + 2 * (len(columns) - 1) - width) > 0:
        # The widest list becomes narrower first, until another is as wide. Once all are narrow, a column is omitted.
        wide = [k for k in (0, *_LISTS) if k in columns and widths[k] > _NARROWEST]
        if wide:
            widest = max(wide, key=lambda k: widths[k])
            second = max([_NARROWEST, *(widths[k] for k in wide if widths[k] < widths[widest])])
            widths[widest] = max(second, widths[widest] - over)
        elif omitted_next:
            columns.remove(omitted_next.pop(0))
            widths = [0 if k not in columns else whole[k] for k in range(len(_HEAD))]
        else:
            break
    lines = []
    for row in rows:
        cells = [(k, _wrapped(row[k], widths[k])) for k in columns]
        for line in zip_longest(*(cell for _, cell in cells), fillvalue=""):
            aligned = (
                word.ljust(widths[k]) if k < _TEXT_COLUMNS else word.rjust(widths[k])
                for (k, _), word in zip(cells, line, strict=True)
            )
            lines.append("  ".join(aligned).rstrip())
    if left := [name for k, name in enumerate(_HEAD) if k not in columns]:
        lines += textwrap.wrap(f"not shown in {width} columns: {', '.join(left)}", width or 80, break_on_hyphens=False)
    return lines


def _wrapped(words: Sequence[str], width: int) -> list[str]:
    """Return the words in lines of at most ``width`` characters. The middle of a longer word becomes an ellipsis."""
    lines: list[str] = []
    for word in words:
        if lines and len(lines[-1]) + 1 + len(word) <= width:
            lines[-1] += f" {word}"
        else:
            half = max(1, (width - 1) // 2)
            lines.append(word if len(word) <= width else f"{word[: width - half - 1]}…{word[-half:]}")
    return lines or [""]

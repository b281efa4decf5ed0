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
_SPARED = ("tops", "MiB", "bottoms", "type", "multiply-adds")  # columns that a narrow table lacks, the first first
_LEAST = 16  # characters that a list or a name keeps before another column goes
MOST_WORDS = 20  # blobs of one layer that are listed
_WORDS = 5  # columns of words, aligned left; then come the numbers
_Row = tuple[list[str], ...]  # the lines of each cell


def table(plan: Plan, layers: Sequence[Layer], width: int | None = None) -> str:
    """Return one line per layer: its name and type, its blobs, the shapes of its tops, its costs; and totals.

    Costs: number of learnable values ("shared" if an earlier layer owns them), memory of its tops, multiply-adds of
    one forward pass. Splits are left out: a reader of a copy counts as a reader of the blob. In a table of at
    most ``width`` characters lists take several lines, and if that is not enough, columns are left out, as its last
    line says.
    """
    rows: list[_Row] = []
    totals = [0, 0, 0]
    counted: set[int] = set()
    origin: dict[int, int] = {}  # of the copies of a blob
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


def _listed(words: Iterable[str]) -> list[str]:
    first = list(islice(words := iter(words), MOST_WORDS))
    more = sum(1 for _ in words)
    words = [*first, *([f"and {more:,} more"] if more else [])] or ["-"]
    return [*(f"{word}," for word in words[:-1]), words[-1]]


def _printed(parameters: int, memory: int, work: int, shared: bool = False) -> tuple[str, str, str]:
    count = "shared" if shared else f"{parameters:,}" if parameters else ""
    return count, f"{memory / 2**20:.2f}", f"{work:,}" if work else ""


def _lines(rows: Sequence[_Row], width: int | None) -> list[str]:
    """Return the lines of the table, which fit into ``width``, if there is one."""
    columns = list(range(len(_HEAD)))
    whole = [max(len(" ".join(row[k])) for row in rows) for k in columns]
    spared = [_HEAD.index(name) for name in _SPARED]
    widths = list(whole)
    while width is not None and (over := sum(widths) + 2 * (len(columns) - 1) - width) > 0:
        # The widest list gives way first; a column is left out where all lists and the names are narrow.
        shrinks = [k for k in (0, *_LISTS) if k in columns and widths[k] > _LEAST]
        if shrinks:
            k = max(shrinks, key=lambda k: widths[k])
            next_ = max([_LEAST, *(widths[j] for j in shrinks if widths[j] < widths[k])])
            widths[k] = max(next_, widths[k] - over)
        elif spared:
            columns.remove(spared.pop(0))
            widths = [0 if k not in columns else whole[k] for k in range(len(_HEAD))]
        else:
            break
    lines = []
    for row in rows:
        cells = [(k, _wrapped(row[k], widths[k])) for k in columns]
        for line in zip_longest(*(cell for _, cell in cells), fillvalue=""):
            aligned = (
                word.ljust(widths[k]) if k < _WORDS else word.rjust(widths[k])
                for (k, _), word in zip(cells, line, strict=True)
            )
            lines.append("  ".join(aligned).rstrip())
    if left := [name for k, name in enumerate(_HEAD) if k not in columns]:
        lines += textwrap.wrap(f"not shown in {width} columns: {', '.join(left)}", width or 80, break_on_hyphens=False)
    return lines


def _wrapped(words: Sequence[str], width: int) -> list[str]:
    """Return the words in lines of at most ``width`` characters; a word that is longer loses its middle."""
    lines: list[str] = []
    for word in words:
        if lines and len(lines[-1]) + 1 + len(word) <= width:
            lines[-1] += f" {word}"
        else:
            half = max(1, (width - 1) // 2)
            lines.append(word if len(word) <= width else f"{word[: width - half - 1]}…{word[-half:]}")
    return lines or [""]

"""A built net as a table for people, and as JSON for programs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import islice

from netspec.errors import printable
from netspec.graph.plan import Plan
from netspec.layers.base import Layer

_HEAD = ("layer", "type", "bottoms", "tops", "shapes", "parameters", "MiB", "multiply-adds")
MOST_WORDS = 20  # blobs of one layer that are listed
_WORDS = 5  # columns of words, aligned left; then come the numbers


def table(plan: Plan, layers: Sequence[Layer]) -> str:
    """Return one line per layer: its name and type, its blobs, the shapes of its tops, its costs; and totals.

    Costs: number of learnable values ("shared" if an earlier layer owns them), memory of its tops, multiply-adds of
    one forward pass.
    """
    rows: list[tuple[str, ...]] = [_HEAD]
    totals = [0, 0, 0]
    counted: set[int] = set()
    for node, layer in zip(plan.nodes, layers, strict=True):
        parameters = sum(blob.numel() for blob in layer.blobs if id(blob) not in counted)
        shared = len(layer.blobs) > 0 and parameters == 0
        counted.update(id(blob) for blob in layer.blobs)
        memory, work = 4 * sum(map(math.prod, layer.top_shapes)), layer.multiply_adds()
        totals = [total + cost for total, cost in zip(totals, (parameters, memory, work), strict=True)]
        shapes = _listed("x".join(map(str, shape)) or "scalar" for shape in layer.top_shapes)
        blobs = [_listed(plan.blobs[v] for v in values) for values in (node.bottoms, node.tops)]
        rows.append(
            (
                printable(node.name),
                printable(node.type),
                *map(printable, blobs),
                shapes,
                *_printed(parameters, memory, work, shared),
            )
        )
    rows.append(("total", "", "", "", "", *_printed(totals[0], totals[1], totals[2])))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(_line(row, widths) for row in rows)


def _listed(words: Iterable[str]) -> str:
    first = list(islice(words := iter(words), MOST_WORDS))
    more = sum(1 for _ in words)
    return ", ".join(first) + (f", and {more:,} more" if more else "") or "-"


def _printed(parameters: int, memory: int, work: int, shared: bool = False) -> tuple[str, str, str]:
    count = "shared" if shared else f"{parameters:,}" if parameters else ""
    return count, f"{memory / 2**20:.2f}", f"{work:,}" if work else ""


def _line(row: tuple[str, ...], widths: list[int]) -> str:
    words = [cell.ljust(width) for cell, width in zip(row[:_WORDS], widths[:_WORDS], strict=True)]
    numbers = [cell.rjust(width) for cell, width in zip(row[_WORDS:], widths[_WORDS:], strict=True)]
    return "  ".join(words + numbers).rstrip()

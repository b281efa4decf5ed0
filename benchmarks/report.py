"""Prints the results of a benchmark."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

REFERENCES = ("pytorch", "opencv4")


@dataclass(frozen=True)
class Row:
    """How one program ran one net.

    ``seconds`` (wall clock) and ``computing`` (CPU time of all threads) are times of a pass, one per round. ``ratios``
    and ``spent`` are their ratios to the references. ``peak`` is the peak memory of the process in MB. ``what`` was
    timed: "forward", "training" or "program".
    """

    net: str
    batch: int
    threads: int
    name: str
    seconds: list[float]
    computing: list[float]
    ratios: Mapping[str, float]
    difference: float | None
    fault: str = ""
    spent: Mapping[str, float] = field(default_factory=dict)
    peak: float | None = None
    what: str = "forward"


def columns(row: Row) -> dict[str, Any]:
    """Return a row for the results file: milliseconds, ratios to each reference, MB; None if not measured."""
    found: dict[str, Any] = {"what": row.what, "net": row.net, "batch": row.batch, "threads": row.threads}
    found["run by"] = row.name
    times = (statistics.median, row.seconds), (min, row.seconds), (statistics.median, row.computing)
    for name, (of, seconds) in zip(("ms", "best", "CPU ms"), times, strict=True):
        value = math.nan if row.fault else 1e3 * of(seconds)
        found[name] = None if math.isnan(value) else value
    for prefix, ratios in (("/", row.ratios), ("CPU /", row.spent)):
        found |= {f"{prefix} {name}": ratios.get(name) for name in REFERENCES}
    return {**found, "MB": row.peak, "off by": row.difference}


def table(rows: Sequence[Row]) -> str:
    """Return rows as a Markdown table."""
    kept = [columns(row) for row in rows]
    unknown = {
        f"{prefix} {name}"
        for name in REFERENCES
        if not any(name in row.ratios for row in rows)
        for prefix in ("/", "CPU /")
    }
    head = [name for name in kept[0] if name != "what" and name not in unknown]
    lines = [head, ["---"] * len(head), *([_cell(name, row[name]) for name in head] for row in kept)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(name: str, value: Any) -> str:
    if value is None:
        return "-"
    form = {"MB": ".0f", "off by": ".0e"}.get(name, ".2f")
    return f"{value:{form}}" if isinstance(value, float) else str(value)

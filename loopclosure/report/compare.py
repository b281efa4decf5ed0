"""Compares the reports of several evaluations: a table and a figure of curves, made from their report.json files."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from loopclosure.errors import InputError
from loopclosure.evaluate import RECALL_AT, SOFT_ZONE
from loopclosure.precision_recall import ALL_PAIRS, BEST_MATCH
from loopclosure.report.files import SOFT_MEASURES, share
from loopclosure.report.page import rendered
from loopclosure.report.plots import STYLE, draw_curve, frame_curves, legends_below
from netspec.errors import printable
from netspec.files.figures import COLORS, png
from netspec.files.kinds import unreadable
from netspec.files.whole_file import write_whole
from netspec.terminal.output import in_columns

EXPECTED = "a report.json that loopclosure evaluate wrote"
BY_CONVENTION = ("average precision", "recall at 100 % precision", "best F1")
# (convention and zone, measure) of each column, and its heading.
COLUMNS = (
    *(((ALL_PAIRS, name), head) for name, head in zip(BY_CONVENTION, ("AP", "R@P=1", "F1"), strict=True)),
    *(((BEST_MATCH, name), head) for name, head in zip(BY_CONVENTION, ("AP", "R@P=1", "F1"), strict=True)),
    *(((BEST_MATCH, f"recall at {k}"), f"R@{k}") for k in RECALL_AT),
    *(((BEST_MATCH + SOFT_ZONE, name), head) for name, head in zip(SOFT_MEASURES, ("AP", "R@P=1"), strict=True)),
)
PANELS = (ALL_PAIRS, BEST_MATCH, BEST_MATCH + SOFT_ZONE)


@dataclass(frozen=True)
class Report:
    """The contents of a report.json: a label, the data set, the truth, and the figures and curves of each method.

    figures  method -> convention and zone -> measure -> value; None if it is undefined
    curves   method -> convention and zone -> ("recall", "precision") -> (n,)
    """

    label: str
    data_set: str
    truth: str
    figures: dict[str, dict[str, dict[str, float | None]]]
    curves: dict[str, dict[str, dict[str, np.ndarray]]]


@dataclass(frozen=True)
class Row:
    """A row of the table, for one report or the difference of two; the cells are text."""

    method: str
    report: str
    cells: tuple[str, ...]


def read_reports(paths: Sequence[str | Path]) -> list[Report]:
    """Read reports. Their labels are the shortest endings of their folders' paths that are all different.

    Raises InputError for any other file.
    """
    folders = [Path(path).resolve().parent for path in paths]
    parts = 1
    while len({folder.parts[-parts:] for folder in folders}) < len(set(folders)):
        parts += 1
    labels = ["/".join(folder.parts[-parts:]) for folder in folders]
    labels = [
        f"{label}/{Path(path).name}" if labels.count(label) > 1 else label
        for label, path in zip(labels, paths, strict=True)
    ]
    for label, path in zip(labels, paths, strict=True):
        if labels.count(label) > 1:
            raise InputError("is given twice; name two reports", path)
    return [_read(Path(path), label) for path, label in zip(paths, labels, strict=True)]


def _read(path: Path, label: str) -> Report:
    try:
        found = json.loads(path.read_text("utf-8"))
    except OSError as error:
        raise InputError(unreadable(path, error, EXPECTED), path) from None
    except (ValueError, RecursionError):
        raise InputError(f"is not JSON; expected {EXPECTED}", path) from None
    try:
        methods = {str(method["name"]): method for method in found["methods"]}
        figures = {name: _figures(method["figures"]) for name, method in methods.items()}
        curves = {name: _curves(method.get("curves", {})) for name, method in methods.items()}
        return Report(printable(label), str(found["data_set"]), str(found["truth_and_exclusion"]), figures, curves)
    except (LookupError, TypeError, ValueError, AttributeError):
        raise InputError(f"is not {EXPECTED}", path) from None


def _figures(found: dict[str, dict[str, Any]]) -> dict[str, dict[str, float | None]]:
    return {
        convention: {name: None if value is None else float(value) for name, value in values.items()}
        for convention, values in found.items()
    }


def _curves(found: dict[str, dict[str, list[float]]]) -> dict[str, dict[str, np.ndarray]]:
    return {
        convention: {axis: np.array(points[axis], float) for axis in ("recall", "precision")}
        for convention, points in found.items()
    }


def warnings(reports: Sequence[Report]) -> list[str]:
    """Return warnings: reports with different data or truth, which cannot be compared, and reports without curves."""
    found = []
    for kind, name in (("data_set", "data"), ("truth", "truth")):
        values = {getattr(report, kind) for report in reports}
        if len(values) > 1:
            each = "; ".join(f"{report.label}: {getattr(report, kind)}" for report in reports)
            found.append(f"the reports are of different {name}, and their figures do not compare. {each}")
    for report in reports:
        if not any(report.curves.values()):
            found.append(f"{report.label} has no curves: it is of an earlier version; evaluate again")
    return found


def table(reports: Sequence[Report]) -> list[Row]:
    """Return one row per method and report. If there are two reports, add the difference, second - first."""
    rows = []
    for method in dict.fromkeys(name for report in reports for name in report.figures):
        having = [report for report in reports if method in report.figures]
        values = [[report.figures[method].get(zone, {}).get(name) for (zone, name), _ in COLUMNS] for report in having]
        rows += [
            Row(method, report.label, tuple(share(math.nan if v is None else v) for v in cells))
            for report, cells in zip(having, values, strict=True)
        ]
        if len(having) == len(reports) == 2:
            gains = ["–" if a is None or b is None else f"{b - a:+.3f}" for a, b in zip(*values, strict=True)]
            rows.append(Row(method, "difference", tuple(gains)))
    return rows


def text(reports: Sequence[Report]) -> str:
    """Return the table for a terminal, with warnings."""
    rows = [("method", "report", *(head for _, head in COLUMNS))]
    rows += [(row.method, row.report, *row.cells) for row in table(reports)]
    spans = [(ALL_PAIRS, 3), (BEST_MATCH, 3 + len(RECALL_AT)), ("soft zone", 2)]
    first = reports[0]
    return "\n".join([*warnings(reports), f"{first.data_set}: {first.truth}", *in_columns(rows, 2, spans)])


def curves(reports: Sequence[Report]) -> Figure:
    """Draw the curves of all methods of all reports: a color for each method, a line style for each report."""
    methods = list(dict.fromkeys(name for report in reports for name in report.curves))
    panels = [p for p in PANELS if any(p in found for report in reports for found in report.curves.values())]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(4.8 * max(1, len(panels)), 4.2), layout="constrained")
        axes = list(figure.subplots(1, max(1, len(panels)), squeeze=False).flat)
        for axis, panel in zip(axes, panels or [ALL_PAIRS], strict=True):
            for number, report in enumerate(reports):
                for method, found in report.curves.items():
                    if panel not in found:
                        continue
                    points = found[panel]
                    recall = np.append(0.0, points["recall"])
                    precision = np.append(points["precision"][:1], points["precision"])
                    area = report.figures[method].get(panel, {}).get("average precision")
                    color = methods.index(method) % len(COLORS) + len(COLORS) * number
                    name = f"{method} ({report.label})"
                    draw_curve(axis, recall, precision, name, color, math.nan if area is None else area)
            frame_curves(axis, panel)
        if panels:
            legends_below(figure, axes)
        return figure


def write_comparison(reports: Sequence[Report], path: str | Path, command: str = "") -> None:
    """Write the table and the curves as one self-contained HTML page."""
    page = rendered(
        "compare.html.jinja",
        title=f"Comparison of {len(reports)} reports",
        reports=reports,
        warnings=warnings(reports),
        heads=[head for _, head in COLUMNS],
        spans=[(ALL_PAIRS, 3), (BEST_MATCH, 3 + len(RECALL_AT)), (f"{BEST_MATCH}, soft zone", 2)],
        rows=table(reports),
        picture=png(curves(reports)),
        command=command,
    )
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    write_whole(path, page, "backslashreplace")

"""An HTML page with curves of trainings: checkboxes for runs and curves, a cursor, and a table of values."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from markupsafe import Markup
from matplotlib.figure import Figure

from netspec.files.figures import COLORS
from netspec.inspect.draw.page import page
from netspec.inspect.draw.style import svg
from netspec.inspect.draw.training import MOST_POINTS
from netspec.inspect.logs.training_log import Curve, TrainingLog, summary, thinned

_PARTS = (("raw", "training, as logged"), ("smooth", "training, smoothed"), ("test", "tests"), ("rate", "rate"))
_FEW = 6  # test outputs that the cursor reads


def training_page(logs: Sequence[TrainingLog], figure: Figure, title: str) -> str:
    """Return the page, which needs no other files. ``figure`` is the drawing of the runs."""
    summaries = [summary(log) for log in logs]
    columns = list(dict.fromkeys(name for line in summaries for name in line))
    shown = [
        {"name": log.name, "color": COLORS[number % len(COLORS)], "cells": [line.get(column, "") for column in columns]}
        for number, (log, line) in enumerate(zip(logs, summaries, strict=True))
    ]
    drawing = svg(figure)
    return page(
        "training_page.html.jinja",
        title=title,
        runs=shown,
        parts=_PARTS,
        columns=columns,
        svg=Markup(drawing[drawing.index("<svg") :]),
        description=describe(logs),
        curves={**_horizontal(figure), "runs": [_curves(log, k) for k, log in enumerate(logs)]},
    )


def _horizontal(figure: Figure) -> dict[str, float]:
    """Return the left and right ends of the panels, as shares of the drawing's width, and the iterations there."""
    panel = figure.axes[0]
    place, (first, last) = panel.get_position(), panel.get_xlim()
    return {"left": place.x0, "right": place.x1, "first": first, "last": last}


def _curves(log: TrainingLog, number: int) -> dict[str, object]:
    """Return the curves that the cursor reads, as points (iteration, value); None is a value that is not finite."""
    named = [("loss", log.loss), ("learning rate", log.rate)]
    for net, curves in log.tests.items():
        named += [(f"{log.test_label(net)} {name}", curve) for name, curve in list(curves.items())[:_FEW]]
    return {
        "name": log.name,
        "color": COLORS[number % len(COLORS)],
        "curves": [(name, _points(curve)) for name, curve in named],
    }


def _points(curve: Curve) -> list[tuple[int, float | None]]:
    x, y = thinned(*curve.arrays(), MOST_POINTS)
    return [(int(at), float(value) if np.isfinite(value) else None) for at, value in zip(x, y, strict=True)]


def describe(logs: Sequence[TrainingLog]) -> str:
    """Return a description of the drawing in words."""
    lines = []
    for log in logs:
        cells = ", ".join(f"{name} {value}" for name, value in summary(log).items())
        lines.append(f"{log.name}: {cells}")
    return "Curves over iterations. " + ". ".join(lines) + "."

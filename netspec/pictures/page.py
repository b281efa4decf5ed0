"""Curves of trainings as one HTML file: the picture, boxes that hide runs and curves, a table of numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from jinja2 import Environment
from markupsafe import Markup
from matplotlib.figure import Figure

from netspec.pictures.style import COLORS, svg
from netspec.runs.run import Run
from netspec.runs.summary import summary

_PARTS = (("raw", "training, as logged"), ("smooth", "training, smoothed"), ("test", "tests"), ("rate", "rate"))


def training_page(runs: Sequence[Run], figure: Figure, title: str) -> str:
    """Return the page; ``figure`` is the picture of the runs. It needs nothing from elsewhere."""
    environment = Environment(autoescape=True, trim_blocks=False)
    template = environment.from_string(Path(__file__).with_name("page.html.jinja").read_text(encoding="utf-8"))
    told = [summary(run) for run in runs]
    columns = list(dict.fromkeys(name for line in told for name in line))
    shown = [
        {
            "name": run.name,
            "color": COLORS[number % len(COLORS)],
            "cells": [line.get(column, "") for column in columns],
        }
        for number, (run, line) in enumerate(zip(runs, told, strict=True))
    ]
    drawing = svg(figure)
    return template.render(
        title=title,
        runs=shown,
        parts=_PARTS,
        columns=columns,
        svg=Markup(drawing[drawing.index("<svg") :]),
        description=describe(runs),
    )


def describe(runs: Sequence[Run]) -> str:
    """Return in words what the picture shows."""
    lines = []
    for run in runs:
        cells = ", ".join(f"{name} {value}" for name, value in summary(run).items())
        lines.append(f"{run.name}: {cells}")
    return "Curves over iterations. " + ". ".join(lines) + "."

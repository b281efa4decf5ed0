"""The style of drawings, and writing them to files."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.figure import Figure

from netspec.errors import SpecError, Where
from netspec.files import figures
from netspec.files.whole_file import write_whole

FAULT = "#c62828"
DPI = 144
ENDINGS = ("png", "svg")

STYLE: dict[Any, Any] = {
    **figures.STYLE,
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.formatter.useoffset": False,
    "figure.dpi": DPI,
    "svg.fonttype": "none",  # keep text as text, for searching, copying and screen readers
    "svg.hashsalt": "netspec",  # equal drawings give equal files
}


def ending_of(path: str | Path) -> str:
    """Return the format of a file name. Raises SpecError for another format."""
    ending = Path(path).suffix.lower().lstrip(".")
    if ending not in ENDINGS:
        raise SpecError(f"expected a name that ends in {', '.join(f'.{each}' for each in ENDINGS)}", Where(str(path)))
    return ending


def write_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG or SVG, by the ending of the name. Raises SpecError."""
    data = svg(figure).encode() if ending_of(path) == "svg" else figures.png(figure)
    write_whole(path, data)


def svg(figure: Figure) -> str:
    """Return a figure as SVG."""
    with matplotlib.rc_context(STYLE):
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()

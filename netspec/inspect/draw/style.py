"""How pictures look, and how they are written."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from netspec.errors import SpecError, Where
from netspec.files.whole_file import why_unwritable, write_whole

# Color-blind readers can distinguish these too (Okabe and Ito).
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C6D31")
GRID, PALE, FAULT = "#e6e6e6", "#777777", "#c62828"
DPI = 144
ENDINGS = ("png", "svg", "html")

STYLE: dict[Any, Any] = {
    "font.size": 10,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "axes.formatter.useoffset": False,
    "legend.frameon": False,
    "figure.dpi": DPI,
    "svg.fonttype": "none",  # text stays text: it can be read aloud, searched and copied
    "svg.hashsalt": "netspec",  # the same picture is the same file
}


def ending_of(path: str | Path, endings: Sequence[str] = ENDINGS) -> str:
    """Return the kind of picture that a file name asks for. Raises SpecError for another, and for a bad folder."""
    ending = Path(path).suffix.lower().lstrip(".")
    if ending not in endings:
        raise SpecError(f"expected a name that ends in {', '.join(f'.{each}' for each in endings)}", Where(str(path)))
    if reason := why_unwritable(path):
        raise SpecError(f"cannot be written: {reason}", Where(str(path)))
    return ending


def write_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG or SVG, as the name asks for. Raises SpecError."""
    data = svg(figure).encode() if ending_of(path) == "svg" else _png(figure)
    write_whole(path, data)


def svg(figure: Figure) -> str:
    """Return a figure as SVG."""
    with matplotlib.rc_context(STYLE):
        text = io.StringIO()
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()


def _png(figure: Figure) -> bytes:
    data = io.BytesIO()
    figure.savefig(data, format="png", metadata={"Software": None})
    return data.getvalue()


def text_at(axis: Axes, x: float, y: float, text: str, **options: Any) -> None:
    """Write a text that is no formula, in the coordinates of the data."""
    axis.text(x, y, text, parse_math=False, **options)


def stretched(values: np.ndarray, low: float | None = None, high: float | None = None) -> np.ndarray:
    """Return values as brightness, 0 to 1: ``low`` and ``high``, else the least and the greatest, are black and white.

    NaN and infinity become 0.
    """
    known = values[np.isfinite(values)]
    low = float(known.min()) if low is None and len(known) else (low or 0.0)
    high = float(known.max()) if high is None and len(known) else (high or 1.0)
    return np.clip(np.nan_to_num((values - low) / ((high - low) or 1.0), posinf=0.0, neginf=0.0), 0, 1)

"""The style of drawings, writing them to files, and drawing arrays as tiles."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from netspec.data.datum import shape_text
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


def text_at(axis: Axes, x: float, y: float, text: str, **options: Any) -> None:
    """Write a text at data coordinates, without parsing formulas."""
    axis.text(x, y, text, parse_math=False, **options)


def stretched(values: np.ndarray, low: float | None = None, high: float | None = None) -> np.ndarray:
    """Scale values to brightness, 0 to 1: black is ``low`` or the minimum, and white is ``high`` or the maximum.

    NaN and infinity become 0.
    """
    known = values[np.isfinite(values)]
    low = float(known.min()) if low is None and len(known) else (low or 0.0)
    high = float(known.max()) if high is None and len(known) else (high or 1.0)
    return np.clip(np.nan_to_num((values - low) / ((high - low) or 1.0), posinf=0.0, neginf=0.0), 0, 1)


FRAME = 0.06  # of a tile's side, between tiles


def as_picture(values: np.ndarray) -> np.ndarray:
    """Return values (C, H, W) as brightness (H, W) or (H, W, 3), 0 to 1, for drawing.

    Bytes are not scaled; other values are scaled from the minimum (black) to the maximum (white). Three channels are
    blue, green, red, as in OpenCV. For two or more than four channels, the mean is drawn; a vector becomes a block.
    """
    if values.shape[1:] == (1, 1):
        values = _block(values.reshape(-1))[None]
    shown = values.astype(np.float64)
    shown = shown / 255 if values.dtype == np.uint8 else stretched(shown)
    if len(shown) in (3, 4):
        return shown[2::-1].transpose(1, 2, 0)
    return shown.mean(axis=0)


def split(values: np.ndarray, images: int) -> list[np.ndarray]:
    """Return the images (C / images, H, W) of a record (C, H, W), or the whole record if C cannot be divided."""
    if images > 1 and len(values) % images == 0:
        return np.split(values, images)
    return [values]


def images_in(values: np.ndarray) -> int:
    """Return the probable number of images in a record (C, H, W): 2 for two gray or two color images, else 1."""
    return 2 if len(values) in (2, 6) and values.shape[1:] != (1, 1) else 1


def what_is_shown(values: np.ndarray) -> str:
    """Return a note if a drawing of values (C, H, W) cannot show the channels themselves, else ""."""
    if values.shape[1:] == (1, 1) and len(values) > 4:
        return f"vectors of {len(values)} numbers as blocks"
    return f"{shape_text(values.shape)}, mean of the channels" if len(values) not in (1, 3, 4) else ""


def draw_tile(axis: Axes, picture: np.ndarray, left: float, bottom: float, width: float, height: float) -> None:
    """Draw an image in the center of a rectangle, as large as possible."""
    rows, columns = picture.shape[:2]
    scale = min(width / columns, height / rows)
    x, y = left + (width - scale * columns) / 2, bottom + (height - scale * rows) / 2
    axis.imshow(
        picture,
        cmap="gray",
        vmin=0,
        vmax=1,
        extent=(x, x + scale * columns, y, y + scale * rows),
        interpolation="nearest" if scale * 100 > 1.2 else "antialiased",
        aspect="equal",
    )


def _block(vector: np.ndarray) -> np.ndarray:
    """Return a vector as an approximately square block, padded with the minimum."""
    columns = int(np.ceil(np.sqrt(len(vector))))
    rows = -(-len(vector) // columns)
    block = np.full(rows * columns, vector.min() if len(vector) else 0, vector.dtype)
    block[: len(vector)] = vector
    return block.reshape(rows, columns)

"""Marks as PNG, drawn by matplotlib: the font comes with it, so pictures are alike on all machines."""

from __future__ import annotations

from io import BytesIO

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import FancyBboxPatch, PathPatch, Polygon, Rectangle
from matplotlib.path import Path

from netspec.inspect.draw.marks import Curve, Mark, Rect, Text
from netspec.inspect.draw.picture import Picture

POINTS = 72  # in an inch: a pixel of the picture is a point
SCALE = 2.0  # pixels of the file for one of the picture
MOST = 60_000  # pixels of a side, somewhat below what the renderer can draw


def png_of(picture: Picture, unfolded: bool = False) -> bytes:
    """Return a file with the whole picture, twice as large as the SVG or, if that is too much, as large as can be."""
    drawing = picture.marks(unfolded)
    width, height = picture.width, drawing.height
    scale = min(SCALE, MOST / max(width, height))
    figure = Figure((width / POINTS, height / POINTS), dpi=POINTS * scale, facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.set_xlim(0, width)
    axes.set_ylim(height, 0)
    for order, mark in enumerate(drawing.marks):
        _draw(axes, mark, order)
    file = BytesIO()
    FigureCanvasAgg(figure).print_png(file)
    return file.getvalue()


def _draw(axes: Axes, mark: Mark, order: int) -> None:
    if isinstance(mark, Text):
        weight = "bold" if mark.bold else "normal"
        axes.text(
            mark.x,
            mark.y,
            mark.text,
            size=mark.size,
            color=mark.fill,
            weight=weight,
            family="DejaVu Sans",
            parse_math=False,
            zorder=order,
            va="baseline",
        )
    elif isinstance(mark, Rect):
        style = {"facecolor": mark.fill, "edgecolor": mark.stroke, "linewidth": 1, "zorder": order}
        style["linestyle"] = (0, (5, 3)) if mark.dashed else "-"
        box = (mark.x, mark.y), mark.width, mark.height
        if mark.radius:
            axes.add_patch(
                FancyBboxPatch(*box, boxstyle=f"round,pad=0,rounding_size={min(mark.radius, mark.width / 2)}", **style)
            )
        else:
            axes.add_patch(Rectangle(*box, **style))
    else:
        _draw_curve(axes, mark, order)


def _draw_curve(axes: Axes, curve: Curve, order: int) -> None:
    codes = [Path.MOVETO, *([Path.CURVE4] * 3 if curve.bent else []), *[Path.LINETO] * len(curve.points)]
    path = Path(curve.points, codes[: len(curve.points)])
    line = (0, (3, 3)) if curve.dashed else "-"
    axes.add_patch(PathPatch(path, fill=False, edgecolor=curve.stroke, linewidth=1.2, linestyle=line, zorder=order))
    if curve.arrow:
        x, y = curve.points[-1]
        head = [(x, y), (x - 3.5, y - 7), (x + 3.5, y - 7)]
        axes.add_patch(Polygon(head, closed=True, color=curve.stroke, linewidth=0, zorder=order))

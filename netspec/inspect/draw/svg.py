"""A net's picture as SVG, and as an HTML file that needs no others, whose values are all escaped."""

from __future__ import annotations

import math
from collections.abc import Iterable
from html import escape
from pathlib import Path

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from netspec.errors import printable
from netspec.inspect.draw.diagram import Diagram
from netspec.inspect.draw.marks import Curve, Mark, Rect, Text
from netspec.inspect.draw.picture import Drawing, Picture

FONT = "font-family=\"'DejaVu Sans', Verdana, 'Segoe UI', Helvetica, Arial, sans-serif\""


def svg_of(picture: Picture, unfolded: bool = False) -> str:
    """Return a file with the whole picture."""
    drawing = picture.marks(unfolded)
    title = f"<title>{escape(printable(picture.title) or 'net')}</title>"
    background = '<rect width="100%" height="100%" fill="#ffffff"/>'
    body = "\n".join(shapes(drawing.marks))
    return f"{opening(picture.width, drawing.height)}{title}{background}\n{body}\n</svg>\n"


def opening(width: int, height: int, attributes: str = "") -> str:
    """Return the opening tag of a picture."""
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" width="{width}" height="{height}" viewBox="0 0 {width} {height}" '
        f'{FONT} role="img"{attributes}>'
    )


def shapes(marks: Iterable[Mark]) -> list[str]:
    """Return an element for each mark; boxes of layers get ``data-layer``."""
    return [element for mark in marks for element in _elements(mark)]


def _elements(mark: Mark) -> list[str]:
    if isinstance(mark, Text):
        weight = ' font-weight="bold"' if mark.bold else ""
        place = f'x="{_n(mark.x)}" y="{_n(mark.y)}" font-size="{_n(mark.size)}"'
        return [f'<text {place}{weight} fill="{mark.fill}">{escape(mark.text)}</text>']
    if isinstance(mark, Rect):
        place = f'x="{_n(mark.x)}" y="{_n(mark.y)}" width="{_n(mark.width)}" height="{_n(mark.height)}"'
        place += f' rx="{_n(mark.radius)}"' if mark.radius else ""
        line = "" if mark.stroke == "none" else f' stroke="{mark.stroke}"'
        line += ' stroke-dasharray="5 3"' if mark.dashed else ""
        line += f' data-layer="{mark.layer}"' if mark.layer >= 0 else ""
        return [f'<rect {place} fill="{mark.fill}"{line}/>']
    dashes = ' stroke-dasharray="3 3"' if mark.dashed else ""
    path = f'<path d="{_path(mark)}" fill="none" stroke="{mark.stroke}" stroke-width="1.2"{dashes}/>'
    if not mark.arrow:
        return [path]
    x, y = mark.points[-1]
    head = f"M{_n(x)} {_n(y)}L{_n(x - 3.5)} {_n(y - 7)}L{_n(x + 3.5)} {_n(y - 7)}Z"
    return [path, f'<path d="{head}" fill="{mark.stroke}"/>']


def _path(curve: Curve) -> str:
    points = [f"{_n(x)} {_n(y)}" for x, y in curve.points]
    if not curve.bent:
        return "M" + "L".join(points)
    return f"M{points[0]}C{' '.join(points[1:4])}" + "".join(f"L{point}" for point in points[4:])


def _n(number: float) -> str:
    """Return a number with at most one digit behind the point."""
    assert math.isfinite(number)
    return f"{number:.1f}".removesuffix(".0")


def page(template: str, **values: object) -> str:
    """Return the page that a template makes of these values."""
    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True)
    return environment.get_template(template).render(**values)


def html_of(diagram: Diagram, picture: Picture) -> str:
    """Return the page of a net: what repeats unfolds, and a click on a layer shows its prototxt."""

    def svg(drawing: Drawing, attributes: str = "") -> Markup:
        return Markup(f"{opening(picture.width, drawing.height, attributes)}{''.join(shapes(drawing.marks))}</svg>")

    bands = [
        (svg(band.drawing, ' class="folded"'), svg(band.unfolded, ' class="unfolded" hidden=""'))
        if band.unfolded
        else (svg(band.drawing), None)
        for band in picture.bands
    ]
    layers = [
        {"name": printable(box.name), "where": printable(str(box.where)), "text": box.text} for box in diagram.boxes
    ]
    return page("net_page.html.jinja", title=printable(diagram.name) or "net", bands=bands, layers=layers)

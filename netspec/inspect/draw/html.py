"""Pictures as HTML files that need no others, made from the templates beside this file; all values are escaped."""

from __future__ import annotations

from pathlib import Path

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from netspec.errors import printable
from netspec.inspect.draw.diagram import Diagram
from netspec.inspect.draw.picture import Drawing, Picture
from netspec.inspect.draw.svg import opening, shapes


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

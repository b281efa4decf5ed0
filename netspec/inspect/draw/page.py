"""Writes drawings as HTML pages that need no other files. All values are escaped."""

from __future__ import annotations

import re
from pathlib import Path

from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup

from netspec.errors import printable
from netspec.inspect.draw.diagram import Diagram
from netspec.inspect.draw.dot import dot_of
from netspec.inspect.draw.graphviz import render


def page(template: str, **values: object) -> str:
    """Return the page of a template with these values."""
    environment = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True)
    return environment.get_template(template).render(**values)


def net_page(diagram: Diagram) -> str:
    """Return the page of a net: repeated blocks can be unfolded, and a click on a layer shows its prototxt."""
    drawings = dict.fromkeys(_svg_element(diagram, unfolded) for unfolded in (False, True))  # one if nothing repeats
    layers = [
        {"name": printable(box.name), "where": printable(str(box.where)), "text": box.text} for box in diagram.boxes
    ]
    title = printable(diagram.name) or "net"
    return page("net_page.html.jinja", title=title, drawings=list(drawings), layers=layers)


def _svg_element(diagram: Diagram, unfolded: bool) -> Markup:
    """Return a drawing as an element of a page, without ids, because two drawings on a page must not share ids."""
    svg = render(dot_of(diagram, unfolded), "svg").decode()
    return Markup(re.sub(r' id="[^"]*"', "", svg[svg.index("<svg") :]))

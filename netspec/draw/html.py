"""A picture as one HTML file that needs no other: what repeats unfolds, and a click on a layer shows its prototxt."""

from __future__ import annotations

import json
import re
from html import escape
from importlib.resources import files

from netspec.draw.diagram import Diagram
from netspec.draw.picture import Band, Drawing, Picture
from netspec.draw.svg import opening, shapes
from netspec.errors import printable


def html_of(diagram: Diagram, picture: Picture) -> str:
    """Return the page."""
    template = files("netspec.draw").joinpath("page.html").read_text()
    layers = [
        {"name": printable(box.name), "where": printable(str(box.where)), "text": box.text} for box in diagram.boxes
    ]
    parts = {
        "TITLE": escape(printable(diagram.name) or "net"),
        "BANDS": "\n".join(_band(picture, band, k) for k, band in enumerate(picture.bands)),
        # No text of a layer can end the script: "<" is written as an escape.
        "LAYERS": json.dumps(layers).replace("<", "\\u003c"),
    }
    return re.sub(f"@({'|'.join(parts)})@", lambda place: parts[place[1]], template)  # at once: a part may hold a mark


def _band(picture: Picture, band: Band, number: int) -> str:
    if band.unfolded is None:
        return _svg(picture, band.drawing)
    folded = _svg(picture, band.drawing, ' class="folded"')
    unfolded = _svg(picture, band.unfolded, ' class="unfolded" hidden=""')
    label = "show every copy, or one for all"
    return (
        f'<div class="block" id="block{number}"><button type="button" aria-expanded="false" title="{label}">'
        f"unfold</button>{folded}{unfolded}</div>"
    )


def _svg(picture: Picture, drawing: Drawing, attributes: str = "") -> str:
    return f"{opening(picture.width, drawing.height, attributes)}{''.join(shapes(drawing.marks))}</svg>"

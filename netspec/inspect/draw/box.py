"""A box of a picture: a layer's name, type, settings and costs, and the layers in place that are in it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from netspec.errors import printable
from netspec.inspect.draw.diagram import Attached, Box
from netspec.inspect.draw.marks import Mark, Rect, Text, moved, shortened, text_width

INK, PALE, TRACK, EDGE, SHARED = "#1f2933", "#52606d", "#e4e7eb", "#cbd2d9", "#b83280"
COLORS = {  # by the room of netspec.layers, the most special first
    "vision.pooling": ("pooling", "#e08e0b"),
    "vision": ("convolution", "#2f6fb7"),
    "common": ("inner product", "#7c4fc4"),
    "recurrent": ("recurrent", "#b83280"),
    "activation": ("activation", "#2f9e44"),
    "powers": ("activation", "#2f9e44"),
    "contrast": ("normalization", "#0c8599"),
    "normalization": ("normalization", "#0c8599"),
    "scale": ("normalization", "#0c8599"),
    "loss": ("loss and score", "#d6336c"),
    "data": ("data", "#495057"),
    "utility": ("utility", "#868e96"),
    "dialect": ("dialect", "#a0522d"),
    "": ("unknown type", "#e03131"),
}
NAME, SMALL = 12, 10.5  # sizes of text
LINE, PAD, STRIP = 15, 8, 5
ROOM, WIDEST = 190, 290  # width of a text that may be left out, and of any text


def color_of(kind: str) -> tuple[str, str]:
    """Return what a kind of layers is called, and its color."""
    return next(COLORS[room] for room in COLORS if not room or kind == room or kind.startswith(f"{room}."))


def amount_text(number: int) -> str:
    """Return ``18.4 M``."""
    for unit, size in (("T", 10**12), ("G", 10**9), ("M", 10**6), ("k", 10**3)):
        if number >= size:
            return f"{number / size:.3g} {unit}" if number < 999.5 * size else f"{number / size:.0f} {unit}"
    return str(number)


def _line(
    text: str, size: float = SMALL, fill: str = PALE, bold: bool = False, dot: str = "", phases: Sequence[str] = ()
) -> tuple[list[Mark], float]:
    """Return a line that begins at x = 0, a dot, a text and badges, with its baseline at y = 0, and its width."""
    label = Text(12 if dot else 0, 0, text, size, fill, bold)
    marks: list[Mark] = [*([Rect(0, -8, 7, 7, dot, radius=2)] if dot else []), label]
    x = label.x + label.width + 6
    for phase in phases:
        width = text_width(phase, SMALL, True) + 8
        color = "#9c4221" if phase == "TRAIN" else "#2b6cb0"
        marks += [Rect(x, -11, width, 14, color, radius=3), Text(x + 4, 0, phase, SMALL, "#ffffff", True)]
        x += width + 4
    return marks, label.x + label.width + _badges_width(phases)


def _lines(box: Box) -> list[tuple[list[Mark], float]]:
    """Return all that stands in a box, from top to bottom."""
    name = shortened(printable(box.name), NAME, WIDEST - _badges_width(box.phases), bold=True)
    kind = shortened(printable(" ".join(filter(None, (box.type, box.settings)))), SMALL, WIDEST)
    lines = [_line(name, NAME, INK, True, phases=box.phases), _line(kind)]
    lines += [_line(_attached_text(a), dot=color_of(a.kind)[1], phases=a.phases) for a in box.attached]
    if cost := _cost_text(box):
        lines.append(_line(cost, fill=SHARED if box.owner else PALE))
    return lines


def box_size(box: Box) -> tuple[int, int]:
    """Return the least width of a box, and its height."""
    lines = _lines(box)
    width = math.ceil(max(width for _, width in lines)) + STRIP + 2 * PAD
    return width, 8 + LINE * len(lines) + (8 if box.work else 0)


def box_marks(box: Box, number: int, width: int, most: int) -> list[Mark]:
    """Draw a box, box ``number`` of its diagram, about x = 0; its bar is as long as its share of ``most`` work."""
    left, height = -(width // 2), box_size(box)[1]
    color = color_of(box.kind)[1]
    marks: list[Mark] = [
        Rect(left, 0, width, height, "#ffffff", EDGE, 5, number),
        Rect(left, 0, STRIP, height, color, radius=2),
    ]
    x, y = left + STRIP + PAD, 17 - LINE
    for line, _ in _lines(box):
        y += LINE
        marks += moved(line, x, y)
    if box.work:
        track = width - STRIP - 2 * PAD
        filled = max(2.0, round(track * box.work / most, 1))
        marks += [Rect(x, y + 6, each, 3, fill, radius=1.5) for each, fill in ((track, TRACK), (filled, color))]
    return marks


def _attached_text(attached: Attached) -> str:
    """Return the type and the name, with the settings where there is room for them."""
    text = shortened(printable(f"{attached.type} · {attached.name}"), SMALL, WIDEST - 12)
    longer = printable(f"{text} · {attached.settings}") if attached.settings else text
    return longer if text_width(longer, SMALL) <= ROOM else text


def _cost_text(box: Box) -> str:
    words = [f"{amount_text(box.work)} mult-adds"] if box.work else []
    if box.weights:
        words.append(f"{amount_text(box.weights)} weights")
    if box.owner:
        words.append(shortened(f"weights of {printable(box.owner)}", SMALL, 180))
    return " · ".join(words)


def _badges_width(phases: Sequence[str]) -> float:
    return sum(text_width(phase, SMALL, True) + 16 for phase in phases)

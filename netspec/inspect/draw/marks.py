"""What a picture consists of, in pixels from its upper left corner; and how wide a text is."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

# Advance widths in thousandths of the size, of the characters 32 to 126 of DejaVu Sans: few fonts are wider.
_PLAIN = (
    318, 401, 460, 838, 636, 950, 780, 275, 390, 390, 500, 838, 318, 361, 318, 337, 636, 636, 636, 636, 636, 636, 636,
    636, 636, 636, 337, 337, 838, 838, 838, 531, 1000, 684, 686, 698, 770, 632, 575, 775, 752, 295, 295, 656, 557, 863,
    748, 787, 603, 787, 695, 635, 611, 732, 684, 989, 685, 611, 685, 390, 337, 390, 838, 500, 500, 613, 635, 550, 635,
    615, 352, 635, 634, 278, 278, 579, 278, 974, 634, 612, 635, 635, 411, 521, 392, 634, 592, 818, 592, 592, 525, 636,
    337, 636, 838,
)  # fmt: skip
_BOLD = (
    348, 456, 521, 838, 696, 1002, 872, 306, 457, 457, 523, 838, 380, 415, 380, 365, 696, 696, 696, 696, 696, 696, 696,
    696, 696, 696, 400, 400, 838, 838, 838, 580, 1000, 774, 762, 734, 830, 683, 683, 821, 837, 372, 372, 775, 637, 995,
    837, 850, 733, 850, 770, 720, 682, 812, 774, 1103, 771, 724, 725, 457, 365, 457, 838, 500, 500, 675, 716, 593, 716,
    678, 435, 716, 712, 343, 343, 665, 343, 1042, 712, 687, 716, 716, 493, 595, 478, 712, 652, 924, 645, 652, 582, 712,
    365, 712, 838,
)  # fmt: skip
_OTHERS = {"×": 838, "·": 318, "…": 1000, "\u00a0": 318}
_NARROWEST = min(*_PLAIN, *_BOLD, *_OTHERS.values())


def text_width(text: str, size: float, bold: bool = False) -> float:
    """Return the width of a text in pixels, or a little more."""
    widths = _BOLD if bold else _PLAIN
    return size / 1000 * sum(widths[ord(c) - 32] if 32 <= ord(c) < 127 else _OTHERS.get(c, 1100) for c in text)


def shortened(text: str, size: float, most: float, bold: bool = False) -> str:
    """Return a text that is at most so wide: its middle is left out where it must be."""
    if text_width(text, size, bold) <= most:
        return text
    for kept in range(min(len(text) - 1, int(most / size * 1000 / _NARROWEST)), 1, -1):
        short = text[: (kept + 1) // 2] + "…" + text[len(text) - kept // 2 :]
        if text_width(short, size, bold) <= most:
            return short
    return "…"


@dataclass(frozen=True)
class Rect:
    """A box; ``layer`` is the number of the box of the diagram that it shows, -1 where it is none."""

    x: float
    y: float
    width: float
    height: float
    fill: str
    stroke: str = "none"
    radius: float = 0
    layer: int = -1
    dashed: bool = False


@dataclass(frozen=True)
class Text:
    """A line of text that begins at ``x``; ``y`` is its baseline."""

    x: float
    y: float
    text: str
    size: float
    fill: str
    bold: bool = False

    @property
    def width(self) -> float:
        """The width in pixels, or a little more."""
        return text_width(self.text, self.size, self.bold)


@dataclass(frozen=True)
class Curve:
    """A line through points: the first, then straight to each next one, or by two control points and an end each.

    ``arrow`` sets the head of an arrow that points down at its end.
    """

    points: tuple[tuple[float, float], ...]
    stroke: str
    bent: bool = False
    arrow: bool = False
    dashed: bool = False


Mark = Rect | Text | Curve


def moved(marks: Iterable[Mark], x: float, y: float) -> list[Mark]:
    """Return the marks shifted."""
    return [_moved(mark, x, y) for mark in marks]


def _moved(mark: Mark, x: float, y: float) -> Mark:
    if isinstance(mark, Curve):
        return replace(mark, points=tuple((px + x, py + y) for px, py in mark.points))
    return replace(mark, x=mark.x + x, y=mark.y + y)

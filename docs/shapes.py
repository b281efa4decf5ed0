"""Pictures of what layers do to shapes: bottoms on the left, the layer, its learned arrays below it, tops on the right.

The examples are in ``reference/layers.prototxt``. netspec computes their shapes.
"""

from __future__ import annotations

import logging
import math
import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from html import escape
from pathlib import Path

EXAMPLES = Path(__file__).parent / "reference" / "layers.prototxt"
EXAMPLE = re.compile(
    r"^# (?P<bottoms>[^\n]*?) ?(?:->(?P<tops>[^\n]*))?\n(?P<text>layer \{.*?\}\n)(?=\n|\Z)", re.M | re.S
)
WIDTH, BOX, COLUMN = 400, 104, 134  # widths of the picture, of the layer's box, and of a column of blobs
LINE = 15  # height of a line of text
LEAN = 0.4  # how much the edges that show depth are shifted, per length

Shape = tuple[int, ...]


@dataclass(frozen=True)
class Example:
    """A layer of one type: its prototxt, and the shapes by name, in order; learned arrays have none."""

    text: str
    bottoms: Mapping[str, Shape]
    learned: Sequence[Shape]
    tops: Mapping[str, Shape]


@cache
def examples() -> dict[str, Example]:
    """Return the example of each layer type that has one. Raises ValueError for an example that netspec refuses."""
    return dict(_example(found) for found in EXAMPLE.finditer(EXAMPLES.read_text()))


def _example(found: re.Match[str]) -> tuple[str, Example]:
    from netspec.inspect.check.check import ON_META, check_file

    bottoms, given = (_shapes(found[part] or "") for part in ("bottoms", "tops"))
    inputs = [
        f'layer {{ name: "in_{name}" type: "Input" top: "{name}" input_param {{ shape {{ {_dims(shape)} }} }} }}\n'
        for name, shape in bottoms.items()
    ]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "layer.prototxt"
        path.write_text("".join(inputs) + found["text"])
        logging.getLogger("netspec").setLevel(logging.WARNING)
        (checked,) = check_file(path, options=replace(ON_META, given_shapes=given))
    if checked.net is None or checked.faults:
        raise ValueError(f"{EXAMPLES}: {checked.faults}\n{found['text']}")
    param, layer = checked.net.param.layer[-1], checked.net.layers[-1]
    return param.type, Example(
        found["text"], bottoms, layer.blob_shapes, dict(zip(param.top, layer.top_shapes, strict=True))
    )


def _shapes(text: str) -> dict[str, Shape]:
    pairs = (word.split("=") for word in text.split())
    return {name: tuple(map(int, sizes.split(","))) for name, sizes in pairs}


def _dims(shape: Shape) -> str:
    return " ".join(f"dim: {size}" for size in shape)


def shape_text(shape: Shape) -> str:
    """Return a shape as text: the sizes with multiplication signs between them, or "one number" without axes."""
    return " \N{MULTIPLICATION SIGN} ".join(map(str, shape)) or "one number"


def caption(kind: str, example: Example) -> str:
    """Return a description of the picture."""
    bottoms, tops = (
        ", ".join(f"{name} {shape_text(shape)}" for name, shape in blobs.items()) or "no blob"
        for blobs in (example.bottoms, example.tops)
    )
    learned = "; learned: " + ", ".join(map(shape_text, example.learned)) if example.learned else ""
    return f"{kind} reads {bottoms} and gives {tops}{learned}"


def picture(kind: str, example: Example) -> str:
    """Return an SVG element of one line; its colors are those of the page's theme (site.css)."""
    label = _lines(kind)
    learned = [shape_text(shape) for shape in example.learned]
    left, right = (_Column(list(blobs.items())) for blobs in (example.bottoms, example.tops))
    box = LINE * len(label) + 16
    middle = box + (LINE * (len(learned) + 1) + 4 if learned else 0)
    height = max(left.height, right.height, middle) + 4
    x, y = WIDTH / 2, (height - middle) / 2
    parts = [
        left.drawn(COLUMN / 2, height),
        right.drawn(WIDTH - COLUMN / 2, height),
        _rectangle(x - BOX / 2, y, BOX, box, "layer"),
        *(_text(x, y + 8 + LINE * (i + 0.75), part, "kind") for i, part in enumerate(label)),
        *(_text(x, y + box + LINE * (i + 1), part) for i, part in enumerate(["learned:", *learned] if learned else [])),
    ]
    for blobs, start in ((example.bottoms, COLUMN), (example.tops, (WIDTH + BOX) / 2)):
        if blobs:
            tip, across = start + (WIDTH - BOX) / 2 - COLUMN - 2, y + box / 2
            parts.append(f'<path class="arrow" d="M{start + 2:g} {across:g}H{tip:g}m-5 -4l5 4l-5 4"/>')
    title = f"<title>{escape(caption(kind, example))}</title>"
    return f'<svg class="shapes" viewBox="0 0 {WIDTH} {height:g}" role="img">{title}{"".join(parts)}</svg>'


def _lines(kind: str) -> list[str]:
    """Cut a name before capitals into lines of up to 13 letters."""
    lines = [""]
    for word in re.findall(r"[A-Z0-9]+[^A-Z]*", kind):
        if len(lines[-1] + word) > 13:
            lines.append("")
        lines[-1] += word
    return lines


class _Column:
    """Blobs in a column: each with its name and its shape below it."""

    def __init__(self, blobs: Sequence[tuple[str, Shape]]) -> None:
        self._blobs = [(name, shape, _size_in_picture(shape)) for name, shape in blobs]
        self.height = sum(h + LEAN * d + 2 * LINE + 14 for *_, (_, h, d) in self._blobs)

    def drawn(self, x: float, height: float) -> str:
        """Return its parts around ``x``, in the middle of a picture of this height."""
        y, parts = (height - self.height) / 2, []
        for name, shape, (w, h, d) in self._blobs:
            lean = LEAN * d
            left, top = x - (w + lean) / 2, y + lean + 4
            parts += [
                f'<path class="blob" d="M{left:g} {top:g}l{lean:g} {-lean:g}h{w:g}v{h:g}l{-lean:g} {lean:g}"/>'
                if d
                else "",
                _rectangle(left, top, w, h, "blob"),
                f'<path class="blob" d="M{left + w:g} {top:g}l{lean:g} {-lean:g}"/>' if d else "",
                _text(x, top + h + LINE, name, "name"),
                _text(x, top + h + 2 * LINE, shape_text(shape)),
            ]
            y = top + h + 2 * LINE + 10
        return "".join(parts)


def _size_in_picture(shape: Shape) -> tuple[float, float, float]:
    """Return width, height and depth of a blob in the picture, from the sizes of its axes without the batch.

    Lengths grow with the logarithm of the sizes, so that both 3 and 4096 channels fit into the picture.
    """
    axes = (1, *shape) if len(shape) == 3 else shape
    height, width = axes[-2:] if len(axes) > 1 else (math.prod(axes), 1)
    depth = math.prod(axes[1:-2])
    return _length(width), _length(height), _length(depth) if len(shape) > 2 else 0


def _length(size: int) -> float:
    return round(5 + 5.5 * math.log2(max(size, 1)), 1)


def _rectangle(x: float, y: float, width: float, height: float, kind: str) -> str:
    corner = ' rx="4"' if kind == "layer" else ""
    return f'<rect class="{kind}" x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}"{corner}/>'


def _text(x: float, y: float, text: str, kind: str = "size") -> str:
    return f'<text class="{kind}" x="{x:g}" y="{y:g}">{escape(text)}</text>'

"""Writes a diagram for Graphviz: a table for each box, an edge for each blob, a cluster for each repeated block."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape

from netspec.errors import printable
from netspec.inspect.draw.blocks import Block, find_blocks
from netspec.inspect.draw.diagram import Attached, Box, Diagram

INK, PALE, TRACK, EDGE, SHARED, WIRE = "#1f2933", "#52606d", "#e4e7eb", "#cbd2d9", "#b83280", "#7b8794"
PHASE_COLORS = {"TRAIN": "#9c4221", "TEST": "#2b6cb0"}
COLORS = {  # by module of netspec.layers, the most specific first
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
NAME, SMALL = 12, 10  # sizes of text, in points
BAR = 120  # length of the bar of the box with the most work, in points
LONGEST = 44  # characters of a line
BARE_TABLE = '<TABLE BORDER="0" CELLBORDER="0" CELLSPACING="0" CELLPADDING="0">'


def dot_of(diagram: Diagram, unfolded: bool = False) -> str:
    """Return the text of a graph. Repeated blocks are drawn once, in a frame, or in full if ``unfolded``.

    The element of box ``k`` in an SVG has the class ``layer-k``.
    """
    most = max((box.work for box in diagram.boxes), default=0)
    nodes = _nodes(diagram)
    blocks = find_blocks(diagram)
    # The box of the first copy stands for those of the others.
    copies = {k: block.first + (k - block.first) % block.length for block in blocks for k in block.boxes}
    hidden = {} if unfolded else copies
    lines = [
        "digraph {",
        'graph [rankdir="TB" nodesep="0.35" ranksep="0.3" fontname="Arial" bgcolor="white" labelloc="t" labeljust="l"]',
        'node [shape="plain" fontname="Arial"]',
        f'edge [color="{WIRE}" arrowsize="0.6"]',
        f"label={_header(diagram)}",
    ]
    shown = [k for k in range(len(diagram.boxes)) if hidden.get(k, k) == k]
    lines += [f'{nodes[k]} [class="layer-{k}" label={_table(diagram, k, most)}]' for k in shown]
    lines += _clusters(diagram, nodes, blocks, unfolded)
    for k in shown:
        for source, top in diagram.reads[k]:
            lines.append(f"{nodes[hidden.get(source, source)]}:t{top}:s -> {nodes[k]}")
    lines += _ties(diagram, nodes, shown)
    return "\n".join([*lines, "}", ""])


def _nodes(diagram: Diagram) -> list[str]:
    """Return the node names of the boxes, in quotes: the names of the layers, with a number if they repeat."""
    names: dict[str, None] = {}
    for box in diagram.boxes:
        name, count = printable(box.name), 1
        while name in names:
            count += 1
            name = f"{printable(box.name)} ({count})"
        names[name] = None
    return ['"' + name.replace("\\", "\\\\").replace('"', '\\"') + '"' for name in names]


def _clusters(diagram: Diagram, nodes: Sequence[str], blocks: Iterable[Block], unfolded: bool) -> Iterator[str]:
    """Yield a frame around each block, with the number of copies."""
    for number, block in enumerate(blocks):
        first, last = (diagram.boxes[k].name for k in (block.first, block.boxes.stop - block.length))
        title = _text(f"{block.copies} × the same: {printable(first)} … {printable(last)}", SMALL, "#243b53")
        boxes = block.boxes if unfolded else range(block.first, block.first + block.length)
        style = 'style="rounded,dashed,filled" color="#9fb3c8" fillcolor="#f3f6fb" labeljust="l"'
        yield f"subgraph cluster_{number} {{ {style} label=<{title}> {' '.join(nodes[k] for k in boxes)} }}"


def _ties(diagram: Diagram, nodes: Sequence[str], shown: Sequence[int]) -> Iterator[str]:
    """Yield a dashed line between two boxes for each layer that uses the parameters of another."""
    number = {diagram.boxes[k].name: k for k in shown}
    for k in shown:
        owner = number.get(diagram.boxes[k].owner)
        if owner is not None:
            yield f'{nodes[owner]} -> {nodes[k]} [style="dashed" color="{SHARED}" dir="none" constraint="false"]'


def _header(diagram: Diagram) -> str:
    """Return the title, the totals and the legend."""
    layers = sum(1 + len(box.attached) for box in diagram.boxes)
    sums = [f"{layers} layers"]
    if weights := sum(box.weights for box in diagram.boxes):
        sums.append(f"{amount_text(weights)} weights")
    if work := sum(box.work for box in diagram.boxes):
        sums.append(f"{amount_text(work)} multiply-adds in a forward pass (bars)")
    kinds = {color_of(kind): None for box in diagram.boxes for kind in (box.kind, *(a.kind for a in box.attached))}
    legend = "   ".join(f"{_text('■', SMALL, color)} {_text(label, SMALL, PALE)}" for label, color in kinds)
    rows = [_text(printable(diagram.name or "a net without a name"), 16, INK, bold=True)]
    rows += [_text(" · ".join(sums), SMALL, PALE), legend, " "]
    cells = "".join(f'<TR><TD ALIGN="LEFT">{row}</TD></TR>' for row in rows)
    return f'<<TABLE BORDER="0" CELLBORDER="0" CELLSPACING="0">{cells}</TABLE>>'


def _table(diagram: Diagram, k: int, most: int) -> str:
    """Return the label of a box: its lines, and below them a cell for each top, where the edges begin.

    The edges of a single top without a text begin at the box itself.
    """
    box = diagram.boxes[k]
    lines = list(_lines(box))
    if box.work:
        lines.append(_bar(box, most))
    rows = "".join(f'<TR><TD ALIGN="LEFT" BALIGN="LEFT" CELLPADDING="1">{line}</TD></TR>' for line in lines)
    inner = f"{BARE_TABLE}{rows}</TABLE>"
    side = f'SIDES="L" BORDER="5" COLOR="{color_of(box.kind)[1]}"'  # the color of its kind
    body = f'<TABLE BORDER="1" COLOR="{EDGE}" CELLBORDER="0" CELLSPACING="0" CELLPADDING="5" BGCOLOR="white">'
    body += f'<TR><TD {side} ALIGN="LEFT">{inner}</TD></TR></TABLE>'
    labels = _tops(diagram, k)
    if labels == [""]:
        return f'<{BARE_TABLE}<TR><TD PORT="t0">{body}</TD></TR></TABLE>>'
    tops = "".join(
        f'<TD PORT="t{j}" CELLPADDING="2">{_text(label, SMALL, PALE) if label else " "}</TD>'
        for j, label in enumerate(labels)
    )
    span = max(1, len(diagram.tops[k]))
    below = f"<TR>{tops}</TR>" if tops else ""
    return f'<{BARE_TABLE}<TR><TD COLSPAN="{span}">{body}</TD></TR>{below}</TABLE>>'


def _lines(box: Box) -> Iterator[str]:
    """Yield the lines of text in a box, from top to bottom."""
    badges = "".join(f" {_badge(phase)}" for phase in box.phases)
    yield _text(shortened(printable(box.name)), NAME, INK, bold=True) + badges
    yield _text(shortened(printable(" ".join(filter(None, (box.type, box.settings))))), SMALL, PALE)
    for attached in box.attached:
        badges = "".join(f" {_badge(phase)}" for phase in attached.phases)
        dot = _text("●", SMALL, color_of(attached.kind)[1])
        yield f"{dot} {_text(_attached_text(attached), SMALL, PALE)}{badges}"
    if cost := _cost_text(box):
        yield _text(cost, SMALL, SHARED if box.owner else PALE)


def _tops(diagram: Diagram, k: int) -> list[str]:
    """Return the text for each top below a box: its shape, and its name if it is not the layer's."""
    box, tops = diagram.boxes[k], diagram.tops[k]
    shapes = [*box.shapes, *[""] * (len(tops) - len(box.shapes))]
    named = [printable(top) if top != box.name or len(tops) > 1 else "" for top in tops]
    return [" ".join(filter(None, pair)) for pair in zip(named, shapes, strict=True)]


def _bar(box: Box, most: int) -> str:
    """Return a bar whose length is the work of a box relative to ``most``."""
    filled = max(2, round(BAR * box.work / most))
    cells = [(filled, color_of(box.kind)[1]), (BAR - filled, TRACK)]
    row = "".join(
        f'<TD FIXEDSIZE="TRUE" WIDTH="{width}" HEIGHT="3" BGCOLOR="{color}"></TD>' for width, color in cells if width
    )
    table = BARE_TABLE.replace(">", f' FIXEDSIZE="TRUE" WIDTH="{BAR}" HEIGHT="3">')
    return f"{table}<TR>{row}</TR></TABLE>"


def _badge(phase: str) -> str:
    return _text(phase, SMALL, PHASE_COLORS[phase], bold=True)


def _attached_text(attached: Attached) -> str:
    text = shortened(printable(f"{attached.type} · {attached.name}"))
    longer = printable(f"{text} · {attached.settings}") if attached.settings else text
    return longer if len(longer) <= LONGEST else text


def _cost_text(box: Box) -> str:
    words = [f"{amount_text(box.work)} mult-adds"] if box.work else []
    if box.weights:
        words.append(f"{amount_text(box.weights)} weights")
    if box.owner:
        words.append(f"weights of {shortened(printable(box.owner), 28)}")
    return " · ".join(words)


def _text(text: str, size: int, color: str, bold: bool = False) -> str:
    escaped = escape(text)
    body = f"<B>{escaped}</B>" if bold else escaped
    return f'<FONT POINT-SIZE="{size}" COLOR="{color}">{body}</FONT>'


def color_of(kind: str) -> tuple[str, str]:
    """Return the name of a kind of layers, and its color."""
    return next(COLORS[prefix] for prefix in COLORS if not prefix or kind == prefix or kind.startswith(f"{prefix}."))


def amount_text(number: int) -> str:
    """Return ``18.4 M``."""
    for unit, size in (("T", 10**12), ("G", 10**9), ("M", 10**6), ("k", 10**3)):
        if number >= size:
            return f"{number / size:.3g} {unit}" if number < 999.5 * size else f"{number / size:.0f} {unit}"
    return str(number)


def shortened(text: str, most: int = LONGEST) -> str:
    """Shorten a text to at most ``most`` characters by removing its middle."""
    return text if len(text) <= most else f"{text[: most // 2]}…{text[len(text) - most // 2 + 1 :]}"

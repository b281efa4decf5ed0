"""A diagram as marks: boxes with their texts, wires with the shapes of their blobs, frames around what repeats.

A picture is a stack of bands, each as wide as the picture. A wire leaves a band where it comes into the next one, so a
band that shows a repeated block once, or all its copies, can be replaced by its other form.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from netspec.errors import printable
from netspec.inspect.draw.blocks import Block, find_blocks
from netspec.inspect.draw.box import (
    INK,
    LINE,
    PAD,
    PALE,
    SHARED,
    SMALL,
    WIDEST,
    amount_text,
    box_marks,
    box_size,
    color_of,
)
from netspec.inspect.draw.diagram import Diagram, Output
from netspec.inspect.draw.layout import Layout, Piece, Size, Wire, lay_out
from netspec.inspect.draw.marks import Curve, Mark, Rect, Text, moved, shortened, text_width

WIRE = "#7b8794"
LABEL = 17  # height of the shapes under a box
MARGIN, FRAME, TITLE = 24, 14, 24
LEAST_GAP, MOST_GAP = 24, 70


@dataclass(frozen=True)
class Drawing:
    """Marks within a height."""

    marks: list[Mark]
    height: int


@dataclass(frozen=True)
class Band:
    """A part of a picture over its whole width; ``unfolded`` is its other form where something repeats in it."""

    drawing: Drawing
    unfolded: Drawing | None = None


@dataclass(frozen=True)
class Picture:
    """Bands from top to bottom."""

    title: str
    width: int
    bands: list[Band]

    def marks(self, unfolded: bool = False) -> Drawing:
        """Return the bands as one drawing, with what repeats once or in full."""
        return _stack([band.unfolded or band.drawing if unfolded else band.drawing for band in self.bands])


def picture_of(diagram: Diagram) -> Picture:
    """Return the picture of a net."""
    return _Painter(diagram).paint()


def _stack(drawings: Sequence[Drawing]) -> Drawing:
    marks: list[Mark] = []
    height = 0
    for drawing in drawings:
        marks += moved(drawing.marks, 0, height)
        height += drawing.height
    return Drawing(marks, height)


@dataclass(frozen=True)
class _Part:
    """Something in a layout: a box, a block, or an end of a block (both None)."""

    box: int | None = None
    block: Block | None = None


@dataclass
class _Level:
    """A net, or a copy of a block: what is in it and where that is placed."""

    parts: list[_Part]
    wires: list[Wire]
    sizes: list[Size]
    layout: Layout


class _Painter:
    def __init__(self, diagram: Diagram) -> None:
        self.diagram = diagram
        self.blocks = find_blocks(diagram)
        self.most = max((box.work for box in diagram.boxes), default=0)
        self.inner = {block: self._level_inside(block) for block in self.blocks}

    # ---- What is where ----

    def paint(self) -> Picture:
        inside = {k: block for block in self.blocks for k in block.boxes}
        parts, outputs = [], {}
        for k in range(len(self.diagram.boxes)):
            block = inside.get(k)
            if block is None:
                outputs.update({(k, j): (len(parts), j) for j in range(len(self.diagram.tops[k]))})
                parts.append(_Part(box=k))
            elif k == block.first:
                outputs[block.last] = len(parts), 0
                parts.append(_Part(block=block))
        level = self._level(parts, outputs)
        header = _header(self.diagram)
        width = max(level.layout.width, header[1]) + 2 * MARGIN
        left = (width - level.layout.width) // 2
        bands = [Band(Drawing(moved(header[0].marks, MARGIN, 0), header[0].height))]
        for folded, unfolded in zip(self._bands(level, False), self._bands(level, True), strict=True):
            wide = Drawing(moved(folded.marks, left, 0), folded.height)
            other = Drawing(moved(unfolded.marks, left, 0), unfolded.height)
            bands.append(Band(wide, other if len(other.marks) != len(wide.marks) else None))
        bands.append(Band(Drawing([], MARGIN)))
        return Picture(self.diagram.name, width, bands)

    def _level(self, parts: list[_Part], outputs: dict[Output, tuple[int, int]]) -> _Level:
        """Lay out parts; ``outputs`` says which part gives what."""
        targets: dict[tuple[int, int], list[int]] = {}
        for p, part in enumerate(parts):
            for output in self._read_by(part):
                if output in outputs and p not in targets.setdefault(outputs[output], []):
                    targets[outputs[output]].append(p)
        wires = [Wire(*port, tuple(found)) for port, found in sorted(targets.items())]
        entries = [sum(p in wire.targets for wire in wires) for p in range(len(parts))]
        sizes = [self._size(part, count) for part, count in zip(parts, entries, strict=True)]
        return _Level(parts, wires, sizes, lay_out(sizes, wires))

    def _level_inside(self, block: Block) -> _Level:
        """Lay out a copy of a block, between its entry and its exit; names are as long as in any copy."""
        boxes = range(block.first, block.first + block.length)
        parts = [_Part(), *(_Part(box=k) for k in boxes), _Part()]
        outputs = {(k, j): (k - block.first + 1, j) for k in boxes for j in range(len(self.diagram.tops[k]))}
        outputs[block.entry] = (0, 0)
        level_wires: dict[tuple[int, int], list[int]] = {outputs[block.exit]: [len(parts) - 1]}
        for p, k in enumerate(boxes, 1):
            for output in self.diagram.reads[k]:
                level_wires.setdefault(outputs[output], []).append(p)
        wires = [Wire(*port, tuple(sorted(found))) for port, found in sorted(level_wires.items())]
        sizes = []
        for p, part in enumerate(parts):
            if part.box is None:
                sizes.append(Size(0, 0, 0))
                continue
            copies = range(part.box, block.boxes.stop, block.length)
            entries = sum(p in wire.targets for wire in wires)
            boxes = [self._box_size(k, entries) for k in copies]  # of copies of a block, which differ in names only
            sizes.append(max(boxes, key=lambda size: (size.left, size.right)))
        return _Level(parts, wires, sizes, lay_out(sizes, wires))

    def _read_by(self, part: _Part) -> Sequence[Output]:
        if part.block:
            return [part.block.entry]
        return self.diagram.reads[part.box] if part.box is not None else []

    def _size(self, part: _Part, entries: int) -> Size:
        if part.block:
            level = self.inner[part.block]
            entry, exit_ = level.layout.rows[0].axes[0], level.layout.rows[-1].axes[0]
            right = max(level.layout.width - entry, 10 + math.ceil(text_width(_title(self.diagram, part.block), SMALL)))
            return Size(entry + FRAME, right + FRAME, 0, exit_ - entry)
        assert part.box is not None
        return self._box_size(part.box, entries)

    def _box_size(self, k: int, entries: int) -> Size:
        box = self.diagram.boxes[k]
        text, height = box_size(box)
        width = max(text, 12 * entries + 2 * PAD)
        labels = [math.ceil(text_width(label, SMALL)) + 16 for label in self._labels(k)]
        width = max(width, sum(labels) if len(labels) > 1 else 0)
        width += width % 2
        half = width // 2
        right = half if len(labels) > 1 else max(half, *labels, 0)
        port = 8 - half if len(labels) > 1 else 0
        return Size(half, right, height + LABEL * bool(labels), port, tuple(labels), half - PAD)

    def _labels(self, k: int) -> list[str]:
        """Return what stands beside the wires of a box: the shape, and the blob's name where it has another."""
        box = self.diagram.boxes[k]
        shapes = [*box.shapes, *[""] * (len(self.diagram.tops[k]) - len(box.shapes))]
        return [
            " ".join(
                filter(
                    None, (printable(top) if top != box.name or len(shapes) > 1 else "", shape.replace(" ", "\u00a0"))
                )
            )
            for top, shape in zip(self.diagram.tops[k], shapes, strict=True)
        ]

    # ---- Marks ----

    def _bands(self, level: _Level, unfolded: bool, shift: int = 0) -> list[Drawing]:
        """Return a drawing for each row and the wires below it; ``shift`` is added to the numbers of boxes."""
        bands = []
        for row in level.layout.rows:
            placed = [
                (x, level.parts[cell.item], level.sizes[cell.item]) if cell.item >= 0 else (x, None, None)
                for x, cell in zip(row.axes, row.cells, strict=True)
            ]
            drawings = [self._part(level, cell.item, unfolded, shift) if cell.item >= 0 else None for cell in row.cells]
            height = max((drawing.height for drawing in drawings if drawing), default=0)
            marks: list[Mark] = []
            for (x, part, size), drawing, cell in zip(placed, drawings, row.cells, strict=True):
                if drawing is None or size is None:
                    marks.append(Curve(((x, 0), (x, height)), WIRE))
                    continue
                marks += moved(drawing.marks, x, 0)
                top = drawing.height - LABEL * (part is not None and part.box is not None)
                ports = {
                    x + level.layout.ports[cell.item][wire.port] for wire in level.wires if wire.source == cell.item
                }
                if height > top:
                    marks += [Curve(((port, top), (port, height)), WIRE) for port in sorted(ports)]
            marks += self._ties(placed)
            gap = _gap(row.below)
            marks += [_piece(piece, level, height, gap) for piece in row.below]
            bands.append(Drawing(marks, height + gap))
        return bands

    def _part(self, level: _Level, p: int, unfolded: bool, shift: int) -> Drawing:
        """Draw a part, its axis at x = 0."""
        part, size = level.parts[p], level.sizes[p]
        if part.block:
            return self._block(part.block, size, unfolded)
        if part.box is None:
            return Drawing([], 0)
        return self._box(part.box + shift, size, level.layout.ports[p])

    def _block(self, block: Block, size: Size, unfolded: bool) -> Drawing:
        level = self.inner[block]
        copies = [
            _stack(self._bands(level, False, copy * block.length)) for copy in range(block.copies if unfolded else 1)
        ]
        entry, exit_ = level.layout.rows[0].axes[0], level.layout.rows[-1].axes[0]
        marks: list[Mark] = [Curve(((0, 0), (0, TITLE)), WIRE)]
        height = TITLE
        for number, copy in enumerate(copies):
            if number:
                gap = 12 + min(30, abs(exit_ - entry) // 4)
                marks.append(_curve(exit_ - entry, height, 0, height + gap, False))
                height += gap
            marks += moved(copy.marks, -entry, height)
            height += copy.height
        frame = Rect(-size.left, 0, size.left + size.right, height, "#f3f6fb", "#9fb3c8", 8, -2, dashed=True)
        title = Text(10, 15, _title(self.diagram, block), SMALL, "#243b53", bold=False)
        return Drawing([frame, title, *marks], height)

    def _ties(self, placed: Sequence[tuple[int, _Part | None, Size | None]]) -> list[Mark]:
        """Join neighbors that share their parameters."""
        marks: list[Mark] = []
        for (x1, one, size1), (x2, two, size2) in pairwise(placed):
            if one and two and size1 and size2 and self._share(one, two):
                marks.append(Curve(((x1 + size1.left, 18), (x2 - size2.left, 18)), SHARED, dashed=True))
        return marks

    def _share(self, one: _Part, two: _Part) -> bool:
        owners = [
            {name for k in (part.block.boxes if part.block else [part.box]) if k is not None for name in self._names(k)}
            for part in (one, two)
        ]
        return bool(owners[0] & owners[1])

    def _names(self, k: int) -> tuple[str, ...]:
        box = self.diagram.boxes[k]
        return (box.owner,) if box.owner else (box.name,) if box.weights else ()

    def _box(self, k: int, size: Size, ports: Sequence[int]) -> Drawing:
        box = self.diagram.boxes[k]
        height = box_size(box)[1]
        marks = box_marks(box, k, 2 * size.left, self.most)
        for port, label in zip(ports, self._labels(k), strict=True):
            marks.append(Text(port + 6, height + 13, label, SMALL, PALE))
        return Drawing(marks, height + LABEL * bool(ports))


def _gap(pieces: Sequence[Piece]) -> int:
    """Return the height between two rows: more where wires go far aside."""
    if not pieces:
        return 0
    return min(MOST_GAP, LEAST_GAP + max(abs(piece.end - piece.start) for piece in pieces) // 10)


def _piece(piece: Piece, level: _Level, top: int, gap: int) -> Curve:
    ends = piece.target >= 0 and (level.parts[piece.target].box is not None)
    return _curve(piece.start, top, piece.end, top + gap, ends)


def _curve(x1: float, y1: float, x2: float, y2: float, arrow: bool) -> Curve:
    if x1 == x2:
        return Curve(((x1, y1), (x2, y2)), WIRE, arrow=arrow)
    end = y2 - 7 if arrow else y2
    middle = (y1 + end) / 2
    points = ((x1, y1), (x1, middle), (x2, middle), (x2, end))
    return Curve((*points, (x2, y2)) if arrow else points, WIRE, bent=True, arrow=arrow)


def _title(diagram: Diagram, block: Block) -> str:
    first, last = (diagram.boxes[k].name for k in (block.first, block.first + (block.copies - 1) * block.length))
    return shortened(printable(f"{block.copies} × the same: {first} … {last}"), SMALL, WIDEST)


def _header(diagram: Diagram) -> tuple[Drawing, int]:
    """Return the title, the sums and the legend, and their width."""
    layers = sum(1 + len(box.attached) for box in diagram.boxes)
    sums = [f"{layers} layers"]
    if weights := sum(box.weights for box in diagram.boxes):
        sums.append(f"{amount_text(weights)} weights")
    if work := sum(box.work for box in diagram.boxes):
        sums.append(f"{amount_text(work)} multiply-adds in a forward pass (bars)")
    title = shortened(printable(diagram.name or "a net without a name"), 17, 600, bold=True)
    marks: list[Mark] = [Text(0, 36, title, 17, INK, bold=True), Text(0, 56, " · ".join(sums), SMALL, PALE)]
    width = max(text_width(title, 17, True), text_width(" · ".join(sums), SMALL))
    kinds = {color_of(kind): None for box in diagram.boxes for kind in (box.kind, *(a.kind for a in box.attached))}
    x, y = 0.0, 76
    for label, color in kinds:
        step = 12 + text_width(label, SMALL) + 14
        if x and x + step > 620:
            x, y = 0.0, y + LINE
        marks += [Rect(x, y - 8, 8, 8, color, radius=2), Text(x + 12, y, label, SMALL, PALE)]
        x += step
        width = max(width, x)
    return Drawing(marks, y + 28), math.ceil(width)

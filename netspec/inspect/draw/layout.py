"""Where boxes stand and how wires run: a layered layout, from top to bottom.

Every box has a row; a wire to a farther row passes the rows between in a column of its own. Rows and columns are the
optima of two linear programs (Gansner, Koutsofios, North, Vo: A Technique for Drawing Directed Graphs, 1993, sections
2 and 4), which scipy's HiGHS solves; the order within rows follows their section 3.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linprog
from scipy.sparse import coo_array

GAP = 22  # pixels between boxes of a row
WIRE_GAP = 14  # between a wire that passes a row and what is beside it
SWEEPS = 12  # over all rows, to reduce crossings
CHAIN, BRANCH, PASSING = 6.0, 0.5, 8.0  # cost of a wire's step aside: its ends have no other wires, or have; it passes
CENTERED = 0.5  # cost of a box off the middle of its neighbors
NARROW = (0.1, 1.0)  # cost of width, for each row: what is wider than a screen is pressed
SCREEN = 1280
EARLY = 1e-3  # cost of a row further down
ENTRY_GAP = 12  # between the ends of wires in one box


@dataclass(frozen=True)
class Size:
    """A thing to place: its reach to the left and right of its axis and its height, in pixels.

    Its inputs come in above, within ``entry`` to both sides of the axis. Its only output leaves it below at ``port``,
    from the axis; several leave from ``port`` on, where output ``k`` needs ``slots[k]`` pixels to its right.
    """

    left: int
    right: int
    height: int
    port: int = 0
    slots: tuple[int, ...] = (0,)
    entry: int = 0


@dataclass(frozen=True)
class Wire:
    """What output ``port`` of thing ``source`` leads to."""

    source: int
    port: int
    targets: tuple[int, ...]


@dataclass(frozen=True)
class Cell:
    """A thing in its row, or (``item`` -1) a wire that passes row ``row``."""

    item: int
    wire: int = -1
    row: int = -1


@dataclass(frozen=True)
class Piece:
    """A part of a wire between two rows: it leaves the upper at ``start`` and comes into the lower at ``end``."""

    wire: int
    start: int
    end: int
    target: int  # -1: it goes on


@dataclass
class Row:
    """Cells from left to right, with the axes of all; ``below`` are the wires to the next row."""

    cells: list[Cell]
    axes: list[int] = field(default_factory=list)
    below: list[Piece] = field(default_factory=list)


@dataclass(frozen=True)
class Layout:
    """Rows from top to bottom, within ``width``; ``ports[item][k]`` is where output ``k`` leaves, from the axis."""

    rows: list[Row]
    ports: list[tuple[int, ...]]
    width: int


def lay_out(sizes: Sequence[Size], wires: Sequence[Wire]) -> Layout:
    """Place things whose wires all lead from a lower to a higher number."""
    ranks = _ranks(len(sizes), wires)
    rows = _rows(ranks, wires)
    links = _links(rows, ranks, wires)
    _reduce_crossings(rows, links)
    ports = _ports(rows, links, sizes, wires)
    entries = _entries(rows, links, sizes, [ports[wire.source][wire.port] for wire in wires])
    for narrow in NARROW:
        laid = _columns(rows, links, entries, ports, sizes, wires, narrow)
        if laid.width <= SCREEN:
            break
    return laid


def _ranks(count: int, wires: Sequence[Wire]) -> list[int]:
    """Return the row of each thing: wires lead downward, and are as short as possible in sum."""
    edges = [(wire.source, target) for wire in wires for target in wire.targets]
    if not edges:
        return [0] * count
    apart = [(target, source, -1.0) for source, target in edges]
    short = [([(target, 1.0), (source, -1.0)], 0.0, 1.0) for source, target in edges]
    solved = _least_aside(np.full(count, EARLY), apart, short)
    used = {value: k for k, value in enumerate(sorted({round(x) for x in solved}))}
    return [used[round(x)] for x in solved]


def _rows(ranks: Sequence[int], wires: Sequence[Wire]) -> list[Row]:
    """Return the rows with their things and the wires that pass them; a wire has at most one column in a row."""
    rows = [Row([]) for _ in range(max(ranks, default=-1) + 1)]
    leaving: dict[int, list[int]] = {}
    for w, wire in enumerate(wires):
        leaving.setdefault(wire.source, []).append(w)
    for item, rank in enumerate(ranks):
        rows[rank].cells.append(Cell(item))
        for w in leaving.get(item, ()):
            for between in range(rank + 1, max(ranks[t] for t in wires[w].targets)):
                rows[between].cells.append(Cell(-1, w, between))
    return rows


@dataclass(frozen=True)
class _Link:
    """A part of a wire between cells: positions are those in the first order of the two rows."""

    wire: int
    upper: Cell
    lower: Cell


def _links(rows: Sequence[Row], ranks: Sequence[int], wires: Sequence[Wire]) -> list[list[_Link]]:
    """Return, by row, the parts of wires that lead to the next row."""
    links: list[list[_Link]] = [[] for _ in rows]
    for w, wire in enumerate(wires):
        last = max(ranks[t] for t in wire.targets)
        for rank in range(ranks[wire.source], last):
            upper = Cell(wire.source) if rank == ranks[wire.source] else Cell(-1, w, rank)
            links[rank] += [_Link(w, upper, Cell(t)) for t in wire.targets if ranks[t] == rank + 1]
            if rank + 1 < last:
                links[rank].append(_Link(w, upper, Cell(-1, w, rank + 1)))
    return links


# ---- Order within rows ----


def _reduce_crossings(rows: list[Row], links: list[list[_Link]]) -> None:
    """Order the cells of each row: medians of their neighbors, downward and upward in turn; the best is kept."""
    best, fewest = [row.cells for row in rows], _all_crossings(rows, links)
    for sweep in range(SWEEPS):
        if not fewest:
            break
        down = sweep % 2 == 0
        for r in range(1, len(rows)) if down else range(len(rows) - 2, -1, -1):
            fixed, between = (rows[r - 1], links[r - 1]) if down else (rows[r + 1], links[r])
            position = {cell: k for k, cell in enumerate(fixed.cells)}
            near: dict[Cell, list[int]] = {}
            for link in between:
                moved, still = (link.lower, link.upper) if down else (link.upper, link.lower)
                near.setdefault(moved, []).append(position[still])
            _sort(rows[r], near)
            _swap(rows[r], near)
        crossings = _all_crossings(rows, links)
        if crossings < fewest:
            best, fewest = [row.cells for row in rows], crossings
    for row, cells in zip(rows, best, strict=True):
        row.cells = cells


def _sort(row: Row, near: dict[Cell, list[int]]) -> None:
    """Sort by the mean of the neighbors' positions; cells without neighbors keep their places."""
    free = [k for k, cell in enumerate(row.cells) if cell in near]
    ordered = sorted((row.cells[k] for k in free), key=lambda cell: sum(near[cell]) / len(near[cell]))
    cells = list(row.cells)
    for k, cell in zip(free, ordered, strict=True):
        cells[k] = cell
    row.cells = cells


def _swap(row: Row, near: dict[Cell, list[int]]) -> None:
    """Exchange neighbors as long as that removes crossings."""
    cells = row.cells
    for _ in cells:
        changed = False
        for k in range(len(cells) - 1):
            left, right = (sorted(near.get(cell, ())) for cell in cells[k : k + 2])
            now = sum(bisect_left(right, a) for a in left)
            then = sum(bisect_left(left, b) for b in right)
            if then < now:
                cells[k], cells[k + 1] = cells[k + 1], cells[k]
                changed = True
        if not changed:
            return


def _all_crossings(rows: Sequence[Row], links: Sequence[Sequence[_Link]]) -> int:
    return sum(_crossings(upper, lower, between) for upper, lower, between in zip(rows, rows[1:], links, strict=False))


def _crossings(upper: Row, lower: Row, links: Iterable[_Link]) -> int:
    above, below = ({cell: k for k, cell in enumerate(row.cells)} for row in (upper, lower))
    count, seen = 0, []
    for _, group in _grouped(sorted((above[link.upper], below[link.lower]) for link in links)):
        count += sum(len(seen) - bisect_right(seen, end) for end in group)
        for end in group:
            insort(seen, end)
    return count


def _grouped(pairs: Sequence[tuple[int, int]]) -> Iterable[tuple[int, list[int]]]:
    groups: dict[int, list[int]] = {}
    for key, value in pairs:
        groups.setdefault(key, []).append(value)
    return groups.items()


# ---- Columns ----


def _ports(
    rows: Sequence[Row], links: Sequence[Sequence[_Link]], sizes: Sequence[Size], wires: Sequence[Wire]
) -> list[tuple[int, ...]]:
    """Return where the outputs of each thing leave it: in the order of what they lead to."""
    leads: dict[tuple[int, int], list[int]] = {}
    for row, between in zip(rows[1:], links, strict=False):
        position = {cell: k for k, cell in enumerate(row.cells)}
        for link in between:
            if link.upper.item >= 0:
                leads.setdefault((link.upper.item, wires[link.wire].port), []).append(position[link.lower])
    ports = []
    for item, size in enumerate(sizes):
        means = [sum(found) / len(found) for k in range(len(size.slots)) for found in [leads.get((item, k), [1e9])]]
        at, placed = size.port, {}
        for k in sorted(range(len(means)), key=means.__getitem__):
            placed[k] = at
            at += size.slots[k]
        ports.append(tuple(placed[k] for k in range(len(means))))
    return ports


def _entries(
    rows: Sequence[Row], links: Sequence[Sequence[_Link]], sizes: Sequence[Size], starts: Sequence[int]
) -> dict[tuple[int, int], int]:
    """Return where each wire comes into each of its targets, from the axis: in the order in which they come."""
    entries: dict[tuple[int, int], int] = {}
    for row, between in zip(rows, links, strict=True):
        position = {cell: k for k, cell in enumerate(row.cells)}
        coming: dict[int, list[tuple[int, int, int]]] = {}
        for link in between:
            if link.lower.item >= 0:
                port = starts[link.wire] if link.upper.item >= 0 else 0
                coming.setdefault(link.lower.item, []).append((position[link.upper], port, link.wire))
        for item, sources in coming.items():
            size, last = sizes[item], len(sources) - 1
            step = min(ENTRY_GAP, 2 * size.entry // last) if last else 0
            for k, (*_, wire) in enumerate(sorted(sources)):
                entries[wire, item] = step * k - step * last // 2
    return entries


def _gaps(rows: list[Row], index: dict[Cell, int], sizes: Sequence[Size]) -> Iterator[tuple[int, int, float]]:
    """Yield neighbors of a row by number, the right one first, and minus the least distance of their axes."""
    for row in rows:
        for left, right in zip(row.cells, row.cells[1:], strict=False):
            gap = GAP if left.item >= 0 and right.item >= 0 else WIRE_GAP
            yield index[right], index[left], -(_reach(left, sizes)[1] + gap + _reach(right, sizes)[0])


def _columns(
    rows: list[Row],
    links: Sequence[Sequence[_Link]],
    entries: dict[tuple[int, int], int],
    ports: list[tuple[int, ...]],
    sizes: Sequence[Size],
    wires: Sequence[Wire],
    narrow: float,
) -> Layout:
    """Return the layout whose wires step aside least; ``narrow`` is the cost of width."""
    if not sizes:
        return Layout(rows, ports, 0)
    index = {cell: k for k, cell in enumerate(cell for row in rows for cell in row.cells)}
    apart = list(_gaps(rows, index, sizes))

    def start(link: _Link) -> int:
        return ports[link.upper.item][wires[link.wire].port] if link.upper.item >= 0 else 0

    def end(link: _Link) -> int:
        return entries[link.wire, link.lower.item] if link.lower.item >= 0 else 0

    above: dict[Cell, list[_Link]] = {}
    below: dict[Cell, list[_Link]] = {}
    for link in (link for between in links for link in between):
        above.setdefault(link.lower, []).append(link)
        below.setdefault(link.upper, []).append(link)
    aside: list[_Distance] = []
    for link in (link for between in links for link in between):
        chain = len(above[link.lower]) == len(below[link.upper]) == 1
        cost = PASSING if link.upper.item < 0 and link.lower.item < 0 else CHAIN if chain else BRANCH
        aside.append(([(index[link.upper], 1.0), (index[link.lower], -1.0)], start(link) - end(link), cost))
    for around in [*above.values(), *below.values()]:
        if len(around) > 1:  # the mean of their steps aside, with signs
            share = 1 / len(around)
            terms = [(index[cell], sign * share) for k in around for cell, sign in ((k.upper, 1), (k.lower, -1))]
            aside.append((terms, share * sum(start(link) - end(link) for link in around), CENTERED * len(around)))
    # One more unknown is the width.
    for row in rows:
        first, last = row.cells[0], row.cells[-1]
        apart.append((len(index), index[last], -_reach(last, sizes)[1]))
        apart.append((index[first], len(index) + 1, -_reach(first, sizes)[0]))
    costs = np.zeros(len(index) + 2)
    costs[len(index)] = narrow * len(rows)
    solved = _least_aside(costs, apart, aside)
    # Rounding each axis down keeps whole distances between neighbors.
    axis = {cell: int(np.floor(solved[k] + 1e-6)) for cell, k in index.items()}
    lowest = min(axis[cell] - _reach(cell, sizes)[0] for row in rows for cell in row.cells)
    axis = {cell: x - lowest for cell, x in axis.items()}
    width = 0
    for row, between in zip(rows, links, strict=True):
        row.axes = [axis[cell] for cell in row.cells]
        row.below = [
            Piece(link.wire, axis[link.upper] + start(link), axis[link.lower] + end(link), link.lower.item)
            for link in between
        ]
        width = max(width, *(axis[cell] + _reach(cell, sizes)[1] for cell in row.cells))
    return Layout(rows, ports, width)


def _reach(cell: Cell, sizes: Sequence[Size]) -> tuple[int, int]:
    return (sizes[cell.item].left, sizes[cell.item].right) if cell.item >= 0 else (0, 0)


_Distance = tuple[list[tuple[int, float]], float, float]  # terms (unknown, factor), a constant; the cost of |sum|


def _least_aside(costs: np.ndarray, apart: Sequence[tuple[int, int, float]], aside: Sequence[_Distance]) -> np.ndarray:
    """Return the x >= 0 of least ``costs @ x`` and distances; ``x[j] - x[i] <= most`` for each ``(i, j, most)``."""
    count = len(costs)
    cost = np.concatenate([costs, [weight for *_, weight in aside]])
    entries: list[tuple[int, int, float]] = []  # row, column, value
    most: list[float] = []
    for i, j, least in apart:
        entries += [(len(most), j, 1.0), (len(most), i, -1.0)]
        most.append(least)
    for k, (terms, constant, _) in enumerate(aside):
        for sign in (1.0, -1.0):
            entries += [(len(most), column, sign * value) for column, value in terms]
            entries.append((len(most), count + k, -1.0))
            most.append(-sign * constant)
    rows, columns, values = zip(*entries, strict=True)
    matrix = coo_array((values, (rows, columns)), shape=(len(most), len(cost))).tocsr()
    found = linprog(cost, A_ub=matrix, b_ub=most, bounds=(0, None), method="highs-ds")
    assert found.x is not None, found.message
    return found.x[:count]

"""Finds repeated parts of a net, such as the blocks of a residual net."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from netspec.inspect.draw.diagram import Diagram, Output

LEAST_SAVED = 4  # minimum number of boxes that folding a block must save
LONGEST = 300  # boxes of a block


@dataclass(frozen=True)
class Block:
    """A repeated part: ``copies`` copies of ``length`` boxes, starting at box ``first``, with one input and one output.

    ``entry`` is the output that the first copy reads. ``exit`` is the output of the first copy: a box and its top.
    """

    first: int
    length: int
    copies: int
    entry: Output
    exit: Output

    @property
    def boxes(self) -> range:
        """The boxes of all copies."""
        return range(self.first, self.first + self.length * self.copies)

    @property
    def last(self) -> Output:
        """The output of the last copy."""
        return self.exit[0] + self.length * (self.copies - 1), self.exit[1]


def find_blocks(diagram: Diagram) -> list[Block]:
    """Return the repeated parts in order, without overlaps. If several start at a box, use the one that saves most."""
    kinds: dict[object, int] = {}
    same = [
        kinds.setdefault((box.type, box.same, box.shapes, bool(box.owner), box.work), len(kinds))
        for box in diagram.boxes
    ]
    readers: dict[Output, list[int]] = {}
    for k, outputs in enumerate(diagram.reads):
        for output in outputs:
            readers.setdefault(output, []).append(k)
    found: list[Block] = []
    first = 0
    while first < len(same):
        blocks = [
            block
            for length in range(1, min(LONGEST, (len(same) - first) // 2) + 1)
            if (copies := _copies(diagram, same, first, length)) > 1
            and (block := _longest(diagram, readers, first, length, copies))
            and (block.copies - 1) * length >= LEAST_SAVED
        ]
        best = max(blocks, key=lambda block: (block.copies - 1) * block.length, default=None)
        if best:
            found.append(best)
        first = best.boxes.stop if best else first + 1
    return found


def _copies(diagram: Diagram, same: Sequence[int], first: int, length: int) -> int:
    """Return how often the ``length`` boxes from ``first`` on repeat, by their kinds, ignoring their connections."""
    second = first + length
    if same[first] != same[second] or not all(first <= source < second for source, _ in diagram.reads[second]):
        return 1  # a copy reads the output of the previous copy
    copies = 1
    while same[first + copies * length : second + copies * length] == same[first:second]:
        copies += 1
    return copies


def _longest(diagram: Diagram, readers: dict[Output, list[int]], first: int, length: int, copies: int) -> Block | None:
    """Return the block with as many consecutive copies as have the same connections."""
    within = range(first, first + length)
    entries = {output for k in within for output in diagram.reads[k] if output[0] < first}
    given = {
        (k, j)
        for k in within
        for j in range(len(diagram.tops[k]))
        if any(reader >= within.stop for reader in readers.get((k, j), ()))
    }
    unread = [(k, j) for k in within for j in range(len(diagram.tops[k])) if not readers.get((k, j))]
    if len(entries) != 1 or len(given) != 1 or unread:
        return None
    (entry,), (exit_,) = entries, given
    block = Block(first, length, 1, entry, exit_)
    whole = 1
    while whole < copies and _is_alike(diagram, readers, block, whole):
        whole += 1
    return replace(block, copies=whole)


def _is_alike(diagram: Diagram, readers: dict[Output, list[int]], block: Block, copy: int) -> bool:
    """Return whether a copy has the same connections as the first one, and reads the exit of the previous copy."""
    first, length, entry, exit_ = block.first, block.length, block.entry, block.exit
    shift = copy * length
    before = (exit_[0] + shift - length, exit_[1])
    for k in range(first, first + length):
        wanted = [before if output == entry else (output[0] + shift, output[1]) for output in diagram.reads[k]]
        if list(diagram.reads[k + shift]) != wanted:
            return False
        for j in range(len(diagram.tops[k])):
            end = first + length + shift
            leaves = any(reader >= end for reader in readers.get((k + shift, j), ()))
            if leaves != ((k, j) == exit_) and not ((k, j) == exit_ and not readers.get((k + shift, j))):
                return False
    # Only this copy may read the output of the previous copy.
    return all(reader < first + length + shift for reader in readers.get(before, ()))

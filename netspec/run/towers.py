"""Joins the towers of a siamese net, when it trains in fewer bits than float32: each layer runs once for all of them.

Towers are layers that share their blobs and run alike on different bottoms of the same shapes. Their batches become one
batch, tower after tower. So the kernels read and lay out each weight once, and add up its gradient once. This changes
the order of sums, so it is not done in float32.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch

from netspec.graph.plan import Plan, last_uses
from netspec.layers.contract.base import Layer
from netspec.run.parts import Part, has_hooks
from netspec.run.walk import Step

_NOT_SETTINGS = ("name", "bottom", "top", "param", "blobs", "include", "exclude")  # of a LayerParameter


@dataclass
class _Group:
    """Parts that run alike, one of each tower. A group of one part runs by itself."""

    parts: list[Part]
    bottoms: list[tuple[int, ...]]  # the values that each part reads
    tops: list[tuple[int, ...]]
    layer: Layer | None = None  # runs all of them, if there are several

    @property
    def rows(self) -> list[tuple[int, ...]]:
        """The values of all parts for each bottom."""
        return list(zip(*self.bottoms, strict=True))

    @property
    def reads(self) -> set[int]:
        """The values that any of the parts reads."""
        return {v for row in self.bottoms for v in row}


def steps_of_towers(
    plan: Plan,
    parts: Sequence[Part],
    alone: Sequence[bool],
    step_of: Callable[[Part], Sequence[Step]],
    kept: Collection[int],
) -> list[Step] | None:
    """Return the steps of a run with joined towers; None if nothing can be joined.

    A part of a layer with ``alone`` set runs by itself. ``step_of`` returns the steps of a part that does. The values
    ``kept`` are among the values of the run.
    """
    groups = _in_order(_groups(plan, parts, alone))
    if groups is None or all(group.layer is None for group in groups):
        return None
    line = _Line()
    for group in groups:
        if group.layer is None:
            for v in group.reads:
                line.separate(v)
            line.steps += step_of(group.parts[0])
        else:
            line.add(group, group.layer)
    for v in sorted(kept):
        line.separate(v)
    return _with_ends(line.steps, kept)


def _groups(plan: Plan, parts: Sequence[Part], alone: Sequence[bool]) -> list[_Group]:
    """Return all parts in groups, in the order of the first part of each."""
    nodes, groups = plan.nodes, list[_Group]()
    made: dict[int, tuple[int, int, int]] = {}  # by value: its group, the tower, and the index of the top
    known: dict[Any, int] = {}  # by what parts of a group have in common: the group
    behind: dict[int, set[int]] = {}  # by value: the parts that it depends on
    for k, part in enumerate(parts):
        bottoms, tops = nodes[part.first].bottoms, nodes[part.last].tops
        before = set().union(*(behind.get(v, set()) for v in bottoms))
        key = None if any(alone[part.first : part.last + 1]) else _key(part, [made.get(v) for v in bottoms])
        i = known.get(key, len(groups)) if key else len(groups)
        is_free = i < len(groups) and not before & {id(each) for each in groups[i].parts}
        if is_free and _fits(groups[i], bottoms, made):
            groups[i].parts.append(part)
            groups[i].bottoms.append(bottoms)
            groups[i].tops.append(tops)
        else:
            i = len(groups)
            groups.append(_Group([part], [bottoms], [tops]))
            if key:
                known[key] = i
        for j, v in enumerate(tops):
            made[v] = i, len(groups[i].parts) - 1, j
            behind[v] = before | {id(parts[k])}
    for group in groups:
        count = len(group.parts)
        if count > 1:
            group.layer = group.parts[0].layer.of_batches(count)
    return groups


def _key(part: Part, sources: Sequence[tuple[int, int, int] | None]) -> Any:
    """Return what the parts of a group have in common; None for a part that cannot be in a group.

    ``sources`` are where the bottoms come from: the group, the tower, and the index of the top. Bottoms come from the
    same tops of groups, or, at the start of towers that share blobs, from different tops of a single part.
    """
    layer = part.layer
    if layer.of_batches(2) is None or None in sources:
        return None
    shares = tuple(id(blob) for blob in part.blobs)
    origins = tuple((i, j) for i, _, j in filter(None, sources))
    starts = tuple(i for i, _ in origins)
    settings = tuple((type(each), each.held, _settings(each.param)) for each in part.members)
    return settings, tuple(layer.bottom_shapes), shares, starts if shares else origins


def _settings(param: Any) -> bytes:
    """Return the settings of a LayerParameter, without names."""
    settings = type(param)()
    settings.CopyFrom(param)
    for name in _NOT_SETTINGS:
        settings.ClearField(name)
    return settings.SerializeToString(deterministic=True)


def _fits(group: _Group, bottoms: Sequence[int], made: dict[int, tuple[int, int, int]]) -> bool:
    """Return whether a part with these bottoms can be the next of a group: from the next tower, or all from tower 0.

    The latter are the tops of a part that runs once, such as a Slice, and none of them is read twice.
    """
    tower, first = len(group.parts), group.bottoms[0]
    found = [made[v] for v in bottoms]
    if all(source[1] == tower and source[2] == made[v][2] for source, v in zip(found, first, strict=True)):
        return True
    return all(source[1] == 0 for source in found) and not group.reads & set(bottoms)


def _in_order(groups: Sequence[_Group]) -> list[_Group] | None:
    """Return groups in an order in which each follows what it reads; None if there is none."""
    waiting, ordered, ready = list(groups), list[_Group](), set[int]()
    made = {v for group in groups for row in group.tops for v in row}
    while waiting:
        group = next((each for each in waiting if not (each.reads & made) - ready), None)
        if group is None:
            return None
        waiting.remove(group)
        ordered.append(group)
        ready.update(v for row in group.tops for v in row)
    return ordered


@dataclass
class _Line:
    """Steps, and where their values are: ``joined`` has the number of the value that holds several values."""

    steps: list[Step] = field(default_factory=list[Step])
    joined: dict[tuple[int, ...], int] = field(default_factory=dict[tuple[int, ...], int])
    within: dict[int, tuple[int, ...]] = field(default_factory=dict[int, tuple[int, ...]])  # by value, if not separate
    numbers: int = 0

    def add(self, group: _Group, layer: Layer) -> None:
        """Add the step of a group, after those that join its bottoms."""
        bottoms = tuple(self.together(row) for row in group.rows)
        rows = list(zip(*group.tops, strict=True))
        tops = tuple(self._number() for _ in rows)
        self.steps.append(Step(group.parts[-1].last, partial(_run, layer, group.parts), bottoms, tops))
        for row, top in zip(rows, tops, strict=True):
            self.joined[row] = top
            self.within.update(dict.fromkeys(row, row))

    def _number(self) -> int:
        """Return a new number for a value; those of the plan are not negative."""
        self.numbers -= 1
        return self.numbers

    def together(self, row: tuple[int, ...]) -> int:
        """Return the number of the value that holds the values of a row, after a step that joins them if necessary."""
        if row not in self.joined:
            for v in row:
                self.separate(v)
            self.joined[row] = top = self._number()
            self.steps.append(Step(-1, _join, row, (top,)))
        return self.joined[row]

    def separate(self, v: int) -> None:
        """Add a step that separates a value from others, if it was joined with them."""
        if v in self.within:
            row = self.within[v]
            self.steps.append(Step(-1, partial(_divide, len(row)), (self.joined[row],), row))
            for each in row:
                del self.within[each]


def _join(*batches: torch.Tensor) -> Any:
    """Return the batches as one. If they differ in shape in this pass, they stay apart: a tuple in a tuple of tops."""
    return torch.cat(batches) if len({batch.shape for batch in batches}) == 1 else (batches,)


def _divide(count: int, batches: Any) -> tuple[torch.Tensor, ...]:
    return batches if isinstance(batches, tuple) else batches.chunk(count)


def _run(layer: Layer, parts: Sequence[Part], *bottoms: Any) -> tuple[Any, ...]:
    """Run the layer of a group. Run its parts one by one if one of them has hooks, or if their batches are apart."""
    hooked = any(has_hooks(member) for part in parts for member in part.members)
    if not hooked and not any(isinstance(bottom, tuple) for bottom in bottoms):
        return layer.run(*bottoms)
    batches = zip(*(_divide(len(parts), bottom) for bottom in bottoms), strict=True)
    return tuple(zip(*(part.run(*batch) for part, batch in zip(parts, batches, strict=True)), strict=True))


def _with_ends(steps: Sequence[Step], kept: Collection[int]) -> list[Step]:
    """Return the steps, each with the values that no later step reads, except those that are kept."""
    return [
        step._replace(ends=tuple(v for v in ends if v not in kept))
        for step, ends in zip(steps, last_uses(steps), strict=True)
    ]

"""Fold layers that only scale, shift or copy into the layers before them.

The pass knows no layer type. Its callers say of each layer whether it is an affine map of its channels, can take one
on, or hands its bottom on unchanged; fold.py asks the layers.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from netspec.graph.plan import Plan, origins


@dataclass(frozen=True)
class Roles:
    """What each layer of a plan is, by its index.

    ``absorbs``: it can scale and shift its top's channels; ``affine``: that is all it does to its one bottom;
    ``absorbs_before``: it can do so to its bottom's channels before its own work; ``passes_on``: its tops are its
    bottom; ``finishes``: it can be computed in place, at the end of the step before; ``fresh``: its top is memory of
    its own. Only :func:`netspec.fast.steps.schedule` reads the last two.
    """

    absorbs: Sequence[bool]
    affine: Sequence[bool]
    absorbs_before: Sequence[bool]
    passes_on: Sequence[bool]
    finishes: Sequence[bool] = ()
    fresh: Sequence[bool] = ()


@dataclass(frozen=True)
class Chain:
    """A layer that stays and those whose work it does, in running order: it is the first of them, or the last."""

    keeper: int
    folded: tuple[int, ...]

    @property
    def last(self) -> int:
        """The layer whose top is the chain's."""
        return max(self.keeper, *self.folded)


def find_chains(plan: Plan, roles: Roles, kept: Collection[int] = ()) -> list[Chain]:
    """Return the chains of a plan; no value within one is read by another layer, put out by the net, or ``kept``."""
    origin = origins(plan, roles.passes_on)
    readers: dict[int, list[int]] = {}
    for i, node in enumerate(plan.nodes):
        for v in node.bottoms if not roles.passes_on[i] else ():
            readers.setdefault(origin[v], []).append(i)
    put_out = {origin[v] for v in (*plan.outputs.values(), *kept)}

    def follower(i: int) -> int | None:
        """Return the affine layer that alone reads the only top of layer ``i``."""
        tops = plan.nodes[i].tops
        if len(tops) != 1 or origin[tops[0]] in put_out:
            return None
        read_by = readers.get(origin[tops[0]], [])
        return read_by[0] if len(read_by) == 1 and roles.affine[read_by[0]] else None

    chains, used = [], set()
    for i in range(len(plan.nodes)):
        if i in used or not (roles.absorbs[i] or roles.affine[i]):
            continue
        run = [i]
        while (after := follower(run[-1])) is not None:
            run.append(after)
        used.update(run)
        if len(run) == 1:
            continue
        if roles.absorbs[i]:
            chains.append(Chain(i, tuple(run[1:])))
        elif roles.absorbs_before[run[-1]]:
            chains.append(Chain(run[-1], tuple(run[:-1])))
    return chains

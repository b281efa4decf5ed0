"""Finds chains of layers that one of them can compute, because the others only scale and shift channels.

This module knows no layer types. Its callers say what each layer can do (:class:`Roles`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from netspec.graph.plan import Plan, origins


@dataclass(frozen=True)
class Roles:
    """What each layer of a plan can do, by its index.

    - ``absorbs``: it can also scale and shift the channels of its top.
    - ``absorbs_before``: it can also scale and shift the channels of its bottom, before its own work.
    - ``affine``: it only scales and shifts the channels of its single bottom.
    - ``passes_on``: it returns its bottom unchanged.
    - ``is_activation``: it can be computed in place, at the end of the step before it.
    - ``fresh``: its top has memory of its own, not that of a bottom.

    ``is_activation`` and ``fresh`` are read only by :func:`netspec.fast.steps.schedule`.
    """

    absorbs: Sequence[bool]
    affine: Sequence[bool]
    absorbs_before: Sequence[bool]
    passes_on: Sequence[bool]
    is_activation: Sequence[bool] = ()
    fresh: Sequence[bool] = ()


@dataclass(frozen=True)
class Chain:
    """Consecutive layers of which only one runs: the ``keeper``, the first or the last, which computes all of them."""

    keeper: int
    folded: tuple[int, ...]

    @property
    def last(self) -> int:
        """The last layer of the chain, which makes its top."""
        return max(self.keeper, *self.folded)


def find_chains(plan: Plan, roles: Roles, kept: Collection[int] = ()) -> list[Chain]:
    """Return the chains of a plan. No value inside a chain is an output or in ``kept``, or has a reader outside."""
    origin = origins(plan, roles.passes_on)
    readers: dict[int, list[int]] = {}
    for i, node in enumerate(plan.nodes):
        for v in node.bottoms if not roles.passes_on[i] else ():
            readers.setdefault(origin[v], []).append(i)
    needed = {origin[v] for v in (*plan.outputs.values(), *kept)}

    def follower(i: int) -> int | None:
        """Return the layer that can be folded together with layer ``i``: an affine one, the only reader of its top."""
        tops = plan.nodes[i].tops
        if len(tops) != 1 or origin[tops[0]] in needed:
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

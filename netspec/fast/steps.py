"""Plans the steps of inference, with these passes over the layers of a net:

``fold``   a layer that scales and shifts channels becomes part of the weights of the layer before or after it
``fuse``   an activation is computed in place, on the top of the layer before it
``skip``   a layer that returns its bottom unchanged is not run
``pack``   weights are stored in the layout that kernels prefer (fused.py)

The passes know no layer types: :class:`Roles` says what each layer can do.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

from netspec.fast.chains import Chain, Roles, find_chains
from netspec.graph.options import FOLD, FUSE, SKIP
from netspec.graph.plan import Plan, origins


@dataclass(frozen=True)
class PlannedStep:
    """One kernel of a run: layer ``node`` with its ``chain`` folded in, then layer ``finish`` in place on its top.

    - ``bottoms``, ``tops``: value numbers.
    - ``reuse``: the kernel may overwrite its first bottom.
    - ``ends``: values that are not needed after this step.
    - ``lasts``: its tops are still read after the run.
    """

    node: int
    bottoms: tuple[int, ...]
    tops: tuple[int, ...]
    chain: Chain | None = None
    finish: int | None = None
    reuse: bool = False
    ends: tuple[int, ...] = ()
    lasts: bool = True


@dataclass(frozen=True)
class Schedule:
    """Steps in running order. Value v is computed as value ``origin[v]``."""

    steps: tuple[PlannedStep, ...]
    origin: tuple[int, ...]


def schedule(
    plan: Plan,
    roles: Roles,
    given: Collection[int],
    kept: Collection[int],
    passes: Collection[str],
) -> Schedule:
    """Return the steps that compute the values ``kept`` and the outputs of the net. Every layer runs once.

    The values ``given`` are known before the first step.
    """
    finishes, fresh = roles.finishes, roles.fresh
    passes_on = roles.passes_on if SKIP in passes else [False] * len(plan.nodes)
    kept = {*kept, *plan.outputs.values()}
    chains = find_chains(plan, replace(roles, passes_on=passes_on), kept) if FOLD in passes else []
    by_keeper = {chain.keeper: chain for chain in chains}
    gone = {i for chain in chains for i in chain.folded}
    origin = origins(plan, passes_on)
    lasting = {origin[v] for v in kept}
    readers = _readers(plan, origin, passes_on)
    steps: list[PlannedStep] = []
    for i, node in enumerate(plan.nodes):
        if i in gone or passes_on[i] or (node.tops and set(node.tops) <= set(given)):
            continue
        chain = by_keeper.get(i)
        first, last = (min(i, *chain.folded), chain.last) if chain else (i, i)
        tops, finish = plan.nodes[last].tops, None
        if FUSE in passes and fresh[i] and len(tops) == 1 and tops[0] not in lasting:
            after = readers.get(tops[0], [])
            if len(after) == 1 and finishes[after[0]] and after[0] not in gone:
                finish = after[0]
                gone.add(finish)
                tops = plan.nodes[finish].tops
        steps.append(PlannedStep(i, tuple(origin[v] for v in plan.nodes[first].bottoms), tops, chain, finish))
    return Schedule(tuple(_with_ends(steps, fresh, lasting, FUSE in passes)), origin)


def _readers(plan: Plan, origin: Sequence[int], passes_on: Sequence[bool]) -> dict[int, list[int]]:
    """Return the layers that read each value, in running order."""
    readers: dict[int, list[int]] = {}
    for i, node in enumerate(plan.nodes):
        for v in node.bottoms if not passes_on[i] else ():
            readers.setdefault(origin[v], []).append(i)
    return readers


def _with_ends(
    steps: Sequence[PlannedStep], fresh: Sequence[bool], lasting: Collection[int], reusing: bool
) -> list[PlannedStep]:
    """Return the steps with ``ends`` and ``reuse`` set. Memory that a view may show is not reused."""
    last = {v: s for s, step in enumerate(steps) for v in (*step.bottoms, *step.tops)}
    owned, shown = set[int](), set(lasting)
    for step in reversed(steps):
        if not (fresh[step.node] or shown.isdisjoint(step.tops)):
            shown.update(step.bottoms)
    made = []
    for s, step in enumerate(steps):
        ends = tuple(dict.fromkeys(v for v in (*step.bottoms, *step.tops) if last[v] == s and v not in lasting))
        first = step.bottoms[0] if step.bottoms else -1
        reuse = reusing and first in ends and first in owned and step.bottoms.count(first) == 1
        made.append(replace(step, reuse=reuse, ends=ends, lasts=not shown.isdisjoint(step.tops)))
        if fresh[step.node]:
            owned.update(step.tops)
        else:
            owned.difference_update(step.bottoms)
    return made

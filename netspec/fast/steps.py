"""Plans the steps of a run without gradients, by these passes over the layers of a net:

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
    """One kernel of a run: layer ``node`` with its ``chain`` folded in, then layer ``activation`` in place on its top.

    - ``bottoms``, ``tops``: value numbers.
    - ``reuse``: the kernel may overwrite its first bottom.
    - ``ends``: values that are not needed after this step.
    - ``lasts``: its tops, or views of their memory, are still read after the run.
    """

    node: int
    bottoms: tuple[int, ...]
    tops: tuple[int, ...]
    chain: Chain | None = None
    activation: int | None = None
    reuse: bool = False
    ends: tuple[int, ...] = ()
    lasts: bool = True


@dataclass(frozen=True)
class Schedule:
    """Steps in running order. Value v is the same as value ``origin[v]``, which a step computes."""

    steps: tuple[PlannedStep, ...]
    origin: tuple[int, ...]


def schedule(
    plan: Plan,
    roles: Roles,
    given: Collection[int],
    kept: Collection[int],
    passes: Collection[str],
) -> Schedule:
    """Return the steps that run every layer once, and keep the values ``kept`` and the outputs of the net.

    The values ``given`` are known before the first step.
    """
    is_activation, fresh = roles.is_activation, roles.fresh
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
        tops, activation = plan.nodes[last].tops, None
        if FUSE in passes and fresh[i] and len(tops) == 1 and tops[0] not in lasting:
            after = readers.get(tops[0], [])
            if len(after) == 1 and is_activation[after[0]] and after[0] not in gone:
                activation = after[0]
                gone.add(activation)
                tops = plan.nodes[activation].tops
        steps.append(PlannedStep(i, tuple(origin[v] for v in plan.nodes[first].bottoms), tops, chain, activation))
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
    """Return the steps with ``ends``, ``reuse`` and ``lasts`` set.

    The top of a layer that is not fresh may be a view of the memory of its bottoms. So these bottoms last as long as
    the top, and their memory is not reused.
    """
    last = {v: s for s, step in enumerate(steps) for v in (*step.bottoms, *step.tops)}
    owned, needed_later = set[int](), set(lasting)
    for step in reversed(steps):
        if not (fresh[step.node] or needed_later.isdisjoint(step.tops)):
            needed_later.update(step.bottoms)
    made = []
    for s, step in enumerate(steps):
        ends = tuple(dict.fromkeys(v for v in (*step.bottoms, *step.tops) if last[v] == s and v not in lasting))
        first = step.bottoms[0] if step.bottoms else -1
        reuse = reusing and first in ends and first in owned and step.bottoms.count(first) == 1
        made.append(replace(step, reuse=reuse, ends=ends, lasts=not needed_later.isdisjoint(step.tops)))
        if fresh[step.node]:
            owned.update(step.tops)
        else:
            owned.difference_update(step.bottoms)
    return made

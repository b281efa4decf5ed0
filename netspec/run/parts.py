"""Joins consecutive layers, when a net trains, into one layer that does the work of all of them.

The joined layer reads the blobs of all its layers in each run. BatchNorm, Scale and ReLU become one kernel of torch,
which rounds once instead of three times. The results of a training therefore depend on it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer


@dataclass(frozen=True)
class Part:
    """Consecutive layers, ``members``, from node ``first`` to node ``last``. ``layer`` does the work of all of them."""

    first: int
    last: int
    layer: Layer
    members: tuple[Layer, ...]

    @property
    def blobs(self) -> list[torch.Tensor]:
        """The learnable blobs of all members."""
        return [blob for layer in self.members for blob in layer.blobs]

    def run(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Run the joined layer, or the members one by one if a member has hooks."""
        if len(self.members) > 1 and any(hooks_of(self.members)):
            for layer in self.members:
                bottoms = layer.run(*bottoms)
            return bottoms
        return self.layer.run(*bottoms)


def hooks_of(layers: Iterable[Layer]) -> list[Any]:
    """Return the dicts of the layers' hooks. If one is not empty, a program watches the layers: each runs by itself."""
    names = ("_forward_hooks", "_forward_pre_hooks", "_backward_hooks", "_backward_pre_hooks")
    return [vars(layer)[name] for layer in layers for name in names]


def parts_of(
    plan: Plan, layers: Sequence[Layer], alone: Sequence[bool], kept: Collection[int] = frozenset()
) -> list[Part]:
    """Return the layers of a plan in order, with consecutive layers joined where possible.

    A layer with ``alone`` set is never joined. A value inside a part has no other reader and is not in ``kept``.
    """
    readers = Counter(v for node in plan.nodes for v in node.bottoms)

    def is_between(v: int) -> bool:
        return readers[v] == 1 and v not in kept

    parts: list[Part] = []
    for i, (node, layer) in enumerate(zip(plan.nodes, layers, strict=True)):
        before, one = parts[-1] if parts else None, None
        if before and plan.nodes[before.last].tops == node.bottoms and not (alone[before.first] or alone[i]):
            one = before.layer.joined_with(layer) if [*map(is_between, node.bottoms)] == [True] else None
        if before and one:
            parts[-1] = Part(before.first, i, one, (*before.members, layer))
        else:
            parts.append(Part(i, i, layer, (layer,)))
    return parts

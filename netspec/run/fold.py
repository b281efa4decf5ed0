"""Layers that do the work of others: weights that scale and shift as well, and layers in a row that are one.

A convolution y = W x + b followed by z = s y + t, both s and t one number for each channel, is a convolution with the
weights s W and the bias s b + t. A BatchNorm that normalizes by its past is such a map, s = 1 / sqrt(var + eps) and t =
-mean s, and so is a Scale; maps in a row are one map. The arithmetic is in double precision. The layers know their own
part (netspec/layers/contract/folding.py); here they are only put together.

A net that learns keeps its blobs as they are. There, layers in a row may be joined: one layer does the work of all, and
reads the blobs of all in each run.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass

import torch

from netspec.graph.fold import Chain, Roles, find_chains
from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.folding import Absorbed, Affine, folds_of


@dataclass(frozen=True)
class Fold:
    """A chain of a net's layers, and the parameters and learned blobs (double) with which its keeper does it all."""

    chain: Chain
    absorbed: Absorbed


@dataclass(frozen=True)
class Part:
    """Layers in a row, ``members``, from node ``first`` to node ``last``; ``layer`` does the work of all."""

    first: int
    last: int
    layer: Layer
    members: tuple[Layer, ...]

    @property
    def blobs(self) -> list[torch.Tensor]:
        """The learnable blobs of all."""
        return [blob for layer in self.members for blob in layer.blobs]

    def run(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Run all, one after the other where hooks look at one."""
        if len(self.members) > 1 and any(layer._forward_hooks for layer in self.members):
            for layer in self.members:
                bottoms = layer.run(*bottoms)
            return bottoms
        return self.layer.run(*bottoms)


def parts_of(
    plan: Plan, layers: Sequence[Layer], apart: Sequence[bool], kept: Collection[int] = frozenset()
) -> list[Part]:
    """Return the layers of a plan, joined where one can do the work of those after it.

    Layers that are ``apart`` are parts of their own. Nobody else reads a value within a part, and none is ``kept``.
    """
    readers = Counter(v for node in plan.nodes for v in node.bottoms)

    def is_between(v: int) -> bool:
        return readers[v] == 1 and v not in kept

    parts: list[Part] = []
    for i, (node, layer) in enumerate(zip(plan.nodes, layers, strict=True)):
        before, joined = parts[-1] if parts else None, None
        if before and plan.nodes[before.last].tops == node.bottoms and not (apart[before.first] or apart[i]):
            join = folds_of(before.layer).join
            joined = join(layer) if join and [*map(is_between, node.bottoms)] == [True] else None
        if before and joined:
            parts[-1] = Part(before.first, i, joined, (*before.members, layer))
        else:
            parts.append(Part(i, i, layer, (layer,)))
    return parts


def roles_of(plan: Plan, layers: Sequence[Layer]) -> Roles:
    """Return what each layer of a plan is for folding."""
    folds = [folds_of(layer) for layer in layers]
    one_top = [len(node.tops) == 1 for node in plan.nodes]
    one_to_one = [one and len(node.bottoms) == 1 for one, node in zip(one_top, plan.nodes, strict=True)]
    affine = [one and its.affine is not None for one, its in zip(one_to_one, folds, strict=True)]
    return Roles(
        absorbs=[one and its.absorb is not None for one, its in zip(one_top, folds, strict=True)],
        affine=affine,
        absorbs_before=[a and its.absorb_before is not None for a, its in zip(affine, folds, strict=True)],
        passes_on=[its.passes_on for its in folds],
    )


def find_folds(plan: Plan, layers: Sequence[Layer]) -> list[Fold]:
    """Return all that can be folded, with the weights as they are; the layers are not changed."""
    return [Fold(chain, absorbed_by(chain, layers)) for chain in find_chains(plan, roles_of(plan, layers))]


def absorbed_by(chain: Chain, layers: Sequence[Layer], like: torch.Tensor | None = None) -> Absorbed:
    """Return what a chain's keeper has to be to do the work of all, in double or in the precision of ``like``.

    What scales and shifts is composed in double in any case.
    """
    affine, keeper = [folds_of(layers[i]).affine for i in chain.folded], folds_of(layers[chain.keeper])
    scale, shift = composed([each() for each in affine if each])
    if like is not None:
        scale, shift = scale.to(like), shift.to(like)
    absorb = keeper.absorb if chain.keeper < chain.folded[0] else keeper.absorb_before
    assert absorb is not None, "the chain's keeper absorbs"
    return absorb(scale, shift)


def composed(maps: Sequence[Affine]) -> Affine:
    """Return the one map that does what these do one after the other."""
    scale, shift = torch.ones((), dtype=torch.double), torch.zeros((), dtype=torch.double)
    for each in maps:
        scale, shift = each[0] * scale, each[0] * shift + each[1]
    return scale, shift

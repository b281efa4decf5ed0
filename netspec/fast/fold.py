"""Folds layers that scale and shift channels into the weights of other layers.

A convolution y = W x + b followed by z = s y + t, both s and t one number for each channel, is a convolution with the
weights s W and the bias s b + t. A BatchNorm with stored statistics is such a map, s = 1 / sqrt(var + eps) and t =
-mean s, and so is a Scale. Consecutive maps are one map. The arithmetic is in double precision. The entry of a layer
says how it can be joined with its neighbors (folding.py); this module only combines them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from netspec.fast.chains import Chain, Roles, find_chains
from netspec.fast.folding import Absorbed, Affine
from netspec.fast.table import folds_of
from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import passes_on


@dataclass(frozen=True)
class Fold:
    """A chain of layers, and the parameters and learned blobs (double) with which its keeper computes all of it."""

    chain: Chain
    absorbed: Absorbed


def roles_of(plan: Plan, layers: Sequence[Layer]) -> Roles:
    """Return what each layer of a plan can do in folding."""
    folds = [folds_of(layer) for layer in layers]
    one_top = [len(node.tops) == 1 for node in plan.nodes]
    one_to_one = [one and len(node.bottoms) == 1 for one, node in zip(one_top, plan.nodes, strict=True)]
    affine = [one and its.affine is not None for one, its in zip(one_to_one, folds, strict=True)]
    return Roles(
        absorbs=[one and its.absorb is not None for one, its in zip(one_top, folds, strict=True)],
        affine=affine,
        absorbs_before=[a and its.absorb_before is not None for a, its in zip(affine, folds, strict=True)],
        passes_on=[passes_on(layer) for layer in layers],
    )


def find_folds(plan: Plan, layers: Sequence[Layer]) -> list[Fold]:
    """Return everything that can be folded, with the present weights. The layers are not changed."""
    return [Fold(chain, absorbed_by(chain, layers)) for chain in find_chains(plan, roles_of(plan, layers))]


def absorbed_by(chain: Chain, layers: Sequence[Layer], like: torch.Tensor | None = None) -> Absorbed:
    """Return the layer that computes a whole chain, in double or in the precision of ``like``.

    Scales and shifts are always combined in double.
    """
    affine, keeper = [folds_of(layers[i]).affine for i in chain.folded], folds_of(layers[chain.keeper])
    scale, shift = composed([each() for each in affine if each])
    if like is not None:
        scale, shift = scale.to(like), shift.to(like)
    absorb = keeper.absorb if chain.keeper < chain.folded[0] else keeper.absorb_before
    assert absorb is not None, "the chain's keeper absorbs"
    return absorb(scale, shift)


def composed(maps: Sequence[Affine]) -> Affine:
    """Return the map that is the composition of these, in order."""
    scale, shift = torch.ones((), dtype=torch.double), torch.zeros((), dtype=torch.double)
    for each in maps:
        scale, shift = each[0] * scale, each[0] * shift + each[1]
    return scale, shift

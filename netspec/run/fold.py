"""Folding: what only scales and shifts the channels becomes part of the weights before it, as is done before shipping.

A convolution y = W x + b followed by z = s y + t, both s and t one number for each channel, is a convolution with the
weights s W and the bias s b + t. A BatchNorm that normalizes by its past is such a map, s = 1 / sqrt(var + eps) and t =
-mean s, and so is a Scale; maps in a row are one map. The arithmetic is in double precision. The layers know their own
part (netspec/layers/contract/folding.py); here they are only put together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from netspec.graph.fold import Chain, Roles, find_chains
from netspec.graph.plan import Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.folding import Absorbed, Affine, as_affine, passes_on
from netspec.layers.contract.offers import offered


@dataclass(frozen=True)
class Fold:
    """A chain of a net's layers, and the parameters and learned blobs (double) with which its keeper does it all."""

    chain: Chain
    absorbed: Absorbed


def roles_of(plan: Plan, layers: Sequence[Layer]) -> Roles:
    """Return what each layer of a plan is for folding."""
    one_top = [len(node.tops) == 1 for node in plan.nodes]
    one_to_one = [one and len(node.bottoms) == 1 for one, node in zip(one_top, plan.nodes, strict=True)]
    affine = [one and as_affine(layer) is not None for one, layer in zip(one_to_one, layers, strict=True)]
    return Roles(
        absorbs=[one and bool(offered(layer, "absorbs")) for one, layer in zip(one_top, layers, strict=True)],
        affine=affine,
        absorbs_before=[a and bool(offered(layer, "absorbs_before")) for a, layer in zip(affine, layers, strict=True)],
        passes_on=[passes_on(layer) for layer in layers],
    )


def find_folds(plan: Plan, layers: Sequence[Layer]) -> list[Fold]:
    """Return all that can be folded, with the weights as they are; the layers are not changed."""
    return [Fold(chain, absorbed_by(chain, layers)) for chain in find_chains(plan, roles_of(plan, layers))]


def absorbed_by(chain: Chain, layers: Sequence[Layer], like: torch.Tensor | None = None) -> Absorbed:
    """Return what a chain's keeper has to be to do the work of all, in double or in the precision of ``like``.

    What scales and shifts is composed in double in any case.
    """
    scale, shift = composed([as_affine(layers[i]) for i in chain.folded])
    if like is not None:
        scale, shift = scale.to(like), shift.to(like)
    absorb = offered(layers[chain.keeper], "absorb" if chain.keeper < chain.folded[0] else "absorb_before")
    return absorb(scale, shift)


def composed(maps: Sequence[Affine | None]) -> Affine:
    """Return the one map that does what these do one after the other."""
    scale, shift = torch.ones((), dtype=torch.double), torch.zeros((), dtype=torch.double)
    for each in maps:
        assert each is not None, "the chain consists of affine layers"
        scale, shift = each[0] * scale, each[0] * shift + each[1]
    return scale, shift

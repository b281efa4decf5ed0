"""Folds layers that scale and shift channels into the weights of other layers.

A convolution y = W x + b followed by z = s y + t, where s and t have one number for each channel, is a convolution with
the weights s W and the bias s b + t. A BatchNorm with stored statistics computes such a z, with s = 1 / sqrt(var + eps)
and t = -mean s. So does a Scale. Several of them in a row are combined into one s and one t, in double precision. The
entry of a layer says how it can be joined with its neighbors (folding.py).
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


@dataclass(frozen=True)
class Fold:
    """A chain of layers, and the settings and learned blobs (double) with which its keeper computes the whole chain."""

    chain: Chain
    absorbed: Absorbed


def roles_of(plan: Plan, layers: Sequence[Layer]) -> Roles:
    """Return what each layer of a plan can do, except for ``is_activation`` and ``fresh``."""
    folds = [folds_of(layer) for layer in layers]
    one_top = [len(node.tops) == 1 for node in plan.nodes]
    one_bottom = [len(node.bottoms) == 1 for node in plan.nodes]
    affine = [t and b and fold.affine is not None for t, b, fold in zip(one_top, one_bottom, folds, strict=True)]
    return Roles(
        absorbs=[t and fold.absorb is not None for t, fold in zip(one_top, folds, strict=True)],
        affine=affine,
        absorbs_before=[a and fold.absorb_before is not None for a, fold in zip(affine, folds, strict=True)],
        passes_on=[layer.passes_on for layer in layers],
    )


def find_folds(plan: Plan, layers: Sequence[Layer]) -> list[Fold]:
    """Return all chains that can be folded, with the present weights. The layers are not changed."""
    return [Fold(chain, absorbed_by(chain, layers)) for chain in find_chains(plan, roles_of(plan, layers))]


def absorbed_by(chain: Chain, layers: Sequence[Layer], like: torch.Tensor | None = None) -> Absorbed:
    """Return the settings and blobs with which the keeper computes a whole chain.

    The blobs have the type and device of ``like``, by default double on the CPU. Scales and shifts are always combined
    in double.
    """
    affine, keeper = [folds_of(layers[i]).affine for i in chain.folded], folds_of(layers[chain.keeper])
    scale, shift = composed([each() for each in affine if each])
    if like is not None:
        scale, shift = scale.to(like), shift.to(like)
    absorb = keeper.absorb if chain.keeper < chain.folded[0] else keeper.absorb_before
    assert absorb is not None, "the chain's keeper absorbs"
    return absorb(scale, shift)


def composed(maps: Sequence[Affine]) -> Affine:
    """Return the scale and shift that have the effect of all these, in order."""
    scale, shift = torch.ones((), dtype=torch.double), torch.zeros((), dtype=torch.double)
    for each in maps:
        scale, shift = each[0] * scale, each[0] * shift + each[1]
    return scale, shift

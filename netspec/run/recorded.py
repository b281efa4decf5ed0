"""A layer as a pair of functions, one forward and one backward, by autograd of this layer alone."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch

Diff = torch.Tensor | None
Backward = Callable[..., Any]  # the tops' gradients to the bottom's gradient, or to a tuple, one per bottom


class Kernels(NamedTuple):
    """What runs a layer that learns: ``forward`` takes bottoms to a top, or to a tuple of tops.

    ``backward`` takes the tops' gradients to the bottom's, or to a tuple, one per bottom.
    """

    forward: Callable[..., Any]
    backward: Backward


def recorded(
    run: Callable[..., Sequence[torch.Tensor]], wanted: Sequence[bool], blobs: Sequence[torch.Tensor] = ()
) -> Kernels:
    """Return kernels for a layer, with gradients by autograd. ``run`` runs the layer with these blobs."""
    leaves: list[torch.Tensor] = []
    made: Sequence[torch.Tensor] = ()

    def forward(*bottoms: torch.Tensor) -> Sequence[torch.Tensor]:
        nonlocal made
        leaves[:] = [x.detach().requires_grad_(w) for x, w in zip(bottoms, wanted, strict=True)]
        with torch.enable_grad():
            made = run(*leaves)
        return [top.detach() for top in made]

    def backward(*diffs: Diff) -> Sequence[Diff]:
        nonlocal made
        ends = [(top, diff) for top, diff in zip(made, diffs, strict=False) if diff is not None and top.requires_grad]
        made, learned = (), [blob for blob in blobs if blob.requires_grad]
        asked = [leaf for leaf in leaves if leaf.requires_grad]
        if not ends or not (asked or learned):
            return [None] * len(leaves)
        # Not torch.autograd.backward: it would copy the gradients into the layout of the leaves.
        tops, given = zip(*ends, strict=True)
        found = torch.autograd.grad(tops, [*asked, *learned], given, allow_unused=True)
        for blob, gradient in zip(learned, found[len(asked) :], strict=True):
            if gradient is not None:
                blob.grad = gradient if blob.grad is None else blob.grad.add_(gradient)
        of_asked = iter(found)
        return [next(of_asked) if leaf.requires_grad else None for leaf in leaves]

    return Kernels(forward, backward)

"""Makes a pair of functions, forward and backward, from one layer, with autograd."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch

Diff = torch.Tensor | None
Backward = Callable[..., Any]  # takes the tops' gradients; returns the bottom's gradient, or a tuple of one per bottom


class Kernels(NamedTuple):
    """The two functions that run a layer in training.

    ``forward`` takes the bottoms and returns the top, or a tuple of tops. ``backward`` takes the gradients of the tops
    and returns the gradient of the bottom, or a tuple with one for each bottom.
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

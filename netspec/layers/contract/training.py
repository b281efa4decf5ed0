"""How a layer is made ready to be trained at fixed shapes: a kernel forward and one backward, called again and again.

A layer may have kernels of its own; of the others autograd records each pass. Both compute the same numbers: kernels
are a way to call the same functions with less work around them, and with memory that is kept from pass to pass, as
Caffe's blobs are.
"""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch

from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import offered

Diff = torch.Tensor | None
Forward = Callable[..., Any]  # bottoms to a top, or to a tuple of tops
Backward = Callable[..., Any]  # the tops' gradients to the bottom's gradient, or to a tuple, one per bottom
Kernels = tuple[Forward, Backward]


@dataclass(frozen=True)
class Learning:
    """What is asked of a layer that is trained at its present shapes.

    ``wanted[i]`` says whether bottom i's gradient is asked for; ``sums[j]`` is where that of learnable blob j is added
    up, in the blob's shape, None where it is not learned. Both kernels run without autograd, in turns, and BLAS uses
    one thread. The backward kernel gets None for a top without a gradient, though never for all tops. Tensors that a
    kernel returns are good until its next call. Where the net is ``steady``, bottoms do not change before the backward
    kernel has run; otherwise it reads them again, as Caffe's does.
    """

    wanted: tuple[bool, ...]
    sums: tuple[Diff, ...] = ()
    steady: bool = True


class PreparesTraining(Protocol):
    """A layer that has kernels of its own."""

    def prepare_training(self, learning: Learning) -> Kernels | None:
        """Return what computes ``forward``, and its gradients, for bottoms of the present shapes, again and again.

        None: there is nothing better at these shapes than what autograd records.
        """
        ...


def has_kernels(layer: Layer) -> bool:
    """Return whether a layer has kernels of its own, at some shapes at least."""
    return offered(layer, "prepare_training") is not None


def kernels(layer: Layer, learning: Learning) -> Kernels:
    """Return a layer's own kernels for its present shapes, or else those that autograd makes of its ``forward``."""
    prepare = offered(layer, "prepare_training")
    return (prepare and prepare(learning)) or recorded(layer.run, learning)


def weight_and_bias(
    layer: Layer, learning: Learning
) -> tuple[tuple[torch.Tensor, torch.Tensor | None], tuple[Diff, Diff]]:
    """Return the values of blobs 0 and 1, and where their gradients are added up; blob 1 may be missing."""
    values = layer.values()
    has_bias = len(values) > 1
    return (values[0], values[1] if has_bias else None), (learning.sums[0], learning.sums[1] if has_bias else None)


def recorded(run: Callable[..., Sequence[torch.Tensor]], learning: Learning) -> Kernels:
    """Return the kernels of a layer whose gradients autograd computes; ``run`` is the layer's."""
    leaves: list[torch.Tensor] = []
    made: Sequence[torch.Tensor] = ()

    def forward(*bottoms: torch.Tensor) -> Sequence[torch.Tensor]:
        nonlocal made
        leaves[:] = [x.detach().requires_grad_(w) for x, w in zip(bottoms, learning.wanted, strict=True)]
        with torch.enable_grad():
            made = run(*leaves)
        return [top.detach() for top in made]

    def backward(*diffs: Diff) -> Sequence[Diff]:
        nonlocal made
        ends = [(top, diff) for top, diff in zip(made, diffs, strict=False) if diff is not None and top.requires_grad]
        if ends:
            torch.autograd.backward([top for top, _ in ends], [diff for _, diff in ends])
        made = ()
        return [leaf.grad for leaf in leaves]

    return forward, backward


class Room:
    """Memory for a result, made when the first is known and kept: ``room.like(x)`` has the shape and order of ``x``."""

    __slots__ = ("_kept",)

    def __init__(self) -> None:
        self._kept: torch.Tensor | None = None

    def like(self, x: torch.Tensor) -> torch.Tensor:
        """Return the memory."""
        if self._kept is None:
            self._kept = torch.empty_like(x)
        return self._kept

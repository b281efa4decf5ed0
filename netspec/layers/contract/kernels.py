"""How a layer is run again and again at its present shapes: one kernel forward and, in a net that learns, one backward.

A layer may have kernels of its own where something is faster than its ``forward`` and autograd. Both compute the same
numbers: kernels call the same functions with less work around them, with learned blobs in another form, or with memory
that is kept from run to run, as Caffe's blobs are.
"""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, Protocol

import torch
import torch.nn.functional as F

from netspec.exact.bound import BoundColumns, BoundVectors
from netspec.layers.contract.base import Layer
from netspec.layers.contract.offers import call

Diff = torch.Tensor | None
Kernel = Callable[..., Any]  # bottoms to a top, or to a tuple of tops
Backward = Callable[..., Any]  # the tops' gradients to the bottom's gradient, or to a tuple, one per bottom


def _forward_only(*diffs: Diff) -> Any:
    raise AssertionError("these kernels were made for runs without gradients")


class Kernels(NamedTuple):
    """The kernels of a layer; ``backward`` only where the net learns."""

    forward: Kernel
    backward: Backward = _forward_only


@dataclass(frozen=True)
class Finish:
    """A map from number to number, known by its name; ``change`` does it to its argument in place, and returns it.

    ``operation``: its name and numbers in the kernels of oneDNN, where these compute the same bits, NaN aside.
    """

    name: str
    change: Callable[[torch.Tensor], torch.Tensor] = field(compare=False)
    operation: tuple[str, tuple[float, ...]] | None = None


RELU = Finish("relu", F.relu_, ("relu", ()))  # whose gradient does not read what it overwrites


def clip(low: float, high: float) -> Finish:
    """Return the map max(low, min(x, high)), for ``low`` up to ``high``."""
    return Finish(f"clip {low} {high}", lambda x: x.clamp_(low, high), ("hardtanh", (low, high)))


@dataclass(frozen=True)
class Preparation:
    """What a layer may know when it makes kernels for its present shapes.

    In a net that learns, ``wanted[i]`` says whether bottom i's gradient is asked for; ``sums[j]`` is where that of
    learnable blob j is added up, in the blob's shape, None where it is not learned. Both kernels run without autograd,
    in turns, and BLAS uses one thread. The backward kernel gets None for a top without a gradient, though never for all
    tops. Tensors that a kernel returns are good until its next call. Where the net is ``steady``, bottoms do not change
    before the backward kernel has run; otherwise it reads them again, as Caffe's does.

    In a run without gradients ``wanted`` is None. Then ``finish`` is to be done in place to the top; the first bottom
    may be overwritten where ``reuse``. What a layer makes of its blobs for all shapes it gets by ``memo(name, make)``,
    which makes it once; weights may be laid out for a kernel where ``pack``. The top may be memory that the next run
    overwrites, unless it ``lasts``. ``keeps`` is told the bytes of what the layer keeps for its present shapes.
    """

    wanted: tuple[bool, ...] | None = None
    sums: tuple[Diff, ...] = ()
    steady: bool = True
    finish: Finish | None = None
    reuse: bool = False
    lasts: bool = True
    memo: Callable[[str, Callable[[], Any]], Any] = lambda _, make: make()
    pack: bool = True
    keeps: Callable[[int], None] = lambda _: None

    @property
    def learns(self) -> bool:
        """Whether a backward kernel is asked for."""
        return self.wanted is not None

    def wants(self, bottom: int) -> bool:
        """Return whether a bottom's gradient is asked for."""
        return self.wanted is not None and self.wanted[bottom]


class HasKernels(Protocol):
    """What a layer can offer to those who run it at fixed shapes; any part of it may be missing."""

    fresh: bool  # its one top is memory of its own, not a bottom's
    any_layout: bool  # its kernel takes bottoms whose channels lie side by side (channels_last)

    def kernels(self, how: Preparation) -> Kernels | None:
        """Return what computes ``forward``, and its gradients, for bottoms of the present shapes, again and again.

        Only these kernels use the layer from now on, at these shapes. Without gradients they may keep the blobs in
        another form, copied: after a write to them the layer is asked again; no kernel may keep an alias of them.
        None: at these shapes ``forward`` with autograd is as good.
        """
        ...


def own_kernels(layer: Layer, how: Preparation) -> Kernels | None:
    """Return the kernels that a layer has for its present shapes, None where it has none of its own."""
    return call(layer, "kernels", how)


def learns_alone(layer: Layer, steady: bool = True) -> bool:
    """Return whether a layer has kernels of its own, backward too, at its present shapes."""
    how = Preparation((True,) * len(layer.bottom_shapes), (None,) * len(layer.blobs), steady)
    return own_kernels(layer, how) is not None


def finished(kernel: Kernel, finish: Finish | None) -> Kernels:
    """Return a kernel of one top followed by what changes it in place."""
    if finish is None:
        return Kernels(kernel)
    change = finish.change

    def both(*bottoms: torch.Tensor) -> torch.Tensor:
        top = kernel(*bottoms)
        return change(top[0] if isinstance(top, tuple) else top)

    return Kernels(both)


def copies(blobs: Sequence[torch.Tensor], how: Preparation) -> list[torch.Tensor]:
    """Return copies of a layer's blobs, the same ones for all shapes."""
    copy = partial(torch.clone, memory_format=torch.contiguous_format)
    return [how.memo(f"copy {i}", partial(copy, blob)) for i, blob in enumerate(blobs)]


def lent(bound: BoundVectors | BoundColumns, how: Preparation) -> Kernels:
    """Return the kernel, without gradients, of a layer of one top, whose memory its next run uses again."""
    how.keeps(bound.nbytes)
    kernel = finished(bound.forward, how.finish).forward
    return Kernels((lambda *bottoms: kernel(*bottoms).clone()) if how.lasts else kernel)


def weight_and_bias(
    layer: Layer, how: Preparation
) -> tuple[tuple[torch.Tensor, torch.Tensor | None], tuple[Diff, Diff]]:
    """Return the values of blobs 0 and 1, and where their gradients are added up; blob 1 may be missing."""
    values = layer.values()
    has_bias = len(values) > 1
    return (values[0], values[1] if has_bias else None), (how.sums[0], how.sums[1] if has_bias else None)


def recorded(
    run: Callable[..., Sequence[torch.Tensor]], wanted: Sequence[bool], blobs: Sequence[torch.Tensor] = ()
) -> Kernels:
    """Return the kernels of a layer whose gradients autograd computes; ``run`` is the layer's, with these blobs."""
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

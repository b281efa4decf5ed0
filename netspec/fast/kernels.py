"""The types that kernels share. A kernel runs a layer again and again at fixed shapes.

A layer has its own kernels (layers/) where they are faster than its ``forward`` and autograd. They compute the same
numbers: they call the same functions with less overhead, with learned blobs in another layout, or with memory that is
kept from run to run, as Caffe's blobs are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F

from netspec.fast.bound import BoundColumns, BoundVectors
from netspec.layers.contract.base import Layer
from netspec.run.recorded import Diff

Kernel = Callable[..., Any]  # takes the bottoms; returns the top, or a tuple of tops


@dataclass(frozen=True)
class Finish:
    """An elementwise function. ``change`` applies it to a tensor in place, and returns the tensor.

    ``operation`` is its name and arguments in oneDNN's kernels, if they compute the same bits (except for NaN).
    """

    name: str
    change: Callable[[torch.Tensor], torch.Tensor] = field(compare=False)
    operation: tuple[str, tuple[float, ...]] | None = None


RELU = Finish("relu", F.relu_, ("relu", ()))


def clip(low: float, high: float) -> Finish:
    """Return the function max(low, min(x, high)). ``low`` must not exceed ``high``."""
    return Finish(f"clip {low} {high}", lambda x: x.clamp_(low, high), ("hardtanh", (low, high)))


@dataclass(frozen=True)
class Inference:
    """How to make the kernel of a layer for runs without gradients.

    - ``finish``: is applied to the top in place.
    - ``reuse``: the kernel may overwrite the first bottom.
    - ``memo(name, make)``: returns what ``make`` returns, and calls it only once for kernels of all shapes.
    - ``pack``: weights may be stored in the layout that the kernel prefers.
    - ``lasts``: the next run must not overwrite the top.
    - ``keeps``: must be called with the number of bytes that the kernel keeps for its shapes.

    From now on only this kernel uses the layer, at these shapes. The kernel may keep copies of the blobs, because a new
    kernel is made after a write to them. It must not keep an alias of them.
    """

    finish: Finish | None = None
    reuse: bool = False
    lasts: bool = True
    memo: Callable[[str, Callable[[], Any]], Any] = lambda _, make: make()
    pack: bool = True
    keeps: Callable[[int], None] = lambda _: None


@dataclass(frozen=True)
class Learning:
    """How to make the kernels of a layer for a net that trains.

    - ``wanted[i]``: whether the gradient of bottom i is needed.
    - ``sums[j]``: the tensor to which the gradient of learnable blob j is added; None if it is not learned.
    - ``steady``: bottoms do not change before the backward kernel has run. Otherwise it must read them again, as
      Caffe's does.

    The two kernels run in turn, without autograd, and BLAS uses one thread. The backward kernel gets None for a top
    without a gradient, but never for all tops. A tensor that a kernel returns is valid until its next call.
    """

    wanted: tuple[bool, ...]
    sums: tuple[Diff, ...] = ()
    steady: bool = True


def finished(kernel: Kernel, finish: Finish | None) -> Kernel:
    """Return a kernel of one top that also applies ``finish`` to it in place."""
    if finish is None:
        return kernel
    change = finish.change

    def both(*bottoms: torch.Tensor) -> torch.Tensor:
        top = kernel(*bottoms)
        return change(top[0] if isinstance(top, tuple) else top)

    return both


def copies(blobs: Sequence[torch.Tensor], how: Inference) -> list[torch.Tensor]:
    """Return copies of a layer's blobs. Kernels of all shapes share them."""
    copy = partial(torch.clone, memory_format=torch.contiguous_format)
    return [how.memo(f"copy {i}", partial(copy, blob)) for i, blob in enumerate(blobs)]


def overwriting(bound: BoundVectors | BoundColumns, how: Inference) -> Kernel:
    """Return the kernel of a layer of one top. Its next run overwrites the memory of the top."""
    how.keeps(bound.nbytes)
    kernel = finished(bound.forward, how.finish)
    return (lambda *bottoms: kernel(*bottoms).clone()) if how.lasts else kernel


def weight_and_bias(layer: Layer, how: Learning) -> tuple[tuple[torch.Tensor, torch.Tensor | None], tuple[Diff, Diff]]:
    """Return blobs 0 and 1, and the tensors to which their gradients are added. Blob 1 may be missing."""
    values = layer.values()
    has_bias = len(values) > 1
    return (values[0], values[1] if has_bias else None), (how.sums[0], how.sums[1] if has_bias else None)


class Room:
    """Memory for a result. ``room.like(x)`` returns memory with the shape and strides of ``x``, always the same."""

    __slots__ = ("_kept",)

    def __init__(self) -> None:
        self._kept: torch.Tensor | None = None

    def like(self, x: torch.Tensor) -> torch.Tensor:
        """Return the memory."""
        if self._kept is None:
            self._kept = torch.empty_like(x)
        return self._kept

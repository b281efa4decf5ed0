"""What kernels are made of: how a layer is run again and again at its present shapes.

A layer has kernels of its own (layers/) where something is faster than its ``forward`` and autograd. Both compute the
same numbers: kernels call the same functions with less work around them, with learned blobs in another form, or with
memory that is kept from run to run, as Caffe's blobs are.
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

Kernel = Callable[..., Any]  # bottoms to a top, or to a tuple of tops


@dataclass(frozen=True)
class Finish:
    """A map from number to number, known by its name; ``change`` does it to its argument in place, and returns it.

    ``operation``: its name and numbers in the kernels of oneDNN, where these compute the same bits, NaN aside.
    """

    name: str
    change: Callable[[torch.Tensor], torch.Tensor] = field(compare=False)
    operation: tuple[str, tuple[float, ...]] | None = None


RELU = Finish("relu", F.relu_, ("relu", ()))


def clip(low: float, high: float) -> Finish:
    """Return the map max(low, min(x, high)), for ``low`` up to ``high``."""
    return Finish(f"clip {low} {high}", lambda x: x.clamp_(low, high), ("hardtanh", (low, high)))


@dataclass(frozen=True)
class Inference:
    """What is known when the kernel of a layer is made for runs without gradients.

    ``finish`` is to be done in place to the top; the first bottom may be overwritten where ``reuse``. What a kernel
    makes of the blobs for all shapes it gets by ``memo(name, make)``, which makes it once; weights may be laid out for
    a kernel where ``pack``. The top may be memory that the next run overwrites, unless it ``lasts``. ``keeps`` is
    called with the bytes of what the kernel keeps for its shapes.

    Only this kernel uses the layer from now on, at these shapes. It may keep the blobs in another form, copied: after a
    write to them it is made again; it may keep no alias of them.
    """

    finish: Finish | None = None
    reuse: bool = False
    lasts: bool = True
    memo: Callable[[str, Callable[[], Any]], Any] = lambda _, make: make()
    pack: bool = True
    keeps: Callable[[int], None] = lambda _: None


@dataclass(frozen=True)
class Learning:
    """What is known when the kernels of a layer are made for a net that learns.

    ``wanted[i]`` says whether bottom i's gradient is asked for; ``sums[j]`` is where that of learnable blob j is added
    up, in the blob's shape, None where it is not learned. Both kernels run without autograd, in turns, and BLAS uses
    one thread. The backward kernel gets None for a top without a gradient, though never for all tops. Tensors that a
    kernel returns are good until its next call. Where the net is ``steady``, bottoms do not change before the backward
    kernel has run; otherwise it reads them again, as Caffe's does.
    """

    wanted: tuple[bool, ...]
    sums: tuple[Diff, ...] = ()
    steady: bool = True


def finished(kernel: Kernel, finish: Finish | None) -> Kernel:
    """Return a kernel of one top followed by what changes it in place."""
    if finish is None:
        return kernel
    change = finish.change

    def both(*bottoms: torch.Tensor) -> torch.Tensor:
        top = kernel(*bottoms)
        return change(top[0] if isinstance(top, tuple) else top)

    return both


def copies(blobs: Sequence[torch.Tensor], how: Inference) -> list[torch.Tensor]:
    """Return copies of a layer's blobs, the same ones for all shapes."""
    copy = partial(torch.clone, memory_format=torch.contiguous_format)
    return [how.memo(f"copy {i}", partial(copy, blob)) for i, blob in enumerate(blobs)]


def overwriting(bound: BoundVectors | BoundColumns, how: Inference) -> Kernel:
    """Return the kernel of a layer of one top, whose memory its next run overwrites."""
    how.keeps(bound.nbytes)
    kernel = finished(bound.forward, how.finish)
    return (lambda *bottoms: kernel(*bottoms).clone()) if how.lasts else kernel


def weight_and_bias(layer: Layer, how: Learning) -> tuple[tuple[torch.Tensor, torch.Tensor | None], tuple[Diff, Diff]]:
    """Return the values of blobs 0 and 1, and where their gradients are added up; blob 1 may be missing."""
    values = layer.values()
    has_bias = len(values) > 1
    return (values[0], values[1] if has_bias else None), (how.sums[0], how.sums[1] if has_bias else None)


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

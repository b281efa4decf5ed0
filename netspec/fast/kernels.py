"""Types and functions that kernels share. A kernel is a function that computes a layer at fixed shapes.

Layers have kernels of their own (layers/) where these are faster than ``forward`` and autograd. They compute the same
numbers, by the same functions: with less overhead, with learned blobs in another layout, or with memory that is kept
from run to run, as Caffe's blobs are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F

from netspec.fast.products import PreparedColumns, PreparedVectors
from netspec.layers.contract.base import Layer
from netspec.run.recorded import Diff

Kernel = Callable[..., Any]  # takes the bottoms; returns the top, or a tuple of tops


@dataclass(frozen=True)
class Activation:
    """An elementwise function. ``apply`` applies it to a tensor in place, and returns the tensor.

    ``operation`` is its name and arguments in oneDNN's kernels, if they compute the same bits (except for NaN).
    """

    name: str
    apply: Callable[[torch.Tensor], torch.Tensor] = field(compare=False)
    operation: tuple[str, tuple[float, ...]] | None = None


RELU = Activation("relu", F.relu_, ("relu", ()))


def clip(low: float, high: float) -> Activation:
    """Return the function max(low, min(x, high)). ``low`` must not exceed ``high``."""
    return Activation(f"clip {low} {high}", lambda x: x.clamp_(low, high), ("hardtanh", (low, high)))


@dataclass(frozen=True)
class Inference:
    """How to make the kernel of a layer for runs without gradients.

    - ``activation``: the kernel must apply it to the top.
    - ``reuse``: the kernel may overwrite the first bottom.
    - ``lasts``: the next run must not overwrite the top.
    - ``memo(name, make)``: returns the result of ``make()``, which must depend on the name and the blobs alone. Other
      kernels of layers with these blobs get the same object, so it must not be written to.
    - ``pack``: weights may be stored in the layout that the kernel prefers.
    - ``keeps``: must be called with the number of bytes that the kernel keeps for its shapes.

    Nothing but the kernel uses the given layer object. The kernel may keep copies of the blobs, because a new kernel is
    made after a write to them. It must not keep tensors that share memory with them.
    """

    activation: Activation | None = None
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

    The forward and the backward kernel run alternately, without autograd, and BLAS uses one thread. The backward kernel
    gets None for a top without a gradient, but never for all tops. A tensor that a kernel returns is valid until the
    next call of that kernel.
    """

    wanted: tuple[bool, ...]
    sums: tuple[Diff, ...] = ()


def with_activation(kernel: Kernel, activation: Activation | None) -> Kernel:
    """Return a kernel of one top that also applies ``activation`` to the top, in place."""
    if activation is None:
        return kernel
    apply = activation.apply

    def both(*bottoms: torch.Tensor) -> torch.Tensor:
        top = kernel(*bottoms)
        return apply(top[0] if isinstance(top, tuple) else top)

    return both


def copies(blobs: Sequence[torch.Tensor], how: Inference) -> list[torch.Tensor]:
    """Return copies of a layer's blobs, which its kernels for all shapes share."""
    copy = partial(torch.clone, memory_format=torch.contiguous_format)
    return [how.memo(f"copy {i}", partial(copy, blob)) for i, blob in enumerate(blobs)]


def product_kernel(product: PreparedVectors | PreparedColumns, how: Inference) -> Kernel:
    """Return the kernel of a layer that computes ``product``.

    The product overwrites its result in the next run, so the top is copied if it must last.
    """
    how.keeps(product.nbytes)
    kernel = with_activation(product.forward, how.activation)
    return (lambda *bottoms: kernel(*bottoms).clone()) if how.lasts else kernel


def weight_and_bias(layer: Layer, how: Learning) -> tuple[tuple[torch.Tensor, torch.Tensor | None], tuple[Diff, Diff]]:
    """Return blobs 0 and 1, and the tensors to which their gradients are added. Blob 1 may be missing."""
    values = layer.values()
    has_bias = len(values) > 1
    return (values[0], values[1] if has_bias else None), (how.sums[0], how.sums[1] if has_bias else None)


class Buffer:
    """A tensor that is allocated once, and then used for the result of each run."""

    __slots__ = ("_kept",)

    def __init__(self) -> None:
        self._kept: torch.Tensor | None = None

    def like(self, x: torch.Tensor) -> torch.Tensor:
        """Return the tensor. The first call allocates it with the shape and strides of ``x``."""
        if self._kept is None:
            self._kept = torch.empty_like(x)
        return self._kept

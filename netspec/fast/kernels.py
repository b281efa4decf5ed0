"""Types and functions that kernels share. A kernel is a function that computes a layer at fixed shapes.

Layers have kernels of their own (layers/) where these are faster than ``forward`` and autograd. They compute the same
numbers, by the same functions: with less overhead, with learned blobs in another layout, or with memory that is kept
from run to run, as Caffe's blobs are.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
import torch.nn.functional as F

from netspec.data.blobs import Shape
from netspec.exact.accumulate import Diff, Operation
from netspec.exact.layout import in_shape
from netspec.layers.contract.base import Layer
from netspec.run.recorded import Kernels

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


def padded(parts: Sequence[Any]) -> tuple[Any, Any]:
    """Return blobs 0 and 1 of a layer, or what belongs to them; None for blob 1 if it is missing."""
    return parts[0], parts[1] if len(parts) > 1 else None


def operation_kernel(operation: Operation, layer: Layer, shape: Shape, how: Inference) -> Kernel:
    """Return the kernel of a layer that applies an operation to its bottom, seen in this shape."""
    top_shape, forward = layer.top_shapes[0], operation.forward
    parameters = [layer.blob(j) for j in range(len(layer.blobs))]  # a detached one would count as an alias

    def kernel(bottom: torch.Tensor) -> torch.Tensor:
        return in_shape(forward(in_shape(bottom, shape), *parameters), top_shape)

    return with_activation(kernel, how.activation)


def operation_kernels(operation: Operation, layer: Layer, shapes: tuple[Shape, Shape], how: Learning) -> Kernels:
    """Return the training kernels of a layer that applies an operation. It sees bottom and top in these ``shapes``."""
    (shape, made_shape), parameters, sums = shapes, padded(layer.values()), padded(how.sums)
    bottom_shape, top_shape, bottom = layer.bottom_shapes[0], layer.top_shapes[0], parameters[0]

    def forward(given: torch.Tensor) -> torch.Tensor:
        nonlocal bottom
        bottom = in_shape(given, shape)
        return in_shape(operation.forward(bottom, *parameters), top_shape)

    def backward(diff: torch.Tensor) -> Diff:
        found = operation.backward(in_shape(diff, made_shape), how.wanted[0], sums, bottom, *parameters)
        return None if found is None else in_shape(found, bottom_shape)

    return Kernels(forward, backward)


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

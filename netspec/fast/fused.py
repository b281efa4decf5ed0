"""Kernels of oneDNN that torch's compiler uses: with weights laid out in advance, and an activation in the same kernel.

They are private operators of torch, so :func:`suits` says whether this version of torch has them. They take and return
maps in channels_last.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
import torch.nn.functional as F

from netspec.exact.products import Filter
from netspec.fast.kernels import Activation, Inference, Kernel, with_activation
from netspec.layers.contract.base import Shape
from netspec.layers.contract.learned import values_of

_NEEDED = ("_convolution_pointwise", "_linear_pointwise", "_convolution_transpose_pointwise")
_LEAST_DIVIDED = 2**20  # numbers of a matrix: a smaller one is not divided among threads
_LEAST_ROWS = 64  # of a part of a divided matrix


def _ops() -> Any:
    return torch.ops.mkldnn


def suits(weight: torch.Tensor) -> bool:
    """Return whether torch has these kernels, for weights like this one."""
    is_usual = weight.device.type == "cpu" and weight.dtype == torch.float32 and weight.numel() > 0
    return is_usual and torch.backends.mkldnn.is_available() and all(hasattr(_ops(), name) for name in _NEEDED)


def convolution(
    shape: Shape, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter, group: int, how: Inference
) -> Kernel:
    """Return a convolution of maps (N, C, H, W) by fixed weights (num_output, C / group, kernel_h, kernel_w)."""
    geometry = [list(sliding.pad), list(sliding.stride), list(sliding.dilation), group]
    weight = _laid_out(_ops()._reorder_convolution_weight, weight, geometry, shape, how)
    bias = _bias_copy(bias, how)
    call, (operation, rest) = _ops()._convolution_pointwise.default, _within(how.activation)
    arguments = (*geometry, *operation, "")

    def kernel(maps: torch.Tensor) -> torch.Tensor:
        return call(maps.contiguous(memory_format=torch.channels_last), weight, bias, *arguments)

    return with_activation(kernel, rest)


def deconvolution(
    shape: Shape, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter, how: Inference
) -> Kernel:
    """Return a transposed convolution of maps (N, C, H, W) by fixed weights (C, num_output, kernel_h, kernel_w).

    The activation is applied separately, because oneDNN uses a slow kernel for a deconvolution with an activation.
    """
    geometry = [list(sliding.pad), [0, 0], list(sliding.stride), list(sliding.dilation), 1]
    call = _ops()._convolution_transpose_pointwise.default
    weight = _laid_out(_ops()._reorder_convolution_transpose_weight, weight, geometry, shape, how)
    bias = _bias_copy(bias, how)

    def kernel(maps: torch.Tensor) -> torch.Tensor:
        return call(maps.contiguous(memory_format=torch.channels_last), weight, bias, *geometry, "none", [], "")

    return with_activation(kernel, how.activation)


def spread_by_channel(
    shape: Shape, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter, how: Inference
) -> Kernel:
    """Return a transposed convolution of each channel of maps (N, C, H, W) by a filter (C, 1, kernel_h, kernel_w).

    oneDNN's own kernel for this is slow. So it is computed as a convolution with mirrored filters, of maps with
    ``stride`` - 1 zeros between the pixels.
    """
    (count, channels, *size), (down, across) = shape, sliding.stride
    spread_shape = (count, channels, (size[0] - 1) * down + 1, (size[1] - 1) * across + 1)
    spread = values_of(weight).new_zeros(spread_shape).contiguous(memory_format=torch.channels_last)
    how.keeps(spread.nbytes)
    pixels = spread[:, :, ::down, ::across]
    axes = zip(sliding.kernel, sliding.dilation, sliding.pad, strict=True)
    mirrored = sliding._replace(stride=(1, 1), pad=tuple(d * (k - 1) - p for k, d, p in axes))
    own_names = replace(how, memo=lambda name, make: how.memo(f"mirrored {name}", make))
    convolve = convolution(spread_shape, values_of(weight).flip(2, 3), bias, mirrored, channels, own_names)

    def kernel(maps: torch.Tensor) -> torch.Tensor:
        pixels.copy_(maps)
        return convolve(spread)

    return kernel


def _bias_copy(bias: torch.Tensor | None, how: Inference) -> torch.Tensor | None:
    return None if bias is None else how.memo("bias", values_of(bias).clone)


def _laid_out(reorder: Any, weight: torch.Tensor, geometry: Sequence[Any], shape: Shape, how: Inference) -> Any:
    """Return filters in the layout that oneDNN prefers for maps of this shape. Other layouts may be ten times as slow.

    If it prefers the same layout for several shapes, their kernels share the memory.
    """
    name = f"{reorder} {tuple(weight.shape)} {geometry}"

    def make() -> torch.Tensor:
        filters = values_of(weight).contiguous(memory_format=torch.channels_last)
        laid_out = reorder(filters, *geometry, list(shape))
        layout = getattr(_ops(), "_get_mkldnn_serialized_md", None)
        return how.memo(f"{name} {layout(laid_out).tolist()}", lambda: laid_out) if layout else laid_out

    return how.memo(f"{name} {shape}", make)


def product(weight: torch.Tensor, bias: torch.Tensor | None, how: Inference) -> Kernel:
    """Return the product of vectors (M, K) with fixed weights (num_output, K)."""
    name = f"rows {tuple(weight.shape)} {weight.stride()}"  # layers may share a weight, one of them transposed
    weight = how.memo(name, lambda: _ops()._reorder_linear_weight(values_of(weight).contiguous()))
    bias = _bias_copy(bias, how)
    call, (operation, rest) = _ops()._linear_pointwise.default, _within(how.activation)
    return with_activation(lambda vectors: call(vectors, weight, bias, *operation, ""), rest)


def vector_product(weight: torch.Tensor, bias: torch.Tensor | None) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return a function that multiplies one vector (1, K) with weights (num_output, K), on several threads.

    Torch uses one thread, which cannot read large weights at the full speed of memory. Here the rows of the weights are
    divided into parts, one or two for each thread. Every part begins at a multiple of four rows, because BLAS sums up
    several rows at a time. In which order it adds is its own choice in either way, as in every product that is not
    exact (netspec/exact).
    """
    count, length = weight.shape

    def kernel(vector: torch.Tensor) -> torch.Tensor:
        threads = torch.get_num_threads()
        parts = min(2 * threads, count // _LEAST_ROWS)
        if threads == 1 or parts < 2:
            return F.linear(vector, weight, bias)
        step = count // (4 * parts) * 4
        # The last part has more rows. All parts compute as many, and the others' surplus is dropped.
        rows_of_last = count - (parts - 1) * step
        rows = weight.as_strided((parts, length, rows_of_last), (step * length, 1, length))
        found = torch.bmm(vector.expand(parts, 1, length), rows)[:, 0]
        top = torch.cat([found[:-1, :step].reshape(-1), found[-1]]).view(1, count)
        return top if bias is None else top.add_(bias)

    by_mkl = torch.backends.mkl.is_available() and suits(weight) and weight.is_contiguous()
    if by_mkl and weight.numel() >= _LEAST_DIVIDED:
        return kernel
    return lambda vector: F.linear(vector, weight, bias)


def _within(activation: Activation | None) -> tuple[tuple[str, list[float]], Activation | None]:
    """Return the activation that oneDNN's kernel applies itself, and one that must be applied after it, if any."""
    if activation is None or activation.operation is None:
        return ("none", []), activation
    name, numbers = activation.operation
    return (name, list(numbers)), None

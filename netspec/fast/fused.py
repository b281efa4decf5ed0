"""Kernels of oneDNN that torch's compiler uses: weights laid out in advance, an activation in the same pass.

They take and return maps in channels_last. Where torch does not have them, the usual functions are used.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F

from netspec.exact.products import Filter
from netspec.fast.kernels import Finish, Inference, Kernel, finished
from netspec.layers.contract.base import Shape
from netspec.layers.contract.learned import values_of

_NEEDED = ("_convolution_pointwise", "_linear_pointwise", "_convolution_transpose_pointwise")
_DIVIDED, _ROWS = 2**20, 64  # the least size of a matrix that is divided among threads, and the least rows of a part


def _ops() -> Any:
    return torch.ops.mkldnn


def suits(weight: torch.Tensor) -> bool:
    """Return whether oneDNN's kernels take these weights."""
    here = weight.device.type == "cpu" and weight.dtype == torch.float32 and weight.numel() > 0
    return here and torch.backends.mkldnn.is_available() and all(hasattr(_ops(), name) for name in _NEEDED)


def convolution(
    shape: Shape, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter, group: int, how: Inference
) -> Kernel:
    """Return a convolution of maps (N, C, H, W) by fixed weights (num_output, C / group, kernel_h, kernel_w)."""
    geometry = [list(sliding.pad), list(sliding.stride), list(sliding.dilation), group]
    weight = _laid_out(_ops()._reorder_convolution_weight, weight, geometry, shape, how)
    bias = _kept(bias, how)
    call, (operation, rest) = _ops()._convolution_pointwise.default, _within(how.finish)
    arguments = (*geometry, *operation, "")

    def kernel(maps: torch.Tensor) -> torch.Tensor:
        return call(maps.contiguous(memory_format=torch.channels_last), weight, bias, *arguments)

    return finished(kernel, rest)


def deconvolution(
    shape: Shape, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter, how: Inference
) -> Kernel:
    """Return a transposed convolution of maps (N, C, H, W) by fixed weights (C, num_output, kernel_h, kernel_w).

    An activation is a separate pass here, because with one oneDNN falls back to a slow kernel.
    """
    geometry = [list(sliding.pad), [0, 0], list(sliding.stride), list(sliding.dilation), 1]
    call = _ops()._convolution_transpose_pointwise.default
    weight = _laid_out(_ops()._reorder_convolution_transpose_weight, weight, geometry, shape, how)
    bias = _kept(bias, how)

    def kernel(maps: torch.Tensor) -> torch.Tensor:
        return call(maps.contiguous(memory_format=torch.channels_last), weight, bias, *geometry, "none", [], "")

    return finished(kernel, how.finish)


def spread_by_channel(
    shape: Shape, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter, how: Inference
) -> Kernel:
    """Return a transposed convolution by weights (C, 1, kernel_h, kernel_w), each channel of (N, C, H, W) by itself.

    oneDNN's own kernel is slow. A convolution with mirrored filters, on maps with ``stride`` - 1 zeros between the
    pixels, computes the same.
    """
    (count, channels, *size), (down, across) = shape, sliding.stride
    framed = (count, channels, (size[0] - 1) * down + 1, (size[1] - 1) * across + 1)
    zeros = partial(values_of(weight).new_zeros, framed)
    frame = how.memo(f"frame {framed}", lambda: zeros().contiguous(memory_format=torch.channels_last))
    pixels = frame[:, :, ::down, ::across]
    axes = zip(sliding.kernel, sliding.dilation, sliding.pad, strict=True)
    turned = replace(sliding, stride=(1, 1), pad=tuple(d * (k - 1) - p for k, d, p in axes))
    under_own_key = replace(how, memo=lambda name, make: how.memo(f"turned {name}", make))
    convolve = convolution(framed, values_of(weight).flip(2, 3), bias, turned, channels, under_own_key)

    def kernel(maps: torch.Tensor) -> torch.Tensor:
        pixels.copy_(maps)
        return convolve(frame)

    return kernel


def _kept(bias: torch.Tensor | None, how: Inference) -> torch.Tensor | None:
    return None if bias is None else how.memo("bias", values_of(bias).clone)


def _laid_out(reorder: Any, weight: torch.Tensor, geometry: Sequence[Any], shape: Shape, how: Inference) -> Any:
    """Return filters in the layout that oneDNN prefers for maps of this shape. Others may be ten times as slow.

    Shapes that prefer the same layout share the memory.
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
    name = f"rows {tuple(weight.shape)} {weight.stride()}"  # a layer may use the transpose of another's
    weight = how.memo(name, lambda: _ops()._reorder_linear_weight(values_of(weight).contiguous()))
    bias = _kept(bias, how)
    call, (operation, rest) = _ops()._linear_pointwise.default, _within(how.finish)
    return finished(lambda vectors: call(vectors, weight, bias, *operation, ""), rest)


def vector_product(weight: torch.Tensor, bias: torch.Tensor | None) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return a function that multiplies one vector (1, K) with weights (num_output, K), on several threads.

    Torch uses one thread, which cannot read large weights at the full speed of memory. MKL sums up four rows at a time,
    so parts that begin at multiples of four give the same bits as the whole. The function checks this first.
    """
    count, length = weight.shape
    same_bits: dict[int, bool] = {}  # by number of parts

    def divided(vector: torch.Tensor, parts: int) -> torch.Tensor:
        step = count // (4 * parts) * 4
        most = (
            count - (parts - 1) * step
        )  # rows of the last part; all parts compute as many, and the surplus is dropped
        rows = weight.as_strided((parts, length, most), (step * length, 1, length))
        found = torch.bmm(vector.expand(parts, 1, length), rows)[:, 0]
        top = torch.cat([found[:-1, :step].reshape(-1), found[-1]]).view(1, count)
        return top if bias is None else top.add_(bias)

    def kernel(vector: torch.Tensor) -> torch.Tensor:
        threads = torch.get_num_threads()
        parts = min(2 * threads, count // _ROWS) if threads > 1 else 1
        if parts > 1 and parts not in same_bits:
            probe = torch.linspace(-1, 1, length).view(1, length)
            same_bits[parts] = torch.equal(divided(probe, parts), F.linear(probe, weight, bias))
        return divided(vector, parts) if same_bits.get(parts) else F.linear(vector, weight, bias)

    by_mkl = torch.backends.mkl.is_available() and suits(weight) and weight.is_contiguous()
    return kernel if by_mkl and weight.numel() >= _DIVIDED else lambda vector: F.linear(vector, weight, bias)


def _within(finish: Finish | None) -> tuple[tuple[str, list[float]], Finish | None]:
    """Return the operation that oneDNN's kernel applies itself, and what must be applied after it."""
    if finish is None or finish.operation is None:
        return ("none", []), finish
    name, numbers = finish.operation
    return (name, list(numbers)), None

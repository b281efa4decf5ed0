"""What layers sum up, in Caffe's order and so to the last bit; see netspec/exact/blas.py."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from netspec.exact.blas import add_sums, adds_to_grad, gemm, one_thread, root, suits_blas

Geometry = tuple[Sequence[int], Sequence[int], Sequence[int]]

# Up to so many multiply-adds an image; beyond, torch's own kernels are faster.
MOST_WORK = 500_000
# What the passes over memory of BatchNorm, Scale or a softmax cost for each value, in multiply-adds.
PASSES = 250


def in_caffes_order(bottom: torch.Tensor, weight: torch.Tensor, multiply_adds: int) -> bool:
    """Return whether a product with ``multiply_adds`` an image is one for the classes of this module.

    They call into numpy, which tools that record a net's operations cannot follow, and BLAS refuses empty matrices.
    """
    if torch.compiler.is_compiling() or torch.jit.is_tracing() or not bottom.numel():
        return False
    return multiply_adds <= MOST_WORK and suits_blas(bottom) and bottom.dtype == weight.dtype


class _Product(torch.autograd.Function):
    """Base: the place where the gradients of weight and bias are summed up."""

    @staticmethod
    def keep(ctx: Any, bottom: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None) -> None:
        ctx.save_for_backward(bottom, weight, bias)
        ctx.adds = [tensor is not None and adds_to_grad(tensor) for tensor in (weight, bias)]

    @staticmethod
    def sums(ctx: Any) -> list[torch.Tensor | None]:
        """Return where to add the gradients of the weight and of the bias; None where one is not asked for."""
        found: list[torch.Tensor | None] = []
        for parameter, asked, adds in zip(ctx.saved_tensors[1:], ctx.needs_input_grad[1:3], ctx.adds, strict=True):
            if not asked:
                found.append(None)
            elif not adds:
                found.append(torch.zeros_like(parameter, memory_format=torch.contiguous_format))
            else:
                if parameter.grad is None:
                    parameter.grad = torch.zeros_like(parameter)
                found.append(parameter.grad)
        return found

    @staticmethod
    def gradients(ctx: Any, *sums: torch.Tensor | None) -> list[torch.Tensor | None]:
        """Return what autograd is to add: nothing where it was added already."""
        return [None if added else total for added, total in zip(ctx.adds, sums, strict=True)]


class ColumnProducts(_Product):
    """Cross-correlate maps with filters: the pixels under the filter as columns, times the filters, image by image.

    maps      (N, C, H, W)
    weight    (num_output, C, kernel_h, kernel_w)
    bias      (num_output,) or None
    geometry  stride, pad and dilation, each (vertical, horizontal)
    returns   (N, num_output, H', W')

    Caffe: src/caffe/layers/base_conv_layer.cpp, src/caffe/util/im2col.cpp
    """

    @staticmethod
    def forward(
        ctx: Any, maps: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, geometry: Geometry
    ) -> torch.Tensor:
        """Return the responses; keep the maps, not their columns, which are larger by the filter's pixels."""
        _Product.keep(ctx, maps, weight, bias)
        ctx.geometry = geometry
        filters = weight.flatten(1)
        axes = zip(maps.shape[2:], weight.shape[2:], *geometry, strict=True)
        spatial = [(size + 2 * p - d * (k - 1) - 1) // s + 1 for size, k, s, p, d in axes]
        tops = maps.new_empty(len(maps), len(weight), *spatial)
        with one_thread():
            for image, top in zip(maps, tops.flatten(2), strict=True):
                gemm(filters, _columns(image, weight.shape[2:], geometry), top)
        return tops if bias is None else tops.add_(bias[:, None, None])

    @staticmethod
    @once_differentiable
    @one_thread()
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        """Return the gradients of maps, weight and bias, where they are asked for."""
        maps, weight, _ = ctx.saved_tensors
        weight_diff, bias_diff = _Product.sums(ctx)
        filters, kernel = weight.flatten(1), weight.shape[2:]
        stride, pad, dilation = ctx.geometry
        maps_diff = torch.empty_like(maps) if ctx.needs_input_grad[0] else None
        columns_diff = None
        for n, diff in enumerate(tops_diff.contiguous().flatten(2)):
            if bias_diff is not None:
                add_sums(diff, bias_diff, axis=1)
            if weight_diff is not None:
                gemm(diff, _columns(maps[n], kernel, ctx.geometry), weight_diff.flatten(1), b_t=True, add=True)
            if maps_diff is not None:
                if columns_diff is None:
                    columns_diff = diff.new_empty(filters.shape[1], diff.shape[1])
                gemm(filters, diff, columns_diff, a_t=True)
                maps_diff[n] = F.fold(columns_diff, maps.shape[2:], kernel, dilation, pad, stride)
        return maps_diff, *_Product.gradients(ctx, weight_diff, bias_diff), None


def _columns(image: torch.Tensor, kernel: Sequence[int], geometry: Geometry) -> torch.Tensor:
    """Return (C kernel_h kernel_w, H' W'): a column for each position of the filter, the pixels under it."""
    stride, pad, dilation = geometry
    windows = F.pad(image, (pad[1], pad[1], pad[0], pad[0])) if any(pad) else image
    for axis in (0, 1):
        extent = dilation[axis] * (kernel[axis] - 1) + 1
        windows = windows.unfold(1 + axis, extent, stride[axis])[..., :: dilation[axis]]
    columns = windows.permute(0, 3, 4, 1, 2).reshape(len(image) * kernel[0] * kernel[1], -1)
    return columns.contiguous()


class VectorProducts(_Product):
    """Multiply vectors by a matrix.

    vectors  (M, K)
    weight   (num_output, K), or (K, num_output) where ``transposed``
    bias     (num_output,) or None
    returns  (M, num_output)

    Caffe: src/caffe/layers/inner_product_layer.cpp
    """

    @staticmethod
    def forward(
        ctx: Any, vectors: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, transposed: bool
    ) -> torch.Tensor:
        """Return the products."""
        vectors = vectors.contiguous()
        _Product.keep(ctx, vectors, weight, bias)
        ctx.transposed = transposed
        tops = vectors.new_empty(len(vectors), weight.shape[1 if transposed else 0])
        with one_thread():
            gemm(vectors, weight.contiguous(), tops, b_t=not transposed)
        return tops if bias is None else tops.add_(bias)

    @staticmethod
    @once_differentiable
    @one_thread()
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        """Return the gradients of vectors, weight and bias, where they are asked for."""
        vectors, weight, _ = ctx.saved_tensors
        weight_diff, bias_diff = _Product.sums(ctx)
        tops_diff = tops_diff.contiguous()
        if weight_diff is not None:
            factors = (vectors, tops_diff) if ctx.transposed else (tops_diff, vectors)
            gemm(*factors, weight_diff, a_t=True, add=True)
        if bias_diff is not None:
            add_sums(tops_diff, bias_diff, axis=0)
        vectors_diff = None
        if ctx.needs_input_grad[0]:
            vectors_diff = torch.empty_like(vectors)
            gemm(tops_diff, weight.contiguous(), vectors_diff, b_t=ctx.transposed)
        return vectors_diff, *_Product.gradients(ctx, weight_diff, bias_diff), None


class ChannelProducts(_Product):
    """Multiply each channel by a factor and add a bias.

    maps     (N, C, ...)
    factors  (C,)
    bias     (C,) or None
    returns  (N, C, ...)

    Caffe: src/caffe/layers/scale_layer.cpp, bias_layer.cpp
    """

    @staticmethod
    def forward(ctx: Any, maps: torch.Tensor, factors: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
        """Return the products, and the bias added."""
        _Product.keep(ctx, maps, factors, bias)
        tops = _by_channel(maps) * factors[:, None]
        return (tops if bias is None else tops.add_(bias[:, None])).view(maps.shape)

    @staticmethod
    @once_differentiable
    @one_thread()
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        """Return the gradients of maps, factors and bias, where they are asked for."""
        maps, factors, _ = ctx.saved_tensors
        factors_diff, bias_diff = _Product.sums(ctx)
        diff = _by_channel(tops_diff)
        if bias_diff is not None:
            for image in diff:
                add_sums(image, bias_diff, axis=1)
        if factors_diff is not None:
            factors_diff += _channel_sums(_by_channel(maps) * diff)
        maps_diff = (diff * factors[:, None]).view(maps.shape) if ctx.needs_input_grad[0] else None
        return maps_diff, *_Product.gradients(ctx, factors_diff, bias_diff)


class BatchNormalization(torch.autograd.Function):
    """Subtract each channel's mean over the batch, and divide by the root of its variance + eps.

    maps     (N, C, ...)
    returns  (N, C, ...), the means (C,) and the biased variances (C,)

    Caffe: src/caffe/layers/batch_norm_layer.cpp
    """

    @staticmethod
    @one_thread()
    def forward(ctx: Any, maps: torch.Tensor, eps: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the normalised maps and what they were normalised by."""
        values = _by_channel(maps)
        count = values.numel() // values.shape[1]
        mean = _channel_sums(values, 1 / count)
        centred = values - mean[:, None]
        variance = _channel_sums(centred * centred, 1 / count)
        deviation = root(variance + eps)
        tops = centred / deviation[:, None]
        ctx.save_for_backward(tops, deviation)
        ctx.mark_non_differentiable(mean, variance)
        return tops.view(maps.shape), mean, variance

    @staticmethod
    @once_differentiable
    @one_thread()
    def backward(ctx: Any, tops_diff: torch.Tensor, *_: Any) -> tuple[torch.Tensor, None]:
        """Return the gradient of the maps: (d - mean(d) - mean(d y) y) / deviation, for the gradient d of y."""
        tops, deviation = ctx.saved_tensors
        diff = _by_channel(tops_diff)
        count = diff.numel() // diff.shape[1]
        sums = tops * _channel_sums(tops * diff)[:, None] + _channel_sums(diff)[:, None]
        return (diff + sums * (-1 / count)).div_(deviation[:, None]).view(tops_diff.shape), None


def _by_channel(maps: torch.Tensor) -> torch.Tensor:
    """Return maps (N, C, ...) as (N, C, pixels), without gaps."""
    return maps.contiguous().view(*maps.shape[:2], -1)


def _channel_sums(values: torch.Tensor, factor: float = 1.0) -> torch.Tensor:
    """Return the sums (C,) of values (N, C, pixels): of each map, times a factor, then over the images."""
    of_maps, sums = values.new_zeros(values.shape[:2]), values.new_zeros(values.shape[1])
    add_sums(values.flatten(0, 1), of_maps.view(-1), axis=1, factor=factor)
    add_sums(of_maps, sums, axis=0)
    return sums

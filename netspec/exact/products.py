"""Matrix products with learned weights: Convolution, Deconvolution, InnerProduct, Embed."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable
from torch.nn import functional as F
from typing_extensions import override

from netspec.exact.accumulate import ParameterSums
from netspec.exact.blas import Values, add_sums, array, gemm, gemm_routine, one_thread

Axes = tuple[int, ...]


@dataclass(frozen=True)
class Filter:
    """How a filter slides over a map: one number for each spatial axis.

    Caffe: src/caffe/util/im2col.cpp
    """

    kernel: Axes
    stride: Axes
    pad: Axes
    dilation: Axes

    def fits(self, size: Axes) -> list[int]:
        """Return how often the filter fits along each axis of a map of this size."""
        axes = zip(size, self.kernel, self.stride, self.pad, self.dilation, strict=True)
        return [(n + 2 * p - d * (k - 1) - 1) // s + 1 for n, k, s, p, d in axes]

    def columns(self, image: torch.Tensor) -> torch.Tensor:
        """Return (C kernel, positions): a column for each position of the filter, the pixels under it (im2col)."""
        axes = len(self.kernel)
        windows = F.pad(image, [p for pad in reversed(self.pad) for p in (pad, pad)]) if any(self.pad) else image
        for axis in range(axes):
            extent = self.dilation[axis] * (self.kernel[axis] - 1) + 1
            windows = windows.unfold(1 + axis, extent, self.stride[axis])[..., :: self.dilation[axis]]
        columns = windows.permute(0, *range(1 + axes, 1 + 2 * axes), *range(1, 1 + axes))
        return columns.reshape(len(image) * math.prod(self.kernel), -1).contiguous()

    def spread(self, columns: torch.Tensor, size: Axes) -> torch.Tensor:
        """Return the map (C, size) to which every column adds its pixels, one pixel of the filter at a time (col2im).

        Torch's own col2im adds in the same order; it is for two axes.
        """
        if len(size) == 2:
            return F.fold(columns, size, self.kernel, self.dilation, self.pad, self.stride)
        channels, positions = len(columns) // math.prod(self.kernel), self.fits(size)
        pixels = columns.view(channels, *self.kernel, *positions)
        framed = columns.new_zeros(channels, *(n + 2 * p for n, p in zip(size, self.pad, strict=True)))
        for pixel in product(*map(range, self.kernel)):
            axes = zip(pixel, self.dilation, self.stride, positions, strict=True)
            under = tuple(slice(k * d, k * d + s * (count - 1) + 1, s) for k, d, s, count in axes)
            framed[(slice(None), *under)] += pixels[(slice(None), *pixel)]
        return framed[(slice(None), *(slice(p, p + n) for n, p in zip(size, self.pad, strict=True)))]


def _gemm_by_group(a: Values, b: Values, c: Values, group: int, **how: bool) -> None:
    """Multiply matrices group by group; the rows of each are those of one group after the other."""
    if group == 1:
        gemm(a, b, c, **how)
        return
    parts = [array(m).reshape(group, len(m) // group, -1) for m in (a, b, c)]
    for k in range(group):
        gemm(*[part[k] for part in parts], **how)


class ColumnProducts(ParameterSums):
    """Cross-correlate maps with filters: the filters, times the pixels under the filter as columns, image by image.

    maps     (N, C, ...)
    weight   (num_output, C / group, kernel)
    bias     (num_output,) or None
    returns  (N, num_output, ...)

    Caffe: src/caffe/layers/base_conv_layer.cpp, conv_layer.cpp
    """

    @staticmethod
    @override
    def forward(
        ctx: Any,
        maps: torch.Tensor,
        weight: torch.Tensor,
        bias: torch.Tensor | None,
        sliding: Filter,
        group: int,
        in_place: bool,
    ) -> torch.Tensor:
        """Return the responses; keep the maps, not their columns, which are larger by the filter's pixels."""
        ParameterSums.keep(ctx, maps, (weight, bias), in_place)
        ctx.sliding, ctx.group = sliding, group
        filters = array(weight.flatten(1))
        tops = maps.new_empty(len(maps), len(weight), *sliding.fits(maps.shape[2:]))
        with one_thread():
            for image, top in zip(maps, array(tops.flatten(2)), strict=True):
                _gemm_by_group(filters, sliding.columns(image), top, group)
        return tops if bias is None else tops.add_(_by_channel(bias, tops))

    @staticmethod
    @once_differentiable
    @one_thread()
    @override
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        """Return the gradients of maps, weight and bias, where they are asked for."""
        maps, weight, _ = ctx.saved_tensors
        weight_sums, bias_sums = sums = ParameterSums.sums(ctx)
        filters, diffs = array(weight.flatten(1)), array(tops_diff.contiguous().flatten(2))
        of_filters = None if weight_sums is None else array(weight_sums.flatten(1))
        maps_diff = torch.empty_like(maps) if ctx.needs_input_grad[0] else None
        columns_diff = maps.new_empty(ctx.group * filters.shape[1], diffs.shape[2])
        for n, diff in enumerate(diffs):
            if bias_sums is not None:
                add_sums(diff, bias_sums, axis=1)
            if of_filters is not None:
                _gemm_by_group(diff, ctx.sliding.columns(maps[n]), of_filters, ctx.group, b_t=True, add=True)
            if maps_diff is not None:
                _gemm_by_group(filters, diff, columns_diff, ctx.group, a_t=True)
                maps_diff[n] = ctx.sliding.spread(columns_diff, maps.shape[2:])
        return maps_diff, *ParameterSums.for_autograd(ctx, sums), None, None, None


def prepared_columns(
    shape: Axes, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return what :class:`ColumnProducts` computes for maps (N, C, H, W) of one shape, without gradients.

    It works in memory of its own, on copies of the weights, and expects that BLAS uses one thread.
    """
    count, fits, outputs = shape[0], sliding.fits(shape[2:]), len(weight)
    filters = weight.detach().flatten(1).clone().numpy().T
    bias = None if bias is None else bias.detach().clone().view(-1, 1)
    lay_out = _columns_of_shape(shape, weight.dtype, sliding, fits)
    top_shape, rows = (count, outputs, *fits), (count, outputs, fits[0] * fits[1])
    multiply, dtype = gemm_routine(filters), weight.dtype

    def run(maps: torch.Tensor) -> torch.Tensor:
        tops = torch.empty(rows, dtype=dtype)
        for image, top in zip(lay_out(maps), tops.numpy(), strict=True):
            multiply(1.0, image.T, filters, 0.0, top.T, 0, 0, 1)
        if bias is not None:
            tops.add_(bias)
        return tops.view(top_shape)

    return run


def _columns_of_shape(
    shape: Axes, dtype: torch.dtype, sliding: Filter, fits: Sequence[int]
) -> Callable[[torch.Tensor], np.ndarray]:
    """Return what :meth:`Filter.columns` gives for all maps of one shape: (N, C kernel, positions), in fixed memory."""
    (count, channels, *size), (kernel, stride, dilation) = shape, (sliding.kernel, sliding.stride, sliding.dilation)
    flat = (count, channels * math.prod(kernel), math.prod(fits))
    each_pixel_once = math.prod(kernel) * flat[2] == math.prod(size)
    if not any(sliding.pad) and each_pixel_once and (math.prod(kernel) == 1 or flat[2] == 1):
        return lambda maps: maps.contiguous().numpy().reshape(flat)
    frame = None
    if any(sliding.pad):
        frame = torch.zeros(
            (count, channels, *(n + 2 * p for n, p in zip(size, sliding.pad, strict=True))), dtype=dtype
        )
        inner = frame[:, :, sliding.pad[0] : sliding.pad[0] + size[0], sliding.pad[1] : sliding.pad[1] + size[1]]
        size = list(frame.shape[2:])
    area = size[0] * size[1]
    strides = (channels * area, area, dilation[0] * size[1], dilation[1], stride[0] * size[1], stride[1])
    columns = torch.empty((count, channels, *kernel, *fits), dtype=dtype)
    layout, found = columns.shape, columns.view(flat).numpy()

    def lay_out(maps: torch.Tensor) -> np.ndarray:
        if frame is not None:
            inner.copy_(maps)
            maps = frame
        columns.copy_(maps.contiguous().as_strided(layout, strides))
        return found

    return lay_out


class SpreadProducts(ParameterSums):
    """Spread each pixel by filters: what is a convolution's backward pass, run forward.

    maps     (N, C, ...)
    weight   (C, num_output / group, kernel)
    bias     (num_output,) or None
    size     of the tops, (...)
    returns  (N, num_output, ...)

    Caffe: src/caffe/layers/base_conv_layer.cpp, deconv_layer.cpp
    """

    @staticmethod
    @override
    def forward(
        ctx: Any,
        maps: torch.Tensor,
        weight: torch.Tensor,
        bias: torch.Tensor | None,
        sliding: Filter,
        group: int,
        in_place: bool,
        size: Axes,
    ) -> torch.Tensor:
        maps = maps.contiguous()
        ParameterSums.keep(ctx, maps, (weight, bias), in_place)
        ctx.sliding, ctx.group = sliding, group
        filters, values = array(weight.flatten(1)), array(maps.flatten(2))
        tops = maps.new_empty(len(maps), weight.shape[1] * group, *size)
        columns = maps.new_empty(group * filters.shape[1], values.shape[2])
        with one_thread():
            for image, top in zip(values, tops, strict=True):
                _gemm_by_group(filters, image, columns, group, a_t=True)
                top.copy_(sliding.spread(columns, size))
        return tops if bias is None else tops.add_(_by_channel(bias, tops))

    @staticmethod
    @once_differentiable
    @one_thread()
    @override
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        """Return the gradients of maps, weight and bias, where they are asked for."""
        maps, weight, _ = ctx.saved_tensors
        weight_sums, bias_sums = sums = ParameterSums.sums(ctx)
        filters, values = array(weight.flatten(1)), array(maps.flatten(2))
        of_filters = None if weight_sums is None else array(weight_sums.flatten(1))
        maps_diff = torch.empty_like(maps) if ctx.needs_input_grad[0] else None
        for n, diff in enumerate(tops_diff.contiguous()):
            if bias_sums is not None:
                add_sums(diff.flatten(1), bias_sums, axis=1)
            columns = ctx.sliding.columns(diff)
            if of_filters is not None:
                _gemm_by_group(values[n], columns, of_filters, ctx.group, b_t=True, add=True)
            if maps_diff is not None:
                _gemm_by_group(filters, columns, maps_diff[n].flatten(1), ctx.group)
        return maps_diff, *ParameterSums.for_autograd(ctx, sums), None, None, None, None


class Columns(torch.autograd.Function):
    """Lay the pixels under each position of a filter one below the other.

    maps     (N, C, ...)
    returns  (N, C kernel, positions)

    Caffe: src/caffe/layers/im2col_layer.cpp
    """

    @staticmethod
    @override
    def forward(ctx: Any, maps: torch.Tensor, sliding: Filter) -> torch.Tensor:
        ctx.sliding, ctx.size = sliding, maps.shape[2:]
        return torch.stack([sliding.columns(image) for image in maps])

    @staticmethod
    @once_differentiable
    @override
    def backward(ctx: Any, diff: torch.Tensor) -> tuple[torch.Tensor, None]:
        return torch.stack([ctx.sliding.spread(columns, ctx.size) for columns in diff.contiguous()]), None


def _by_channel(bias: torch.Tensor, tops: torch.Tensor) -> torch.Tensor:
    return bias.view(-1, *(1,) * (tops.dim() - 2))


class VectorProducts(ParameterSums):
    """Multiply vectors by a matrix.

    vectors  (M, K)
    weight   (num_output, K), or (K, num_output) where ``transposed``
    bias     (num_output,) or None
    returns  (M, num_output)

    Caffe: src/caffe/layers/inner_product_layer.cpp
    """

    @staticmethod
    @override
    def forward(
        ctx: Any,
        vectors: torch.Tensor,
        weight: torch.Tensor,
        bias: torch.Tensor | None,
        transposed: bool,
        in_place: bool,
    ) -> torch.Tensor:
        vectors = vectors.contiguous()
        ParameterSums.keep(ctx, vectors, (weight, bias), in_place)
        ctx.transposed = transposed
        tops = vectors.new_empty(len(vectors), weight.shape[1 if transposed else 0])
        with one_thread():
            gemm(vectors, weight.contiguous(), tops, b_t=not transposed)
        return tops if bias is None else tops.add_(bias)

    @staticmethod
    @once_differentiable
    @one_thread()
    @override
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        """Return the gradients of vectors, weight and bias, where they are asked for."""
        vectors, weight, _ = ctx.saved_tensors
        weight_sums, bias_sums = sums = ParameterSums.sums(ctx)
        tops_diff = tops_diff.contiguous()
        if weight_sums is not None:
            factors = (vectors, tops_diff) if ctx.transposed else (tops_diff, vectors)
            gemm(*factors, weight_sums, a_t=True, add=True)
        if bias_sums is not None:
            add_sums(tops_diff, bias_sums, axis=0)
        vectors_diff = None
        if ctx.needs_input_grad[0]:
            vectors_diff = torch.empty_like(vectors)
            gemm(tops_diff, weight.contiguous(), vectors_diff, b_t=ctx.transposed)
        return vectors_diff, *ParameterSums.for_autograd(ctx, sums), None, None


def prepared_vectors(
    rows: int, weight: torch.Tensor, bias: torch.Tensor | None, transposed: bool
) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return what :class:`VectorProducts` computes for vectors (rows, K), without gradients.

    It works on copies of the weights, and expects that BLAS uses one thread.
    """
    matrix = weight.detach().clone(memory_format=torch.contiguous_format).numpy().T
    bias = None if bias is None else bias.detach().clone()
    outputs = weight.shape[1 if transposed else 0]
    multiply, trans = gemm_routine(matrix), int(not transposed)

    def kernel(vectors: torch.Tensor) -> torch.Tensor:
        tops = vectors.new_empty(rows, outputs)
        multiply(1.0, matrix, vectors.contiguous().numpy().T, 0.0, tops.numpy().T, trans, 0, 1)
        return tops if bias is None else tops.add_(bias)

    return kernel


class ChosenRows(ParameterSums):
    """Look up rows.

    index    (M,), whole numbers
    rows     (input_dim, num_output)
    bias     (num_output,) or None
    returns  (M, num_output)

    Caffe: src/caffe/layers/embed_layer.cpp
    """

    @staticmethod
    @override
    def forward(
        ctx: Any, index: torch.Tensor, rows: torch.Tensor, bias: torch.Tensor | None, in_place: bool
    ) -> torch.Tensor:
        ParameterSums.keep(ctx, index, (rows, bias), in_place)
        tops = rows[index]
        return tops if bias is None else tops.add_(bias)

    @staticmethod
    @once_differentiable
    @one_thread()
    @override
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        """Return the gradients of rows and bias, where they are asked for."""
        rows_sums, bias_sums = sums = ParameterSums.sums(ctx)
        tops_diff = tops_diff.contiguous()
        if rows_sums is not None:
            rows_sums.index_add_(0, ctx.saved_tensors[0], tops_diff)  # one after the other
        if bias_sums is not None:
            add_sums(tops_diff, bias_sums, axis=0)
        return None, *ParameterSums.for_autograd(ctx, sums), None

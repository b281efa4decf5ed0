"""Matrix products with learned filters: Convolution, Deconvolution."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Any

import torch
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from netspec.exact.accumulate import ParameterSums
from netspec.exact.blas import add_sums, gemm, one_thread
from netspec.exact.layout import by_channel

Axes = tuple[int, ...]
COLUMNS = 2**20  # numbers (4 MB): the columns of several images, which fit into a CPU's cache


@dataclass(frozen=True)
class Filter:
    """The geometry of a filter: one number for each spatial axis.

    Caffe: src/caffe/util/im2col.cpp
    """

    kernel: Axes
    stride: Axes
    pad: Axes
    dilation: Axes

    @property
    def extent(self) -> Axes:
        """The pixels that the dilated filter spans."""
        return tuple(d * (k - 1) + 1 for k, d in zip(self.kernel, self.dilation, strict=True))

    @property
    def reads_padding_alone(self) -> bool:
        """Whether it fits between the edge of the padding and the map: oneDNN may then read beyond the map."""
        return any(p >= e for p, e in zip(self.pad, self.extent, strict=True))

    def fits(self, size: Axes) -> list[int]:
        """Return how often the filter fits along each axis of a map of this size."""
        axes = zip(size, self.kernel, self.stride, self.pad, self.dilation, strict=True)
        return [(n + 2 * p - d * (k - 1) - 1) // s + 1 for n, k, s, p, d in axes]

    def columns(self, maps: torch.Tensor) -> torch.Tensor:
        """Return the pixels under each position of the filter as a column (im2col): (N, C kernel, positions)."""
        axes = len(self.kernel)
        windows = F.pad(maps, [p for pad in reversed(self.pad) for p in (pad, pad)]) if any(self.pad) else maps
        for axis in range(axes):
            extent = self.dilation[axis] * (self.kernel[axis] - 1) + 1
            windows = windows.unfold(2 + axis, extent, self.stride[axis])[..., :: self.dilation[axis]]
        columns = windows.permute(0, 1, *range(2 + axes, 2 + 2 * axes), *range(2, 2 + axes))
        pixels, positions = math.prod(self.kernel), math.prod(self.fits(maps.shape[2:]))
        return columns.reshape(len(maps), maps.shape[1] * pixels, positions).contiguous()

    def spread(self, columns: torch.Tensor, size: Axes) -> torch.Tensor:
        """Add columns up to maps (N, C, size), one pixel of the filter at a time (col2im).

        For two axes, torch's col2im adds in the same order.
        """
        if len(size) == 2:
            return F.fold(columns, size, self.kernel, self.dilation, self.pad, self.stride)
        count, positions = len(columns), self.fits(size)
        pixels = columns.view(count, -1, *self.kernel, *positions)
        padded = columns.new_zeros(count, pixels.shape[1], *(n + 2 * p for n, p in zip(size, self.pad, strict=True)))
        every = (slice(None), slice(None))
        for pixel in product(*map(range, self.kernel)):
            axes = zip(pixel, self.dilation, self.stride, positions, strict=True)
            under = tuple(slice(k * d, k * d + s * (count - 1) + 1, s) for k, d, s, count in axes)
            padded[(*every, *under)] += pixels[(*every, *pixel)]
        return padded[(*every, *(slice(p, p + n) for n, p in zip(size, self.pad, strict=True)))]

    def images_at_once(self, channels: int, size: Axes) -> int:
        """Return the number of maps (channels, size) with columns of at most ``COLUMNS`` numbers together."""
        return max(1, COLUMNS // (channels * math.prod(self.kernel) * math.prod(self.fits(size))))


def _gemm_by_group(a: torch.Tensor, b: torch.Tensor, c: torch.Tensor, group: int, **how: bool) -> None:
    """Multiply stacks of matrices group by group; the rows of a matrix are ordered by group."""
    if group == 1:
        gemm(a, b, c, **how)
        return
    for own in zip(*(m.unflatten(-2, (group, -1)).unbind(-3) for m in (a, b, c)), strict=True):
        gemm(*own, **how)


class ColumnProducts(ParameterSums):
    """Cross-correlate maps with filters: the filters, times the pixels under the filter as columns, image by image.

    maps     (N, C, ...)
    weight   (num_output, C / group, kernel)
    bias     (num_output,) or None
    returns  (N, num_output, ...)

    Caffe: src/caffe/layers/base_conv_layer.cpp, conv_layer.cpp
    """

    @staticmethod
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
        ctx.at_once = sliding.images_at_once(maps.shape[1], maps.shape[2:])
        filters = weight.contiguous().flatten(1)
        tops = maps.new_empty(len(maps), len(weight), *sliding.fits(maps.shape[2:]))
        with one_thread():
            for some, top in zip(maps.split(ctx.at_once), tops.flatten(2).split(ctx.at_once), strict=True):
                _gemm_by_group(filters, sliding.columns(some), top, group)
        return tops if bias is None else tops.add_(by_channel(bias, tops))

    @staticmethod
    @once_differentiable
    @one_thread()
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        maps, weight, _ = ctx.saved_tensors
        weight_sums, bias_sums = sums = ParameterSums.sums(ctx)
        filters, diffs = weight.contiguous().flatten(1), tops_diff.contiguous().flatten(2)
        if bias_sums is not None:
            add_sums(diffs, bias_sums, axis=1)
        if weight_sums is not None:
            of_filters = weight_sums.flatten(1)
            for some, diff in zip(maps.split(ctx.at_once), diffs.split(ctx.at_once), strict=True):
                _gemm_by_group(diff, ctx.sliding.columns(some), of_filters, ctx.group, b_t=True, add=True)
        maps_diff = None
        if ctx.needs_input_grad[0]:
            maps_diff = torch.empty_like(maps, memory_format=torch.contiguous_format)
            columns = maps.new_empty(min(ctx.at_once, len(maps)), ctx.group * filters.shape[1], diffs.shape[2])
            for some, diff in zip(maps_diff.split(ctx.at_once), diffs.split(ctx.at_once), strict=True):
                _gemm_by_group(filters, diff, columns[: len(diff)], ctx.group, a_t=True)
                some.copy_(ctx.sliding.spread(columns[: len(diff)], maps.shape[2:]))
        return maps_diff, *ParameterSums.for_autograd(ctx, sums), None, None, None


class SpreadProducts(ParameterSums):
    """Spread each pixel by filters, like the backward pass of a convolution.

    maps     (N, C, ...)
    weight   (C, num_output / group, kernel)
    bias     (num_output,) or None
    size     of the tops, (...)
    returns  (N, num_output, ...)

    Caffe: src/caffe/layers/base_conv_layer.cpp, deconv_layer.cpp
    """

    @staticmethod
    def forward(
        ctx: Any,
        maps: torch.Tensor,
        weight: torch.Tensor,
        bias: torch.Tensor | None,
        geometry: tuple[Filter, int],
        in_place: bool,
        size: Axes,
    ) -> torch.Tensor:
        maps = maps.contiguous()
        ParameterSums.keep(ctx, maps, (weight, bias), in_place)
        sliding, group = ctx.sliding, ctx.group = geometry
        channels = weight.shape[1] * group
        ctx.at_once = sliding.images_at_once(channels, size)
        filters, values = weight.contiguous().flatten(1), maps.flatten(2)
        tops = maps.new_empty(len(maps), channels, *size)
        columns = maps.new_empty(min(ctx.at_once, len(maps)), group * filters.shape[1], values.shape[2])
        with one_thread():
            for some, top in zip(values.split(ctx.at_once), tops.split(ctx.at_once), strict=True):
                _gemm_by_group(filters, some, columns[: len(some)], group, a_t=True)
                top.copy_(sliding.spread(columns[: len(some)], size))
        return tops if bias is None else tops.add_(by_channel(bias, tops))

    @staticmethod
    @once_differentiable
    @one_thread()
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        maps, weight, _ = ctx.saved_tensors
        weight_sums, bias_sums = sums = ParameterSums.sums(ctx)
        filters, values = weight.contiguous().flatten(1), maps.flatten(2)
        maps_diff = torch.empty_like(maps) if ctx.needs_input_grad[0] else None
        for start in range(0, len(maps), ctx.at_once):
            these = slice(start, start + ctx.at_once)
            diff = tops_diff[these].contiguous()
            if bias_sums is not None:
                add_sums(diff.flatten(2), bias_sums, axis=1)
            columns = ctx.sliding.columns(diff)
            if weight_sums is not None:
                _gemm_by_group(values[these], columns, weight_sums.flatten(1), ctx.group, b_t=True, add=True)
            if maps_diff is not None:
                _gemm_by_group(filters, columns, maps_diff[these].flatten(2), ctx.group)
        return maps_diff, *ParameterSums.for_autograd(ctx, sums), None, None, None


def is_rounded(values: torch.Tensor) -> bool:
    """Return whether autocast computes products with these float32 values in another precision."""
    kind = values.device.type
    return kind in ("cpu", "cuda") and torch.is_autocast_enabled(kind) and values.dtype == torch.float32


def convolution(
    maps: torch.Tensor,
    weight: torch.Tensor,
    bias: torch.Tensor | None,
    sliding: Filter,
    group: int,
    transposed: bool = False,
) -> torch.Tensor:
    """Return the convolution, or transposed convolution, of torch's kernel for the number of axes."""
    axes = len(sliding.kernel) - 1
    if transposed:
        function = (F.conv_transpose1d, F.conv_transpose2d, F.conv_transpose3d)[axes]
        return function(maps, weight, bias, sliding.stride, sliding.pad, 0, group, sliding.dilation)
    function = (F.conv1d, F.conv2d, F.conv3d)[axes]
    return function(maps, weight, bias, sliding.stride, sliding.pad, sliding.dilation, group)


class Columns(torch.autograd.Function):
    """Copy the pixels under each position of a filter into a column.

    maps     (N, C, ...)
    returns  (N, C kernel, positions)

    Caffe: src/caffe/layers/im2col_layer.cpp
    """

    @staticmethod
    def forward(ctx: Any, maps: torch.Tensor, sliding: Filter) -> torch.Tensor:
        ctx.sliding, ctx.size = sliding, maps.shape[2:]
        return sliding.columns(maps)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, diff: torch.Tensor) -> tuple[torch.Tensor, None]:
        return ctx.sliding.spread(diff.contiguous(), ctx.size), None

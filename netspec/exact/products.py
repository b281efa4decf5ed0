"""Products with learned parameters: Convolution, Deconvolution, InnerProduct, Embed, and the steps of RNN and LSTM."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

import math
from collections.abc import Iterable
from contextlib import nullcontext
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
from typing import NamedTuple

import torch
from torch.nn import functional as F

from netspec.exact.accumulate import Diff, Sums
from netspec.exact.blas import add_sums, gemm
from netspec.exact.layout import by_channel
from netspec.exact.pointwise import pointwise

Axes = tuple[int, ...]
COLUMNS = 2**19  # numbers (2 MB): the columns of several images, which fit into a CPU's cache
FEWEST_VECTORS = 64  # for fewer, the product takes less time than rounding the weights to another precision


class Filter(NamedTuple):
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
        windows = _windows(self, maps.shape[1], maps.shape[2:])
        if any(self.pad):
            maps = F.pad(maps, [p for pad in reversed(self.pad) for p in (pad, pad)])
        pixels = maps.contiguous().as_strided((maps.shape[0], *windows.layout), windows.strides)
        return pixels.reshape(maps.shape[0], windows.pixels, windows.positions)

    def spread(self, columns: torch.Tensor, size: Axes) -> torch.Tensor:
        """Add columns up to maps (N, C, size), one pixel of the filter at a time (col2im).

        For two axes, torch's col2im adds in the same order.
        """
        if len(size) == 2:
            return F.fold(columns, size, self.kernel, self.dilation, self.pad, self.stride)
        count, positions = columns.shape[0], self.fits(size)
        pixels = columns.view(count, -1, *self.kernel, *positions)
        padded = columns.new_zeros(count, pixels.shape[1], *(n + 2 * p for n, p in zip(size, self.pad, strict=True)))
        every = (slice(None), slice(None))
        for pixel in product(*map(range, self.kernel)):
            axes = zip(pixel, self.dilation, self.stride, positions, strict=True)
            under = tuple(slice(k * d, k * d + s * (count - 1) + 1, s) for k, d, s, count in axes)
            padded[(*every, *under)] += pixels[(*every, *pixel)]
        return padded[(*every, *(slice(p, p + n) for n, p in zip(size, self.pad, strict=True)))]


class _Windows(NamedTuple):
    """The positions of a filter on the padded maps of an image."""

    fits: Axes  # along each axis
    positions: int
    pixels: int  # under the filter at one position, of all channels
    layout: Axes  # channels, the pixels along each axis, the positions along each axis
    strides: Axes  # of an image, and of the layout
    at_once: int  # images with columns of at most COLUMNS numbers together


@lru_cache(maxsize=1024)
def _windows(sliding: Filter, channels: int, size: Axes) -> _Windows:
    """Return the positions of a filter on maps (channels, size)."""
    fits = sliding.fits(size)
    padded = [n + 2 * p for n, p in zip(size, sliding.pad, strict=True)]
    steps = [math.prod(padded[axis + 1 :]) for axis in range(len(size))]  # from a pixel to the next
    area, pixels, positions = math.prod(padded), channels * math.prod(sliding.kernel), math.prod(fits)
    strides = [channels * area, area]
    strides += [n * step for by in (sliding.dilation, sliding.stride) for n, step in zip(by, steps, strict=True)]
    at_once = max(1, COLUMNS // max(1, pixels * positions))
    return _Windows(tuple(fits), positions, pixels, (channels, *sliding.kernel, *fits), tuple(strides), at_once)


@dataclass
class ColumnProducts:
    """Cross-correlate maps with filters: the filters, times the pixels under the filter as columns, image by image.

    maps     (N, C, ...)
    weight   (num_output, C / group, kernel)
    bias     (num_output,) or None
    returns  (N, num_output, ...)

    Caffe: src/caffe/layers/base_conv_layer.cpp, conv_layer.cpp
    """

    sliding: Filter
    group: int

    def forward(self, maps: torch.Tensor, weight: torch.Tensor, bias: Diff = None) -> torch.Tensor:
        filters, windows = weight.contiguous().flatten(1), _windows(self.sliding, maps.shape[1], maps.shape[2:])
        tops = maps.new_empty((maps.shape[0], weight.shape[0], windows.positions))
        for some, top in self._in_parts(maps, tops):
            self._multiply(filters, self.sliding.columns(some), top)
        if bias is not None:
            tops.add_(bias.unsqueeze(1))
        return tops.view(maps.shape[0], weight.shape[0], *windows.fits)

    def backward(
        self, diff: torch.Tensor, wanted: bool, sums: Sums, maps: torch.Tensor, weight: torch.Tensor, *_: Diff
    ) -> Diff:
        diff = diff.contiguous()
        self.add_to_sums(diff, sums, maps, diff)
        return self.spread(diff, weight, maps.shape[2:]) if wanted else None

    def spread(self, values: torch.Tensor, weight: torch.Tensor, size: Axes) -> torch.Tensor:
        """Return the products (N, C, size) of the transposed filters with values (N, num_output, ...), added up."""
        filters = weight.contiguous().flatten(1)
        maps = values.new_empty(values.shape[0], self.group * weight.shape[1], *size)
        for some, few in self._in_parts(maps, values.flatten(2)):
            columns = few.new_empty(few.shape[0], self.group * filters.shape[1], few.shape[2])
            self._multiply(filters, few, columns, a_t=True)
            some.copy_(self.sliding.spread(columns, size))
        return maps

    def add_to_sums(self, responses: torch.Tensor, sums: Sums, maps: torch.Tensor, of_bias: torch.Tensor) -> None:
        """Add the products of responses with the columns of maps, and the sums of ``of_bias``, in place."""
        weight_sums, bias_sums = sums
        if bias_sums is not None:
            add_sums(of_bias.flatten(2), bias_sums, axis=1)
        if weight_sums is not None:
            for some, few in self._in_parts(maps, responses.flatten(2)):
                self._multiply(few, self.sliding.columns(some), weight_sums.flatten(1), b_t=True, add=True)

    def _in_parts(self, maps: torch.Tensor, others: torch.Tensor) -> Iterable[tuple[torch.Tensor, torch.Tensor]]:
        """Return a batch in parts with columns that fit into a CPU's cache."""
        at_once = _windows(self.sliding, maps.shape[1], maps.shape[2:]).at_once
        if at_once >= maps.shape[0]:
            return [(maps, others)]
        return zip(maps.split(at_once), others.split(at_once), strict=True)

    def _multiply(self, a: torch.Tensor, b: torch.Tensor, c: torch.Tensor, **how: bool) -> None:
        """Multiply stacks of matrices group by group; the rows of a matrix are ordered by group."""
        if self.group == 1:
            gemm(a, b, c, **how)
            return
        for own in zip(*(m.unflatten(-2, (self.group, -1)).unbind(-3) for m in (a, b, c)), strict=True):
            gemm(*own, **how)


@dataclass
class SpreadProducts(ColumnProducts):
    """Spread each pixel by filters, like the backward pass of a convolution.

    maps     (N, C, ...)
    weight   (C, num_output / group, kernel)
    bias     (num_output,) or None
    returns  (N, num_output, ...), with the spatial axes ``size``

    Caffe: src/caffe/layers/base_conv_layer.cpp, deconv_layer.cpp
    """

    size: Axes

    def forward(self, maps: torch.Tensor, weight: torch.Tensor, bias: Diff = None) -> torch.Tensor:
        tops = self.spread(maps.contiguous(), weight, self.size)
        return tops if bias is None else tops.add_(by_channel(bias, tops))

    def backward(
        self, diff: torch.Tensor, wanted: bool, sums: Sums, maps: torch.Tensor, weight: torch.Tensor, *_: Diff
    ) -> Diff:
        diff = diff.contiguous()
        self.add_to_sums(maps.contiguous(), sums, diff, diff)
        return super().forward(diff, weight) if wanted else None


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
    directions = (F.conv1d, F.conv2d, F.conv3d), (F.conv_transpose1d, F.conv_transpose2d, F.conv_transpose3d)
    geometry = {"stride": sliding.stride, "padding": sliding.pad, "dilation": sliding.dilation}
    return directions[transposed][axes](maps, weight, bias, groups=group, **geometry)


def columns(maps: torch.Tensor, sliding: Filter) -> torch.Tensor:
    """Copy the pixels under each position of a filter into a column: (N, C, ...) to (N, C kernel, positions).

    Caffe: src/caffe/layers/im2col_layer.cpp
    """
    return pointwise(maps, sliding.columns, lambda maps, _, diff: sliding.spread(diff.contiguous(), maps.shape[2:]))


@dataclass
class VectorProducts:
    """Multiply vectors by a matrix.

    vectors  (M, K)
    weight   (num_output, K), or (K, num_output) where ``transposed``
    bias     (num_output,) or None
    returns  (M, num_output)

    Caffe: src/caffe/layers/inner_product_layer.cpp
    """

    transposed: bool

    def forward(self, vectors: torch.Tensor, weight: torch.Tensor, bias: Diff = None) -> torch.Tensor:
        tops = vectors.new_empty(len(vectors), weight.shape[1 if self.transposed else 0])
        gemm(vectors, weight.contiguous(), tops, b_t=not self.transposed)
        return tops if bias is None else tops.add_(bias)

    def backward(
        self, diff: torch.Tensor, wanted: bool, sums: Sums, vectors: torch.Tensor, weight: torch.Tensor, *_: Diff
    ) -> Diff:
        (weight_sums, bias_sums), vectors, diff = sums, vectors.contiguous(), diff.contiguous()
        if weight_sums is not None:
            gemm(*((vectors, diff) if self.transposed else (diff, vectors)), weight_sums, a_t=True, add=True)
        if bias_sums is not None:
            add_sums(diff, bias_sums, axis=0)
        if not wanted:
            return None
        vectors_diff = torch.empty_like(vectors)
        gemm(diff, weight.contiguous(), vectors_diff, b_t=self.transposed)
        return vectors_diff


class SummedProducts(VectorProducts):
    """Like :class:`VectorProducts`, but with torch's kernels, on any device.

    In contrast to torch's own function, it adds the gradient of the weights to the sum at once. In fully connected
    layers it is the largest of all tensors, and allocating memory for it takes longer than the product itself.
    """

    def forward(self, vectors: torch.Tensor, weight: torch.Tensor, bias: Diff = None) -> torch.Tensor:
        """Return the product. For few vectors it has the precision of the weights, even with autocast."""
        few, kind = len(vectors) < FEWEST_VECTORS, weight.device.type
        vectors = vectors.to(weight.dtype) if few else vectors
        autocast = few and kind in ("cpu", "cuda") and torch.is_autocast_enabled(kind)
        with torch.autocast(kind, enabled=False) if autocast else nullcontext():
            return F.linear(vectors, weight.t() if self.transposed else weight, bias)

    def backward(
        self, diff: torch.Tensor, wanted: bool, sums: Sums, vectors: torch.Tensor, weight: torch.Tensor, *_: Diff
    ) -> Diff:
        weight_sums, bias_sums = sums
        kind = diff.dtype  # of the product, which autocast may have chosen
        if weight_sums is not None:
            given = vectors.to(kind)
            factors = (given.t(), diff) if self.transposed else (diff.t(), given)
            if weight_sums.dtype == kind:
                weight_sums.addmm_(*factors)
            else:
                weight_sums += factors[0] @ factors[1]
        if bias_sums is not None:
            bias_sums += diff.sum(0)
        return (diff @ (weight.t() if self.transposed else weight).to(kind)).to(vectors.dtype) if wanted else None


class ChosenRows:
    """Look up rows.

    index    (M,), whole numbers
    rows     (input_dim, num_output)
    bias     (num_output,) or None
    returns  (M, num_output)

    Caffe: src/caffe/layers/embed_layer.cpp
    """

    def forward(self, index: torch.Tensor, rows: torch.Tensor, bias: Diff) -> torch.Tensor:
        tops = rows[index]
        return tops if bias is None else tops.add_(bias)

    def backward(self, diff: torch.Tensor, _: bool, sums: Sums, index: torch.Tensor, *rows: Diff) -> None:
        (rows_sums, bias_sums), diff = sums, diff.contiguous()
        if rows_sums is not None:
            rows_sums.index_add_(0, index, diff)  # one after the other
        if bias_sums is not None:
            add_sums(diff, bias_sums, axis=0)

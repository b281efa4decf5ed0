"""Products with learned weights at fixed shapes, with the numbers of products.py and vectors.py in netspec/exact.

They are faster because the arguments of BLAS are made once, as views of memory that each call reuses. A result is
therefore valid only until the next call. BLAS must use one thread.

BLAS stores matrices by column, so it gets transposed views: ``gemm(1, b.T, a.T, 0, c.T, 0, 0, 1)`` computes c = a b.
``gemv(1, a, x, 1, y, 0, 1, 0, 1, trans, 1)`` adds a x to y, or a.T x if ``trans`` is 1.

Caffe: src/caffe/layers/inner_product_layer.cpp, base_conv_layer.cpp
"""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from netspec.exact.blas import routine
from netspec.exact.products import Axes, Filter

SMALL = 2**14  # numbers in a tensor: for fewer, a copy takes less time than making a view


class TransposedView:
    """Makes transposed views of tensors of one shape, as matrices with ``columns`` columns, and reuses them.

    A view is kept for the next call with the same memory. A tensor that is not contiguous is copied. So is a small
    tensor in other memory than last time, because a copy takes less time than a new view.
    """

    __slots__ = ("_address", "_columns", "_copy", "_copy_view", "_view")

    def __init__(self, columns: int) -> None:
        self._columns = columns
        self._address: int | None = None  # the view keeps its memory alive, so no other tensor gets this address
        self._copy: torch.Tensor | None = None

    def __call__(self, tensor: torch.Tensor) -> np.ndarray:
        """Return the view, (columns, rows)."""
        address = tensor.data_ptr() if tensor.is_contiguous() else None
        if address is not None and address == self._address:
            return self._view
        if address is not None and (self._address is None or tensor.numel() > SMALL):
            self._address = address
            self._view = tensor.view(-1, self._columns).numpy().T
            return self._view
        if self._copy is None:
            self._copy = torch.empty(tensor.shape, dtype=tensor.dtype)
            self._copy_view = self._copy.view(-1, self._columns).numpy().T
        self._copy.copy_(tensor)
        return self._copy_view


class Weights(NamedTuple):
    """The weights of a layer, and the tensors to which their gradients are added (None: not learned)."""

    weight: torch.Tensor
    bias: torch.Tensor | None
    weight_sums: torch.Tensor | None
    bias_sums: torch.Tensor | None


def fixed_weights(weight: torch.Tensor, bias: torch.Tensor | None = None) -> Weights:
    """Return the Weights of a layer that does not learn."""
    return Weights(weight, bias, None, None)


class PreparedVectors:
    """:class:`netspec.exact.vectors.VectorProducts` of vectors of one shape, and of one matrix.

    ``shape`` is the shape of the bottom, whose numbers are vectors of length K one after the other; ``top_shape`` is
    the shape of the top. ``wanted`` says whether the gradient of the bottom is computed. ``nbytes`` is the memory that
    is kept between runs.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        top_shape: tuple[int, ...],
        transposed: bool,
        learned: Weights,
        wanted: bool = False,
    ) -> None:
        weight, self._bias, weight_sums, bias_sums = learned
        inputs, outputs = weight.shape if transposed else (weight.shape[1], weight.shape[0])
        rows = math.prod(shape) // inputs
        self._matrix, self._transposed = weight.numpy().T, transposed
        self._top = torch.empty(top_shape, dtype=weight.dtype)
        self.nbytes = self._top.nbytes
        self._rows = self._top.view(rows, outputs)
        self._rows_view = self._rows.numpy().T
        self._vectors, self._diffs = TransposedView(inputs), TransposedView(outputs)
        self._weight_sums = None if weight_sums is None else weight_sums.numpy().T
        self._bias_sums = None if bias_sums is None else bias_sums.numpy()
        self._diff = torch.empty(shape, dtype=weight.dtype) if wanted else None
        self._diff_view = None if self._diff is None else self._diff.view(rows, inputs).numpy().T
        self._ones = np.ones(rows, self._matrix.dtype)
        self._gemm, self._gemv = routine("gemm", self._matrix), routine("gemv", self._matrix)

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        """Return the products."""
        self._read = self._vectors(data)
        self._gemm(1.0, self._matrix, self._read, 0.0, self._rows_view, not self._transposed, 0, 1)
        if self._bias is not None:
            self._rows.add_(self._bias)
        return self._top

    def backward(self, diff: torch.Tensor) -> torch.Tensor | None:
        """Add the gradients of the weights to their sums; return the gradient of the bottom."""
        rows = self._diffs(diff)
        if self._weight_sums is not None:
            first, second = (rows, self._read) if self._transposed else (self._read, rows)
            self._gemm(1.0, first, second, 1.0, self._weight_sums, 0, 1, 1)
        if self._bias_sums is not None:
            self._gemv(1.0, rows, self._ones, 1.0, self._bias_sums, 0, 1, 0, 1, 0, 1)
        if self._diff_view is not None:
            self._gemm(1.0, self._matrix, rows, 0.0, self._diff_view, self._transposed, 0, 1)
        return self._diff


class PreparedColumns:
    """:class:`netspec.exact.products.ColumnProducts` of maps (N, C, H, W) of one shape.

    If the columns of a batch fit into :data:`netspec.exact.products.COLUMNS`, they are kept for the backward pass.
    ``nbytes`` is about the memory that is kept between runs.
    """

    def __init__(
        self,
        shape: tuple[int, ...],
        sliding: Filter,
        group: int,
        learned: Weights,
        wanted: bool = False,
    ) -> None:
        weight, bias, weight_sums, bias_sums = learned
        count, channels, *size = shape
        self._size, self._sliding, self._group = tuple(size), sliding, group
        fits = sliding.fits(self._size)
        self._top = torch.empty((count, len(weight), *fits), dtype=weight.dtype)
        self._bias = None if bias is None else bias.view(-1, 1, 1)
        self._at_once = min(count, sliding.images_at_once(channels, self._size))
        positions = math.prod(fits)
        columns = self._at_once * channels * math.prod(sliding.kernel) * positions
        self.nbytes = self._top.nbytes + columns * weight.itemsize
        self._tops = [_by_group(image.numpy(), group) for image in self._top.flatten(2)]
        whole, rest = divmod(count, self._at_once)
        columns_of = partial(_columns, dtype=weight.dtype, sliding=sliding, fits=fits, group=group)
        self._columns = [columns_of((self._at_once, channels, *size))] * whole
        if rest:
            self._columns.append(columns_of((rest, channels, *size)))
        self._filters = _by_group(weight.flatten(1).numpy(), group)
        self._weight_sums = None if weight_sums is None else _by_group(weight_sums.flatten(1).numpy(), group)
        self._bias_sums = None if bias_sums is None else bias_sums.numpy()
        self._diffs = TransposedView(positions)
        self._ones = np.ones(positions, self._filters[0].dtype)
        self._spread = None
        if wanted:
            self._spread = torch.empty(
                (self._at_once, channels * math.prod(sliding.kernel), positions), dtype=weight.dtype
            )
        self._gemm, self._gemv = routine("gemm", self._filters[0]), routine("gemv", self._filters[0])

    def forward(self, maps: torch.Tensor) -> torch.Tensor:
        """Return the responses."""
        self._maps = maps
        for k, lay_out in enumerate(self._columns):
            start = k * self._at_once
            self._laid_out = lay_out(maps[start : start + self._at_once] if len(self._columns) > 1 else maps)
            for columns, top in zip(self._laid_out, self._tops[start:], strict=False):
                for inputs, filters, outputs in zip(columns, self._filters, top, strict=True):
                    self._gemm(1.0, inputs, filters, 0.0, outputs, 0, 0, 1)
        if self._bias is not None:
            self._top.add_(self._bias)
        return self._top

    def backward(self, diff: torch.Tensor) -> torch.Tensor | None:
        """Add the gradients of filters and bias to their sums; return the gradient of the maps."""
        count, outputs = self._top.shape[:2]
        diffs = self._diffs(diff).T.reshape(count, outputs, -1)
        if self._bias_sums is not None:
            for each in diffs:
                self._gemv(1.0, each.T, self._ones, 1.0, self._bias_sums, 0, 1, 0, 1, 1, 1)
        found: list[torch.Tensor] = []
        whole = len(self._columns) == 1
        for k, lay_out in enumerate(self._columns):
            start = k * self._at_once
            some = [_by_group(each, self._group) for each in diffs[start : start + self._at_once]]
            if self._weight_sums is not None:
                laid_out = self._laid_out if whole else lay_out(self._maps[start : start + self._at_once])
                for columns, each in zip(laid_out, some, strict=True):
                    for inputs, outputs_diff, sums in zip(columns, each, self._weight_sums, strict=True):
                        self._gemm(1.0, inputs, outputs_diff, 1.0, sums, 1, 0, 1)
            if self._spread is not None:
                spread = self._spread[: len(some)]
                for columns, each in zip(spread.numpy(), some, strict=True):
                    for inputs, outputs_diff, filters in zip(
                        _by_group(columns, self._group), each, self._filters, strict=True
                    ):
                        self._gemm(1.0, outputs_diff, filters, 0.0, inputs, 0, 1, 1)
                found.append(self._sliding.spread(spread, self._size))
        return None if not found else found[0] if len(found) == 1 else torch.cat(found)


def _by_group(matrix: np.ndarray, group: int) -> list[np.ndarray]:
    """Return the rows of each group, one group after the other, as BLAS takes them: transposed."""
    return [matrix.T] if group == 1 else [rows.T for rows in np.split(matrix, group)]


def _columns(
    shape: Axes, dtype: torch.dtype, sliding: Filter, fits: Sequence[int], group: int
) -> Callable[[torch.Tensor], list[list[np.ndarray]]]:
    """Return a function like :meth:`Filter.columns` for maps (N, C, H, W) of one shape, by image and by group."""
    (count, channels, *size), (kernel, stride, dilation) = shape, (sliding.kernel, sliding.stride, sliding.dilation)
    flat = (count, channels * math.prod(kernel), math.prod(fits))
    each_pixel_once = math.prod(kernel) * flat[2] == math.prod(size)
    if not any(sliding.pad) and each_pixel_once and (math.prod(kernel) == 1 or flat[2] == 1):
        return lambda maps: [_by_group(image, group) for image in maps.contiguous().numpy().reshape(flat)]
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
    layout, found = columns.shape, [_by_group(image, group) for image in columns.view(flat).numpy()]
    address, pixels = None, columns if frame is None else frame.as_strided(layout, strides)

    def lay_out(maps: torch.Tensor) -> list[list[np.ndarray]]:
        nonlocal address, pixels
        if frame is not None:
            inner.copy_(maps)
        elif maps.data_ptr() != address or not maps.is_contiguous():
            whole = maps.contiguous()
            # The view keeps its memory alive, so no other tensor gets this address.
            address, pixels = whole.data_ptr(), whole.as_strided(layout, strides)
        columns.copy_(pixels)
        return found

    return lay_out

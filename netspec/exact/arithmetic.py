"""The two arithmetics of layers: torch's, and Caffe's, which is equal to Caffe in every bit.

A layer gets one of them from :meth:`netspec.layers.contract.base.Layer.arithmetic`, and its ``forward`` is a formula of
operations that both have. The two differ in the order of additions, also of gradients, and in rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
from torch.nn import functional as F
from typing_extensions import override

from netspec.exact import libm, losses, lrn, sums
from netspec.exact.accumulate import Applied, Operation, added_at_once
from netspec.exact.blas import applies, is_recorded, sum_in_order
from netspec.exact.by_torch import (
    normalized_batch,
    normalizes,
    response_base,
    scales_channels,
    standardized,
    standardized_gradient,
    window_sums,
)
from netspec.exact.channels import (
    BatchNormalization,
    ChannelProducts,
    Slopes,
    normalized_rows,
    row_normalization_gradient,
)
from netspec.exact.layout import by_channel, channels_side_by_side, map_by_map, of_one_channel
from netspec.exact.pointwise import CellUpdate, Gradient, lstm_unit, pointwise
from netspec.exact.products import (
    Axes,
    ChosenRows,
    ColumnProducts,
    Filter,
    SpreadProducts,
    SummedProducts,
    VectorProducts,
    columns,
    convolution,
    is_rounded,
)

Function = Callable[[torch.Tensor], torch.Tensor]


class AsTorch:
    """Torch's own functions and gradients. With ``in_place``, gradients of parameters are added to ``grad`` at once."""

    is_caffes = False

    def __init__(self, in_place: bool = False) -> None:
        self.in_place = in_place

    def _applied(self, operation: Operation, bottom: torch.Tensor, *parameters: torch.Tensor | None) -> torch.Tensor:
        return Applied.apply(operation, self.is_caffes, self.in_place, bottom, *parameters)

    def _by_rows(self, products: Operation, vectors: torch.Tensor, *parameters: torch.Tensor | None) -> torch.Tensor:
        """Return the products of vectors (..., K) by an operation on vectors (M, K)."""
        found = self._applied(products, vectors.reshape(-1, vectors.shape[-1]), *parameters)
        return found.reshape(*vectors.shape[:-1], found.shape[1])

    # Products with learned blobs

    def inner_product(
        self, vectors: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, transposed: bool = False
    ) -> torch.Tensor:
        """Multiply vectors (..., K) by a matrix (num_output, K), or (K, num_output) if transposed; add the bias."""
        if self.in_place and torch.is_grad_enabled():
            return self._by_rows(SummedProducts(transposed), vectors, weight, bias)
        return self.product_of_step(vectors, weight.t() if transposed else weight, bias)

    def product_of_step(
        self, vectors: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None = None
    ) -> torch.Tensor:
        """Return the inner product of one time step; autograd adds the gradients of all steps."""
        return F.linear(vectors, weight, bias)

    def chosen_rows(self, index: torch.Tensor, rows: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
        """Look up rows (input_dim, num_output) by an index (...), and add the bias: (..., num_output)."""
        top = F.embedding(index, rows)
        return top if bias is None else top + bias

    def convolution(
        self, maps: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter, group: int
    ) -> torch.Tensor:
        """Cross-correlate maps (N, C, ...) with filters (num_output, C / group, kernel), and add the bias."""
        if sliding.reads_padding_alone:
            maps = F.pad(maps, [p for p in reversed(sliding.pad) for _ in range(2)])
            sliding = sliding._replace(pad=(0,) * len(sliding.pad))
        if not torch.is_grad_enabled():  # in channels_last, weights would be copied for each product
            return convolution(of_one_channel(maps), weight, bias, sliding, group)
        in_channels = maps.numel() > 2 * weight.numel() or is_rounded(weight)
        lay_out = channels_side_by_side if in_channels else map_by_map
        return self._convolved(maps, weight, bias, (sliding, group, False), lay_out)

    def deconvolution(
        self, maps: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, how: tuple[Filter, int], size: Axes
    ) -> torch.Tensor:
        """Spread maps (N, C, ...) by filters (C, num_output / group, kernel) to the ``size`` of the tops.

        ``how`` is the filter and the number of groups.
        """
        if not torch.is_grad_enabled():
            return convolution(maps, weight, bias, *how, transposed=True)
        return self._convolved(maps, weight, bias, (*how, True), lambda maps: maps)

    def _convolved(
        self,
        maps: torch.Tensor,
        weight: torch.Tensor,
        bias: torch.Tensor | None,
        geometry: tuple[Filter, int, bool],
        lay_out: Function,
    ) -> torch.Tensor:
        """Return the result of torch's kernel, with gradients, for maps in the layout that ``lay_out`` makes."""
        if self.in_place and not is_recorded():
            weight, bias = added_at_once(weight), None if bias is None else added_at_once(bias)
        return convolution(lay_out(maps), weight, bias, *geometry)

    def columns(self, maps: torch.Tensor, sliding: Filter) -> torch.Tensor:
        """Copy the pixels under each position of a filter into a column (im2col): (N, C kernel, positions)."""
        return sliding.columns(maps)

    # Along axes

    def scaled(
        self, data: torch.Tensor, axis: int, factors: torch.Tensor | None, bias: torch.Tensor | None
    ) -> torch.Tensor:
        """Multiply by factors and add a bias, aligned with the axes from ``axis`` on; one of them may be None."""
        if factors is not None and axis == 1 and factors.dim() == 1:
            return scales_channels(factors, bias)(data)
        top = data if factors is None else data * _laid_over(factors, axis, data)
        return top if bias is None else top + _laid_over(bias, axis, data)

    def sloped(self, x: torch.Tensor, slopes: torch.Tensor) -> torch.Tensor:
        """Multiply the negative values of x (N, C, ...) by the slope of their channel (C,), or by a single slope."""
        return F.prelu(x, slopes.reshape(-1))

    def normalized_batch(
        self, data: torch.Tensor, eps: float, factors: torch.Tensor | None, bias: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, float]:
        """Normalize the channels of a batch (N, C, ...) to mean 0 and variance 1, then scale and shift them.

        Returns the result, the means (C,), the variances (C,), and the factor that makes these unbiased.
        """
        how = torch.batch_norm, (factors, bias), eps, torch.backends.cudnn.enabled
        top, _, mean, variance = normalized_batch(data, *how)
        return top, mean, variance, 1.0

    def normalizes(self, mean: torch.Tensor, variance: torch.Tensor, eps: float) -> Function:
        """Return a function that normalizes (N, C, ...) by a mean and a variance of each channel."""
        return normalizes(mean, variance, eps)

    def standardized(self, rows: torch.Tensor, eps: float | None) -> torch.Tensor:
        """Subtract each row's mean and, with an ``eps``, divide by its deviation + eps: (M, K)."""
        return rows - rows.mean(dim=1, keepdim=True) if eps is None else standardized(rows, eps)

    def standardized_gradient(
        self, rows: torch.Tensor, tops: torch.Tensor, diff: torch.Tensor, eps: float
    ) -> torch.Tensor:
        """Return the gradient of :meth:`standardized` with an ``eps``."""
        return standardized_gradient(rows, tops, diff, eps)

    def across_channels(self, maps: torch.Tensor, settings: lrn.Settings) -> torch.Tensor:
        """Divide by (k + alpha / size * the sum of the squares in ``size`` channels around) ** beta: (N, C, H, W)."""
        return maps * response_base(maps, settings).pow(-settings.beta)

    def across_channels_gradient(
        self, maps: torch.Tensor, tops: torch.Tensor, diff: torch.Tensor, settings: lrn.Settings
    ) -> torch.Tensor:
        """Return the gradient of :meth:`across_channels`."""
        size, alpha, beta, _ = settings
        base = response_base(maps, settings)
        return diff * base.pow(-beta) - 2 * alpha * beta / size * maps * window_sums(diff * tops / base, size)

    def within_channel(self, maps: torch.Tensor, settings: lrn.Settings) -> torch.Tensor:
        """Divide by (1 + alpha * the mean of the squares in ``size`` x ``size`` pixels around) ** beta."""
        size, alpha, beta, _ = settings
        base = 1 + alpha * F.avg_pool2d(maps * maps, size, stride=1, padding=size // 2)
        return maps * base.pow(-beta)

    def softmax(self, x: torch.Tensor, axis: int) -> torch.Tensor:
        """Return exp(x) divided by its sum along an axis."""
        return F.softmax(x, axis)

    def softmax_gradient(self, top: torch.Tensor, diff: torch.Tensor, axis: int) -> torch.Tensor:
        """Return the gradient of :meth:`softmax`."""
        return (diff - (diff * top).sum(axis, keepdim=True)) * top

    # Elementwise

    def function(self, x: torch.Tensor, by_torch: Function, as_caffe: Function, gradient: Gradient) -> torch.Tensor:
        """Apply an elementwise function: ``by_torch``, with the gradient of autograd.

        As in Caffe: ``as_caffe``, which rounds each step like Caffe, with the gradient ``gradient(bottom, top, diff)``.
        """
        return by_torch(x)

    def log(self, x: torch.Tensor) -> torch.Tensor:
        """Return natural logarithms."""
        return x.log()

    def floored(self, x: torch.Tensor, least: float) -> torch.Tensor:
        """Return max(x, least), with a gradient that also passes below it, as in Caffe's losses."""
        return pointwise(x, lambda x: x.clamp(min=least), lambda x, top, diff: diff)

    def lstm_unit(
        self, cell: torch.Tensor, gates: torch.Tensor, keep: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the next cell and hidden state of an LSTM (N, D) from its gates (N, 4 D)."""
        return lstm_unit(cell, gates, keep)

    def weighted_sum(self, terms: Sequence[torch.Tensor], weights: Sequence[float]) -> torch.Tensor:
        """Return the sum of tensors, each multiplied by its weight."""
        top, *others = (x if c == 1 else x * c for x, c in zip(terms, weights, strict=True))
        for x in others:
            top = top + x
        return top

    def product(self, factors: Sequence[torch.Tensor], stable: bool) -> torch.Tensor:
        """Multiply tensors. Unless ``stable``, Caffe computes a factor's gradient as the product divided by it."""
        return sums.product(factors)

    def sigmoid_cross_entropy(self, x: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        """Return the cross entropy of sigmoid(x) and the target, of each number."""
        return F.binary_cross_entropy_with_logits(x, targets, reduction="none")

    # Sums

    def sums(self, x: torch.Tensor, axis: int | None = None, factor: float = 1.0) -> torch.Tensor:
        """Return the sum over the axes from ``axis`` on (None: all), times a factor."""
        found = x.sum() if axis is None else x.flatten(axis).sum(axis)
        return found if factor == 1 else found * factor

    def sums_of_magnitudes(self, x: torch.Tensor, axis: int | None = None) -> torch.Tensor:
        """Return the sum of |x| over the axes from ``axis`` on (None: all)."""
        return self.sums(x.abs(), axis)

    def sums_of_squares(self, x: torch.Tensor, axis: int | None = None) -> torch.Tensor:
        """Return the sum of x * x over the axes from ``axis`` on (None: all)."""
        return self.sums(x.square(), axis)

    def total(self, values: torch.Tensor) -> torch.Tensor:
        """Return the sum of all losses; Caffe adds them one after the other."""
        return values.sum()

    def infogain(self, scores: torch.Tensor, gain: torch.Tensor, least: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Return -gain log(max(p, least)) and p, the softmax of scores (outer, classes, inner).

        The losses are those of each class, (outer, inner, classes), or their sums, (outer, inner, 1).
        """
        log_p = F.log_softmax(scores, 1)
        terms = gain.movedim(2, 1) * self.floored(log_p, math.log(least))
        return -terms.sum(1).unsqueeze(2), log_p.detach().exp()

    # Copies

    def copies(self, x: torch.Tensor, count: int) -> tuple[torch.Tensor, ...]:
        """Return ``count`` views of a tensor. Their gradients are added."""
        return tuple(x.view_as(x) for _ in range(count))

    def tiles(self, x: torch.Tensor, axis: int, count: int) -> torch.Tensor:
        """Repeat a tensor ``count`` times along an axis."""
        return x.repeat([count if i == axis else 1 for i in range(x.dim())])


class AsCaffe(AsTorch):
    """Caffe's bits, on the CPU: sums in the order of its BLAS and loops, functions rounded as by the C library."""

    is_caffes = True

    @override
    def inner_product(
        self, vectors: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, transposed: bool = False
    ) -> torch.Tensor:
        return self._by_rows(VectorProducts(transposed), vectors, weight, bias)

    @override
    def product_of_step(
        self, vectors: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None = None
    ) -> torch.Tensor:
        return self.inner_product(vectors, weight, bias)

    @override
    def chosen_rows(self, index: torch.Tensor, rows: torch.Tensor, bias: torch.Tensor | None) -> torch.Tensor:
        return self._applied(ChosenRows(), index.flatten(), rows, bias).reshape(*index.shape, rows.shape[1])

    @override
    def convolution(
        self, maps: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter, group: int
    ) -> torch.Tensor:
        return self._applied(ColumnProducts(sliding, group), maps, weight, bias)

    @override
    def deconvolution(
        self, maps: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, how: tuple[Filter, int], size: Axes
    ) -> torch.Tensor:
        return self._applied(SpreadProducts(*how, size), maps, weight, bias)

    @override
    def columns(self, maps: torch.Tensor, sliding: Filter) -> torch.Tensor:
        return columns(maps, sliding)

    @override
    def scaled(
        self, data: torch.Tensor, axis: int, factors: torch.Tensor | None, bias: torch.Tensor | None
    ) -> torch.Tensor:
        operand = bias if factors is None else factors
        assert operand is not None
        values = data.reshape(math.prod(data.shape[:axis]), operand.numel(), -1)
        return self._applied(ChannelProducts(), values, factors, bias).reshape(data.shape)

    @override
    def sloped(self, x: torch.Tensor, slopes: torch.Tensor) -> torch.Tensor:
        return self._applied(Slopes(), x.reshape(*x.shape[:2], -1), slopes).reshape(x.shape)

    @override
    def normalized_batch(
        self, data: torch.Tensor, eps: float, factors: torch.Tensor | None, bias: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, float]:
        top, mean, variance = BatchNormalization.apply(data.reshape(*data.shape[:2], -1), eps)
        top, count = top.reshape(data.shape), data.numel() // data.shape[1]
        top = top if factors is None and bias is None else self.scaled(top, 1, factors, bias)
        return top, mean, variance, count / (count - 1) if count > 1 else 1.0

    @override
    def normalizes(self, mean: torch.Tensor, variance: torch.Tensor, eps: float) -> Function:
        deviation = libm.sqrt(variance + eps)
        return lambda data: (data - by_channel(mean, data)).div_(by_channel(deviation, data))

    @override
    def standardized(self, rows: torch.Tensor, eps: float | None) -> torch.Tensor:
        return normalized_rows(rows, eps)

    @override
    def standardized_gradient(
        self, rows: torch.Tensor, tops: torch.Tensor, diff: torch.Tensor, eps: float
    ) -> torch.Tensor:
        return row_normalization_gradient(rows, tops, diff, eps)

    @override
    def across_channels(self, maps: torch.Tensor, settings: lrn.Settings) -> torch.Tensor:
        return lrn.across_channels(maps, settings)

    @override
    def across_channels_gradient(
        self, maps: torch.Tensor, tops: torch.Tensor, diff: torch.Tensor, settings: lrn.Settings
    ) -> torch.Tensor:
        return lrn.across_channels_gradient(maps, tops, diff, settings)

    @override
    def within_channel(self, maps: torch.Tensor, settings: lrn.Settings) -> torch.Tensor:
        return lrn.within_channel(maps, settings)

    @override
    def softmax(self, x: torch.Tensor, axis: int) -> torch.Tensor:
        return pointwise(
            x,
            lambda x: losses.softmax(_by_class(x, axis)).reshape(x.shape),
            lambda bottom, top, diff: self.softmax_gradient(top, diff, axis),
        )

    @override
    def softmax_gradient(self, top: torch.Tensor, diff: torch.Tensor, axis: int) -> torch.Tensor:
        return losses.softmax_gradient(_by_class(top, axis), _by_class(diff, axis)).reshape(top.shape)

    @override
    def function(self, x: torch.Tensor, by_torch: Function, as_caffe: Function, gradient: Gradient) -> torch.Tensor:
        return pointwise(x, as_caffe, gradient)

    @override
    def log(self, x: torch.Tensor) -> torch.Tensor:
        return pointwise(x, libm.log, lambda x, top, diff: diff / x)

    @override
    def lstm_unit(
        self, cell: torch.Tensor, gates: torch.Tensor, keep: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        return CellUpdate.apply(cell, gates, keep)

    @override
    def weighted_sum(self, terms: Sequence[torch.Tensor], weights: Sequence[float]) -> torch.Tensor:
        top = terms[0] * weights[0]
        for x, factor in zip(terms[1:], weights[1:], strict=True):
            top = torch.add(top, x, alpha=factor)  # rounds once, as BLAS' axpy does
        return top

    @override
    def product(self, factors: Sequence[torch.Tensor], stable: bool) -> torch.Tensor:
        return sums.Product.apply(stable, *factors)

    @override
    def sigmoid_cross_entropy(self, x: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        return losses.sigmoid_cross_entropy(x, targets)

    @override
    def sums(self, x: torch.Tensor, axis: int | None = None, factor: float = 1.0) -> torch.Tensor:
        return _of_rows(lambda rows: sums.row_sums(rows, factor), x, axis)

    @override
    def sums_of_magnitudes(self, x: torch.Tensor, axis: int | None = None) -> torch.Tensor:
        return _of_rows(sums.row_magnitudes, x, axis)

    @override
    def sums_of_squares(self, x: torch.Tensor, axis: int | None = None) -> torch.Tensor:
        return _of_rows(sums.row_squares, x, axis)

    @override
    def total(self, values: torch.Tensor) -> torch.Tensor:
        return pointwise(values.flatten(), sum_in_order, lambda values, _, diff: diff.expand_as(values))

    @override
    def infogain(self, scores: torch.Tensor, gain: torch.Tensor, least: float) -> tuple[torch.Tensor, torch.Tensor]:
        return losses.Infogain.apply(scores, gain, least)

    @override
    def copies(self, x: torch.Tensor, count: int) -> tuple[torch.Tensor, ...]:
        return sums.Copies.apply(x, count) if count > 2 else super().copies(x, count)  # of two, any order is the same

    @override
    def tiles(self, x: torch.Tensor, axis: int, count: int) -> torch.Tensor:
        values = x.reshape(math.prod(x.shape[:axis]), -1)
        shape = [size * count if i == axis else size for i, size in enumerate(x.shape)]
        return sums.tiles(values, count).reshape(shape)


def arithmetic(exact: str, values: torch.Tensor, small: bool = False, in_place: bool = False) -> AsTorch:
    """Return the arithmetic for values under the option ``exact``.

    ``small``: whether there is so little work that ``exact: small`` applies. ``in_place``: whether gradients of
    parameters are added to ``grad`` at once (netspec/exact/accumulate.py).
    """
    return _WAYS[applies(exact, values, small), in_place]


_WAYS = {
    (is_caffes, adds): (AsCaffe if is_caffes else AsTorch)(adds)
    for is_caffes in (False, True)
    for adds in (False, True)
}


def _of_rows(function: Function, x: torch.Tensor, axis: int | None) -> torch.Tensor:
    """Apply a function from (M, K) to (M,) over the axes from ``axis`` on (None: all)."""
    outer = x.shape[: axis or 0]
    return function(x.reshape(math.prod(outer), -1)).reshape(outer)


def _by_class(x: torch.Tensor, axis: int) -> torch.Tensor:
    """Return x as (outer, classes, inner)."""
    if (x.dim(), axis) == (3, 1):
        return x
    return x.reshape(math.prod(x.shape[:axis]), x.shape[axis], -1)


def _laid_over(values: torch.Tensor, axis: int, data: torch.Tensor) -> torch.Tensor:
    """Return ``values`` in a shape that broadcasts over ``data`` from ``axis`` on."""
    return values.reshape(*values.shape, *(1,) * (data.dim() - axis - values.dim()))

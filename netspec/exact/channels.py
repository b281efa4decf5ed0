"""Factors, biases, slopes and statistics along axes: Scale, Bias, PReLU, BatchNorm, MVN.

Their values are seen as (outer, channels, inner): the numbers before the axes in question, along them and after them.
"""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

from typing import Any

import torch
from torch.autograd.function import once_differentiable

from netspec.exact import libm
from netspec.exact.accumulate import Diff, Sums
from netspec.exact.blas import add_sums, dot, one_thread, sum_in_order
from netspec.exact.pointwise import pointwise


class ChannelProducts:
    """Multiply each channel by a factor and add a bias; one of them may be missing.

    values   (outer, channels, inner)
    factors  (channels,) or None
    bias     (channels,) or None
    returns  (outer, channels, inner)

    Caffe: src/caffe/layers/scale_layer.cpp, bias_layer.cpp
    """

    def forward(self, values: torch.Tensor, factors: Diff, bias: Diff = None) -> torch.Tensor:
        tops = values.clone() if factors is None else values * factors.reshape(-1, 1)
        return tops if bias is None else tops.add_(bias.reshape(-1, 1))

    def backward(
        self, diff: torch.Tensor, wanted: bool, sums: Sums, values: torch.Tensor, factors: Diff, *_: Diff
    ) -> Diff:
        (factors_sums, bias_sums), diff = sums, diff.contiguous()
        if bias_sums is not None:
            add_sums(diff, bias_sums.view(-1), axis=1)
        if factors_sums is not None:
            _add_products(values * diff, factors_sums.view(-1))
        if not wanted:
            return None
        return diff if factors is None else diff * factors.reshape(-1, 1)


def _add_products(products: torch.Tensor, sums: torch.Tensor) -> None:
    """Add products (outer, channels, inner) to the sums (channels,), with BLAS' calls that suit their shape."""
    outer, channels, inner = products.shape
    if inner > 1 and outer * channels == 1:
        sums += _total(products)
        return
    of_outer = products.reshape(outer, channels) if inner == 1 else _inner_sums(products)
    if outer == 1:
        sums += of_outer[0]
    elif channels == 1:
        sums += _total(of_outer)
    else:
        add_sums(of_outer, sums, axis=0)


def _total(values: torch.Tensor) -> torch.Tensor:
    return dot(values, torch.ones_like(values))


def _inner_sums(values: torch.Tensor, factor: float = 1.0) -> torch.Tensor:
    """Return the sums (outer, channels), times a factor, of values (outer, channels, inner)."""
    sums = values.new_zeros(values.shape[:2])
    add_sums(values.flatten(0, 1), sums.view(-1), axis=1, factor=factor)
    return sums


def _channel_sums(values: torch.Tensor, factor: float = 1.0) -> torch.Tensor:
    """Return the sums (channels,) of values (outer, channels, inner): of each map, times a factor, then over outer."""
    sums = values.new_zeros(values.shape[1])
    add_sums(_inner_sums(values, factor), sums, axis=0)
    return sums


class Slopes:
    """Multiply negative values by a slope, one for each channel or a single one.

    values   (outer, channels, inner)
    slopes   (channels,), or one number
    returns  (outer, channels, inner)

    Caffe: src/caffe/layers/prelu_layer.cpp
    """

    def forward(self, values: torch.Tensor, slopes: torch.Tensor) -> torch.Tensor:
        return torch.where(values > 0, values, values * slopes.reshape(-1, 1))

    def backward(
        self, diff: torch.Tensor, wanted: bool, sums: Sums, values: torch.Tensor, slopes: torch.Tensor
    ) -> Diff:
        if sums[0] is not None:
            terms = (diff * values * (values <= 0)).transpose(0, 1).flatten(1)
            if slopes.numel() == 1:
                terms = terms.view(len(terms), len(values), -1).transpose(0, 1).reshape(1, -1)
            flat = sums[0].view(-1, 1)
            flat.copy_(sum_in_order(torch.cat([flat, terms], 1), 1).unsqueeze(1))
        return torch.where(values > 0, diff, diff * slopes.reshape(-1, 1)) if wanted else None


class BatchNormalization(torch.autograd.Function):
    """Subtract each channel's mean over the batch, and divide by the root of its variance + eps.

    values   (outer, channels, inner)
    returns  (outer, channels, inner), the means (channels,) and the biased variances (channels,)

    Caffe: src/caffe/layers/batch_norm_layer.cpp
    """

    @staticmethod
    @one_thread()
    def forward(ctx: Any, values: torch.Tensor, eps: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        count = values.numel() // values.shape[1]
        mean = _channel_sums(values, 1 / count)
        centered = values - mean[:, None]
        variance = _channel_sums(centered * centered, 1 / count)
        deviation = libm.sqrt(variance + eps)
        tops = centered / deviation[:, None]
        ctx.save_for_backward(tops, deviation)
        ctx.mark_non_differentiable(mean, variance)
        return tops, mean, variance

    @staticmethod
    @once_differentiable
    @one_thread()
    def backward(ctx: Any, diff: torch.Tensor, *_: Any) -> tuple[torch.Tensor, None]:
        """Return the gradient of the values: (d - mean(d) - mean(d y) y) / deviation, for the gradient d of y."""
        tops, deviation = ctx.saved_tensors
        diff = diff.contiguous()
        count = diff.numel() // diff.shape[1]
        sums = tops * _channel_sums(tops * diff)[:, None] + _channel_sums(diff)[:, None]
        return (diff + sums * (-1 / count)).div_(deviation[:, None]), None


def normalized_rows(rows: torch.Tensor, eps: float | None) -> torch.Tensor:
    """Subtract each row's mean and, with an ``eps``, divide by its standard deviation + eps: (M, K).

    Caffe: src/caffe/layers/mvn_layer.cpp
    """

    @one_thread()
    def compute(rows: torch.Tensor) -> torch.Tensor:
        centered = rows - _row_means(rows)
        return centered if eps is None else centered / _deviations(centered, eps)

    return pointwise(rows, compute, lambda rows, tops, diff: row_normalization_gradient(rows, tops, diff, eps))


@one_thread()
def row_normalization_gradient(
    rows: torch.Tensor, tops: torch.Tensor, diff: torch.Tensor, eps: float | None
) -> torch.Tensor:
    """Return the gradient of :func:`normalized_rows`, (M, K), from ``tops`` that may be overwritten."""
    diff = diff.contiguous()
    if eps is None:
        return diff - _row_means(diff)
    sums = tops * _row_sums(tops * diff) + _row_sums(diff)
    return (diff + sums * (-1 / diff.shape[1])).div_(_deviations(rows - _row_means(rows), eps))


def _deviations(centered: torch.Tensor, eps: float) -> torch.Tensor:
    return libm.power(_row_means(libm.power(centered, 2)), 0.5) + eps


def _row_sums(rows: torch.Tensor, factor: float = 1.0) -> torch.Tensor:
    return _inner_sums(rows.unsqueeze(0), factor).view(-1, 1)


def _row_means(rows: torch.Tensor) -> torch.Tensor:
    return _row_sums(rows, 1 / rows.shape[1])

"""Torch's kernels, adapted so that they compute what Caffe's layers compute."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch.nn import functional as F

from netspec.exact.layout import by_channel, of_one_layout
from netspec.exact.lrn import Settings
from netspec.exact.pointwise import pointwise

MAX_OFFSET = 8  # the largest mean, in standard deviations, for which torch's CPU kernel is exact to 1e-6


def standardized(rows: torch.Tensor, eps: float) -> torch.Tensor:
    """Normalize rows to mean 0 and standard deviation 1, with Caffe's gradient.

    Caffe differentiates as if ``eps`` were 0, and then divides by the deviation plus ``eps``. So a constant row has a
    finite gradient, while autograd returns NaN.
    """

    def compute(rows: torch.Tensor) -> torch.Tensor:
        centered = rows - rows.mean(dim=1, keepdim=True)
        return centered / _deviation(centered, eps)

    return pointwise(rows, compute, lambda rows, top, diff: standardized_gradient(rows, top, diff, eps))


def standardized_gradient(rows: torch.Tensor, tops: torch.Tensor, diff: torch.Tensor, eps: float) -> torch.Tensor:
    """Return the gradient of :func:`standardized` from its rows and ``tops``, which may have been overwritten."""
    along = (diff * tops).mean(dim=1, keepdim=True)
    deviation = _deviation(rows - rows.mean(dim=1, keepdim=True), eps)
    return (diff - diff.mean(dim=1, keepdim=True) - along * tops) / deviation


def _deviation(centered: torch.Tensor, eps: float) -> torch.Tensor:
    return centered.square().mean(dim=1, keepdim=True).sqrt() + eps


def response_base(maps: torch.Tensor, settings: Settings) -> torch.Tensor:
    """Return the base of LRN's divisor: k + alpha times the mean of the squares in the neighboring channels."""
    return settings.k + settings.alpha / settings.size * window_sums(maps * maps, settings.size)


def window_sums(maps: torch.Tensor, size: int) -> torch.Tensor:
    """Return the sums over the ``size`` channels around each."""
    channels = maps.shape[1]
    padded = F.pad(maps, (0, 0, 0, 0, size // 2, size // 2))
    total = padded[:, :channels]
    for shift in range(1, size):
        total = total + padded[:, shift : shift + channels]
    return total


def scales_channels(scale: torch.Tensor, bias: torch.Tensor | None) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return a function that scales and shifts the channels.

    Batch normalization with mean 0 and variance 1 takes a third of the time of a product and a sum, also backward.
    """
    if not scale.numel():  # torch takes no maps without channels
        return torch.clone
    arguments = (scale, bias, torch.zeros_like(scale), torch.ones_like(scale), False, 0.0, 0.0)
    return lambda data: torch.batch_norm(of_one_layout(data), *arguments, torch.backends.cudnn.enabled)


def normalizes(mean: torch.Tensor, variance: torch.Tensor, eps: float) -> Callable[[torch.Tensor], torch.Tensor]:
    """Return a function that normalizes (N, C, ...) by a mean and a variance of each channel."""
    far = _far_from_zero(mean, variance, eps)
    arguments = (torch.zeros_like(mean) if far else mean, variance, False, 0.0, eps, torch.backends.cudnn.enabled)

    def normalized(data: torch.Tensor) -> torch.Tensor:
        data = of_one_layout(data)
        return torch.batch_norm(data - by_channel(mean, data) if far else data, None, None, *arguments)

    return normalized


def normalized_batch(
    data: torch.Tensor,
    normalize: Callable[..., Any],
    affine: tuple[torch.Tensor | None, torch.Tensor | None],
    eps: float,
    *options: Any,
) -> tuple[Any, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Normalize a batch (N, C, ...) with torch's function ``normalize``; ``affine`` are factors and biases, or None.

    Returns its result, its input, the means (C,) and the unbiased variances (C,).
    """
    data = of_one_layout(data)
    made, mean, variance = _normalized(data, normalize, affine, eps, options)
    exact_enough = torch.finfo(data.dtype).bits < 32  # data of fewer bits lost more by their own rounding
    if not exact_enough and _far_from_zero(mean, variance, eps):
        # Subtracting a constant from each channel changes only the rounding, not the result or the gradient.
        data = data - by_channel(mean, data)
        made, _, variance = _normalized(data, normalize, affine, eps, options)
    # Torch's unbiased variance of one value is 0 / 0, Caffe's 0.
    return made, data, mean, torch.zeros_like(variance) if data.numel() == len(mean) else variance


def _normalized(
    data: torch.Tensor, normalize: Callable[..., Any], affine: Any, eps: float, options: Any
) -> tuple[Any, torch.Tensor, torch.Tensor]:
    exact_enough = torch.promote_types(data.dtype, torch.float32)
    mean, variance = data.new_zeros(2, data.shape[1], dtype=exact_enough).unbind()
    made = normalize(data, *affine, mean, variance, True, 1.0, eps, *options)
    return made, mean, variance


def _far_from_zero(mean: torch.Tensor, variance: torch.Tensor, eps: float) -> bool:
    """Return whether torch's kernel would lose digits: on a CPU it computes x / std - mean / std.

    Compiled by torch.compile, it subtracts the mean first.
    """
    return (
        mean.device.type == "cpu"
        and not torch.compiler.is_compiling()
        and bool((mean.square() > MAX_OFFSET**2 * (variance + eps)).any())
    )

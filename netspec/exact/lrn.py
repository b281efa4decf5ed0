"""Local response normalization.

Caffe: src/caffe/layers/lrn_layer.cpp
"""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

from typing import NamedTuple

import torch
from torch.nn import functional as F

from netspec.exact import libm
from netspec.exact.pointwise import pointwise
from netspec.exact.sums import Product


class Settings(NamedTuple):
    """The numbers of a local response normalization."""

    size: int
    alpha: float
    beta: float
    k: float


def within_channel(maps: torch.Tensor, settings: Settings) -> torch.Tensor:
    """Divide each value by a power of the squares around it in its map: (1 + alpha * their mean) ** beta.

    Caffe computes this with an internal net: Power, average Pooling, Power and a product.
    """
    size, alpha, beta, _ = settings
    squares = pointwise(maps, lambda x: libm.power(x, 2), lambda x, _, diff: diff * (2 * x))
    means = F.avg_pool2d(squares, size, stride=1, padding=size // 2)

    def roots(x: torch.Tensor) -> torch.Tensor:
        return libm.power(alpha * x + 1, -beta)

    def gradient(x: torch.Tensor, root: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return diff * (root / (alpha * x + 1) * (-beta * alpha))

    return Product.apply(True, maps, pointwise(means, roots, gradient))


def across_channels(maps: torch.Tensor, settings: Settings) -> torch.Tensor:
    """Divide each value by a power of the squares in the channels around it: (k + alpha / size * their sum) ** beta.

    The sums run from channel to channel; each step of them rounds once, as BLAS' axpy does.
    """

    def compute(maps: torch.Tensor) -> torch.Tensor:
        size, alpha, beta, k = settings
        return libm.power(_forward_sums(maps * maps, size, alpha / size, k), -beta) * maps

    return pointwise(maps, compute, lambda maps, tops, diff: across_channels_gradient(maps, tops, diff, settings))


def across_channels_gradient(
    maps: torch.Tensor, tops: torch.Tensor, diff: torch.Tensor, settings: Settings
) -> torch.Tensor:
    """Return the gradient of :func:`across_channels`, (N, C, H, W), from ``tops`` that may have been overwritten."""
    size, alpha, beta, k = settings
    base = _forward_sums(maps * maps, size, alpha / size, k)
    sums = _backward_sums(diff * tops / base, size)
    return torch.add(diff * libm.power(base, -beta), maps * sums, alpha=-2 * alpha * beta / size)


def _padded(maps: torch.Tensor, size: int) -> torch.Tensor:
    """Pad the channels with zeros, so that there is a window of ``size`` channels around each."""
    return F.pad(maps, (0, 0, 0, 0, size // 2, size // 2))


def _forward_sums(squares: torch.Tensor, size: int, factor: float, start: float) -> torch.Tensor:
    """Return start + factor * sum for each window. Between windows, one channel is added and one subtracted."""
    padded = _padded(squares, size)
    sums = torch.empty_like(squares)
    running = torch.full_like(squares[:, 0], start)
    for channel in range(size):
        running = torch.add(running, padded[:, channel], alpha=factor)
    sums[:, 0] = running
    for channel in range(1, squares.shape[1]):
        running = torch.add(running, padded[:, channel + size - 1], alpha=factor)
        running = torch.add(running, padded[:, channel - 1], alpha=-factor)
        sums[:, channel] = running
    return sums


def _backward_sums(ratios: torch.Tensor, size: int) -> torch.Tensor:
    """Return the sum of each window of channels. Each channel is added once, and subtracted after its last window."""
    padded = _padded(ratios, size)
    sums = torch.empty_like(ratios)
    running = torch.zeros_like(ratios[:, 0])
    for channel in range(size - 1):
        running = running + padded[:, channel]
    for channel in range(ratios.shape[1]):
        running = running + padded[:, channel + size - 1]
        sums[:, channel] = running
        running = running - padded[:, channel]
    return sums

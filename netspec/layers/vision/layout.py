"""In which order maps lie in memory.

Caffe's blobs lie image by image, map by map. Torch's kernels for CPUs are faster where the channels of a pixel lie side
by side (``torch.channels_last``), as vectors then hold channels. Max pooling takes a tenth of the time, batch
normalization half, convolution six to ten tenths. What a layer computes does not depend on the order, but for
the rounding of sums. Layers further on keep the order they meet; those that look at maps as vectors restore Caffe's.
Gradients come in the order of the maps they belong to: where the two differ, torch's kernels take 10 to 20 times as
long.
"""

from __future__ import annotations

from typing import Any

import torch

from netspec.exact.switch import is_recorded

FEWEST = 3  # channels from which on the other order pays


def channels_side_by_side(maps: torch.Tensor) -> torch.Tensor:
    """Return maps (N, C, H, W) in the order that suits torch's kernels: on a CPU with their channels side by side."""
    if maps.dim() != 4 or maps.device.type != "cpu":
        return maps
    if maps.shape[1] < FEWEST:
        return of_one_channel(maps)
    if maps.is_contiguous(memory_format=torch.channels_last):
        return maps
    if not torch.is_grad_enabled() or is_recorded():
        return maps.contiguous(memory_format=torch.channels_last)
    return _SideBySide.apply(maps)


def of_one_channel(maps: torch.Tensor) -> torch.Tensor:
    """Return maps (N, 1, H, W) with the strides of Caffe's order, others as they are.

    A single channel lies alike in both orders. By its strides torch may take it for the other one, and some of oneDNN's
    convolutions then compute wrong numbers.
    """
    if maps.dim() != 4 or maps.shape[1] != 1 or maps.stride(1) == maps.shape[2] * maps.shape[3]:
        return maps
    return maps.reshape(-1).view(maps.shape)


def map_by_map(maps: torch.Tensor) -> torch.Tensor:
    """Return maps (N, C, H, W) in Caffe's order."""
    return of_one_channel(maps.contiguous())


class _SideBySide(torch.autograd.Function):
    """Return maps with their channels side by side; their gradient comes map by map, as they did."""

    @staticmethod
    def forward(maps: torch.Tensor) -> torch.Tensor:
        return maps.contiguous(memory_format=torch.channels_last)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[torch.Tensor], output: torch.Tensor) -> None:
        """Keep nothing."""

    @staticmethod
    def backward(ctx: Any, *diffs: torch.Tensor) -> torch.Tensor:
        return diffs[0].contiguous()

"""The memory layout of maps.

Caffe's blobs are stored image by image, map by map. Torch's kernels for CPUs are faster with the channels of a pixel
next to each other (``torch.channels_last``), because vectors then hold channels. Max pooling takes a tenth of the time,
batch normalization half, convolution six to ten tenths. The results do not depend on the layout, except for the
rounding of sums. Later layers keep the layout of their bottom; layers that take maps as vectors restore Caffe's.
Gradients have the layout of their maps. If the two differ, torch's kernels take 10 to 20 times as long.
"""

from __future__ import annotations

from typing import Any

import torch

from netspec.exact.blas import is_recorded

FEWEST = 3  # with fewer channels, channels_last is not faster
LAST = {4: torch.channels_last, 5: torch.channels_last_3d}  # by the number of axes


def channels_side_by_side(maps: torch.Tensor) -> torch.Tensor:
    """Return maps (N, C, H, W) in the layout that is best for torch's kernels: channels_last on a CPU."""
    if maps.dim() != 4 or maps.device.type != "cpu":
        return maps
    if maps.shape[1] < FEWEST:
        return of_one_channel(maps)
    if maps.is_contiguous(memory_format=torch.channels_last):
        return maps
    if not torch.is_grad_enabled() or is_recorded():
        return maps.contiguous(memory_format=torch.channels_last)
    return _Relaid.apply(maps, torch.channels_last, torch.contiguous_format)


def of_one_channel(maps: torch.Tensor) -> torch.Tensor:
    """Return maps (N, 1, H, W) with the strides of Caffe's layout. Return other maps unchanged.

    With a single channel, both layouts are the same in memory. Its strides may be those of channels_last, and some of
    oneDNN's convolutions then compute wrong numbers.
    """
    if maps.dim() != 4 or maps.shape[1] != 1 or maps.stride(1) == maps.shape[2] * maps.shape[3]:
        return maps
    return maps.reshape(-1).view(maps.shape)


def map_by_map(maps: torch.Tensor) -> torch.Tensor:
    """Return maps (N, C, H, W) in Caffe's layout."""
    if maps.dim() != 4 or maps.is_contiguous() or not maps.is_contiguous(memory_format=torch.channels_last):
        return of_one_channel(maps.contiguous())
    if not torch.is_grad_enabled() or is_recorded():
        return maps.contiguous()
    return _Relaid.apply(maps, torch.contiguous_format, torch.channels_last)


def of_one_layout(maps: torch.Tensor) -> torch.Tensor:
    """Return maps (N, C, ...) in channels_last, with exactly its strides, if an axis other than C has length 1.

    The stride of such an axis means nothing; views set it as they like. From it torch's batch normalization guesses the
    layout of maps and of their gradient. If it guesses two layouts, it reads the gradient in the wrong order. Maps with
    the strides of channels_last are safe with every gradient.
    """
    layout = LAST.get(maps.dim())
    if layout is None or maps.device.type != "cpu" or 1 not in (len(maps), *maps.shape[2:]) or is_recorded():
        return maps
    strides = torch.empty(maps.shape, device="meta").to(memory_format=layout).stride()
    return maps if maps.stride() == strides else maps.clone(memory_format=layout)


def in_shape(maps: torch.Tensor, shape: torch.Size | tuple[int, ...]) -> torch.Tensor:
    """Return maps in another shape. Maps that have the shape keep their strides, unlike those of ``reshape``."""
    return maps if maps.shape == shape else maps.reshape(shape)


def layout_of(maps: torch.Tensor) -> torch.memory_format:
    """Return the memory layout of maps: torch.channels_last, or torch.contiguous_format for every other."""
    last = maps.dim() == 4 and not maps.is_contiguous() and maps.is_contiguous(memory_format=torch.channels_last)
    return torch.channels_last if last else torch.contiguous_format


def laid_out_like(maps: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
    """Return the gradient in the memory layout of the maps, because torch's kernels are slow if layouts differ."""
    return diff.contiguous(memory_format=layout_of(maps))


class _Relaid(torch.autograd.Function):
    """Return maps in another layout. Their gradient gets the layout that the maps had, so that kernels stay fast."""

    @staticmethod
    def forward(maps: torch.Tensor, layout: torch.memory_format, before: torch.memory_format) -> torch.Tensor:
        return maps.contiguous(memory_format=layout)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: torch.Tensor) -> None:
        ctx.before = inputs[2]

    @staticmethod
    def backward(ctx: Any, *diffs: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return diffs[0].contiguous(memory_format=ctx.before), None, None


def by_channel(values: torch.Tensor, maps: torch.Tensor) -> torch.Tensor:
    """Return one value for each channel (C,) in a shape that broadcasts over maps (N, C, ...)."""
    return values.view(-1, *(1,) * (maps.dim() - 2))

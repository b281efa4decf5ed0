"""Convolution as Caffe computes it: the pixels under the filter as columns, times the filters, image by image."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

Geometry = tuple[Sequence[int], Sequence[int], Sequence[int]]


class ColumnProducts(torch.autograd.Function):
    """Cross-correlate maps with filters, with the sums in Caffe's order.

    maps      (N, C, H, W)
    weight    (num_output, C, kernel_h, kernel_w)
    bias      (num_output,) or None
    geometry  stride, pad and dilation, each (vertical, horizontal)
    returns   (N, num_output, H', W')

    Float32 sums differ by their order in the last bits; those decide between two nearly equal pixels in a max pooling,
    and the adaptive solvers blow that up. Caffe's order is one product an image, the bias added afterwards, and the
    gradients of weight and bias added up image by image.
    Caffe: src/caffe/layers/base_conv_layer.cpp, src/caffe/util/im2col.cpp
    """

    @staticmethod
    def forward(
        ctx: Any, maps: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, geometry: Geometry
    ) -> torch.Tensor:
        """Return the responses; keep the maps, not their columns, which are larger by the filter's pixels."""
        ctx.save_for_backward(maps, weight)
        ctx.geometry = geometry
        filters = weight.flatten(1)
        axes = zip(maps.shape[2:], weight.shape[2:], *geometry, strict=True)
        spatial = [(size + 2 * p - d * (k - 1) - 1) // s + 1 for size, k, s, p, d in axes]
        tops = maps.new_empty(len(maps), len(weight), *spatial)
        for image, top in zip(maps, tops.flatten(2), strict=True):
            torch.mm(filters, _columns(image, weight.shape[2:], geometry), out=top)
            if bias is not None:
                top += bias[:, None]
        return tops

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        """Return the gradients of maps, weight and bias, where they are asked for."""
        maps, weight = ctx.saved_tensors
        needs_maps, needs_weight, needs_bias, _ = ctx.needs_input_grad
        filters, kernel = weight.flatten(1), weight.shape[2:]
        stride, pad, dilation = ctx.geometry
        maps_diff = torch.empty_like(maps) if needs_maps else None
        weight_diff = torch.zeros_like(filters)
        bias_diff = weight.new_zeros(len(weight))
        for n, diff in enumerate(tops_diff.flatten(2)):
            if needs_bias:
                bias_diff += diff.sum(1)
            if needs_weight:
                weight_diff += diff @ _columns(maps[n], kernel, ctx.geometry).T
            if maps_diff is not None:
                maps_diff[n] = F.fold(filters.T @ diff, maps.shape[2:], kernel, dilation, pad, stride)
        return maps_diff, weight_diff.reshape(weight.shape), bias_diff if needs_bias else None, None


def _columns(image: torch.Tensor, kernel: Sequence[int], geometry: Geometry) -> torch.Tensor:
    """Return (C kernel_h kernel_w, H' W'): a column for each position of the filter, the pixels under it."""
    stride, pad, dilation = geometry
    windows = F.pad(image, (pad[1], pad[1], pad[0], pad[0])) if any(pad) else image
    for axis in (0, 1):
        extent = dilation[axis] * (kernel[axis] - 1) + 1
        windows = windows.unfold(1 + axis, extent, stride[axis])[..., :: dilation[axis]]
    return windows.permute(0, 3, 4, 1, 2).reshape(len(image) * kernel[0] * kernel[1], -1)

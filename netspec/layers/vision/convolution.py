"""Convolution and Deconvolution."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch.nn import functional as F
from typing_extensions import override

from netspec.exact import SMALL_PRODUCT
from netspec.exact.layout import in_shape
from netspec.exact.products import Filter
from netspec.layers.contract.base import Shape
from netspec.layers.contract.registry import register
from netspec.layers.vision.sliding import SlidingFilter


@register("Convolution", "convolution_param")
class Convolution(SlidingFilter):
    """Cross-correlate maps with learnable filters; any number of bottoms share the filters.

    bottom[i]  (N, C, H, W); in general (..., C, up to three spatial axes), where ``axis`` is the axis of C
    top[i]     (N, num_output, H', W'),  H' = (H + 2 pad - dilation (kernel - 1) - 1) // stride + 1
    blobs[0]   filters (num_output, C / group, kernel_h, kernel_w)
    blobs[1]   bias    (num_output,)                                   unless bias_term: false
    Caffe: src/caffe/layers/base_conv_layer.cpp, conv_layer.cpp
    """

    bottoms = (1, None)
    tops = (1, None)
    same_tops = True

    def setup(self) -> None:
        self.read_geometry()
        if self.spatial_axes > 3:
            raise self.error(
                f"{self.type} of {self.spatial_axes} spatial axes is not supported; at most 3 are", "bottom"
            )
        param = self.param.convolution_param
        self.channels = self.bottom_shapes[0][self.channel_axis]
        self.num_output, self.group = param.num_output, param.group
        if self.num_output < 1:
            raise self.error("num_output must be at least 1", "convolution_param", "num_output")
        for name, count in (("channels of the bottom", self.channels), ("num_output", self.num_output)):
            if self.group < 1 or count % self.group:
                raise self.error(
                    f"{name}, {count}, must be a multiple of group, {self.group}", "convolution_param", "group"
                )
        self.add_blob(self.filter_shape(), param.weight_filler)
        if param.bias_term:
            self.add_blob((self.num_output,), param.bias_filler)

    def filter_shape(self) -> Shape:
        """Return the shape of blobs[0]."""
        return (self.num_output, self.channels // self.group, *self.kernel)

    def output_shape(self, shape: Shape) -> Shape:
        """Return the spatial shape of a top for a bottom of ``shape``."""
        return self.slide(shape)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return one shape for all tops. Raise SpecError for bottoms that do not fit the filters."""
        self.check_axes(bottom_shapes, self.channels)
        shape = bottom_shapes[0]
        top = (*shape[: self.channel_axis], self.num_output, *self.output_shape(shape))
        return [top] * len(bottom_shapes)

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        weight = self.blob(0)
        bias = self.blob(1) if len(self.blobs) > 1 else None
        if not self.kernel:  # a map without spatial axes counts as a single pixel
            weight = weight.unsqueeze(2)
        geometry = [v or (n,) for v, n in ((self.stride, 1), (self.pad, 0), (self.dilation, 1))]
        sliding = Filter(tuple(weight.shape[2:]), *geometry)
        tops = []
        for bottom in reversed(bottoms):  # autograd starts with the last: the first bottom, as in Caffe
            images = math.prod(bottom.shape[: self.channel_axis])
            maps = in_shape(bottom, (images, self.channels, *(bottom.shape[self.channel_axis + 1 :] or (1,))))
            tops.append(in_shape(self.apply_filters(maps, weight, bias, sliding), self.top_shapes[0]))
        return tuple(reversed(tops))

    def apply_filters(
        self, maps: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter
    ) -> torch.Tensor:
        """Return the responses to maps (N, C, spatial axes) with at least one spatial axis."""
        overhang = self.overhang(self.bottom_shapes[0])
        if any(overhang):
            maps = F.pad(maps, overhang)
        return self.arithmetic(maps).convolution(maps, weight, bias, sliding, self.group)

    @property
    def small(self) -> bool:
        return self.spatial_axes == 2 and self.group == 1 and self.work <= SMALL_PRODUCT

    @property
    def work(self) -> int:
        """The multiply-adds for one image, without the bias."""
        return math.prod(self.top_shapes[0][self.channel_axis + 1 :]) * math.prod(self.blob_shapes[0])

    def multiply_adds(self) -> int:
        pixels = math.prod(self.top_shapes[0]) // self.num_output
        return len(self.top_shapes) * pixels * math.prod(self.blob_shapes[0])


@register("Deconvolution", "convolution_param")
class Deconvolution(Convolution):
    """Spread each pixel with learnable filters, like the backward pass of a convolution.

    bottom[i]  (N, C, H, W); in general (..., C, up to three spatial axes), where ``axis`` is the axis of C
    top[i]     (N, num_output, H', W'),  H' = stride (H - 1) + dilation (kernel - 1) + 1 - 2 pad
    blobs[0]   filters (C, num_output / group, kernel_h, kernel_w)
    blobs[1]   bias    (num_output,)                                   unless bias_term: false
    Caffe: src/caffe/layers/base_conv_layer.cpp, deconv_layer.cpp
    """

    @override
    def filter_shape(self) -> Shape:
        """Return the shape of blobs[0], with the channels of a convolution's filters exchanged."""
        return (self.channels, self.num_output // self.group, *self.kernel)

    @override
    def output_shape(self, shape: Shape) -> Shape:
        axes = zip(shape[self.channel_axis + 1 :], self.stride, self.extent, self.pad, strict=True)
        spatial = tuple(s * (size - 1) + e - 2 * p for size, s, e, p in axes)
        self.check_output(spatial, shape)
        return spatial

    @override
    def apply_filters(
        self, maps: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter
    ) -> torch.Tensor:
        """Return the maps (N, C, spatial axes), with at least one spatial axis, spread by the filters."""
        size = self.top_shapes[0][self.channel_axis + 1 :] or (1,)
        return self.arithmetic(maps).deconvolution(maps, weight, bias, (sliding, self.group), size)

    def multiply_adds(self) -> int:
        pixels = math.prod(self.bottom_shapes[0]) // self.channels
        return len(self.bottom_shapes) * pixels * math.prod(self.blob_shapes[0])

    @property
    def small(self) -> bool:
        return False

    @override
    def overhang(self, shape: Shape) -> list[int]:
        """Return zeros, since any filter fits."""
        return [0] * (2 * self.spatial_axes)

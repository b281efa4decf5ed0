"""The base of layers that slide a filter over a map, and Im2col."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import chain

import torch
from torch.nn import functional as F

from netspec.exact.products import Filter
from netspec.layers.contract.base import Layer, Shape
from netspec.layers.contract.registry import register


def _by(sizes: Shape) -> str:
    return " x ".join(map(str, sizes))


class SlidingFilter(Layer):
    """Base of layers with a ConvolutionParameter: the geometry of the filter, one number per spatial axis."""

    kernel: Shape
    stride: Shape
    pad: Shape
    dilation: Shape

    def read_geometry(self) -> None:
        """Read ``axis`` and the filter's kernel, stride, pad and dilation for the first bottom's axes."""
        param, shape = self.param.convolution_param, self.bottom_shapes[0]
        self.channel_axis = self.canonical_axis(param.axis, shape, "convolution_param", "axis")
        self.spatial_axes = len(shape) - self.channel_axis - 1
        given = param.kernel_size or param.HasField("kernel_h") or param.HasField("kernel_w")
        if self.spatial_axes and not given:
            raise self.error("kernel_size (or kernel_h and kernel_w) is missing", "convolution_param")
        self.kernel = self._read("kernel_size", "kernel_h", "kernel_w", default=1, least=1)
        self.stride = self._read("stride", "stride_h", "stride_w", default=1, least=1)
        self.pad = self._read("pad", "pad_h", "pad_w", default=0, least=0)
        self.dilation = self._read("dilation", None, None, default=1, least=1)

    def _read(self, name: str, name_h: str | None, name_w: str | None, default: int, least: int) -> Shape:
        param, axes, field = self.param.convolution_param, self.spatial_axes, "convolution_param"
        given = tuple(getattr(param, name))
        pair = [n for n in (name_h, name_w) if n is not None and param.HasField(n)]
        if pair:
            if given:
                raise self.error(f"found both {name} and {pair[0]}; give one of them", field, pair[0])
            if axes != 2:
                raise self.error(f"{pair[0]} is for 2 spatial axes, found {axes}; use {name}", field, pair[0])
            given = (getattr(param, str(name_h)), getattr(param, str(name_w)))
        elif len(given) <= 1:
            given = (given or (default,)) * axes
        elif len(given) != axes:
            message = f"found {name} {len(given)} times, expected once or once for each of {axes} spatial axes"
            raise self.error(message, field, name, axes)
        if any(v < least for v in given):
            names = f"{name_h} and {name_w}" if pair else name
            raise self.error(f"{names} must be at least {least}, found {_by(given)}", field, pair[0] if pair else name)
        return given

    @property
    def extent(self) -> Shape:
        """The pixels that a dilated filter spans."""
        return tuple(d * (k - 1) + 1 for k, d in zip(self.kernel, self.dilation, strict=True))

    def slide(self, shape: Shape) -> Shape:
        """Return the number of positions of the filter along each spatial axis of a bottom of ``shape``."""
        axes = zip(shape[self.channel_axis + 1 :], self.pad, self.extent, self.stride, strict=True)
        # C++ rounds toward zero, so a filter that is too long by less than a stride still has one position, over zeros.
        fits = tuple(int((size + 2 * p - e) / s) + 1 for size, p, e, s in axes)
        self.check_output(fits, shape)
        return fits

    def check_output(self, spatial: Shape, shape: Shape) -> None:
        """Raise SpecError for tops without pixels."""
        if any(size < 1 for size in spatial):
            raise self.error(
                f"the filter does not fit: a bottom of shape {shape} would give a map of {_by(spatial)} (kernel "
                f"{_by(self.kernel)}, stride {_by(self.stride)}, pad {_by(self.pad)}, dilation {_by(self.dilation)})",
                "convolution_param",
            )

    def check_axes(self, bottom_shapes: Sequence[Shape], channels: int) -> None:
        """Raise SpecError for bottoms that do not fit the filters, or that have different shapes."""
        shape = bottom_shapes[0]
        if len(shape) != self.channel_axis + 1 + self.spatial_axes or shape[self.channel_axis] != channels:
            raise self.error(
                f"bottom of shape {shape} does not fit the filters, made for {channels} channels at axis "
                f"{self.channel_axis} and {self.spatial_axes} spatial axes",
                "bottom",
            )
        for i, other in enumerate(bottom_shapes):
            if other != shape:
                raise self.error(f"all bottoms must have the same shape, found {shape} and {other}", "bottom", i)

    def overhang(self, shape: Shape) -> list[int]:
        """Return, in the order of F.pad, the zeros to append where the filter is longer than the padded map."""
        axes = zip(shape[self.channel_axis + 1 :], self.pad, self.extent, strict=True)
        short = [max(0, e - size - 2 * p) for size, p, e in axes]
        return list(chain.from_iterable((0, n) for n in reversed(short)))


@register("Im2col", "convolution_param")
class Im2col(SlidingFilter):
    """Return the pixels under each position of a filter as channels.

    bottom[0]  (N, C, H, W); with ``axis`` and other kernels (..., C, spatial axes: any number, at least one)
    top[0]     (N, C kernel_h kernel_w, H', W'),  H' as for Convolution; zero where the filter is outside the map
    Caffe: src/caffe/layers/im2col_layer.cpp
    """

    ignores_propagate_down = frozenset({0})
    ignores = frozenset(
        f"convolution_param.{name}" for name in ("num_output", "bias_term", "group", "weight_filler", "bias_filler")
    )

    def setup(self) -> None:
        self.read_geometry()
        if self.spatial_axes < 1:
            raise self.error("the bottom has no spatial axis after its channels", "bottom")
        self.channels = self.bottom_shapes[0][self.channel_axis]

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape with a channel for each pixel of the filter, and the filter's positions."""
        self.check_axes(bottom_shapes, self.channels)
        shape = bottom_shapes[0]
        return [(*shape[: self.channel_axis], self.channels * math.prod(self.kernel), *self.slide(shape))]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        overhang = self.overhang(self.bottom_shapes[0])
        maps = F.pad(data, overhang) if any(overhang) else data
        maps = maps.reshape(math.prod(maps.shape[: self.channel_axis]), *maps.shape[self.channel_axis :])
        sliding = Filter(self.kernel, self.stride, self.pad, self.dilation)
        return self.arithmetic(data).columns(maps, sliding).reshape(self.top_shapes[0])

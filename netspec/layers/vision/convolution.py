"""Layers that slide a filter over a map, and Crop, which cuts a map to the size of another."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import chain
from typing import Any, ClassVar

import torch
from torch.nn import functional as F
from typing_extensions import override

from netspec.exact import SMALL_PRODUCT
from netspec.exact.bound import BoundColumns
from netspec.exact.products import (
    ColumnProducts,
    Columns,
    Filter,
    SpreadProducts,
    SummedConvolutions,
    convolution,
    laid_out_like,
    prepared_columns,
)
from netspec.exact.switch import is_recorded
from netspec.layers import fused
from netspec.layers.base import Layer, Shape, copy_of
from netspec.layers.exporting import refusal
from netspec.layers.folding import Absorbed, blob_like
from netspec.layers.preparing import Kernel, Preparation, finished
from netspec.layers.registry import register
from netspec.layers.targets import OnnxGraph, TorchCode
from netspec.layers.training import Kernels, Learning, weight_and_bias
from netspec.layers.vision.layout import channels_side_by_side


def _by(sizes: Shape) -> str:
    return " x ".join(map(str, sizes))


class _SlidingFilter(Layer):
    """Base of the layers described by a ConvolutionParameter: the filter's geometry, one number per spatial axis."""

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
                raise self.error(f"{pair[0]} is for 2 spatial axes, the bottom has {axes}; use {name}", field, pair[0])
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
        """Return how often the filter fits, along each spatial axis of a bottom of ``shape``."""
        axes = zip(shape[self.channel_axis + 1 :], self.pad, self.extent, self.stride, strict=True)
        # C++ rounds a quotient toward zero: a filter too long by less than a stride still fits once, over zeros.
        fits = tuple(int((size + 2 * p - e) / s) + 1 for size, p, e, s in axes)
        self.check_output(fits, shape)
        return fits

    def check_output(self, spatial: Shape, shape: Shape) -> None:
        """Refuse tops without a single pixel."""
        if any(size < 1 for size in spatial):
            raise self.error(
                f"the filter does not fit: a bottom of shape {shape} would give a map of {_by(spatial)} (kernel "
                f"{_by(self.kernel)}, stride {_by(self.stride)}, pad {_by(self.pad)}, dilation {_by(self.dilation)})",
                "convolution_param",
            )

    def check_axes(self, bottom_shapes: Sequence[Shape], channels: int) -> None:
        """Refuse bottoms that the filters, made for those seen first, do not suit; all must have one shape."""
        shape = bottom_shapes[0]
        if len(shape) != self.channel_axis + 1 + self.spatial_axes or shape[self.channel_axis] != channels:
            raise self.error(
                f"bottom of shape {shape} does not fit the filters, made for {channels} channels at axis "
                f"{self.channel_axis} and {self.spatial_axes} spatial axes",
                "bottom",
            )
        for i, other in enumerate(bottom_shapes):
            if other != shape:
                raise self.error(f"all bottoms must have one shape, found {shape} and {other}", "bottom", i)

    def overhang(self, shape: Shape) -> list[int]:
        """Return, in the order of F.pad, the zeros to append where the filter is longer than the padded map."""
        axes = zip(shape[self.channel_axis + 1 :], self.pad, self.extent, strict=True)
        short = [max(0, e - size - 2 * p) for size, p, e in axes]
        return list(chain.from_iterable((0, n) for n in reversed(short)))

    def onnx_geometry(self) -> dict[str, Any]:
        """Return the attributes of ONNX's Conv and ConvTranspose."""
        if not self.kernel:
            return {"kernel_shape": [1]}
        return {
            "kernel_shape": list(self.kernel),
            "strides": list(self.stride),
            "dilations": list(self.dilation),
            "pads": [*self.pad, *self.pad],
        }

    onnx_op: ClassVar[str] = "Conv"

    def onnx_convolved(
        self, graph: OnnxGraph, maps: str, weights: Sequence[str], group: int, geometry: dict[str, Any]
    ) -> str:
        """Return the product with the filters. A filter of one pixel is padded before: OpenCV 5.0 does it wrong."""
        pads = geometry.get("pads", [])
        if self.onnx_op == "Conv" and set(self.kernel) == {1} and any(pads):
            before, after = pads[: len(self.pad)], pads[len(self.pad) :]
            maps = graph.node("Pad", maps, graph.constant([0, 0, *before, 0, 0, *after]))
            geometry = {**geometry, "pads": [0] * len(pads)}
        return graph.node(self.onnx_op, maps, *weights, group=group, **geometry)

    def torch_geometry(self) -> dict[str, Any]:
        """Return kernel, stride, padding and dilation as torch takes them: one number where all axes have the same."""
        given = {"kernel_size": self.kernel, "stride": self.stride, "padding": self.pad, "dilation": self.dilation}
        return {name: values[0] if len(set(values)) == 1 else values for name, values in given.items()}


TORCH_USUAL = {"stride": 1, "padding": 0, "dilation": 1, "groups": 1}


@register("Convolution", "convolution_param")
class Convolution(_SlidingFilter):
    """Cross-correlate each map with learned filters; any number of bottoms, one set of filters for all.

    bottom[i]  (N, C, H, W); with ``axis`` and other kernels (..., C, spatial axes: up to three)
    top[i]     (N, num_output, H', W'),  H' = (H + 2 pad - dilation (kernel - 1) - 1) // stride + 1
    blobs[0]   filters (num_output, C / group, kernel_h, kernel_w)
    blobs[1]   bias    (num_output,)                                   unless bias_term: false
    Caffe: src/caffe/layers/base_conv_layer.cpp, conv_layer.cpp
    """

    bottoms = (1, None)
    tops = (1, None)
    same_tops = True
    traceable = True

    @override
    def setup(self) -> None:
        self.read_geometry()
        if self.spatial_axes > 3:
            raise self.error(
                f"{self.type} of {self.spatial_axes} spatial axes is not supported, at most 3 are", "bottom"
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

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return one shape for all tops; the bottoms must suit the filters."""
        self.check_axes(bottom_shapes, self.channels)
        shape = bottom_shapes[0]
        top = (*shape[: self.channel_axis], self.num_output, *self.output_shape(shape))
        return [top] * len(bottom_shapes)

    @override
    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the responses to each bottom."""
        weight = self.blob(0)
        bias = self.blob(1) if len(self.blobs) > 1 else None
        if not self.kernel:  # a map without spatial axes is one of a single pixel
            weight = weight.unsqueeze(2)
        geometry = [v or (n,) for v, n in ((self.stride, 1), (self.pad, 0), (self.dilation, 1))]
        sliding = Filter(tuple(weight.shape[2:]), *geometry)
        tops = []
        for bottom in reversed(bottoms):  # autograd goes backward from the last: as in Caffe, through the first bottom
            images = math.prod(bottom.shape[: self.channel_axis])
            maps = bottom.reshape(images, self.channels, *(bottom.shape[self.channel_axis + 1 :] or (1,)))
            tops.append(self.apply_filters(maps, weight, bias, sliding).reshape(self.top_shapes[0]))
        return tuple(reversed(tops))

    def apply_filters(
        self, maps: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, sliding: Filter
    ) -> torch.Tensor:
        """Return the responses to maps (N, C, spatial axes), at least one."""
        overhang = self.overhang(self.bottom_shapes[0])
        if any(overhang):
            maps = F.pad(maps, overhang)
        if self.is_exact(maps, self.small):
            return ColumnProducts.apply(
                maps, weight, bias, sliding, self.group, self.context.options.accumulate_in_place
            )
        if not torch.is_grad_enabled():  # weights would be laid out anew for each product
            return convolution(maps, weight, bias, sliding, self.group)
        lay_out = channels_side_by_side if maps.numel() > 2 * weight.numel() else torch.Tensor.contiguous
        return self.convolved(maps, weight, bias, sliding, lay_out)

    def convolved(
        self,
        maps: torch.Tensor,
        weight: torch.Tensor,
        bias: torch.Tensor | None,
        sliding: Filter,
        lay_out: Callable[[torch.Tensor], torch.Tensor],
        transposed: bool = False,
    ) -> torch.Tensor:
        """Return what torch's kernel computes of maps that ``lay_out`` puts into its order, with gradients."""
        if self.context.options.accumulate_in_place and not is_recorded():
            return SummedConvolutions.apply(maps, weight, bias, sliding, self.group, transposed, lay_out)
        return convolution(lay_out(maps), weight, bias, sliding, self.group, transposed)

    @property
    @override
    def small(self) -> bool:
        return self.spatial_axes == 2 and self.group == 1 and self._work <= SMALL_PRODUCT

    @property
    def _work(self) -> int:
        """The multiply-adds for one image, bias aside."""
        return math.prod(self.top_shapes[0][self.channel_axis + 1 :]) * math.prod(self.blob_shapes[0])

    fresh = True
    any_layout = True

    def prepare(self, how: Preparation) -> Kernel | None:
        usual = self.channel_axis == 1 and self.spatial_axes == 2 and not any(self.overhang(self.bottom_shapes[0]))
        weight, bias = self.blob(0), self.blob(1) if len(self.blobs) > 1 else None
        exact = self.is_exact(weight, self.small)
        if not usual or len(self.bottom_shapes) > 1 or (exact and self.group > 1):
            return None
        shape, sliding = self.bottom_shapes[0], Filter(self.kernel, self.stride, self.pad, self.dilation)
        if exact:
            return finished(prepared_columns(shape, sliding, *self.values()), how.finish)
        if shape[0] * self._work > SMALL_PRODUCT and how.pack and fused.suits(weight):
            return fused.convolution(shape, weight, bias, sliding, self.group, how)
        geometry = (self.stride, self.pad, self.dilation, self.group)
        return finished(lambda maps: torch.conv2d(maps, weight, bias, *geometry), how.finish)

    def prepare_training(self, learning: Learning) -> Kernels | None:
        """Return the kernels for a single bottom (N, C, H, W)."""
        shape = self.bottom_shapes[0]
        usual = self.channel_axis == 1 and self.spatial_axes == 2 and not any(self.overhang(shape))
        if not usual or len(self.bottom_shapes) > 1 or math.prod(self.top_shapes[0]) == 0:
            return None
        sliding = Filter(self.kernel, self.stride, self.pad, self.dilation)
        (weight, bias), sums = weight_and_bias(self, learning)
        if self.is_exact(weight, self.small):
            asked = (learning.wanted[0], learning.steady)
            bound = BoundColumns(shape, sliding, self.group, weight, bias, *sums, *asked)
            return bound.forward, bound.backward
        lay_out = channels_side_by_side if math.prod(shape) > 2 * weight.numel() else torch.Tensor.contiguous
        return self.convolutions(sliding, weight, bias, sums, learning.wanted[0], lay_out)

    def convolutions(
        self,
        sliding: Filter,
        weight: torch.Tensor,
        bias: torch.Tensor | None,
        sums: Sequence[torch.Tensor | None],
        wanted: bool,
        lay_out: Callable[[torch.Tensor], torch.Tensor],
    ) -> Kernels:
        """Return what :class:`SummedConvolutions` computes, of maps that ``lay_out`` puts into its order."""
        geometry = (sliding.stride, sliding.pad, sliding.dilation)
        asked = (wanted, *(total is not None for total in sums))
        bias_shape = None if bias is None else list(bias.shape)
        gradients = torch.ops.aten.convolution_backward.default
        maps = laid_out = weight

        def forward(x: torch.Tensor) -> torch.Tensor:
            nonlocal maps, laid_out
            maps, laid_out = x, lay_out(x)
            return torch.conv2d(laid_out, weight, bias, *geometry, self.group)

        def backward(diff: torch.Tensor) -> torch.Tensor | None:
            maps_diff, *found = gradients(
                diff, laid_out, weight, bias_shape, *geometry, False, [0, 0], self.group, asked
            )
            for total, gradient in zip(sums, found, strict=True):
                if total is not None:
                    total.add_(gradient)
            return laid_out_like(maps, maps_diff) if wanted else None

        return forward, backward

    @override
    def multiply_adds(self) -> int:
        pixels = math.prod(self.top_shapes[0]) // self.num_output
        return len(self.top_shapes) * pixels * math.prod(self.blob_shapes[0])

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        weights = [graph.blob(0, (*self.blob_shapes[0], *(() if self.kernel else (1,))))]
        if len(self.blobs) > 1:
            weights.append(graph.blob(1))
        geometry = self.onnx_geometry()
        overhang = self.onnx_overhang(graph)
        if any(overhang):
            geometry["pads"] = [*self.pad, *(p + n for p, n in zip(self.pad, overhang, strict=True))]
        tops = []
        for i, bottom in enumerate(bottoms):
            usual = self.channel_axis == 1 and self.spatial_axes
            maps = bottom if usual else self._onnx_maps(graph, bottom)
            top = self.onnx_convolved(graph, maps, weights, self.group, geometry)
            tops.append(top if usual else graph.reshape_to_top(top, i))
        return tops

    def onnx_overhang(self, graph: OnnxGraph) -> Shape:
        """Return the zeros to append along each spatial axis, where the filter is longer than the padded map."""
        overhang = tuple(reversed(self.overhang(self.bottom_shapes[0])[1::2]))
        for axis, zeros in enumerate(overhang, self.channel_axis + 1):
            if zeros:
                graph.size(0, axis, "its filter is longer than the map")
        return overhang

    def _onnx_maps(self, graph: OnnxGraph, bottom: str) -> str:
        """Return a bottom as images, channels and at least one spatial axis."""
        first = self.channel_axis + 1
        why = "its channels are not axis 1"
        spatial = [graph.size(0, axis, why) for axis in range(first, first + self.spatial_axes)] or [1]
        return graph.reshape(bottom, [-1, self.channels, *spatial])

    @property
    def absorbs(self) -> bool:
        return self.channel_axis == 1

    def absorb(self, scale: torch.Tensor, shift: torch.Tensor) -> Absorbed:
        param = copy_of(self.param)
        param.convolution_param.bias_term = True
        bias = blob_like(self, 1, shift) if len(self.blobs) > 1 else torch.zeros_like(shift)
        return Absorbed(param, (self.scaled_filters(scale.expand(self.num_output)), scale * bias + shift))

    def scaled_filters(self, scale: torch.Tensor) -> torch.Tensor:
        """Return blobs[0] with the filters of each output channel multiplied by a number of their own."""
        filters = blob_like(self, 0, scale)
        return filters * scale.reshape(-1, *(1,) * (filters.dim() - 1))

    torch_module: ClassVar[str] = "Conv"

    def to_torch(self, code: TorchCode, *bottoms: str) -> Sequence[str]:
        if self.channel_axis != 1 or not self.spatial_axes or any(self.overhang(self.bottom_shapes[0])):
            raise refusal(self, "PyTorch", "it is exported for (N, C, spatial axes) and filters that fit")
        numbers = {"in_channels": self.channels, "out_channels": self.num_output}
        numbers |= {**self.torch_geometry(), "groups": self.group}
        options = ", ".join(f"{name}={{{name}}}" for name in list(numbers)[2:])
        bias = "" if len(self.blobs) > 1 else ", bias=False"
        template = f"nn.{self.torch_module}{self.spatial_axes}d({{in_channels}}, {{out_channels}}, {options}{bias})"
        state = {"weight": self.blob(0), **({"bias": self.blob(1)} if len(self.blobs) > 1 else {})}
        conv = code.module(template, state, TORCH_USUAL, **numbers)
        return [code.call("{conv}({x})", conv=conv, x=bottom) for bottom in bottoms]


@register("Deconvolution", "convolution_param")
class Deconvolution(Convolution):
    """Spread each pixel by learned filters: a convolution's backward pass, run forward.

    bottom[i]  (N, C, H, W); with ``axis`` and other kernels (..., C, spatial axes: up to three)
    top[i]     (N, num_output, H', W'),  H' = stride (H - 1) + dilation (kernel - 1) + 1 - 2 pad
    blobs[0]   filters (C, num_output / group, kernel_h, kernel_w)
    blobs[1]   bias    (num_output,)                                   unless bias_term: false
    Caffe: src/caffe/layers/base_conv_layer.cpp, deconv_layer.cpp
    """

    @override
    def filter_shape(self) -> Shape:
        """Return the shape of blobs[0]: a convolution's with its ends exchanged."""
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
        """Return the maps (N, C, spatial axes), at least one, spread by the filters."""
        if self.is_exact(maps):
            in_place, size = (
                self.context.options.accumulate_in_place,
                self.top_shapes[0][self.channel_axis + 1 :] or (1,),
            )
            return SpreadProducts.apply(maps, weight, bias, sliding, self.group, in_place, size)
        if not torch.is_grad_enabled():
            return convolution(maps, weight, bias, sliding, self.group, transposed=True)
        return self.convolved(maps, weight, bias, sliding, lambda maps: maps, transposed=True)

    @override
    def multiply_adds(self) -> int:
        pixels = math.prod(self.bottom_shapes[0]) // self.channels
        return len(self.bottom_shapes) * pixels * math.prod(self.blob_shapes[0])

    @property
    @override
    def small(self) -> bool:
        return False

    def prepare_training(self, learning: Learning) -> Kernels | None:
        return None

    def prepare(self, how: Preparation) -> Kernel | None:
        weight, bias = self.blob(0), self.blob(1) if len(self.blobs) > 1 else None
        usual = self.channel_axis == 1 and self.spatial_axes == 2 and len(self.bottom_shapes) == 1
        exact, large = self.is_exact(weight, self.small), self.multiply_adds() > SMALL_PRODUCT
        if usual and not exact and large and how.pack and fused.suits(weight):
            shape, sliding = self.bottom_shapes[0], Filter(self.kernel, self.stride, self.pad, self.dilation)
            if self.group == 1:
                return fused.deconvolution(shape, weight, bias, sliding, how)
            fits = all(p < e for p, e in zip(self.pad, self.extent, strict=True))
            if self.group == self.channels == self.num_output and fits and max(self.stride) <= 2:
                return fused.spread_by_channel(shape, weight, bias, sliding, how)
        return None

    onnx_op = "ConvTranspose"

    @override
    def overhang(self, shape: Shape) -> list[int]:
        """Return zeros: any filter fits."""
        return [0] * (2 * self.spatial_axes)

    @override
    def scaled_filters(self, scale: torch.Tensor) -> torch.Tensor:
        filters = blob_like(self, 0, scale)
        grouped = filters.reshape(self.group, -1, *filters.shape[1:])
        factors = scale.reshape(self.group, 1, -1, *(1,) * self.spatial_axes)
        return (grouped * factors).reshape(filters.shape)

    torch_module = "ConvTranspose"


@register("Im2col", "convolution_param")
class Im2col(_SlidingFilter):
    """Lay the pixels under each position of a filter side by side, as channels.

    bottom[0]  (N, C, H, W); with ``axis`` and other kernels (..., C, spatial axes: any number, at least one)
    top[0]     (N, C kernel_h kernel_w, H', W'),  H' as Convolution's; zero where the filter leaves the map
    Caffe: src/caffe/layers/im2col_layer.cpp
    """

    ignores = frozenset(
        f"convolution_param.{name}" for name in ("num_output", "bias_term", "group", "weight_filler", "bias_filler")
    )

    @override
    def setup(self) -> None:
        self.read_geometry()
        if self.spatial_axes < 1:
            raise self.error("the bottom has no spatial axis after its channels", "bottom")
        self.channels = self.bottom_shapes[0][self.channel_axis]

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape with a channel for each pixel of the filter, and the filter's positions."""
        self.check_axes(bottom_shapes, self.channels)
        shape = bottom_shapes[0]
        return [(*shape[: self.channel_axis], self.channels * math.prod(self.kernel), *self.slide(shape))]

    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
        overhang = self.overhang(self.bottom_shapes[0])
        if self.is_exact(data):
            maps = F.pad(data, overhang).flatten(0, self.channel_axis - 1) if self.channel_axis else data[None]
            sliding = Filter(self.kernel, self.stride, self.pad, self.dilation)
            return Columns.apply(maps, sliding).reshape(self.top_shapes[0])
        padding = chain.from_iterable((p, p) for p in reversed(self.pad))
        windows = F.pad(data, [p + n for p, n in zip(padding, overhang, strict=True)])
        first = self.channel_axis + 1
        geometry = zip(self.extent, self.stride, self.dilation, strict=True)
        for axis, (extent, stride, dilation) in enumerate(geometry, start=first):
            windows = windows.unfold(axis, extent, stride)[..., ::dilation]  # the filter's pixels, as a last axis
        last = first + self.spatial_axes
        order = (*range(first), *range(last, windows.dim()), *range(first, last))
        return windows.permute(order).reshape(self.top_shapes[0])

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        if self.channel_axis != 1 or self.spatial_axes > 3 or any(self.overhang(self.bottom_shapes[0])):
            raise refusal(self, "ONNX", "it is exported for (N, C, spatial axes) and filters that fit")
        pixels = math.prod(self.kernel)
        picks = (
            torch.eye(pixels).reshape(pixels, 1, *self.kernel).repeat(self.channels, *(1,) * (1 + self.spatial_axes))
        )
        return self.onnx_convolved(graph, bottoms[0], [graph.constant(picks)], self.channels, self.onnx_geometry())

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if self.channel_axis != 1 or self.spatial_axes != 2 or any(self.overhang(self.bottom_shapes[0])):
            raise refusal(self, "PyTorch", "it is exported for (N, C, H, W) and filters that fit")
        numbers = self.torch_geometry()
        options = ", ".join(f"{name}={{{name}}}" for name, value in numbers.items() if value != TORCH_USUAL.get(name))
        rows = self.top_shapes[0][2]
        code.size(0, 2, "the rows of windows are counted beforehand")
        template = f"{code.function(lay_out_windows)}({{x}}, {{rows}}, {options})"
        return code.call(template, x=bottoms[0], rows=rows, **numbers)


def lay_out_windows(x, rows, **geometry):
    """Return the pixels under each position of a filter as channels (N, C K, H, W)."""
    return F.unfold(x, **geometry).unflatten(2, (rows, -1))


@register("Crop", "crop_param")
class Crop(Layer):
    """Cut a blob to the size of another, from ``axis`` on.

    bottom[0]  the blob to cut, any shape
    bottom[1]  the blob of the wanted size, at least as many axes; gets no gradient
    top[0]     bottom[0]'s shape before ``axis``, bottom[1]'s from there on
    Caffe: src/caffe/layers/crop_layer.cpp
    """

    bottoms = (2, 2)

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the wanted shape; place the window."""
        data, wanted = bottom_shapes
        param = self.param.crop_param
        axis = self.canonical_axis(param.axis, data, "crop_param", "axis")
        cut = len(data) - axis
        if len(wanted) < len(data):
            raise self.error(f"cannot crop a blob of shape {data} to one of fewer axes, {wanted}", "bottom", 1)
        offsets = tuple(param.offset or (0,))
        if len(offsets) not in (1, cut):
            message = f"found offset {len(offsets)} times, expected once or once for each of {cut} cropped axes"
            raise self.error(message, "crop_param", "offset")
        offsets = offsets if len(offsets) == cut else offsets * cut
        self.window = [slice(None)] * axis
        for i, offset in enumerate(offsets, start=axis):
            if offset + wanted[i] > data[i]:
                message = f"offset {offset} and size {wanted[i]} of the crop leave axis {i}, of size {data[i]}"
                raise self.error(message, "crop_param", "offset", i - axis)
            self.window.append(slice(offset, offset + wanted[i]))
        return [(*data[:axis], *wanted[axis : len(data)])]

    @override
    def forward(self, data: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
        return data[tuple(self.window)]

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        axis = next((i for i, part in enumerate(self.window) if part != slice(None)), 0)
        starts = [part.start or 0 for part in self.window[axis:]]
        wanted = graph.shape_of(bottoms[1], axis, len(self.window))
        start = graph.constant(starts)
        axes = graph.constant(list(range(axis, len(self.window))))
        return graph.node("Slice", bottoms[0], start, graph.node("Add", wanted, start), axes)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        parts = []
        for axis, part in enumerate(self.window):
            if part == slice(None):
                parts.append(":")
            elif part.start == 0:
                parts.append(f": {{y}}.shape[{axis}]")
            else:
                parts.append(f"{part.start} : {part.start} + {{y}}.shape[{axis}]")
        return code.call(f"{{x}}[{', '.join(parts)}]", x=bottoms[0], y=bottoms[1])

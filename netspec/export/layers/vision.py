"""Exporters of the convolutions, Im2col, Pooling, SPP."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, ClassVar

import torch
from torch import nn
from torch.nn import functional as F

from netspec.export.exporter import Exporter, exports
from netspec.export.expression import Expression, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.contract.base import Shape
from netspec.layers.vision.convolution import Convolution, Deconvolution
from netspec.layers.vision.pooling import AVE, MAX, SPP, STOCHASTIC, Pooling
from netspec.layers.vision.sliding import Im2col
from netspec.layers.vision.windows import (
    CEIL,
    SMALLEST,
    Windows,
)
from netspec.proto.schema import TRAIN


class SlidingFilterExport(Exporter):
    onnx_filter: ClassVar[str] = "Conv"

    def onnx_geometry(self) -> dict[str, Any]:
        """Return the attributes of ONNX's Conv and ConvTranspose."""
        layer = self.layer
        if not layer.kernel:
            return {"kernel_shape": [1]}
        return {
            "kernel_shape": list(layer.kernel),
            "strides": list(layer.stride),
            "dilations": list(layer.dilation),
            "pads": [*layer.pad, *layer.pad],
        }

    def onnx_convolved(
        self, graph: OnnxGraph, maps: str, weights: Sequence[str], group: int, geometry: dict[str, Any]
    ) -> str:
        """Return the convolution. A filter of one pixel is padded by a separate node, for OpenCV 5.0."""
        layer = self.layer
        pads = geometry.get("pads", [])
        if self.onnx_filter == "Conv" and set(layer.kernel) == {1} and any(pads):
            before, after = pads[: len(layer.pad)], pads[len(layer.pad) :]
            maps = graph.node("Pad", maps, graph.constant([0, 0, *before, 0, 0, *after]))
            geometry = {**geometry, "pads": [0] * len(pads)}
        return graph.node(self.onnx_filter, maps, *weights, group=group, **geometry)

    def torch_geometry(self) -> dict[str, Any]:
        """Return the arguments of torch that are not usual; one number if all axes have the same."""
        layer = self.layer
        given = {"stride": (layer.stride, 1), "padding": (layer.pad, 0), "dilation": (layer.dilation, 1)}
        unusual = {name: each(values) for name, (values, usual) in given.items() if set(values) != {usual}}
        return {"kernel_size": each(layer.kernel), **unusual}


def each(sizes: Shape) -> Shape | int:
    """Return the sizes along some axes; one number if all are the same."""
    return sizes[0] if len(set(sizes)) == 1 else tuple(sizes)


@exports(Im2col)
class Im2colExport(SlidingFilterExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        if layer.channel_axis != 1 or layer.spatial_axes > 3 or any(layer.overhang(layer.bottom_shapes[0])):
            raise self.refusal("ONNX", "it is exported for (N, C, spatial axes) and filters that fit")
        pixels = math.prod(layer.kernel)
        picks = (
            torch.eye(pixels).reshape(pixels, 1, *layer.kernel).repeat(layer.channels, *(1,) * (1 + layer.spatial_axes))
        )
        return self.onnx_convolved(graph, bottoms[0], [graph.constant(picks)], layer.channels, self.onnx_geometry())

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        if layer.channel_axis != 1 or layer.spatial_axes != 2 or any(layer.overhang(layer.bottom_shapes[0])):
            raise self.refusal("PyTorch", "it is exported for (N, C, H, W) and filters that fit")
        code.size(0, 2, "the rows of windows are counted in advance")
        return call(lay_out_windows, x, layer.top_shapes[0][2], **self.torch_geometry())


@exports(Convolution)
class ConvolutionExport(SlidingFilterExport):
    torch_modules: ClassVar[Sequence[type[nn.Module]]] = (nn.Conv1d, nn.Conv2d, nn.Conv3d)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        layer = self.layer
        weights = [graph.blob(0, (*layer.blob_shapes[0], *(() if layer.kernel else (1,))))]
        if len(layer.blobs) > 1:
            weights.append(graph.blob(1))
        geometry = self.onnx_geometry()
        overhang = self.onnx_overhang(graph)
        if any(overhang):
            geometry["pads"] = [*layer.pad, *(p + n for p, n in zip(layer.pad, overhang, strict=True))]
        tops = []
        for i, bottom in enumerate(bottoms):
            usual = layer.channel_axis == 1 and layer.spatial_axes
            maps = bottom if usual else self._onnx_maps(graph, bottom)
            top = self.onnx_convolved(graph, maps, weights, layer.group, geometry)
            tops.append(top if usual else graph.reshape_to_top(top, i))
        return tops

    def onnx_overhang(self, graph: OnnxGraph) -> Shape:
        """Return the zeros to append along each spatial axis, where the filter is longer than the padded map."""
        layer = self.layer
        overhang = tuple(reversed(layer.overhang(layer.bottom_shapes[0])[1::2]))
        for axis, zeros in enumerate(overhang, layer.channel_axis + 1):
            if zeros:
                graph.size(0, axis, "its filter is larger than the map")
        return overhang

    def _onnx_maps(self, graph: OnnxGraph, bottom: str) -> str:
        """Return a bottom as images, channels and at least one spatial axis."""
        layer = self.layer
        first = layer.channel_axis + 1
        why = "its channels are not axis 1"
        spatial = [graph.size(0, axis, why) for axis in range(first, first + layer.spatial_axes)] or [1]
        return graph.reshape(bottom, [-1, layer.channels, *spatial])

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Sequence[Expression]:
        layer = self.layer
        if layer.channel_axis != 1 or not layer.spatial_axes or any(layer.overhang(layer.bottom_shapes[0])):
            raise self.refusal("PyTorch", "it is exported for (N, C, spatial axes) and filters that fit")
        options, state = self.torch_geometry(), {"weight": layer.blob(0)}
        if layer.group != 1:
            options["groups"] = layer.group
        if len(layer.blobs) > 1:
            state["bias"] = layer.blob(1)
        else:
            options["bias"] = False
        cls = self.torch_modules[layer.spatial_axes - 1]
        convolution = code.module(cls, layer.channels, layer.num_output, state=state, **options)
        return [convolution(bottom) for bottom in bottoms]


@exports(Deconvolution)
class DeconvolutionExport(ConvolutionExport):
    onnx_filter = "ConvTranspose"
    torch_modules = (nn.ConvTranspose1d, nn.ConvTranspose2d, nn.ConvTranspose3d)


class PoolingBaseExport(Exporter):
    def onnx_pool(
        self, graph: OnnxGraph, data: str, windows: Windows, method: int, mask: bool = False
    ) -> Sequence[str]:
        """Return the pooled maps, and the mask if wanted."""
        if any(r >= k for r, k in zip(windows.reach, windows.kernel, strict=True)):
            raise self.refusal(
                "ONNX",
                "windows with stride > kernel can lie outside the map; use round_mode: FLOOR",
            )
        pads = [*windows.pad, *windows.reach]
        geometry = {"kernel_shape": list(windows.kernel), "strides": list(windows.stride), "pads": pads}
        if method == MAX:
            return self._onnx_max(graph, data, geometry, mask)
        if method == AVE:
            return [self._onnx_average(graph, data, windows, geometry)]
        if self.layer.phase == TRAIN:
            raise self.refusal("ONNX", "STOCHASTIC pooling draws random numbers in the training phase")
        squares = graph.node("AveragePool", graph.node("Mul", data, data), count_include_pad=1, **geometry)
        mean = graph.node("AveragePool", data, count_include_pad=1, **geometry)
        least = graph.constant(SMALLEST / math.prod(windows.kernel))
        return [graph.node("Div", squares, graph.node("Add", mean, least))]

    def _onnx_max(self, graph: OnnxGraph, data: str, geometry: dict[str, Any], mask: bool) -> Sequence[str]:
        if not mask:
            return [graph.node("MaxPool", data, **geometry)]
        top, indices = graph.nodes("MaxPool", data, outputs=2, **geometry)
        pixels = graph.node("ReduceProd", graph.shape_of(data, 2, 4), keepdims=1)
        return [top, graph.cast(graph.node("Mod", indices, pixels), "float32")]  # ONNX counts through all maps

    def _onnx_average(self, graph: OnnxGraph, data: str, windows: Windows, geometry: dict[str, Any]) -> str:
        means = graph.node("AveragePool", data, count_include_pad=1, **geometry)
        beyond = [reach - pad for reach, pad in zip(windows.reach, windows.pad, strict=True)]
        fixed = None not in graph.sizes(0)[2:]
        areas = windows.areas(torch.zeros(())) / math.prod(windows.kernel)
        if not any(beyond) or (fixed and bool((areas == 1).all())):
            return means
        # The last windows reach past the padded map. Pixels there do not count.
        if fixed:
            return graph.node("Div", means, graph.constant(areas[None, None]))
        ones = graph.node("Expand", graph.constant(1.0), graph.shape_of(data))
        frame = graph.constant([0, 0, *windows.pad, 0, 0, *windows.pad])
        padded = graph.node("Pad", ones, frame, graph.constant(1.0), mode="constant")
        counts = dict(geometry, pads=[0, 0, *beyond])
        return graph.node("Div", means, graph.node("AveragePool", padded, count_include_pad=1, **counts))

    def torch_pool(self, x: Expression, windows: Windows, method: int, mask: bool = False) -> Expression:
        """Return the pooled maps; with ``mask``, the maps and the mask."""
        if self.layer.phase == TRAIN and method == STOCHASTIC:
            raise self.refusal("PyTorch", "STOCHASTIC pooling draws random numbers in the training phase")
        much = any(2 * p > k for p, k in zip(windows.pad, windows.kernel, strict=True))  # more than torch allows
        if any(r >= k for r, k in zip(windows.reach, windows.kernel, strict=True)) or (much and method != MAX):
            raise self.refusal("PyTorch", "windows can lie outside the map; use round_mode: FLOOR, or less padding")
        kernel = each(windows.kernel)
        options = {"stride": each(windows.stride)} if windows.stride != windows.kernel else {}
        if much:
            frame = (windows.pad[1], windows.reach[1], windows.pad[0], windows.reach[0])
            if mask:
                return call(max_pool_of_padded, x, frame, kernel, **options)
            return call(F.max_pool2d, call(F.pad, x, frame, value=-math.inf), kernel, **options)
        options |= {"padding": each(windows.pad)} if any(windows.pad) else {}
        options |= {"ceil_mode": True} if windows.round_mode == CEIL and windows.stride != (1, 1) else {}
        options |= {"return_indices": True} if mask else {}
        if method == STOCHASTIC:
            mean = call(F.avg_pool2d, x, kernel, **options).clamp(min=SMALLEST)
            return call(F.avg_pool2d, x.square(), kernel, **options) / mean
        return call(F.max_pool2d if method == MAX else F.avg_pool2d, x, kernel, **options)


@exports(Pooling)
class PoolingExport(PoolingBaseExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        layer = self.layer
        if layer.param.pooling_param.global_pooling and layer.method != STOCHASTIC and layer.num_tops == 1:
            return [graph.node("GlobalMaxPool" if layer.method == MAX else "GlobalAveragePool", *bottoms)]
        if layer.param.pooling_param.global_pooling:
            for axis in (2, 3):
                graph.size(0, axis, "its only window is the whole map")
        return self.onnx_pool(graph, bottoms[0], layer.windows, layer.method, mask=layer.num_tops > 1)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        mask = layer.num_tops > 1
        if not layer.param.pooling_param.global_pooling or layer.method == STOCHASTIC or mask:
            return self.torch_pool(x, layer.windows, layer.method, mask)
        return call(F.adaptive_max_pool2d if layer.method == MAX else F.adaptive_avg_pool2d, x, 1)


@exports(SPP)
class SPPExport(PoolingBaseExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        for axis in (2, 3):
            graph.size(0, axis, "the windows of its pyramid depend on the map's size")
        method = self.layer.param.spp_param.pool
        levels = [self.onnx_pool(graph, bottoms[0], windows, method)[0] for windows in self.layer.levels]
        if len(levels) == 1:
            return levels[0]
        return graph.node("Concat", *(graph.node("Flatten", level, axis=1) for level in levels), axis=1)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        for axis in (2, 3):
            code.size(0, axis, "the windows of its pyramid depend on the map's size")
        levels = [self.torch_pool(x, windows, self.layer.param.spp_param.pool) for windows in self.layer.levels]
        return levels[0] if len(levels) == 1 else call(torch.cat, [level.flatten(1) for level in levels], dim=1)


def max_pool_of_padded(x, frame, kernel_size, stride=None):
    """Return the maxima of a padded map, and the pixels of the map itself that have them."""
    left, _, above, _ = frame
    padded = F.pad(x, frame, value=-torch.inf)
    top, pixels = F.max_pool2d(padded, kernel_size, stride, return_indices=True)
    row = torch.div(pixels, padded.shape[3], rounding_mode="floor") - above
    return top, row * x.shape[3] + pixels % padded.shape[3] - left


def lay_out_windows(x, rows, **geometry):
    """Return the pixels under each position of a filter as channels (N, C K, H, W)."""
    return F.unfold(x, **geometry).unflatten(2, (rows, -1))

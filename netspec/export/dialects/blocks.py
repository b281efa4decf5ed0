"""Exporters of layers of netspec/dialects/blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.export.exporter import Exporter, exports, rounded
from netspec.export.expression import Expression, Plain, call, with_axes
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.export.layers.common import DropoutExport
from netspec.export.layers.normalization import BatchNormExport
from netspec.export.layers.vision import ConvolutionExport
from netspec.layers.vision import pooling, windows
from netspec.proto.schema import TRAIN, value

SLOPES, BIASES = 3, 4  # blobs of NVIDIA's BatchNorm


@exports("netspec.dialects.blocks.blocks.Axpy")
class AxpyExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        a, x, y = bottoms
        missing = list(range(len(self.layer.bottom_shapes[0]), len(self.layer.bottom_shapes[1])))
        if missing:
            a = graph.node("Unsqueeze", a, graph.constant(missing))
        return graph.node("Add", graph.node("Mul", a, x), y)

    def to_torch(self, code: TorchCode, a: Expression, x: Expression, y: Expression) -> Expression:
        return with_axes(a, len(self.layer.bottom_shapes[1]) - len(self.layer.bottom_shapes[0])) * x + y


@exports("netspec.dialects.blocks.blocks.ShuffleChannel")
class ShuffleChannelExport(Exporter):
    torch_call = Plain(F.channel_shuffle, "group")

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        channels = layer.bottom_shapes[0][1]
        grouped = graph.reshape(bottoms[0], [0, layer.group, channels // layer.group, -1])
        return graph.reshape_to_top(graph.node("Transpose", grouped, perm=[0, 2, 1, 3]))


@exports("netspec.dialects.blocks.blocks.Interp")
class InterpExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        param, (data, *like) = value(self.layer.param, "interp_param"), bottoms
        if param.pad_beg or param.pad_end:
            start, end = graph.constant([-param.pad_beg] * 2), graph.constant([param.pad_end or 2**62] * 2)
            data = graph.node("Slice", data, start, end, graph.constant([2, 3]))
        if like:
            size = graph.shape_of(like[0], 2, 4)
        elif param.HasField("height"):
            size = graph.constant([param.height, param.width])
        else:
            one, zoom = graph.constant([1, 1]), graph.constant([param.zoom_factor] * 2)
            last = graph.node("Sub", graph.shape_of(data, 2, 4), one)
            steps = graph.node("Mul", graph.node("Div", last, graph.constant([param.shrink_factor] * 2)), zoom)
            size = graph.node("Add", steps, one)
        sizes = graph.node("Concat", graph.shape_of(data, 0, 2), size, axis=0)
        grid = {"mode": "linear", "coordinate_transformation_mode": "align_corners"}
        return graph.node("Resize", data, "", "", sizes, **grid)

    def to_torch(self, code: TorchCode, x: Expression, *like: Expression) -> Expression:
        param = value(self.layer.param, "interp_param")
        cut = (param.pad_beg, param.pad_end) * 2
        if any(cut):
            x = call(F.pad, x, cut)
        if like:
            size = like[0].shape[2:]
        elif None not in code.sizes(0)[2:] or param.HasField("height"):
            size = tuple(self.layer.top_shapes[0][2:])
        else:
            size = call(zoomed_size, x, param.shrink_factor, param.zoom_factor)
        return call(F.interpolate, x, size=size, mode="bilinear", align_corners=True)


@exports("netspec.dialects.blocks.blocks.DeephiResize")
class DeephiResizeExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        p = self.layer.settings
        size = graph.constant([p.new_height, p.new_width])
        if not p.new_height:
            floats = graph.cast(graph.shape_of(bottoms[0], 2, 4), "float32")
            size = graph.cast(graph.node("Mul", floats, graph.constant([p.scale_h, p.scale_w])), "int64")
        sizes = graph.node("Concat", graph.shape_of(bottoms[0], 0, 2), size, axis=0)
        grid = {"mode": "linear", "coordinate_transformation_mode": "half_pixel"}
        if self.layer.nearest:
            grid = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        return graph.node("Resize", bottoms[0], "", "", sizes, **grid)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer, p = self.layer, self.layer.settings
        mode = "nearest" if layer.nearest else "bilinear"
        if p.new_height:
            return call(F.interpolate, x, tuple(layer.top_shapes[0][2:]), mode=mode)
        scales = (p.scale_h, p.scale_w)
        return call(F.interpolate, x, scale_factor=scales, mode=mode, recompute_scale_factor=True)


@exports("netspec.dialects.blocks.filters.Convolution")
class PaddedConvolutionExport(ConvolutionExport):
    @override
    def onnx_geometry(self) -> dict[str, Any]:
        geometry = super().onnx_geometry()
        left, right, top, bottom = self.layer.sides
        return geometry | {"pads": [top, left, bottom, right]} if any(self.layer.sides) else geometry

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        layer = self.layer
        if any(layer.sides) and any(layer.overhang(layer.bottom_shapes[0])):
            raise self.refusal("ONNX", "its filter is longer than the map")
        return super().to_onnx(graph, *bottoms)

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Sequence[Expression]:
        sides = tuple(self.layer.sides)
        padded = [call(F.pad, bottom, sides) for bottom in bottoms] if any(sides) else bottoms
        return super().to_torch(code, *padded)


@exports("netspec.dialects.blocks.filters.Pooling")
class PaddedPoolingExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        for axis in (2, 3):
            graph.size(0, axis, "its windows follow from the map's size")
        left, right, up, down = layer.frame
        if min(layer.frame) < 0:
            raise self.refusal("ONNX", "its windows leave out the map's end")
        value = graph.constant(windows.LOWEST if layer.method == pooling.MAX else 0.0)
        padded = graph.node(
            "Pad", *bottoms, graph.constant([0, 0, up, left, 0, 0, down, right]), value, mode="constant"
        )
        geometry = {"kernel_shape": list(layer.kernel), "strides": list(layer.stride)}
        if layer.method == pooling.MAX:
            return graph.node("MaxPool", padded, **geometry)
        shares = (layer.areas() / math.prod(layer.kernel)).float()
        return graph.node("Div", graph.node("AveragePool", padded, **geometry), graph.constant(shares[None, None]))


@exports("netspec.dialects.blocks.filters.Dropout")
class ScaledDropoutExport(DropoutExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        top = super().to_onnx(graph, *bottoms)
        if value(self.layer.param.dropout_param, "scale_train"):
            return top
        return graph.node("Mul", *bottoms, graph.constant(1 - self.layer.ratio))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        if value(layer.param.dropout_param, "scale_train"):
            return super().to_torch(code, x)
        if layer.phase == TRAIN:
            raise self.refusal("PyTorch", "torch's dropout scales in training, this one in testing")
        return x * (1 - layer.ratio)


@exports("netspec.dialects.blocks.layout.CropCenter")
class CropCenterExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        cuts = [part.start for part in self.layer.window]
        axes = [axis for axis, cut in enumerate(cuts) if cut]
        if not axes:
            return graph.node("Identity", bottoms[0])
        starts, ends = (graph.constant([sign * cuts[axis] for axis in axes]) for sign in (1, -1))
        return graph.node("Slice", bottoms[0], starts, ends, graph.constant(axes))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        cuts = [part.start for part in self.layer.window]
        return x[tuple(slice(cut, -cut) if cut else slice(None) for cut in cuts)]


@exports("netspec.dialects.blocks.normalize.Normalize")
class NormalizeExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str | Sequence[str]:
        layer = self.layer
        axes = len(layer.bottom_shapes[0])
        over = graph.constant(list(range(1, axes)) if layer.across else [1])
        parts = graph.node("Mul", *bottoms, *bottoms) if layer.squares else graph.node("Abs", *bottoms)
        size = graph.node("Add", graph.node("ReduceSum", parts, over, keepdims=1), graph.constant(layer.eps))
        size = graph.node("Sqrt", size) if layer.squares else size
        top = graph.node("Div", *bottoms, size)
        if layer.blobs:
            shape = (*layer.blob_shapes[0], *(1,) * (axes - 2)) if layer.blob_shapes[0] else ()
            top = graph.node("Mul", top, graph.blob(0, shape))
        return top if layer.num_tops == 1 else [top, size]

    def to_torch(self, code: TorchCode, x: Expression) -> Expression | Sequence[Expression]:
        layer = self.layer
        axes, eps = len(layer.bottom_shapes[0]), rounded(layer.eps)
        over = tuple(range(1, axes)) if layer.across else 1
        if layer.blobs:
            shape = (*layer.blob_shapes[0], *(1,) * (axes - 2)) if layer.blob_shapes[0] else ()
            return call(normalize, x, code.parameter(0, shape), over, eps=eps)
        size = call(length, x, over, eps, layer.squares)
        return x / size if layer.num_tops == 1 else [x / size, size]


@exports("netspec.dialects.blocks.nvidia.BatchNorm")
class NvidiaBatchNormExport(BatchNormExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        top = super().to_onnx(graph, *bottoms)
        if not layer.scales:
            return top
        shape = (layer.channels, *(1,) * (len(layer.bottom_shapes[0]) - 2))
        return graph.node("Add", graph.node("Mul", top, graph.blob(SLOPES, shape)), graph.blob(BIASES, shape))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        top = super().to_torch(code, x)
        if layer.use_global_stats or not layer.scales:
            return top
        shape = (layer.channels, *(1,) * (len(layer.bottom_shapes[0]) - 2))
        return top * code.parameter(SLOPES, shape, "slope") + code.parameter(BIASES, shape, "bias")

    @override
    def affine(self, code: TorchCode) -> dict[str, torch.Tensor]:
        layer = self.layer
        return {"weight": layer.blob(SLOPES), "bias": layer.blob(BIASES)} if layer.scales else super().affine(code)


@exports("netspec.dialects.blocks.order.Reordered")
class ReorderedExport(Exporter):
    onnx_op, onnx_attributes = "Transpose", ("perm",)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        return x.permute(*self.layer.perm)


@exports("netspec.dialects.blocks.relu6.Capped")
class CappedExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        if self.layer.slope == 0:
            return graph.node("Clip", *bottoms, graph.constant(0.0), graph.constant(6.0))
        leaky = graph.node("LeakyRelu", *bottoms, alpha=self.layer.slope)
        return graph.node("Min", leaky, graph.constant(6.0))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        return call(F.relu6, x) if self.layer.slope == 0 else call(F.leaky_relu, x, self.layer.slope).clamp(max=6)


def zoomed_size(x, shrink, zoom):
    """Return the height and width of a map of which every shrink-th pixel is kept and the steps are zoomed."""
    return [(n - 1) // shrink * zoom + 1 for n in x.shape[2:]]


def normalize(x, scale, axes, eps):
    """Divide by the length over some axes, and multiply by learnable scales."""
    length = (x.square().sum(axes, keepdim=True) + eps).sqrt()
    return scale * x / length


def length(x, axes, eps, squares):
    """Return the length over some axes, or the sum of absolute values."""
    return (x.square().sum(axes, keepdim=True) + eps).sqrt() if squares else x.abs().sum(axes, keepdim=True) + eps

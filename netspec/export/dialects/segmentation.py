"""Exporters of layers of netspec/dialects/segmentation."""

from __future__ import annotations

import math

import torch.nn.functional as F

from netspec.export.exporter import Exporter, exports, rounded
from netspec.export.expression import Expression, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.export.layers.normalization import onnx_normalized, torch_batch_norm
from netspec.proto.schema import value


@exports("netspec.dialects.segmentation.segnet.Upsample")
class UpsampleExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        if len(bottoms) == 1:
            scales = graph.constant([1.0, 1.0, float(layer.scale_h), float(layer.scale_w)])
            grid = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
            return graph.node("Resize", *bottoms, "", scales, **grid)
        for axis in (2, 3):
            graph.size(0, axis, "its mask counts the pixels of the enlarged map")
        values = graph.reshape(bottoms[0], [0, 0, -1])
        mask = graph.cast(graph.reshape(bottoms[1], [0, 0, -1]), "int64")
        pixels = graph.constant([math.prod(layer.top_shapes[0][2:])])
        shape = graph.node("Concat", graph.shape_of(bottoms[0], 0, 2), pixels, axis=0)
        empty = graph.node("Expand", graph.constant(0.0), shape)
        return graph.reshape_to_top(graph.node("ScatterElements", empty, mask, values, axis=2))

    def to_torch(self, code: TorchCode, x: Expression, *mask: Expression) -> Expression:
        layer, param = self.layer, value(self.layer.param, "upsample_param")
        scale = (layer.scale_h, layer.scale_w)
        if not mask:
            return call(F.interpolate, x, scale_factor=scale[0] if scale[0] == scale[1] else scale)
        size = tuple(layer.top_shapes[0][2:])
        if None in code.sizes(0)[2:] and not param.HasField("upsample_h"):
            cut = (param.pad_out_h, param.pad_out_w)
            sides = [x.shape[2 + k] * scale[k] for k in (0, 1)]
            size = tuple(side - 1 if cut[k] else side for k, side in enumerate(sides))
        return call(unpool, x, *mask, size)


@exports("netspec.dialects.segmentation.segnet.BN")
class BNExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        if layer.num_tops > 1:
            raise self.refusal("ONNX", "it shows a batch's mean")
        shape = (layer.channels, *(1,) * (len(layer.bottom_shapes[0]) - 2))
        slope, bias = graph.blob(0, shape), graph.blob(1, shape)
        if not layer.by_batch and not layer.moving:
            return graph.node("Add", graph.node("Mul", *bottoms, slope), bias)
        if not layer.by_batch:
            if layer.inverse:
                centered = graph.node("Sub", *bottoms, graph.blob(2, shape))
                scaled = graph.node("Mul", centered, graph.node("Mul", graph.blob(3, shape), slope))
                return graph.node("Add", scaled, bias)
            blobs = [graph.blob(i, (layer.channels,)) for i in range(4)]
            return graph.node("BatchNormalization", *bottoms, *blobs, epsilon=layer.eps)
        normalized = onnx_normalized(graph, bottoms[0], len(layer.bottom_shapes[0]), layer.eps)
        return graph.node("Add", graph.node("Mul", normalized, slope), bias)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        if layer.num_tops > 1:
            raise self.refusal("PyTorch", "it shows a batch's mean")
        axes, eps = len(layer.bottom_shapes[0]), rounded(layer.eps)
        if layer.by_batch or not layer.moving:
            shape = (layer.channels, *(1,) * (axes - 2))
            top = call(F.batch_norm, x, None, None, training=True, eps=eps) if layer.by_batch else x
            return top * code.parameter(0, shape, "slope") + code.parameter(1, shape, "bias")
        weight, bias, mean, variance = (layer.blob(i).reshape(-1) for i in range(4))
        variance = variance.pow(-2) - layer.eps if layer.inverse else variance
        return torch_batch_norm(code, axes, mean, variance, eps, weight=weight, bias=bias)(x)


def unpool(x, mask, size):
    """Copy each value to the pixel of a larger map that the mask gives; the others are 0."""
    empty = x.new_zeros(*x.shape[:2], size[0] * size[1])
    return empty.scatter(2, mask.flatten(2).long(), x.flatten(2)).unflatten(2, size)

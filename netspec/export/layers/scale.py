"""Exporters of Scale, Bias."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from netspec.export.exporter import Exporter, exports
from netspec.export.targets import OnnxGraph, TorchCode
from netspec.layers.scale import Bias, Scale


class AffineExport(Exporter):
    def onnx_operand(self, graph: OnnxGraph, bottoms: Sequence[str], blob: int, axis: int) -> str:
        """Return the second bottom or a learnable blob, broadcast over the first bottom's axes from ``axis`` on."""
        layer = self.layer
        axes = len(layer.bottom_shapes[0]) - axis
        if len(bottoms) == 1:
            shape = layer.blob_shapes[blob]
            return graph.blob(blob, (*shape, *(1,) * (axes - len(shape))))
        given = len(layer.bottom_shapes[1])
        if given == axes:
            return bottoms[1]
        return graph.node("Unsqueeze", bottoms[1], graph.constant(list(range(given, axes))))

    def torch_operand(self, code: TorchCode, bottoms: Sequence[str], blob: int, axis: int) -> str:
        """Return the expression of the second bottom or a learnable blob, broadcast over axes from ``axis`` on."""
        layer = self.layer
        axes = len(layer.bottom_shapes[0]) - axis
        if len(bottoms) == 1:
            shape = layer.blob_shapes[blob]
            name = "" if len(layer.blobs) == 1 else ("scale", "bias")[blob]
            return code.parameter(blob, (*shape, *(1,) * (axes - len(shape))), name)
        missing = axes - len(layer.bottom_shapes[1])
        return code.call(f"{{x}}[..., {', '.join(['None'] * missing)}]", x=bottoms[1]) if missing else bottoms[1]


@exports(Scale)
class ScaleExport(AffineExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        top = graph.node("Mul", bottoms[0], self.onnx_operand(graph, bottoms, 0, layer.axis))
        if not layer.param.scale_param.bias_term:
            return top
        return graph.node("Add", top, self.onnx_operand(graph, bottoms[:1], len(layer.blobs) - 1, layer.axis))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        layer = self.layer
        if layer.by_channel:
            scale = layer.blob(0)
            if code.affine(bottoms[0], scale, layer.blob(1) if len(layer.blobs) > 1 else torch.zeros_like(scale)):
                return bottoms[0]
        top = code.call("{x} * {y}", x=bottoms[0], y=self.torch_operand(code, bottoms, 0, layer.axis))
        if not layer.param.scale_param.bias_term:
            return top
        return code.call("{x} + {y}", x=top, y=self.torch_operand(code, bottoms[:1], len(layer.blobs) - 1, layer.axis))


@exports(Bias)
class BiasExport(AffineExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Add", bottoms[0], self.onnx_operand(graph, bottoms, 0, self.layer.axis))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.call("{x} + {y}", x=bottoms[0], y=self.torch_operand(code, bottoms, 0, self.layer.axis))

"""Exporters of Scale, Bias."""

from __future__ import annotations

from collections.abc import Sequence

from netspec.export.exporter import Exporter, exports
from netspec.export.expression import Expression, with_axes
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
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

    def torch_operand(self, code: TorchCode, bottoms: Sequence[Expression], blob: int, axis: int) -> Expression:
        """Return the second bottom or a learnable blob, broadcast over the first bottom's axes from ``axis`` on."""
        layer = self.layer
        axes = len(layer.bottom_shapes[0]) - axis
        if len(bottoms) == 1:
            shape = layer.blob_shapes[blob]
            name = "" if len(layer.blobs) == 1 else ("scale", "bias")[blob]
            return code.parameter(blob, (*shape, *(1,) * (axes - len(shape))), name)
        return with_axes(bottoms[1], axes - len(layer.bottom_shapes[1]))


@exports(Scale)
class ScaleExport(AffineExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        top = graph.node("Mul", bottoms[0], self.onnx_operand(graph, bottoms, 0, layer.axis))
        if not layer.param.scale_param.bias_term:
            return top
        return graph.node("Add", top, self.onnx_operand(graph, bottoms[:1], len(layer.blobs) - 1, layer.axis))

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Expression:
        layer = self.layer
        top = bottoms[0] * self.torch_operand(code, bottoms, 0, layer.axis)
        if not layer.param.scale_param.bias_term:
            return top
        return top + self.torch_operand(code, bottoms[:1], len(layer.blobs) - 1, layer.axis)


@exports(Bias)
class BiasExport(AffineExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Add", bottoms[0], self.onnx_operand(graph, bottoms, 0, self.layer.axis))

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Expression:
        return bottoms[0] + self.torch_operand(code, bottoms, 0, self.layer.axis)

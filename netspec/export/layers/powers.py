"""Exporters of Power, Exp, Log and AbsVal."""

from __future__ import annotations

import torch

from netspec.export.exporter import Exporter, exports
from netspec.export.expression import Expression, Plain, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.export.layers.activation import scaled_and_shifted, torch_scaled_and_shifted
from netspec.layers.powers import AbsVal, Exp, Log, Power


@exports(AbsVal)
class AbsValExport(Exporter):
    onnx_op, torch_call = "Abs", Plain(torch.abs)


@exports(Power)
class PowerExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        if layer.power * layer.scale == 0:
            constant = torch.tensor(layer.shift).pow(layer.power)  # Python's ** raises for inf, and NaN is complex
            return graph.node("Expand", graph.constant(constant), graph.shape_of(bottoms[0]))
        value = scaled_and_shifted(graph, bottoms[0], layer.scale, layer.shift)
        return value if layer.power == 1 else graph.node("Pow", value, graph.constant(layer.power))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        if layer.power * layer.scale == 0:
            return call(torch.full_like, x, layer.shift).pow(layer.power)
        x = torch_scaled_and_shifted(x, layer.scale, layer.shift)
        return x if layer.power == 1 else call(torch.pow, x, layer.power)


@exports(Exp)
class ExpExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Exp", scaled_and_shifted(graph, bottoms[0], self.layer.scale, self.layer.shift))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        return call(torch.exp, torch_scaled_and_shifted(x, self.layer.scale, self.layer.shift))


@exports(Log)
class LogExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        logarithm = graph.node("Log", scaled_and_shifted(graph, bottoms[0], layer.scale, layer.shift))
        return scaled_and_shifted(graph, logarithm, layer.base_scale, 0)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        logarithm = call(torch.log, torch_scaled_and_shifted(x, layer.scale, layer.shift))
        return torch_scaled_and_shifted(logarithm, layer.base_scale, 0)

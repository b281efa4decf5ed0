"""Exporters of Power, Exp, Log and AbsVal."""

from __future__ import annotations

import torch

from netspec.export.exporter import Exporter, exports
from netspec.export.layers.activation import scaled_and_shifted, torch_scaled_and_shifted
from netspec.export.targets import OnnxGraph, TorchCode
from netspec.layers.powers import AbsVal, Exp, Log, Power


@exports(AbsVal)
class AbsValExport(Exporter):
    onnx_op, torch_call = "Abs", "torch.abs({x})"


@exports(Power)
class PowerExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        if layer.power * layer.scale == 0:
            constant = torch.tensor(layer.shift).pow(layer.power)  # Python's ** raises for inf, and NaN is complex
            return graph.node("Expand", graph.constant(constant), graph.shape_of(bottoms[0]))
        value = scaled_and_shifted(graph, bottoms[0], layer.scale, layer.shift)
        return value if layer.power == 1 else graph.node("Pow", value, graph.constant(layer.power))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        layer = self.layer
        if layer.power * layer.scale == 0:
            template = "torch.full_like({x}, {shift}).pow({power})"
            return code.call(template, x=bottoms[0], shift=layer.shift, power=layer.power)
        value = torch_scaled_and_shifted(code, bottoms[0], layer.scale, layer.shift)
        return value if layer.power == 1 else code.call("torch.pow({x}, {power})", x=value, power=layer.power)


@exports(Exp)
class ExpExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Exp", scaled_and_shifted(graph, bottoms[0], self.layer.scale, self.layer.shift))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.call(
            "torch.exp({x})", x=torch_scaled_and_shifted(code, bottoms[0], self.layer.scale, self.layer.shift)
        )


@exports(Log)
class LogExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        logarithm = graph.node("Log", scaled_and_shifted(graph, bottoms[0], layer.scale, layer.shift))
        return scaled_and_shifted(graph, logarithm, layer.base_scale, 0)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        layer = self.layer
        value = torch_scaled_and_shifted(code, bottoms[0], layer.scale, layer.shift)
        return torch_scaled_and_shifted(code, code.call("torch.log({x})", x=value), layer.base_scale, 0)

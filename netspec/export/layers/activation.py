"""Exporters of the activations."""

from __future__ import annotations

import math

from netspec.export.exporter import Exporter, exports
from netspec.export.targets import OnnxGraph, TorchCode
from netspec.layers.activation import BNLL, ELU, Clip, PReLU, ReLU, Sigmoid, Swish, TanH, Threshold


def scaled_and_shifted(graph: OnnxGraph, value: str, scale: float, shift: float) -> str:
    """Return scale value + shift as nodes, without nodes that have no effect."""
    if scale != 1:
        value = graph.node("Mul", value, graph.constant(float(scale)))
    return graph.node("Add", value, graph.constant(float(shift))) if shift else value


def torch_scaled_and_shifted(code: TorchCode, value: str, scale: float, shift: float) -> str:
    """Return the expression of scale value + shift, without parts that have no effect."""
    template = ("{scale} * {x}" if scale != 1 else "{x}") + (
        " + {shift}" if shift > 0 else " - {shift}" if shift else ""
    )
    return code.call(template, x=value, scale=float(scale), shift=abs(float(shift)))


@exports(ReLU)
class ReLUExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return (
            graph.node("LeakyRelu", *bottoms, alpha=self.layer.slope)
            if self.layer.slope
            else graph.node("Relu", *bottoms)
        )

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if self.layer.slope:
            return code.call("F.leaky_relu({x}, {slope})", x=bottoms[0], slope=self.layer.slope)
        return code.call("F.relu({x})", x=bottoms[0])


@exports(PReLU)
class PReLUExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        slopes = math.prod(layer.blob_shapes[0])
        spatial = len(layer.bottom_shapes[0]) - 2
        return graph.node("PRelu", *bottoms, graph.blob(0, (slopes, *(1,) * (spatial if layer.blob_shapes[0] else 0))))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        slopes = self.layer.blob(0).reshape(-1)
        slope = code.module("nn.PReLU({channels})", {"weight": slopes}, channels=len(slopes))
        return code.call("{slope}({x})", slope=slope, x=bottoms[0])


@exports(ELU)
class ELUExport(Exporter):
    onnx_op, onnx_attributes = "Elu", ("alpha",)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if self.layer.alpha == 1:
            return code.call("F.elu({x})", x=bottoms[0])
        return code.call("F.elu({x}, alpha={alpha})", x=bottoms[0], alpha=self.layer.alpha)


@exports(Sigmoid)
class SigmoidExport(Exporter):
    onnx_op, torch_call = "Sigmoid", "torch.sigmoid({x})"


@exports(TanH)
class TanHExport(Exporter):
    onnx_op, torch_call = "Tanh", "torch.tanh({x})"


@exports(BNLL)
class BNLLExport(Exporter):
    onnx_op, torch_call = "Softplus", "F.softplus({x})"


@exports(Threshold)
class ThresholdExport(Exporter):
    torch_call = "torch.gt({x}, {threshold}).to({x}.dtype)"

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.cast(graph.node("Greater", *bottoms, graph.constant(self.layer.threshold)), "float32")


@exports(Clip)
class ClipExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        return graph.node("Clip", *bottoms, graph.constant(layer.low), graph.constant(max(layer.low, layer.high)))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        layer = self.layer
        high = max(layer.low, layer.high)
        return code.call("torch.clamp({x}, {low}, {high})", x=bottoms[0], low=layer.low, high=high)


@exports(Swish)
class SwishExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        gate = graph.node("Sigmoid", scaled_and_shifted(graph, bottoms[0], self.layer.beta, 0))
        return graph.node("Mul", *bottoms, gate)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if self.layer.beta == 1:
            return code.call("F.silu({x})", x=bottoms[0])
        return code.call("{x} * torch.sigmoid({beta} * {x})", x=bottoms[0], beta=self.layer.beta)

"""Exporters of the activations, and of Power, Exp, Log and AbsVal."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import nn

from netspec.export.exporter import Exporter, exports
from netspec.export.expression import Expression, Plain, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.activation import BNLL, ELU, Clip, PReLU, ReLU, Sigmoid, Swish, TanH, Threshold
from netspec.layers.powers import AbsVal, Exp, Log, Power


def scaled_and_shifted(graph: OnnxGraph, value: str, scale: float, shift: float) -> str:
    """Return scale value + shift as nodes, without nodes that have no effect."""
    if scale != 1:
        value = graph.node("Mul", value, graph.constant(float(scale)))
    return graph.node("Add", value, graph.constant(float(shift))) if shift else value


def torch_scaled_and_shifted(x: Expression, scale: float, shift: float) -> Expression:
    """Return scale x + shift, without parts that have no effect."""
    x = float(scale) * x if scale != 1 else x
    return x + float(shift) if shift > 0 else x - abs(float(shift)) if shift else x


@exports(ReLU)
class ReLUExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return (
            graph.node("LeakyRelu", *bottoms, alpha=self.layer.slope)
            if self.layer.slope
            else graph.node("Relu", *bottoms)
        )

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        return call(F.leaky_relu, x, self.layer.slope) if self.layer.slope else call(F.relu, x)


@exports(PReLU)
class PReLUExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        slopes = math.prod(layer.blob_shapes[0])
        spatial = len(layer.bottom_shapes[0]) - 2
        return graph.node("PRelu", *bottoms, graph.blob(0, (slopes, *(1,) * (spatial if layer.blob_shapes[0] else 0))))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        slopes = self.layer.blob(0).reshape(-1)
        return code.module(nn.PReLU, len(slopes), state={"weight": slopes})(x)


@exports(ELU)
class ELUExport(Exporter):
    onnx_op, onnx_attributes = "Elu", ("alpha",)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        return call(F.elu, x) if self.layer.alpha == 1 else call(F.elu, x, alpha=self.layer.alpha)


@exports(Sigmoid)
class SigmoidExport(Exporter):
    onnx_op, torch_call = "Sigmoid", Plain(torch.sigmoid)


@exports(TanH)
class TanHExport(Exporter):
    onnx_op, torch_call = "Tanh", Plain(torch.tanh)


@exports(BNLL)
class BNLLExport(Exporter):
    onnx_op, torch_call = "Softplus", Plain(F.softplus)


@exports(Threshold)
class ThresholdExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.cast(graph.node("Greater", *bottoms, graph.constant(self.layer.threshold)), "float32")

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        return call(torch.gt, x, self.layer.threshold).to(x.dtype)


@exports(Clip)
class ClipExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        return graph.node("Clip", *bottoms, graph.constant(layer.low), graph.constant(max(layer.low, layer.high)))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        return call(torch.clamp, x, self.layer.low, max(self.layer.low, self.layer.high))


@exports(Swish)
class SwishExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        gate = graph.node("Sigmoid", scaled_and_shifted(graph, bottoms[0], self.layer.beta, 0))
        return graph.node("Mul", *bottoms, gate)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        beta = self.layer.beta
        return call(F.silu, x) if beta == 1 else x * call(torch.sigmoid, beta * x)


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

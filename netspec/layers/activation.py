"""Activations, which are computed elementwise.

Caffe: the neuron layers, include/caffe/layers/neuron_layer.hpp
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.exact import libm
from netspec.exact.pointwise import tanh_gradient
from netspec.layers.contract.base import Layer, Shape
from netspec.layers.contract.registry import register
from netspec.layers.contract.targets import OnnxGraph, TorchCode


class Activation(Layer):
    """Base of layers with a top of the same shape as the bottom."""

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return bottom_shapes


class Rounded(Activation):
    """Base of activations that torch rounds differently from the C library, which Caffe calls."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.arithmetic(x).function(x, self.as_torch, self.as_caffe, self.caffes_gradient)

    def as_torch(self, x: torch.Tensor) -> torch.Tensor:
        """Return the activated bottom, computed by torch's functions, with gradients by autograd."""
        return self.compute(x, torch)

    def as_caffe(self, x: torch.Tensor) -> torch.Tensor:
        """Return the activated bottom, with each step rounded as in Caffe."""
        return self.compute(x, libm)

    def compute(self, x: torch.Tensor, functions: Any) -> torch.Tensor:
        """Return the activated bottom, computed by the functions of a module: torch or netspec.exact.libm."""
        raise NotImplementedError

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError


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


@register("ReLU", "relu_param")
class ReLU(Activation):
    """max(x, 0) + negative_slope min(x, 0); the gradient at 0 is that of the negative side.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/relu_layer.cpp
    """

    def setup(self) -> None:
        self.slope: float = self.param.relu_param.negative_slope
        self.gradient_reads = frozenset({"sign" if self.slope >= 0 else "bottom"})  # the top has the sign of the bottom

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.leaky_relu(x, self.slope) if self.slope else F.relu(x)

    @property
    def joins_as(self) -> str:
        return "" if self.slope else "relu"

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return torch.where(bottom > 0, diff, diff * self.slope)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("LeakyRelu", *bottoms, alpha=self.slope) if self.slope else graph.node("Relu", *bottoms)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if self.slope:
            return code.call("F.leaky_relu({x}, {slope})", x=bottoms[0], slope=self.slope)
        return code.call("F.relu({x})", x=bottoms[0])


@register("PReLU", "prelu_param")
class PReLU(Activation):
    """max(x, 0) + slope min(x, 0), with one learnable slope per channel, or one for all (channel_shared).

    bottom[0]  (N, C, ...)
    top[0]     the same shape
    blobs[0]   slopes (C,), or () if channel_shared; 0.25 unless a filler is given
    Caffe: src/caffe/layers/prelu_layer.cpp
    """

    def setup(self) -> None:
        p = self.param.prelu_param
        shape = self.bottom_shapes[0]
        if len(shape) < 2:
            raise self.error(f"bottom has shape {shape}, expected at least 2 axes (N, C, ...)", "bottom")
        self.add_blob(() if p.channel_shared else shape[1:2], p.filler if p.HasField("filler") else None, 0.25)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.arithmetic(x).sloped(x, self.blob(0))

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        slopes = math.prod(self.blob_shapes[0])
        spatial = len(self.bottom_shapes[0]) - 2
        return graph.node("PRelu", *bottoms, graph.blob(0, (slopes, *(1,) * (spatial if self.blob_shapes[0] else 0))))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        slopes = self.blob(0).reshape(-1)
        slope = code.module("nn.PReLU({channels})", {"weight": slopes}, channels=len(slopes))
        return code.call("{slope}({x})", slope=slope, x=bottoms[0])


@register("ELU", "elu_param")
class ELU(Rounded):
    """x if x > 0, else alpha (exp(x) - 1); the gradient at 0 is alpha.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/elu_layer.cpp
    """

    onnx_op, onnx_attributes = "Elu", ("alpha",)

    def setup(self) -> None:
        self.alpha: float = self.param.elu_param.alpha
        self.gradient_reads = frozenset({"top", "sign" if self.alpha >= 0 else "bottom"})  # as ReLU's

    @override
    def compute(self, x: torch.Tensor, functions: Any) -> torch.Tensor:
        # exp(x) - 1 as Caffe computes it, not the more exact expm1.
        return torch.where(x > 0, x, self.alpha * (functions.exp(x.clamp(max=0)) - 1))

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return torch.where(bottom > 0, diff, diff * (self.alpha + top))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if self.alpha == 1:
            return code.call("F.elu({x})", x=bottoms[0])
        return code.call("F.elu({x}, alpha={alpha})", x=bottoms[0], alpha=self.alpha)


@register("Sigmoid", "sigmoid_param")
class Sigmoid(Rounded):
    """1 / (1 + exp(-x)).

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/sigmoid_layer.cpp
    """

    gradient_reads = frozenset({"top"})
    onnx_op, torch_call = "Sigmoid", "torch.sigmoid({x})"

    @override
    def compute(self, x: torch.Tensor, functions: Any) -> torch.Tensor:
        return functions.sigmoid(x)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return (diff * top * (1 - top.double())).to(diff.dtype)  # 1. is a double in C, and so are the results


@register("TanH", "tanh_param")
class TanH(Rounded):
    """Hyperbolic tangent.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/tanh_layer.cpp
    """

    gradient_reads = frozenset({"top"})
    onnx_op, torch_call = "Tanh", "torch.tanh({x})"

    @override
    def compute(self, x: torch.Tensor, functions: Any) -> torch.Tensor:
        return functions.tanh(x)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return tanh_gradient(bottom, top, diff)


@register("BNLL")
class BNLL(Rounded):
    """log(1 + exp(x)), the binomial normal log likelihood.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/bnll_layer.cpp
    """

    gradient_reads = frozenset({"bottom"})
    onnx_op, torch_call = "Softplus", "F.softplus({x})"

    @override
    def as_torch(self, x: torch.Tensor) -> torch.Tensor:
        return F.softplus(x, threshold=50)  # above it the result is x, in double precision too

    @override
    def as_caffe(self, x: torch.Tensor) -> torch.Tensor:
        return (x.clamp(min=0) + libm.log(1 + libm.exp(-x.abs()).double())).to(x.dtype)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        growth = libm.exp(bottom.clamp(max=50))
        return (diff * growth / (growth.double() + 1)).to(diff.dtype)


@register("Threshold", "threshold_param")
class Threshold(Activation):
    """1 if x > threshold, else 0; no gradient.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/threshold_layer.cpp
    """

    torch_call = "torch.gt({x}, {threshold}).to({x}.dtype)"

    def setup(self) -> None:
        self.threshold: float = self.param.threshold_param.threshold

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x > self.threshold).to(x.dtype)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.cast(graph.node("Greater", *bottoms, graph.constant(self.threshold)), "float32")


@register("Clip", "clip_param")
class Clip(Activation):
    """max(min, min(x, max)); the gradient is passed if min <= x <= max.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/clip_layer.cpp
    """

    gradient_reads = frozenset({"bottom"})

    def setup(self) -> None:
        p = self.param.clip_param
        for name in ("min", "max"):
            if not p.HasField(name):
                raise self.error(f"clip_param has no {name}; both min and max are required", "clip_param")
        self.low: float = p.min
        self.high: float = p.max

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.clamp(max=self.high).clamp(min=self.low)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return diff * ((bottom >= self.low) & (bottom <= self.high))

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Clip", *bottoms, graph.constant(self.low), graph.constant(max(self.low, self.high)))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        high = max(self.low, self.high)
        return code.call("torch.clamp({x}, {low}, {high})", x=bottoms[0], low=self.low, high=high)


@register("Swish", "swish_param")
class Swish(Rounded):
    """x sigmoid(beta x).

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/swish_layer.cpp
    """

    gradient_reads = frozenset({"top", "kept"})  # Caffe keeps the gate of the forward pass

    def setup(self) -> None:
        self.beta: float = self.param.swish_param.beta

    @override
    def compute(self, x: torch.Tensor, functions: Any) -> torch.Tensor:
        return x * functions.sigmoid(self.beta * x)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        inner, gate = self.beta * top, libm.sigmoid(self.beta * bottom)
        return (diff * (inner + gate * (1 - inner.double()))).to(diff.dtype)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        gate = graph.node("Sigmoid", scaled_and_shifted(graph, bottoms[0], self.beta, 0))
        return graph.node("Mul", *bottoms, gate)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if self.beta == 1:
            return code.call("F.silu({x})", x=bottoms[0])
        return code.call("{x} * torch.sigmoid({beta} * {x})", x=bottoms[0], beta=self.beta)

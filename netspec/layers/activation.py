"""Activations, which are computed elementwise.

Caffe: the neuron layers, include/caffe/layers/neuron_layer.hpp
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.exact import libm
from netspec.exact.pointwise import tanh_gradient
from netspec.layers.contract.base import Layer, Shape
from netspec.layers.contract.registry import register


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


@register("ReLU", "relu_param")
class ReLU(Activation):
    """max(x, 0) + negative_slope min(x, 0); the gradient at 0 is that of the negative side.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/relu_layer.cpp
    """

    def setup(self) -> None:
        self.slope: float = self.param.relu_param.negative_slope

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return F.leaky_relu(x, self.slope) if self.slope else F.relu(x)

    @property
    def joins_as(self) -> str:
        return "" if self.slope else "relu"

    @property
    def gradient_reads(self) -> frozenset[str]:
        return frozenset({"sign" if self.slope >= 0 else "bottom"})  # the top has the sign of the bottom

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return torch.where(bottom > 0, diff, diff * self.slope)


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


@register("ELU", "elu_param")
class ELU(Rounded):
    """x if x > 0, else alpha (exp(x) - 1); the gradient at 0 is alpha.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/elu_layer.cpp
    """

    def setup(self) -> None:
        self.alpha: float = self.param.elu_param.alpha

    @property
    def gradient_reads(self) -> frozenset[str]:
        return frozenset({"top", "sign" if self.alpha >= 0 else "bottom"})  # as ReLU's

    @override
    def compute(self, x: torch.Tensor, functions: Any) -> torch.Tensor:
        # exp(x) - 1 as Caffe computes it, not the more exact expm1. The gradient of clamp at 0 depends on
        # the version of PyTorch.
        above = x > 0
        return torch.where(above, x, self.alpha * (functions.exp(torch.where(above, 0, x)) - 1))

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return torch.where(bottom > 0, diff, diff * (self.alpha + top))


@register("Sigmoid", "sigmoid_param")
class Sigmoid(Rounded):
    """1 / (1 + exp(-x)).

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/sigmoid_layer.cpp
    """

    gradient_reads = frozenset({"top"})

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

    def setup(self) -> None:
        self.threshold: float = self.param.threshold_param.threshold

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return (x > self.threshold).to(x.dtype)


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
        # The gradient of clamp at its bounds is 0 from PyTorch 2.15 on.
        inside = (x >= self.low) & (x <= self.high)
        return torch.where(inside, x, x.detach().clamp(max=self.high).clamp(min=self.low))

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return diff * ((bottom >= self.low) & (bottom <= self.high))


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

"""Activations: one number in, one number out.

Caffe: the neuron layers, include/caffe/layers/neuron_layer.hpp
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F

from netspec.layers.base import Layer, Shape
from netspec.layers.registry import register


class Activation(Layer):
    """Base of the layers whose top has its bottom's shape."""

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the bottom's shape."""
        return bottom_shapes


@register("ReLU", "relu_param")
class ReLU(Activation):
    """max(x, 0) + negative_slope min(x, 0); the gradient at 0 is the negative side's.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/relu_layer.cpp
    """

    def setup(self) -> None:
        """Read the slope of the negative side."""
        self.slope: float = self.param.relu_param.negative_slope
        self.gradient_reads = frozenset({"sign" if self.slope >= 0 else "bottom"})  # the top's sign is the bottom's

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the rectified bottom."""
        return F.leaky_relu(x, self.slope) if self.slope else F.relu(x)

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        return torch.where(bottom > 0, diff, diff * self.slope)


@register("PReLU", "prelu_param")
class PReLU(Activation):
    """max(x, 0) + slope min(x, 0), with one learned slope a channel, or one for all (channel_shared).

    bottom[0]  (N, C, ...)
    top[0]     the same shape
    blobs[0]   slopes (C,), or () where channel_shared; 0.25 unless a filler is given
    Caffe: src/caffe/layers/prelu_layer.cpp
    """

    def setup(self) -> None:
        """Add the slopes."""
        p = self.param.prelu_param
        shape = self.bottom_shapes[0]
        if len(shape) < 2:
            raise self.error(f"bottom has shape {shape}, expected at least 2 axes (N, C, ...)", "bottom")
        self.add_blob(() if p.channel_shared else shape[1:2], p.filler if p.HasField("filler") else None, 0.25)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the rectified bottom."""
        return F.prelu(x, self.blob(0).reshape(-1))


@register("ELU", "elu_param")
class ELU(Activation):
    """Return x where x > 0, else alpha (exp(x) - 1); the gradient at 0 is alpha.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/elu_layer.cpp
    """

    def setup(self) -> None:
        """Read the scale of the negative side."""
        self.alpha: float = self.param.elu_param.alpha
        self.gradient_reads = frozenset({"top", "sign" if self.alpha >= 0 else "bottom"})  # as ReLU's

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the activated bottom."""
        # exp(x) - 1 as Caffe computes it, not the more exact expm1.
        return torch.where(x > 0, x, self.alpha * (torch.exp(x.clamp(max=0)) - 1))

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        return torch.where(bottom > 0, diff, diff * (self.alpha + top))


@register("Sigmoid", "sigmoid_param")
class Sigmoid(Activation):
    """1 / (1 + exp(-x)).

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/sigmoid_layer.cpp
    """

    gradient_reads = frozenset({"top"})

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the activated bottom."""
        return torch.sigmoid(x)

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        return diff * top * (1 - top)


@register("TanH", "tanh_param")
class TanH(Activation):
    """Hyperbolic tangent.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/tanh_layer.cpp
    """

    gradient_reads = frozenset({"top"})

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the activated bottom."""
        return torch.tanh(x)

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        return diff * (1 - top * top)


@register("AbsVal")
class AbsVal(Activation):
    """|x|; the gradient at 0 is 0.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/absval_layer.cpp
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the absolute values."""
        return x.abs()


@register("Power", "power_param")
class Power(Activation):
    """(shift + scale x) ^ power; the constant shift ^ power where scale or power is 0, whatever x is.

    Where shift is 0, Caffe's gradient divides by x and is NaN at x = 0; this one is the derivative there too.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/power_layer.cpp
    """

    gradient_reads = frozenset({"bottom", "top"})

    def setup(self) -> None:
        """Read power, scale and shift."""
        p = self.param.power_param
        self.power: float = p.power
        self.scale: float = p.scale
        self.shift: float = p.shift

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the powers."""
        if self.power * self.scale == 0:
            return torch.full_like(x, self.shift).pow(self.power)
        if self.scale != 1:
            x = x * self.scale
        if self.shift != 0:
            x = x + self.shift
        return x if self.power == 1 else x.pow(self.power)

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        slope = self.power * self.scale
        if slope == 0 or self.power == 1:
            return diff * slope
        inner = self.scale * bottom + self.shift
        return diff * slope * (inner if self.power == 2 else top / inner)


@register("Exp", "exp_param")
class Exp(Activation):
    """base ^ (shift + scale x); base -1, the default, stands for e.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/exp_layer.cpp
    """

    gradient_reads = frozenset({"top"})

    def setup(self) -> None:
        """Read scale, shift and the base, which must be positive or -1."""
        p = self.param.exp_param
        if p.base <= 0 and p.base != -1:
            raise self.error(f"found base {p.base:g}, expected a positive one, or -1 for e", "exp_param", "base")
        log_base = 1.0 if p.base == -1 else math.log(p.base)
        self.scale = log_base * p.scale
        self.shift = log_base * p.shift

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the exponentials."""
        return torch.exp(x * self.scale + self.shift)

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        return diff * top * self.scale


@register("Log", "log_param")
class Log(Activation):
    """Logarithm of (shift + scale x) to a base; base -1, the default, stands for e.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/log_layer.cpp
    """

    gradient_reads = frozenset({"bottom"})

    def setup(self) -> None:
        """Read scale, shift and the base, which must be -1, or positive and not 1."""
        p = self.param.log_param
        if (p.base <= 0 and p.base != -1) or p.base == 1:
            raise self.error(
                f"found base {p.base:g}, expected a positive one other than 1, or -1 for e", "log_param", "base"
            )
        self.base_scale = 1.0 if p.base == -1 else 1 / math.log(p.base)
        self.scale: float = p.scale
        self.shift: float = p.shift

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the logarithms."""
        return torch.log(x * self.scale + self.shift) * self.base_scale

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        return diff * (self.scale * self.base_scale) / (self.scale * bottom + self.shift)


@register("BNLL")
class BNLL(Activation):
    """log(1 + exp(x)), the binomial normal log likelihood.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/bnll_layer.cpp
    """

    gradient_reads = frozenset({"bottom"})

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the activated bottom."""
        return F.softplus(x, threshold=50)  # above it the result is x, in double precision too

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        return diff * torch.sigmoid(bottom)


@register("Threshold", "threshold_param")
class Threshold(Activation):
    """1 where x > threshold (strictly), else 0; no gradient.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/threshold_layer.cpp
    """

    def setup(self) -> None:
        """Read the threshold."""
        self.threshold: float = self.param.threshold_param.threshold

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return zeros and ones."""
        return (x > self.threshold).to(x.dtype)


@register("Clip", "clip_param")
class Clip(Activation):
    """max(min, min(x, max)); the gradient passes where min <= x <= max, both ends included.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/clip_layer.cpp
    """

    gradient_reads = frozenset({"bottom"})

    def setup(self) -> None:
        """Read min and max, both required."""
        p = self.param.clip_param
        for name in ("min", "max"):
            if not p.HasField(name):
                raise self.error(f"clip_param has no {name}; both min and max are required", "clip_param")
        self.low: float = p.min
        self.high: float = p.max

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the clipped bottom."""
        return x.clamp(max=self.high).clamp(min=self.low)

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        return diff * ((bottom >= self.low) & (bottom <= self.high))


@register("Swish", "swish_param")
class Swish(Activation):
    """x sigmoid(beta x).

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/swish_layer.cpp
    """

    gradient_reads = frozenset({"top"})

    def setup(self) -> None:
        """Read the sigmoid's scale."""
        self.beta: float = self.param.swish_param.beta

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the activated bottom."""
        return x * torch.sigmoid(self.beta * x)

    def gradient_in_place(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        """See :meth:`Layer.gradient_in_place`."""
        gate = torch.sigmoid(self.beta * bottom)
        return diff * (self.beta * top * (1 - gate) + gate)

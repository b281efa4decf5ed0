"""Powers, exponentials and logarithms of scale x + shift, and the absolute value."""

from __future__ import annotations

from typing import Any

import torch
from typing_extensions import override

from netspec.exact import libm
from netspec.layers.activation import Activation, Rounded
from netspec.layers.contract.base import refuse_in_place
from netspec.layers.contract.registry import register


@register("AbsVal")
class AbsVal(Activation):
    """|x|; the gradient at 0 is 0.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/absval_layer.cpp
    """

    def setup(self) -> None:
        refuse_in_place(self)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.abs()


def over_its_diff(bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor, slope: torch.Tensor) -> torch.Tensor:
    """Return the gradient diff * slope like Caffe's Power and Log, which write the slope to the bottom's diff.

    In place, this is also the top's diff, so the gradient of the loss is lost, and the result is the slope squared.
    """
    return (slope if bottom is top else diff) * slope


@register("Power", "power_param")
class Power(Rounded):
    """(shift + scale x) ^ power; if scale or power is 0, the constant shift ^ power for any x.

    If shift is 0, Caffe's gradient divides by x and is NaN at x = 0, while this one is the derivative. In place,
    the gradient is Caffe's, the square of the slope: see :func:`over_its_diff`.

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/power_layer.cpp
    """

    gradient_reads = frozenset({"bottom", "top"})

    def setup(self) -> None:
        p = self.param.power_param
        self.power: float = p.power
        self.scale: float = p.scale
        self.shift: float = p.shift

    @override
    def as_torch(self, x: torch.Tensor) -> torch.Tensor:
        if self.power * self.scale == 0:
            return torch.full_like(x, self.shift).pow(self.power)
        inner = self._inner(x)
        return inner if self.power == 1 else inner.pow(self.power)

    @override
    def as_caffe(self, x: torch.Tensor) -> torch.Tensor:
        inner = torch.full_like(x, self.shift) if self.power * self.scale == 0 else self._inner(x)
        return inner.clone() if self.power == 1 else libm.power(inner, self.power)

    def _inner(self, x: torch.Tensor) -> torch.Tensor:
        if self.scale != 1:
            x = x * self.scale
        return x + self.shift if self.shift != 0 else x

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return over_its_diff(bottom, top, diff, self._slope(bottom, top))

    def _slope(self, bottom: torch.Tensor, top: torch.Tensor) -> torch.Tensor:
        slope = self.power * self.scale
        if slope == 0 or self.power == 1:
            return torch.full_like(bottom, slope)
        if self.power == 2:
            derivative = slope * self.scale * bottom
            return derivative + slope * self.shift if self.shift != 0 else derivative
        if self.shift != 0:
            return top / self._inner(bottom) * slope
        return torch.where(bottom == 0, slope * bottom.pow(self.power - 1), top / bottom * self.power)


def _log(base: float) -> float:
    """Return the logarithm of a base as a float, as in Caffe; -1 stands for e."""
    return 1.0 if base == -1 else libm.log(torch.tensor(base)).item()


@register("Exp", "exp_param")
class Exp(Rounded):
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
        log_base = _log(p.base)
        self.scale = log_base * p.scale
        self.shift = log_base * p.shift

    @override
    def as_torch(self, x: torch.Tensor) -> torch.Tensor:
        return torch.exp(x * self.scale + self.shift)

    @override
    def as_caffe(self, x: torch.Tensor) -> torch.Tensor:
        p = self.param.exp_param
        if p.shift == 0:
            return libm.exp(x * self.scale)
        factor = libm.exp(x.new_tensor(p.shift)) if p.base == -1 else libm.power(x.new_tensor(p.base), p.shift)
        # With a large shift, Caffe computes 0 * infinity for a finite result.
        return libm.exp(x * self.scale) * factor if factor.isfinite() else self.as_torch(x)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return diff * top * self.scale


@register("Log", "log_param")
class Log(Rounded):
    """Logarithm of (shift + scale x) to a base; base -1, the default, stands for e.

    bottom[0]  any shape
    top[0]     the same shape
    In place, the gradient is Caffe's, the square of the slope: see :func:`over_its_diff`.
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
        log_base = _log(p.base)
        self.base_scale = 1 / log_base
        self.slope = p.scale / log_base
        self.scale: float = p.scale
        self.shift: float = p.shift

    @override
    def compute(self, x: torch.Tensor, functions: Any) -> torch.Tensor:
        return functions.log(x * self.scale + self.shift) * self.base_scale

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return over_its_diff(bottom, top, diff, libm.power(bottom * self.scale + self.shift, -1) * self.slope)

"""Layers that normalize each image separately: LRN, MVN."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch.nn import functional as F

from netspec.exact.channels import RowNormalization, row_normalization_gradient
from netspec.exact.lrn import AcrossChannels, across_channels_gradient, within_channel
from netspec.layers.contract.base import MOST, Layer, Shape, is_in_place
from netspec.layers.contract.registry import register
from netspec.layers.contract.targets import OnnxGraph, TorchCode, rounded

ACROSS_CHANNELS = 0  # caffe.proto: enum LRNParameter.NormRegion


@register("LRN", "lrn_param")
class LRN(Layer):
    """Divide each value by a power of the squares of its neighbors: (k + alpha times their mean) ** beta.

    The n = ``local_size`` neighbors are channels (ACROSS_CHANNELS), or n x n pixels (WITHIN_CHANNEL, where k is
    1 and cannot be set); neighbors outside count as zeros.

    bottom[0]  (N, C, H, W)
    top[0]     the same shape
    Caffe: src/caffe/layers/lrn_layer.cpp
    """

    def setup(self) -> None:
        param = self.param.lrn_param
        if param.local_size % 2 == 0 or param.local_size > MOST:
            expected = "odd" if param.local_size % 2 == 0 else f"at most {MOST}"
            raise self.error(f"local_size must be {expected}, found {param.local_size}", "lrn_param", "local_size")
        if param.norm_region == ACROSS_CHANNELS:
            self.ignores_propagate_down = frozenset({0})
            if not is_in_place(self):
                self.gradient_reads = frozenset({"top"})
        else:
            self.ignores = frozenset({"lrn_param.k"})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if len(bottom_shapes[0]) != 4:
            raise self.error(f"LRN needs a bottom of 4 axes (N, C, H, W), found shape {bottom_shapes[0]}", "bottom")
        return bottom_shapes

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        param = self.param.lrn_param
        size = param.local_size
        if self.is_exact(data):
            if param.norm_region == ACROSS_CHANNELS:
                return AcrossChannels.apply(data, size, param.alpha, param.beta, param.k)
            return within_channel(data, size, param.alpha, param.beta)
        if param.norm_region == ACROSS_CHANNELS:
            return data * self._base(data).pow(-param.beta)
        base = 1 + param.alpha * F.avg_pool2d(data * data, size, stride=1, padding=size // 2)
        return data * base.pow(-param.beta)

    def _base(self, data: torch.Tensor) -> torch.Tensor:
        """Return the base of the divisor: k + alpha times the mean of the squares in the neighboring channels."""
        param = self.param.lrn_param
        return param.k + param.alpha / param.local_size * self._window_sums(data * data)

    def _window_sums(self, maps: torch.Tensor) -> torch.Tensor:
        """Return the sums over the neighboring channels."""
        size, channels = self.param.lrn_param.local_size, maps.shape[1]
        framed = F.pad(maps, (0, 0, 0, 0, size // 2, size // 2))
        total = framed[:, :channels]
        for shift in range(1, size):
            total = total + framed[:, shift : shift + channels]
        return total

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        param = self.param.lrn_param
        size, alpha, beta = param.local_size, param.alpha, param.beta
        if self.is_exact(bottom):
            return across_channels_gradient(bottom, top, diff, (size, alpha, beta, param.k))
        base = self._base(bottom)
        sums = self._window_sums(diff * top / base)
        return diff * base.pow(-beta) - 2 * alpha * beta / size * bottom * sums

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        param = self.param.lrn_param
        size, reach = param.local_size, param.local_size // 2
        if param.norm_region == ACROSS_CHANNELS:
            return graph.node("LRN", *bottoms, size=size, alpha=param.alpha, beta=param.beta, bias=param.k)
        squares = graph.node("Mul", *bottoms, *bottoms)
        window = {"kernel_shape": [size] * 2, "pads": [reach] * 4, "count_include_pad": 1}
        mean = graph.node("Mul", graph.node("AveragePool", squares, **window), graph.constant(param.alpha))
        base = graph.node("Add", mean, graph.constant(1.0))
        return graph.node("Mul", *bottoms, graph.node("Pow", base, graph.constant(-param.beta)))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        param, (x,) = self.param.lrn_param, bottoms
        alpha, beta = rounded(param.alpha), rounded(param.beta)
        if param.norm_region == ACROSS_CHANNELS:
            usual = {"alpha": 1e-4, "beta": 0.75, "k": 1.0}
            given = {"alpha": alpha, "beta": beta, "k": rounded(param.k)}
            given = {name: number for name, number in given.items() if number != usual[name]}
            options = "".join(f", {name}={{{name}}}" for name in given)
            return code.call(f"F.local_response_norm({{x}}, {{size}}{options})", x=x, size=param.local_size, **given)
        template = f"{code.function(spatial_response_norm)}({{x}}, {{size}}, {{alpha}}, {{beta}})"
        return code.call(template, x=x, size=param.local_size, alpha=alpha, beta=beta)


@register("MVN", "mvn_param")
class MVN(Layer):
    """Subtract the mean of each map and divide by its standard deviation plus ``eps``.

    A map is one channel of an image or, with ``across_channels``, the whole image.

    bottom[0]  (N, C, H, W); up to four axes
    top[0]     (N, C, H, W); always four axes, missing ones are 1
    Caffe: src/caffe/layers/mvn_layer.cpp
    """

    ignores_propagate_down = frozenset({0})

    def setup(self) -> None:
        if self.param.mvn_param.normalize_variance:  # Caffe keeps the variance of the forward pass, but not the top
            self.gradient_reads = frozenset({"top", "kept"} if is_in_place(self) else {"top"})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shape = bottom_shapes[0]
        if len(shape) > 4:
            raise self.error(f"MVN takes up to 4 axes (N, C, H, W), found shape {shape}", "bottom")
        return [(*shape, *(1,) * (4 - len(shape)))]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        param, maps = self.param.mvn_param, self._maps(data)
        if self.is_exact(data):
            top: torch.Tensor = RowNormalization.apply(maps, param.eps if param.normalize_variance else None)
        elif param.normalize_variance:
            top = _Standardize.apply(maps, param.eps)
        else:
            top = maps - maps.mean(dim=1, keepdim=True)
        return top.reshape(self.top_shapes[0])

    def _maps(self, blob: torch.Tensor) -> torch.Tensor:
        """Return the maps of a bottom or top as rows."""
        shape, outer = self.top_shapes[0], 1 if self.param.mvn_param.across_channels else 2
        return blob.reshape(math.prod(shape[:outer]), math.prod(shape[outer:]))

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        maps, tops, diffs = self._maps(bottom), self._maps(top), self._maps(diff)
        eps = self.param.mvn_param.eps
        if self.is_exact(bottom):
            return row_normalization_gradient(maps, tops, diffs, eps).reshape(bottom.shape)
        deviation = _deviation(maps - maps.mean(dim=1, keepdim=True), eps)
        return _standardized_gradient(tops, deviation, diffs).reshape(bottom.shape)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        param, (data,) = self.param.mvn_param, bottoms
        missing = list(range(len(self.bottom_shapes[0]), 4))
        if missing:
            data = graph.node("Unsqueeze", data, graph.constant(missing))
        axes = graph.constant(list(range(1 if param.across_channels else 2, 4)))
        top = graph.node("Sub", data, graph.node("ReduceMean", data, axes, keepdims=1))
        if not param.normalize_variance:
            return top
        variance = graph.node("ReduceMean", graph.node("Mul", top, top), axes, keepdims=1)
        return graph.node("Div", top, graph.node("Add", graph.node("Sqrt", variance), graph.constant(param.eps)))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        param, x = self.param.mvn_param, bottoms[0]
        missing = 4 - len(self.bottom_shapes[0])
        if missing:
            x = code.call(f"{{x}}[..., {', '.join(['None'] * missing)}]", x=x)
        function = code.function(standardize if param.normalize_variance else center)
        axes = (1, 2, 3) if param.across_channels else (2, 3)
        if not param.normalize_variance:
            return code.call(f"{function}({{x}}, {{axes}})", x=x, axes=axes)
        return code.call(f"{function}({{x}}, {{axes}}, eps={{eps}})", x=x, axes=axes, eps=rounded(param.eps))


class _Standardize(torch.autograd.Function):
    """Normalize rows to mean 0 and standard deviation 1, with Caffe's gradient.

    Caffe differentiates without ``eps``, then divides by the deviation plus eps, so a constant row has a
    finite gradient, while autograd's is NaN.
    """

    @staticmethod
    def forward(ctx: Any, rows: torch.Tensor, eps: float) -> torch.Tensor:
        centered = rows - rows.mean(dim=1, keepdim=True)
        deviation = _deviation(centered, eps)
        top = centered / deviation
        ctx.save_for_backward(top, deviation)
        return top

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None]:
        return _standardized_gradient(*ctx.saved_tensors, *grads), None


def _deviation(centered: torch.Tensor, eps: float) -> torch.Tensor:
    return centered.square().mean(dim=1, keepdim=True).sqrt() + eps


def _standardized_gradient(top: torch.Tensor, deviation: torch.Tensor, grad: torch.Tensor) -> torch.Tensor:
    along = (grad * top).mean(dim=1, keepdim=True)
    return (grad - grad.mean(dim=1, keepdim=True) - along * top) / deviation


def spatial_response_norm(x, size, alpha, beta):
    """Divide by a power of 1 + alpha times the mean square of size x size pixels."""
    mean = F.avg_pool2d(x * x, size, stride=1, padding=size // 2)
    return x / (1 + alpha * mean).pow(beta)


def center(x, axes):
    """Subtract the mean over some axes."""
    return x - x.mean(axes, keepdim=True)


def standardize(x, axes, eps):
    """Subtract the mean over some axes and divide by the standard deviation plus eps."""
    variance, mean = torch.var_mean(x, axes, correction=0, keepdim=True)
    return (x - mean) / (variance.sqrt() + eps)

"""BatchNorm, and functions for layers of forks that normalize a batch."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from typing_extensions import override

from netspec.exact import SMALL_ITEM, libm
from netspec.exact.channels import BatchNormalization
from netspec.layers.contract.base import Layer, Param, Shape
from netspec.layers.contract.offers import offered
from netspec.layers.contract.registry import register
from netspec.layers.contract.targets import OnnxGraph, TorchCode, rounded
from netspec.proto.schema import TEST

MAX_OFFSET = 8  # the largest mean, in standard deviations, for which torch's CPU kernel is exact to 1e-6


@register("BatchNorm", "batch_norm_param")
class BatchNorm(Layer):
    """Subtract each channel's mean and divide by its standard deviation, of the batch, or averages in testing.

    y = (x - mean) / sqrt(var + eps) with the biased variance of the batch, or with blobs[0 and 1] / blobs[2] if
    ``use_global_stats`` (the default in the test phase). Training adds to the sums: S = S moving_average_fraction + the
    batch's mean, its unbiased variance, or 1. Layers that share the blobs add one after the other.

    bottom[0]  (N, C) or (N, C, ...)
    top[0]     the same shape
    blobs[0]   sum of means     (C,)
    blobs[1]   sum of variances (C,)
    blobs[2]   sum of weights   (1,)        the divisor of the others; all three are not learned (lr_mult 0)
    Caffe: src/caffe/layers/batch_norm_layer.cpp
    """

    ignores_propagate_down = frozenset({0})
    joined: tuple[Layer, ...] = ()  # a Scale and a ReLU after it that it also computes, in training
    rectifies = False  # whether they include a ReLU

    def setup(self) -> None:
        """Add the sums, all zero. Raise SpecError for a ``param`` that would train them."""
        param = self.param.batch_norm_param
        for i, spec in enumerate(self.param.param[:3]):
            if spec.lr_mult != 0:
                message = f"BatchNorm's blobs are statistics, not learned: set lr_mult: 0, found {spec.lr_mult:g}"
                raise self.error(message, "param", i, "lr_mult")
        self.use_global_stats: bool = (
            param.use_global_stats if param.HasField("use_global_stats") else self.phase == TEST
        )
        if len(self.bottom_shapes[0]) < 2:
            raise self.error(f"BatchNorm needs at least 2 axes (N, C), found shape {self.bottom_shapes[0]}", "bottom")
        self.channels = self.bottom_shapes[0][1]
        for shape in ((self.channels,), (self.channels,), (1,)):
            self.add_blob(shape)

    @override
    def param_spec(self, j: int, given: Param | None) -> Param:
        return given or replace(super().param_spec(j, None), lr_mult=0.0)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return as_before(self, bottom_shapes, self.channels)

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        """Return the normalized values; in training also add the batch's statistics to the sums."""
        if self.use_global_stats:
            return self.by_past(self.is_exact(data, self.small))(data)
        return self._by_batch(data)

    @property
    def eps(self) -> float:
        """The constant added to the variance."""
        return self.param.batch_norm_param.eps

    def past(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the stored mean and variance of each channel, (C,)."""
        with torch.no_grad():
            return means(*(self.blob(i) for i in range(3)))

    def by_past(self, exact: bool) -> Callable[[torch.Tensor], torch.Tensor]:
        """Return a function that normalizes a bottom of the current shape with the current stored statistics."""
        mean, variance = self.past()
        eps, axes = self.param.batch_norm_param.eps, (-1, *(1,) * (len(self.bottom_shapes[0]) - 2))
        by_channel = mean.view(axes)
        if exact:
            deviation = libm.sqrt(variance + eps).view(axes)
            return lambda data: (data - by_channel).div_(deviation)
        far = _far_from_zero(mean, variance, eps)
        arguments = (torch.zeros_like(mean) if far else mean, variance, False, 0.0, eps, torch.backends.cudnn.enabled)
        return lambda data: torch.batch_norm(data - by_channel if far else data, None, None, *arguments)

    def joined_with(self, after: Layer) -> Layer | None:
        """Return this layer joined with a Scale of its channels or a ReLU after it, for one kernel of torch."""
        kind = offered(after, "joins_as")
        fits = (kind == "scale" and not self.joined) or (kind == "relu" and not self.rectifies)
        if not fits or self.use_global_stats or self.is_exact(self.blob(0), self.small):
            return None
        made = copy.copy(self)
        made.joined, made.rectifies = (*self.joined, after), kind == "relu"
        return made

    def factors(self) -> tuple[torch.Tensor | None, torch.Tensor | None]:
        """Return the factors and biases of the Scale that it was joined with."""
        blobs = [layer.blob(j) for layer in self.joined for j in range(len(layer.blobs))]
        return blobs[0] if blobs else None, blobs[1] if len(blobs) > 1 else None

    def _by_batch(self, data: torch.Tensor) -> torch.Tensor:
        if self.is_exact(data, self.small):
            values = data.numel() // self.channels
            top, mean, variance = BatchNormalization.apply(data.reshape(*data.shape[:2], -1), self.eps)
            self._add(mean, variance, values / (values - 1) if values > 1 else 1.0)
            tops = (top.reshape(data.shape),)
            for layer in self.joined:
                tops = layer.run(*tops)
            return tops[0]
        top = self.normalized(data, torch.batch_norm, torch.backends.cudnn.enabled)[0]
        return top.relu_() if self.rectifies else top

    def normalized(self, data: torch.Tensor, normalize: Callable[..., Any], *options: Any) -> tuple[Any, torch.Tensor]:
        """Normalize a batch with torch's ``normalize``; return the result and its input. Add to the statistics."""
        made, mean, variance = self._by_torch(data, normalize, options)
        if _far_from_zero(mean, variance, self.eps):
            # Subtracting a constant from each channel changes only the rounding of the result and the gradient.
            data = data - mean.view(-1, *(1,) * (data.dim() - 2))
            made, _, variance = self._by_torch(data, normalize, options)
        # Torch's unbiased variance of one value is 0 / 0, and Caffe's is 0.
        self._add(mean, torch.zeros_like(variance) if data.numel() == self.channels else variance)
        return made, data

    def _by_torch(
        self, data: torch.Tensor, normalize: Callable[..., Any], options: Sequence[Any]
    ) -> tuple[Any, torch.Tensor, torch.Tensor]:
        """Return the normalized batch, its mean and its unbiased variance."""
        exact_enough = torch.promote_types(data.dtype, torch.float32)
        mean, variance = data.new_zeros(2, self.channels, dtype=exact_enough).unbind()
        made = normalize(data, *self.factors(), mean, variance, True, 1.0, self.eps, *options)
        return made, mean, variance

    @torch.no_grad()
    def _add(self, mean: torch.Tensor, variance: torch.Tensor, unbiased: float = 1.0) -> None:
        """Add a batch's statistics to the sums."""
        keep = self.param.batch_norm_param.moving_average_fraction
        self.blob(0).mul_(keep).add_(mean)
        self.blob(1).mul_(keep).add_(variance, alpha=unbiased)
        self.blob(2).mul_(keep).add_(1)

    @property
    def small(self) -> bool:
        return math.prod(self.bottom_shapes[0][1:]) <= SMALL_ITEM

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        eps = self.param.batch_norm_param.eps
        if not self.use_global_stats:
            return onnx_normalized(graph, bottoms[0], len(self.bottom_shapes[0]), eps)
        ones, zeros = torch.ones(self.channels), torch.zeros(self.channels)
        constants = [graph.constant(values) for values in (ones, zeros, *self.past())]
        return graph.node("BatchNormalization", *bottoms, *constants, epsilon=eps)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        eps = rounded(self.param.batch_norm_param.eps)
        if not self.use_global_stats:
            return code.call("F.batch_norm({x}, None, None, training=True, eps={eps})", x=bottoms[0], eps=eps)
        norm = torch_batch_norm(code, len(self.bottom_shapes[0]), *self.past(), eps)
        return code.call("{norm}({x})", norm=norm, x=bottoms[0])


def as_before(layer: Layer, shapes: Sequence[Shape], channels: int) -> Sequence[Shape]:
    """Return the shape of a bottom (N, C) or (N, C, ...). Raise SpecError for another number of channels."""
    shape = shapes[0]
    if len(shape) < 2 or shape[1] != channels:
        raise layer.error(f"found a bottom of shape {shape}, expected {channels} channels as before", "bottom")
    return shapes


def means(means: torch.Tensor, variances: torch.Tensor, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sums divided by their weight, or 0 if nothing was added yet."""
    factor = torch.where(weight == 0, 0, 1 / weight)
    return means * factor, variances * factor


def torch_batch_norm(
    code: TorchCode, axes: int, mean: torch.Tensor, variance: torch.Tensor, eps: float, **affine: torch.Tensor
) -> str:
    """Add torch's batch normalization by stored statistics; ``affine`` has its weight and bias, or is empty."""
    count = torch.zeros((), dtype=torch.long)
    state = {**affine, "running_mean": mean, "running_var": variance, "num_batches_tracked": count}
    options = ("" if eps == 1e-5 else ", eps={eps}") + ("" if affine else ", affine=False")
    template = f"nn.BatchNorm{max(1, axes - 2)}d({{channels}}{options})"
    numbers = {"channels": len(mean), **({} if eps == 1e-5 else {"eps": eps})}
    return code.module(template, state, **numbers)


def onnx_normalized(graph: OnnxGraph, data: str, axes: int, eps: float) -> str:
    """Write the normalization of a batch: subtract each channel's mean and divide by its standard deviation."""
    centered = graph.node("Sub", data, _onnx_channel_means(graph, data, axes))
    variance = _onnx_channel_means(graph, graph.node("Mul", centered, centered), axes)
    return graph.node("Div", centered, graph.node("Sqrt", graph.node("Add", variance, graph.constant(eps))))


def _onnx_channel_means(graph: OnnxGraph, data: str, axes: int) -> str:
    # One after the other, since means over nonadjacent axes are wrong in OpenCV 5.0.
    for part in ([0], list(range(2, axes))):
        data = graph.node("ReduceMean", data, graph.constant(part), keepdims=1) if part else data
    return data


def _far_from_zero(mean: torch.Tensor, variance: torch.Tensor, eps: float) -> bool:
    """Return whether torch's kernel would lose precision, since on a CPU it computes x / std - mean / std.

    Compiled by torch.compile, it subtracts the mean first.
    """
    return (
        mean.device.type == "cpu"
        and not torch.compiler.is_compiling()
        and bool((mean.square() > MAX_OFFSET**2 * (variance + eps)).any())
    )

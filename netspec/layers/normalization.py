"""Layers that bring values to a common scale: BatchNorm, Scale, Bias, LRN, MVN."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch.nn import functional as F

from netspec.exact import SMALL_ITEM, libm
from netspec.exact.channels import BatchNormalization, ChannelProducts, RowNormalization
from netspec.exact.lrn import AcrossChannels, within_channel
from netspec.layers.base import Layer, Shape
from netspec.layers.registry import register
from netspec.proto.schema import TEST

ACROSS_CHANNELS = 0  # caffe.proto: enum LRNParameter.NormRegion
MAX_OFFSET = 8  # means, in standard deviations, up to which torch's CPU kernel is exact to 1e-6


@register("BatchNorm", "batch_norm_param")
class BatchNorm(Layer):
    """Subtract each channel's mean, divide by its standard deviation; of the batch in training, of the past in testing.

    y = (x - mean) / sqrt(var + eps) with the biased variance of the batch, or with blobs[0 and 1] / blobs[2] where
    ``use_global_stats`` (by default: in the test phase). Training adds to the sums: S = S moving_average_fraction + the
    batch's mean, its unbiased variance, 1. Layers that share the blobs add one after the other.

    bottom[0]  (N, C) or (N, C, ...)
    top[0]     the same shape
    blobs[0]   sum of means     (C,)
    blobs[1]   sum of variances (C,)
    blobs[2]   sum of weights   (1,)        what the others are to be divided by; all three are not learned: lr_mult 0
    Caffe: src/caffe/layers/batch_norm_layer.cpp
    """

    default_param_lr = 0.0

    def setup(self) -> None:
        """Add the sums, all zero; refuse a ``param`` that would have them learned."""
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

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the bottom's shape; its channels must stay as many."""
        shape = bottom_shapes[0]
        if len(shape) < 2 or shape[1] != self.channels:
            raise self.error(f"bottom of shape {shape} has not the {self.channels} channels seen first", "bottom")
        return [shape]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        """Return the normalised values; in training also add the batch's statistics to the sums."""
        return self._by_past(data) if self.use_global_stats else self._by_batch(data)

    def _by_past(self, data: torch.Tensor) -> torch.Tensor:
        with torch.no_grad():
            weight = self.blob(2)
            factor = torch.where(weight == 0, 0, 1 / weight)
            mean, variance = self.blob(0) * factor, self.blob(1) * factor
        eps = self.param.batch_norm_param.eps
        if self._is_exact(data):
            return (data - _along(mean, 1, data)) / _along(libm.sqrt(variance + eps), 1, data)
        if _far_from_zero(mean, variance, eps):
            data, mean = data - _along(mean, 1, data), torch.zeros_like(mean)
        return torch.batch_norm(data, None, None, mean, variance, False, 0.0, eps, torch.backends.cudnn.enabled)

    def _by_batch(self, data: torch.Tensor) -> torch.Tensor:
        eps, keep = self.param.batch_norm_param.eps, self.param.batch_norm_param.moving_average_fraction
        values = data.numel() // self.channels
        unbiased = 1.0
        if self._is_exact(data):
            top, mean, variance = BatchNormalization.apply(data.reshape(*data.shape[:2], -1), eps)
            top = top.reshape(data.shape)
            unbiased = values / (values - 1) if values > 1 else 1.0
        else:
            top, mean, variance = _normalize(data, eps)
            if _far_from_zero(mean, variance, eps):
                # A constant taken off each channel changes neither the result nor the gradient, only the rounding.
                top, _, variance = _normalize(data - _along(mean, 1, data), eps)
            if values == 1:
                variance = torch.zeros_like(variance)  # torch's unbiased variance is 0 / 0, Caffe's 0
        with torch.no_grad():
            self.blob(0).mul_(keep).add_(mean)
            self.blob(1).mul_(keep).add_(variance, alpha=unbiased)
            self.blob(2).mul_(keep).add_(1)
        return top

    def _is_exact(self, data: torch.Tensor) -> bool:
        return self.is_exact(data, small=math.prod(data.shape[1:]) <= SMALL_ITEM)


def _normalize(data: torch.Tensor, eps: float) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the normalised batch, its mean and its unbiased variance, by torch's own kernel.

    The statistics come out exact as that kernel's running ones, all weight on the present batch.
    """
    mean, variance = data.new_zeros(2, data.shape[1]).unbind()
    top = torch.batch_norm(data, None, None, mean, variance, True, 1.0, eps, torch.backends.cudnn.enabled)
    return top, mean, variance


def _far_from_zero(mean: torch.Tensor, variance: torch.Tensor, eps: float) -> bool:
    """Whether torch's kernel would lose digits: on a CPU it computes x / std - mean / std, not (x - mean) / std."""
    return mean.device.type == "cpu" and bool((mean.square() > MAX_OFFSET**2 * (variance + eps)).any())


def _along(values: torch.Tensor, axis: int, data: torch.Tensor) -> torch.Tensor:
    """Return ``values`` shaped to meet the axes of ``data`` from ``axis`` on."""
    return values.reshape(*values.shape, *(1,) * (data.dim() - axis - values.dim()))


class _Affine(Layer):
    """What Scale and Bias have in common: an operand that is learned or a second bottom, laid over some axes."""

    bottoms = (1, 2)

    def learned_shape(self, param: Any, field: str) -> Shape:
        """Return the shape of a learned operand: ``num_axes`` axes of the bottom from ``axis`` on (-1: all)."""
        shape = self.bottom_shapes[0]
        axis = self.canonical_axis(param.axis, shape, field, "axis")
        if param.num_axes < -1:
            raise self.error(f"num_axes must be at least -1, found {param.num_axes}", field, "num_axes")
        end = len(shape) if param.num_axes == -1 else axis + param.num_axes
        if end > len(shape):
            message = f"{param.num_axes} axes from axis {axis} on are more than the bottom has, shape {shape}"
            raise self.error(message, field, "num_axes")
        return shape[axis:end]

    def locate(self, shapes: Sequence[Shape], param: Any, field: str) -> int:
        """Return the axis of the first bottom where the operand begins; refuse an operand that does not match."""
        shape = shapes[0]
        axis = 0
        for operand in (*shapes[1:], *self.blob_shapes):
            axis = self.canonical_axis(param.axis, shape, field, "axis") if operand else 0
            if shape[axis : axis + len(operand)] != operand:
                message = f"an operand of shape {operand} does not match the bottom's axes from {axis} on, {shape}"
                raise self.error(message, "bottom", len(shapes) - 1)
        return axis

    def apply_exactly(
        self, data: torch.Tensor, factors: torch.Tensor | None, bias: torch.Tensor | None, axis: int
    ) -> torch.Tensor:
        """Multiply and add in Caffe's order; the operands lie over the axes from ``axis`` on."""
        operand = bias if factors is None else factors
        assert operand is not None
        values = data.reshape(math.prod(data.shape[:axis]), operand.numel(), -1)
        tops = ChannelProducts.apply(values, factors, bias, self.context.accumulate_in_place)
        return tops.reshape(data.shape)


@register("Scale", "scale_param")
class Scale(_Affine):
    """Multiply by a learned factor, or by a second bottom, and, with bias_term, add a learned bias.

    bottom[0]  any shape
    bottom[1]  optional, the factors: bottom[0]'s shape from ``axis`` on, as many axes as it has
    top[0]     bottom[0]'s shape
    blobs[0]   factors, bottom[0]'s shape from ``axis`` for ``num_axes``    unless bottom[1] is given
    blobs[1]   bias, the shape of the factors                               with bias_term: true; blobs[0] if bottom[1]
    Caffe: src/caffe/layers/scale_layer.cpp
    """

    def setup(self) -> None:
        """Add the factors, 1 unless a filler is given, and the bias."""
        param = self.param.scale_param
        shape = self.bottom_shapes[1] if len(self.bottom_shapes) > 1 else self.learned_shape(param, "scale_param")
        if len(self.bottom_shapes) == 1:
            self.add_blob(shape, param.filler if param.HasField("filler") else None, value=1.0)
        if param.bias_term:
            self.add_blob(shape, param.bias_filler)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the first bottom's shape."""
        self.axis = self.locate(bottom_shapes, self.param.scale_param, "scale_param")
        return [bottom_shapes[0]]

    def forward(self, data: torch.Tensor, factors: torch.Tensor | None = None) -> torch.Tensor:
        """Return the products, and the bias added."""
        scale = self.blob(0) if factors is None else factors
        bias = self.blob(len(self.blobs) - 1) if self.param.scale_param.bias_term else None
        by_channel = self.axis == 1 and scale.dim() == 1
        if self.is_exact(data, small=by_channel and math.prod(data.shape[1:]) <= SMALL_ITEM):
            return self.apply_exactly(data, scale, bias, self.axis)
        if by_channel:
            # By channel: batch normalisation with mean 0 and variance 1 is this, three times as fast, backward too.
            zero, one = torch.zeros_like(scale), torch.ones_like(scale)
            return torch.batch_norm(data, scale, bias, zero, one, False, 0.0, 0.0, torch.backends.cudnn.enabled)
        top = data * _along(scale, self.axis, data)
        return top if bias is None else top + _along(bias, self.axis, data)


@register("Bias", "bias_param")
class Bias(_Affine):
    """Add a learned bias, or a second bottom.

    bottom[0]  any shape
    bottom[1]  optional, the bias: bottom[0]'s shape from ``axis`` on, as many axes as it has
    top[0]     bottom[0]'s shape
    blobs[0]   bias, bottom[0]'s shape from ``axis`` for ``num_axes``       unless bottom[1] is given
    Caffe: src/caffe/layers/bias_layer.cpp
    """

    def setup(self) -> None:
        """Add the bias, 0 unless a filler says otherwise."""
        param = self.param.bias_param
        if len(self.bottom_shapes) == 1:
            self.add_blob(self.learned_shape(param, "bias_param"), param.filler)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the first bottom's shape."""
        self.axis = self.locate(bottom_shapes, self.param.bias_param, "bias_param")
        return [bottom_shapes[0]]

    def forward(self, data: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
        """Return the sums."""
        operand = self.blob(0) if bias is None else bias
        if self.is_exact(data):
            return self.apply_exactly(data, None, operand, self.axis)
        return data + _along(operand, self.axis, data)


@register("LRN", "lrn_param")
class LRN(Layer):
    """Divide each value by a power of the squares around it: (k + alpha times their mean) ** beta.

    The n = ``local_size`` neighbours are channels (ACROSS_CHANNELS), or n x n pixels (WITHIN_CHANNEL, where k is
    ignored: it is 1); those outside count as zeros.

    bottom[0]  (N, C, H, W)
    top[0]     the same shape
    Caffe: src/caffe/layers/lrn_layer.cpp
    """

    def setup(self) -> None:
        """Refuse an even local_size."""
        if self.param.lrn_param.local_size % 2 == 0:
            message = f"local_size must be odd, found {self.param.lrn_param.local_size}"
            raise self.error(message, "lrn_param", "local_size")
        if self.param.lrn_param.norm_region != ACROSS_CHANNELS:
            self.ignores = frozenset({"lrn_param.k"})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the bottom's shape."""
        if len(bottom_shapes[0]) != 4:
            raise self.error(f"LRN needs a bottom of 4 axes (N, C, H, W), found shape {bottom_shapes[0]}", "bottom")
        return bottom_shapes

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        """Return the normalised values."""
        param = self.param.lrn_param
        size, reach = param.local_size, param.local_size // 2
        if self.is_exact(data):
            if param.norm_region == ACROSS_CHANNELS:
                return AcrossChannels.apply(data, size, param.alpha, param.beta, param.k)
            return within_channel(data, size, param.alpha, param.beta)
        squares = data * data
        if param.norm_region == ACROSS_CHANNELS:
            framed, channels = F.pad(squares, (0, 0, 0, 0, reach, reach)), data.shape[1]
            total = framed[:, :channels]
            for shift in range(1, size):
                total = total + framed[:, shift : shift + channels]
            base = param.k + param.alpha / size * total
        else:
            base = 1 + param.alpha * F.avg_pool2d(squares, size, stride=1, padding=reach)
        return data * base.pow(-param.beta)


@register("MVN", "mvn_param")
class MVN(Layer):
    """Subtract the mean of each map and divide by its standard deviation plus ``eps``.

    A map is one channel of one image, or with ``across_channels`` all of an image.

    bottom[0]  (N, C, H, W); up to four axes
    top[0]     (N, C, H, W); always four axes, missing ones are 1
    Caffe: src/caffe/layers/mvn_layer.cpp
    """

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the bottom's shape, filled up to four axes."""
        shape = bottom_shapes[0]
        if len(shape) > 4:
            raise self.error(f"MVN takes up to 4 axes (N, C, H, W), found shape {shape}", "bottom")
        return [(*shape, *(1,) * (4 - len(shape)))]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        """Return the normalised maps."""
        param, shape = self.param.mvn_param, self.top_shapes[0]
        outer = 1 if param.across_channels else 2
        maps = data.reshape(math.prod(shape[:outer]), math.prod(shape[outer:]))
        if self.is_exact(data):
            top: torch.Tensor = RowNormalization.apply(maps, param.eps if param.normalize_variance else None)
        elif param.normalize_variance:
            top = _Standardize.apply(maps, param.eps)
        else:
            top = maps - maps.mean(dim=1, keepdim=True)
        return top.reshape(shape)


class _Standardize(torch.autograd.Function):
    """Rows to mean 0 and deviation 1, with Caffe's gradient.

    Caffe differentiates as if ``eps`` were not there, then divides by the deviation plus eps: a constant row has a
    finite gradient, where autograd's is not a number.
    """

    @staticmethod
    def forward(ctx: Any, rows: torch.Tensor, eps: float) -> torch.Tensor:
        centred = rows - rows.mean(dim=1, keepdim=True)
        deviation = centred.square().mean(dim=1, keepdim=True).sqrt() + eps
        top = centred / deviation
        ctx.save_for_backward(top, deviation)
        return top

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None]:
        (grad,) = grads
        top, deviation = ctx.saved_tensors
        along = (grad * top).mean(dim=1, keepdim=True)
        return (grad - grad.mean(dim=1, keepdim=True) - along * top) / deviation, None

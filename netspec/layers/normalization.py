"""Layers that normalize or scale values: BatchNorm, Scale, Bias, LRN, MVN."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch.nn import functional as F
from typing_extensions import override

from netspec.exact import ALL, SMALL_ITEM, libm
from netspec.exact.channels import BatchNormalization, ChannelProducts, RowNormalization
from netspec.exact.lrn import AcrossChannels, within_channel
from netspec.layers.base import MOST, Layer, Shape, copy_of, rounded
from netspec.layers.folding import Absorbed, Affine, blob_in_double
from netspec.layers.learned import values_of
from netspec.layers.preparing import RELU, Kernel, Preparation, finished, finishing
from netspec.layers.registry import register
from netspec.layers.targets import OnnxGraph, TorchCode
from netspec.proto.schema import TEST

ACROSS_CHANNELS = 0  # caffe.proto: enum LRNParameter.NormRegion
MAX_OFFSET = 8  # means, in standard deviations, up to which torch's CPU kernel is exact to 1e-6


@register("BatchNorm", "batch_norm_param")
class BatchNorm(Layer):
    """Subtract each channel's mean, divide by its standard deviation: of the batch in training, averages in testing.

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
    traceable = True

    @override
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

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the bottom's shape; its channels must stay as many."""
        shape = bottom_shapes[0]
        if len(shape) < 2 or shape[1] != self.channels:
            raise self.error(f"found a bottom of shape {shape}, expected {self.channels} channels as before", "bottom")
        return [shape]

    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
        """Return the normalized values; in training also add the batch's statistics to the sums."""
        return self._by_past(data) if self.use_global_stats else self._by_batch(data)

    def past(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the mean and the variance of each channel, (C,), that the sums stand for."""
        with torch.no_grad():
            weight = self.blob(2)
            factor = torch.where(weight == 0, 0, 1 / weight)
            return self.blob(0) * factor, self.blob(1) * factor

    def _by_past(self, data: torch.Tensor) -> torch.Tensor:
        mean, variance = self.past()
        eps = self.param.batch_norm_param.eps
        if self.is_exact(data, self.small):
            return (data - _along(mean, 1, data)) / _along(libm.sqrt(variance + eps), 1, data)
        if _far_from_zero(mean, variance, eps):
            data, mean = data - _along(mean, 1, data), torch.zeros_like(mean)
        return torch.batch_norm(data, None, None, mean, variance, False, 0.0, eps, torch.backends.cudnn.enabled)

    def run_with(self, following: Sequence[Layer], *bottoms: torch.Tensor) -> tuple[int, tuple[torch.Tensor, ...]]:
        """Normalize a batch; torch's kernel also scales by channel, and its top may be overwritten by an activation."""
        data, scale = bottoms[0], following[0] if following else None
        self.fit([tuple(data.shape)])
        exact = self.is_exact(data, self.small)
        if exact or self.use_global_stats or not isinstance(scale, Scale) or not scale.by_channel:
            return 0, self.run(*bottoms)
        top = self._by_batch(data, scale.blob(0), scale.blob(1) if len(scale.blobs) > 1 else None)
        if len(following) > 1 and finishing(following[1]) == RELU:
            return 2, (F.relu_(top),)
        return 1, (top,)

    def _by_batch(
        self, data: torch.Tensor, factors: torch.Tensor | None = None, bias: torch.Tensor | None = None
    ) -> torch.Tensor:
        eps, keep = self.param.batch_norm_param.eps, self.param.batch_norm_param.moving_average_fraction
        values = data.numel() // self.channels
        unbiased = 1.0
        if self.is_exact(data, self.small):
            top, mean, variance = BatchNormalization.apply(data.reshape(*data.shape[:2], -1), eps)
            top = top.reshape(data.shape)
            unbiased = values / (values - 1) if values > 1 else 1.0
        else:
            top, mean, variance = _normalize(data, eps, factors, bias)
            if _far_from_zero(mean, variance, eps):
                # A constant taken off each channel changes neither the result nor the gradient, only the rounding.
                top, _, variance = _normalize(data - _along(mean, 1, data), eps, factors, bias)
            if values == 1:
                variance = torch.zeros_like(variance)  # torch's unbiased variance is 0 / 0, Caffe's 0
        with torch.no_grad():
            self.blob(0).mul_(keep).add_(mean)
            self.blob(1).mul_(keep).add_(variance, alpha=unbiased)
            self.blob(2).mul_(keep).add_(1)
        return top

    @property
    @override
    def small(self) -> bool:
        return math.prod(self.bottom_shapes[0][1:]) <= SMALL_ITEM

    fresh = True
    any_layout = True

    def prepare(self, how: Preparation) -> Kernel | None:
        if not self.use_global_stats:
            return None
        eps, axes = self.param.batch_norm_param.eps, (-1, *(1,) * (len(self.bottom_shapes[0]) - 2))
        mean, variance = self.past()
        if self.is_exact(mean, self.small):
            by_channel, deviation = mean.view(axes), libm.sqrt(variance + eps).view(axes)
            return finished(lambda data: (data - by_channel).div_(deviation), how.finish)
        far, by_channel, cudnn = _far_from_zero(mean, variance, eps), mean.view(axes), torch.backends.cudnn.enabled
        mean = torch.zeros_like(mean) if far else mean

        def kernel(data: torch.Tensor) -> torch.Tensor:
            data = data - by_channel if far else data
            return torch.batch_norm(data, None, None, mean, variance, False, 0.0, eps, cudnn)

        return finished(kernel, how.finish)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        eps = self.param.batch_norm_param.eps
        if self.use_global_stats:
            ones, zeros = torch.ones(self.channels), torch.zeros(self.channels)
            constants = [graph.constant(values) for values in (ones, zeros, *self.past())]
            return graph.node("BatchNormalization", *bottoms, *constants, epsilon=eps)
        centered, variance = onnx_centered(graph, bottoms[0], len(self.bottom_shapes[0]))
        return graph.node("Div", centered, graph.node("Sqrt", graph.node("Add", variance, graph.constant(eps))))

    def as_affine(self) -> Affine | None:
        if not self.use_global_stats:
            return None
        weight = blob_in_double(self, 2)
        factor = torch.where(weight == 0, 0, 1 / weight)
        scale = (blob_in_double(self, 1) * factor + self.param.batch_norm_param.eps).rsqrt()
        return scale, -blob_in_double(self, 0) * factor * scale

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        eps = rounded(self.param.batch_norm_param.eps)
        if not self.use_global_stats:
            return code.call("F.batch_norm({x}, None, None, training=True, eps={eps})", x=bottoms[0], eps=eps)
        mean, variance = self.past()
        count = {"num_batches_tracked": torch.zeros((), dtype=torch.long)}
        state = {"running_mean": mean, "running_var": variance, **count}
        norm = torch_batch_norm(code, len(self.bottom_shapes[0]), state, self.channels, eps)
        return code.call("{norm}({x})", norm=norm, x=bottoms[0])


def torch_batch_norm(code: TorchCode, axes: int, state: dict[str, torch.Tensor], channels: int, eps: float) -> str:
    """Add torch's batch normalization by the past for so many axes, scaling where ``state`` has a weight."""
    options = ("" if eps == 1e-5 else ", eps={eps}") + ("" if "weight" in state else ", affine=False")
    template = f"nn.BatchNorm{max(1, axes - 2)}d({{channels}}{options})"
    numbers = {"channels": channels, **({} if eps == 1e-5 else {"eps": eps})}
    return code.module(template, state, **numbers)


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


def onnx_centered(graph: OnnxGraph, data: str, axes: int) -> tuple[str, str]:
    """Write a batch of so many axes less the mean of each channel, and its biased variance."""
    centered = graph.node("Sub", data, _onnx_channel_means(graph, data, axes))
    return centered, _onnx_channel_means(graph, graph.node("Mul", centered, centered), axes)


def _onnx_channel_means(graph: OnnxGraph, data: str, axes: int) -> str:
    # One after the other: OpenCV 5.0 gets means over axes that do not lie side by side wrong.
    for part in ([0], list(range(2, axes))):
        data = graph.node("ReduceMean", data, graph.constant(part), keepdims=1) if part else data
    return data


def _normalize(
    data: torch.Tensor, eps: float, factors: torch.Tensor | None, bias: torch.Tensor | None
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the normalized batch, times factors, plus a bias, its mean and its unbiased variance, by torch's kernel.

    The statistics come out exact as that kernel's running ones, all weight on the present batch.
    """
    exact_enough = torch.promote_types(data.dtype, torch.float32)
    mean, variance = data.new_zeros(2, data.shape[1], dtype=exact_enough).unbind()
    top = torch.batch_norm(data, factors, bias, mean, variance, True, 1.0, eps, torch.backends.cudnn.enabled)
    return top, mean, variance


def _far_from_zero(mean: torch.Tensor, variance: torch.Tensor, eps: float) -> bool:
    """Whether torch's kernel would lose digits: on a CPU it computes x / std - mean / std, not (x - mean) / std.

    What torch.compile makes of it subtracts the mean first.
    """
    return (
        mean.device.type == "cpu"
        and not torch.compiler.is_compiling()
        and bool((mean.square() > MAX_OFFSET**2 * (variance + eps)).any())
    )


def _along(values: torch.Tensor, axis: int, data: torch.Tensor) -> torch.Tensor:
    """Return ``values`` shaped to meet the axes of ``data`` from ``axis`` on."""
    return values.reshape(*values.shape, *(1,) * (data.dim() - axis - values.dim()))


class _Affine(Layer):
    """What Scale and Bias have in common: an operand that is learned or a second bottom, laid over some axes."""

    bottoms = (1, 2)
    traceable = True

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
        tops = ChannelProducts.apply(values, factors, bias, self.context.options.accumulate_in_place)
        return tops.reshape(data.shape)

    def onnx_operand(self, graph: OnnxGraph, bottoms: Sequence[str], blob: int, axis: int) -> str:
        """Return the second bottom, or else a learned blob, laid over the first bottom's axes from ``axis`` on."""
        axes = len(self.bottom_shapes[0]) - axis
        if len(bottoms) == 1:
            shape = self.blob_shapes[blob]
            return graph.blob(blob, (*shape, *(1,) * (axes - len(shape))))
        given = len(self.bottom_shapes[1])
        if given == axes:
            return bottoms[1]
        return graph.node("Unsqueeze", bottoms[1], graph.constant(list(range(given, axes))))

    def torch_operand(self, code: TorchCode, bottoms: Sequence[str], blob: int, axis: int) -> str:
        """Return the expression of the second bottom, or else of a learned blob, laid over axes from ``axis`` on."""
        axes = len(self.bottom_shapes[0]) - axis
        if len(bottoms) == 1:
            shape = self.blob_shapes[blob]
            name = "" if len(self.blobs) == 1 else ("scale", "bias")[blob]
            return code.parameter(blob, (*shape, *(1,) * (axes - len(shape))), name)
        missing = axes - len(self.bottom_shapes[1])
        return code.call(f"{{x}}[..., {', '.join(['None'] * missing)}]", x=bottoms[1]) if missing else bottoms[1]


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

    @override
    def setup(self) -> None:
        param = self.param.scale_param
        shape = self.bottom_shapes[1] if len(self.bottom_shapes) > 1 else self.learned_shape(param, "scale_param")
        if len(self.bottom_shapes) == 1:
            self.add_blob(shape, param.filler if param.HasField("filler") else None, value=1.0)
        if param.bias_term:
            self.add_blob(shape, param.bias_filler)

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.axis = self.locate(bottom_shapes, self.param.scale_param, "scale_param")
        return [bottom_shapes[0]]

    @override
    def forward(self, data: torch.Tensor, factors: torch.Tensor | None = None) -> torch.Tensor:
        scale = self.blob(0) if factors is None else factors
        bias = self.blob(len(self.blobs) - 1) if self.param.scale_param.bias_term else None
        by_channel = self.axis == 1 and scale.dim() == 1
        if self.is_exact(data, self.small):
            return self.apply_exactly(data, scale, bias, self.axis)
        if by_channel:
            # By channel: batch normalization with mean 0 and variance 1 is this, three times as fast, backward too.
            zero, one = torch.zeros_like(scale), torch.ones_like(scale)
            return torch.batch_norm(data, scale, bias, zero, one, False, 0.0, 0.0, torch.backends.cudnn.enabled)
        top = data * _along(scale, self.axis, data)
        return top if bias is None else top + _along(bias, self.axis, data)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        top = graph.node("Mul", bottoms[0], self.onnx_operand(graph, bottoms, 0, self.axis))
        if not self.param.scale_param.bias_term:
            return top
        return graph.node("Add", top, self.onnx_operand(graph, bottoms[:1], len(self.blobs) - 1, self.axis))

    @property
    @override
    def small(self) -> bool:
        shape, axes = self.bottom_shapes[0], len((*self.bottom_shapes[1:], *self.blob_shapes)[0])
        return self.axis == 1 and axes == 1 and math.prod(shape[1:]) <= SMALL_ITEM

    fresh = True
    any_layout = True

    def prepare(self, how: Preparation) -> Kernel | None:
        if not self.by_channel:
            return None
        scale, bias = self.blob(0), self.blob(1) if len(self.blobs) > 1 else None
        axes = (-1, *(1,) * (len(self.bottom_shapes[0]) - 2))
        if self.is_exact(scale, self.small):
            factors, shift = (
                values_of(scale).clone().view(axes),
                None if bias is None else values_of(bias).clone().view(axes),
            )
            if shift is None:
                return finished(lambda data: data * factors, how.finish)
            return finished(lambda data: (data * factors).add_(shift), how.finish)
        zero, one, cudnn = torch.zeros_like(scale), torch.ones_like(scale), torch.backends.cudnn.enabled
        kernel = lambda data: torch.batch_norm(data, scale, bias, zero, one, False, 0.0, 0.0, cudnn)  # noqa: E731
        return finished(kernel, how.finish)

    @property
    def by_channel(self) -> bool:
        """Whether it multiplies each channel by a learned factor."""
        return len(self.bottom_shapes) == 1 and self.axis == 1 and len(self.blob_shapes[0]) == 1

    def as_affine(self) -> Affine | None:
        if not self.by_channel:
            return None
        scale = blob_in_double(self, 0)
        return scale, blob_in_double(self, 1) if len(self.blobs) > 1 else torch.zeros_like(scale)

    @property
    def absorbs_before(self) -> bool:
        return self.by_channel

    def absorb_before(self, scale: torch.Tensor, shift: torch.Tensor) -> Absorbed:
        own = self.as_affine()
        assert own is not None
        param = copy_of(self.param)
        param.scale_param.bias_term = True
        factor, offset = (values.to(scale) for values in own)
        return Absorbed(param, (factor * scale, factor * shift + offset))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if self.by_channel:
            scale = self.blob(0)
            if code.affine(bottoms[0], scale, self.blob(1) if len(self.blobs) > 1 else torch.zeros_like(scale)):
                return bottoms[0]
        top = code.call("{x} * {y}", x=bottoms[0], y=self.torch_operand(code, bottoms, 0, self.axis))
        if not self.param.scale_param.bias_term:
            return top
        return code.call("{x} + {y}", x=top, y=self.torch_operand(code, bottoms[:1], len(self.blobs) - 1, self.axis))


@register("Bias", "bias_param")
class Bias(_Affine):
    """Add a learned bias, or a second bottom.

    bottom[0]  any shape
    bottom[1]  optional, the bias: bottom[0]'s shape from ``axis`` on, as many axes as it has
    top[0]     bottom[0]'s shape
    blobs[0]   bias, bottom[0]'s shape from ``axis`` for ``num_axes``       unless bottom[1] is given
    Caffe: src/caffe/layers/bias_layer.cpp
    """

    @override
    def setup(self) -> None:
        param = self.param.bias_param
        if len(self.bottom_shapes) == 1:
            self.add_blob(self.learned_shape(param, "bias_param"), param.filler)

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.axis = self.locate(bottom_shapes, self.param.bias_param, "bias_param")
        return [bottom_shapes[0]]

    @override
    def forward(self, data: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
        operand = self.blob(0) if bias is None else bias
        if self.is_exact(data):
            return self.apply_exactly(data, None, operand, self.axis)
        return data + _along(operand, self.axis, data)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Add", bottoms[0], self.onnx_operand(graph, bottoms, 0, self.axis))

    def as_affine(self) -> Affine | None:
        if len(self.bottom_shapes) > 1 or self.axis != 1 or len(self.blob_shapes[0]) != 1:
            return None
        shift = blob_in_double(self, 0)
        return torch.ones_like(shift), shift

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.call("{x} + {y}", x=bottoms[0], y=self.torch_operand(code, bottoms, 0, self.axis))


@register("LRN", "lrn_param")
class LRN(Layer):
    """Divide each value by a power of the squares around it: (k + alpha times their mean) ** beta.

    The n = ``local_size`` neighbors are channels (ACROSS_CHANNELS), or n x n pixels (WITHIN_CHANNEL, where k is
    ignored: it is 1); those outside count as zeros.

    bottom[0]  (N, C, H, W)
    top[0]     the same shape
    Caffe: src/caffe/layers/lrn_layer.cpp
    """

    traceable = True

    @override
    def setup(self) -> None:
        if self.param.lrn_param.local_size % 2 == 0:
            message = f"local_size must be odd, found {self.param.lrn_param.local_size}"
            raise self.error(message, "lrn_param", "local_size")
        if self.param.lrn_param.local_size > MOST:
            message = f"local_size must be at most {MOST}, found {self.param.lrn_param.local_size}"
            raise self.error(message, "lrn_param", "local_size")
        if self.param.lrn_param.norm_region != ACROSS_CHANNELS:
            self.ignores = frozenset({"lrn_param.k"})

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if len(bottom_shapes[0]) != 4:
            raise self.error(f"LRN needs a bottom of 4 axes (N, C, H, W), found shape {bottom_shapes[0]}", "bottom")
        return bottom_shapes

    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
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

    fresh = True
    any_layout = True

    def prepare(self, how: Preparation) -> Kernel | None:
        param, shape = self.param.lrn_param, self.bottom_shapes[0]
        if param.norm_region != ACROSS_CHANNELS or self.context.options.exact == ALL:
            return None
        size, channels, reach = param.local_size, shape[1], param.local_size // 2
        frames: dict[bool, torch.Tensor] = {}

        def kernel(data: torch.Tensor) -> torch.Tensor:
            side_by_side = not data.is_contiguous()
            if side_by_side not in frames:
                layout = torch.channels_last if side_by_side else torch.contiguous_format
                with torch.inference_mode(False):
                    frame = data.new_zeros(shape[0], channels + 2 * reach, *shape[2:])
                    frames[side_by_side] = frame.contiguous(memory_format=layout)
            frame = frames[side_by_side]
            torch.mul(data, data, out=frame[:, reach : reach + channels])
            total = frame[:, :channels] + frame[:, 1 : 1 + channels] if size > 1 else frame.clone()
            for shift in range(2, size):
                total += frame[:, shift : shift + channels]
            base = total.mul_(param.alpha / size).add_(param.k)
            if param.beta == 0.75:
                root = base.rsqrt_()  # x ** -0.75 = r sqrt(r), for r = 1 / sqrt(x), five times as fast as a power
                return root.mul_(root.sqrt()).mul_(data)
            return base.pow_(-param.beta).mul_(data)

        return finished(kernel, how.finish)

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

    A map is one channel of one image, or with ``across_channels`` all of an image.

    bottom[0]  (N, C, H, W); up to four axes
    top[0]     (N, C, H, W); always four axes, missing ones are 1
    Caffe: src/caffe/layers/mvn_layer.cpp
    """

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shape = bottom_shapes[0]
        if len(shape) > 4:
            raise self.error(f"MVN takes up to 4 axes (N, C, H, W), found shape {shape}", "bottom")
        return [(*shape, *(1,) * (4 - len(shape)))]

    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
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

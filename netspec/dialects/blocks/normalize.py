"""Normalize, which computes different things in the forks SSD, TSN and happynear's Caffe."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from netspec.layers import Layer
from netspec.layers.contract.base import Shape
from netspec.proto.schema import given_fields, value

SSD, TSN, HAPPYNEAR = "ssd", "tsn", "happynear"
HAPPYNEARS_EPS = 1e-6  # added to the sum


class _Normalized(torch.autograd.Function):
    """Normalize's formula. Its gradient is the fork's, not the derivative: the sum omits the scales.

    dx = scale / length (dy - x sum(x dy) / length^2), while the derivative has sum(scale x dy). With one scale for all
    channels, the difference is only the position of the scale. Every SSD300 was trained with it.
    Fork: src/caffe/layers/normalize_layer.cpp, Backward_cpu
    """

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, scale: torch.Tensor, axes: tuple[int, ...], eps: float) -> torch.Tensor:
        length = (x.square().sum(axes, keepdim=True) + eps).sqrt()
        ctx.save_for_backward(x, scale, length)
        ctx.axes = axes
        return x / length * scale

    @staticmethod
    def backward(ctx: Any, dy: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        x, scale, length = ctx.saved_tensors
        share = (x * dy).sum(ctx.axes, keepdim=True) / length.square()
        dx = (dy - x * share) / length * scale if ctx.needs_input_grad[0] else None
        dscale = (x / length * dy).sum_to_size(scale.shape) if ctx.needs_input_grad[1] else None
        return dx, dscale, None, None


class Normalize(Layer):
    """Divide by the length over the channels of each pixel, or over the whole image.

    SSD's (norm_param): y = scale x / sqrt(sum of squares + eps), over the whole image unless across_spatial is false;
    the scales are learnable. TSN's has no scale and no eps, and is over the whole image. happynear's (normalize_param,
    or a second top) has no scale and is over the channels; with normalize_type: "L1" it divides by the sum of absolute
    values. The gradient of its second top is used only with bp_norm.

    bottom[0]  (N, C, ...)
    top[0]     the same shape
    top[1]     optional, happynear's: the lengths (N, 1, H, W)
    blobs[0]   scales (), or (C,) if channel_shared is false; 1 unless scale_filler is given           SSD's only
    Fork: weiliu89/caffe (ssd), yjxiong/caffe and happynear/caffe-windows, src/caffe/layers/normalize_layer.cpp
    """

    tops = (1, 2)

    def setup(self) -> None:
        fields, shape = given_fields(self.param), self.bottom_shapes[0]
        if len(shape) < 2:
            raise self.error(f"found a bottom of shape {shape}, expected at least 2 axes (N, C, ...)", "bottom")
        self.fork = self.context.fork or SSD
        self.across, self.eps, self.squares = self.fork == TSN, 0.0, True
        if self.fork == HAPPYNEAR:
            self._set_up_as_happynears(value(self.param, "normalize_param") if "normalize_param" in fields else None)
        elif self.fork == SSD:
            param = value(self.param, "norm_param")
            self.across, self.eps = param.across_spatial, param.eps
            filler = param.scale_filler if param.HasField("scale_filler") else None
            self.add_blob(() if param.channel_shared else shape[1:2], filler, value=1.0)

    def _set_up_as_happynears(self, param: Any) -> None:
        kind = param.normalize_type if param else "L2"
        if kind not in ("L1", "L2"):
            raise self.error(f'found "{kind}", expected "L1" or "L2"', "normalize_param", "normalize_type")
        if param and param.fix_gradient:
            message = "the gradient of fix_gradient is not here; without it, it is the derivative"
            raise self.error(message, "normalize_param", "fix_gradient")
        self.eps, self.squares, self.passes_length = HAPPYNEARS_EPS, kind == "L2", bool(param and param.bp_norm)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shapes of the bottom and of the lengths; there must be one scale per channel."""
        shape = bottom_shapes[0]
        if self.blobs and self.blob_shapes[0] not in ((), shape[1:2]):
            raise self.error(f"bottom of shape {shape} does not have the {self.blob_shapes[0][0]} channels", "bottom")
        lengths = (shape[0], 1, *shape[2:])
        lengths = (*lengths, *(1,) * (4 - len(lengths)))  # at least 4 axes
        return [shape, lengths][: self.num_tops]

    def forward(self, data: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        axes = tuple(range(1, data.dim())) if self.across else (1,)
        if self.fork == SSD:
            scale = self.blob(0)
            scale = scale if scale.dim() == 0 else scale.reshape(-1, *(1,) * (data.dim() - 2))
            return _Normalized.apply(data, scale, axes, self.eps)
        size = length(data, axes, self.eps, self.squares)
        if self.num_tops == 1:
            return data / size
        lengths = size if self.passes_length else size.detach()
        return data / size, lengths.reshape(self.top_shapes[1])


def length(x, axes, eps, squares):
    """Return the length over some axes, or the sum of absolute values."""
    return (x.square().sum(axes, keepdim=True) + eps).sqrt() if squares else x.abs().sum(axes, keepdim=True) + eps

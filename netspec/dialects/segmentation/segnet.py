"""Layers of segmentation nets: PSPNet's and SegNet's BN, SegNet's Upsample."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F

from netspec.dialects.gradients import with_gradient_of
from netspec.dialects.not_learned import NotLearned
from netspec.layers import Layer
from netspec.layers.contract.base import Shape
from netspec.layers.normalization import as_before
from netspec.proto.schema import TRAIN, given_fields, value

INFERENCE = 1  # BNParameter.BNMode
SEGNET_EPS = 1e-9  # added to the variance by SegNet's BN


class Upsample(Layer):
    """Enlarge maps: by a pooling mask, which gives the pixel of each value (SegNet), or by repeating pixels (YOLO).

    With a mask, the new size is upsample_h and upsample_w, or ``scale`` times the map's (scale_h and scale_w, default
    2), minus 1 with pad_out_h and pad_out_w. If several values have the same pixel, the last one wins, but all of them
    get the gradient of the pixel.

    bottom[0]  (N, C, H, W)
    bottom[1]  optional: the mask, a Pooling layer's second top, of the same shape; gets no gradient
    top[0]     (N, C, H', W'); without a mask, H' = scale H (default 1)
    Fork: alexgkendall/caffe-segnet and eric612/MobileNet-YOLO, src/caffe/layers/upsample_layer.cpp
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({1})

    def setup(self) -> None:
        param = value(self.param, "upsample_param")
        fields = given_fields(param)
        masked = len(self.bottom_shapes) == 2
        if not masked and fields - {"scale"}:
            extra = min(fields - {"scale"})
            raise self.error("without a mask as second bottom only scale can be set", "upsample_param", extra)
        for pair in ("upsample_h", "upsample_w"), ("scale_h", "scale_w"):
            alone = [name for name in pair if name in fields]
            if len(alone) == 1:
                raise self.error(f"found {alone[0]} alone, expected {' and '.join(pair)}", "upsample_param", alone[0])
        scale = param.scale if "scale" in fields else 2 if masked else 1
        self.scale_h, self.scale_w = (param.scale_h, param.scale_w) if "scale_h" in fields else (scale, scale)
        for name, along in (("pad_out_h", self.scale_h), ("pad_out_w", self.scale_w)):
            if getattr(param, name) and along != 2:
                raise self.error(f"{name} needs a scale of 2, found {along}", "upsample_param", name)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        param, shape = value(self.param, "upsample_param"), bottom_shapes[0]
        if len(shape) != 4 or any(other != shape for other in bottom_shapes):
            message = f"found bottoms of shapes {bottom_shapes}, expected (N, C, H, W), and the mask's the same"
            raise self.error(message, "bottom")
        size = (param.upsample_h, param.upsample_w)
        if not param.HasField("upsample_h"):
            size = (shape[2] * self.scale_h - param.pad_out_h, shape[3] * self.scale_w - param.pad_out_w)
        if min(size) < 1:
            raise self.error(f"the top would have no pixel, {size[0]} x {size[1]}", "upsample_param")
        return [(*shape[:2], *size)]

    def forward(self, data: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Return the enlarged maps; raise SpecError for a mask of another size."""
        if mask is None:
            return F.interpolate(data, self.top_shapes[0][2:], mode="nearest")
        height, width = self.top_shapes[0][2:]
        index = mask.detach().long()
        if index.numel() and not 0 <= int(index.amin()) <= int(index.amax()) < height * width:
            message = f"the mask names pixel {int(index.amax())}, the top has {height} x {width}; check the scale"
            raise self.error(message, "bottom", 1)
        values, index = data.flatten(2), index.flatten(2)
        order = torch.arange(index.shape[2], device=index.device).expand_as(index)
        empty = (*index.shape[:2], height * width)
        last = torch.full(empty, -1, device=index.device).scatter_reduce(2, index, order, "amax")
        top = values.gather(2, last.clamp(min=0)).where(last >= 0, 0)
        top = with_gradient_of(lambda: values.new_zeros(empty).scatter_add(2, index, values), top)
        return top.reshape(self.top_shapes[0])


class BN(NotLearned):
    """Batch normalization with a learnable slope and bias, as in PSPNet, or as in SegNet if its fields are given.

    PSPNet's subtracts the batch's mean and divides by sqrt(variance + eps) in training, and uses moving averages in
    testing or if ``frozen``; these move by 1 - momentum toward the batch's mean and biased variance. SegNet's
    (scale_filler, shift_filler, bn_mode) uses the batch in both phases. With bn_mode INFERENCE, for which its
    weights were changed, it has only slope and bias.

    bottom[0]  (N, C, H, W); up to four axes
    top[0]     the same shape
    top[1]     optional, SegNet's only: the batch's mean (1, C, 1, 1); the gradients of top[1] and top[2] are ignored
    top[2]     optional, SegNet's only: the batch's biased variance (1, C, 1, 1)
    blobs[0]   slopes (1, C, 1, 1), 0 unless a filler is given
    blobs[1]   biases (1, C, 1, 1)
    blobs[2]   moving mean     (1, C, 1, 1)                            PSPNet's only; not learned
    blobs[3]   moving variance (1, C, 1, 1), or 1 / std in happynear's    PSPNet's only; not learned
    Fork: hszhao/PSPNet, happynear/caffe-windows and alexgkendall/caffe-segnet, src/caffe/layers/bn_layer.cpp
    """

    tops = (1, 3)

    def setup(self) -> None:
        param, shape = value(self.param, "bn_param"), self.bottom_shapes[0]
        if not 2 <= len(shape) <= 4:
            raise self.error(f"found a bottom of shape {shape}, expected (N, C, H, W), 2 to 4 axes", "bottom")
        fields = given_fields(param) - {"engine"}
        segnets = fields & {"scale_filler", "shift_filler", "bn_mode"}
        if segnets and fields - segnets:
            other = min(fields - segnets)
            raise self.error(
                f"{other} is PSPNet's and {min(segnets)} is SegNet's; use one kind only", "bn_param", other
            )
        fork = self.context.fork
        segnet = fork == "segmentation" and not fields - segnets
        self.channels = shape[1]
        size = (1, self.channels, 1, 1)
        self.add_blob(size, param.scale_filler if segnet else param.slope_filler)
        self.add_blob(size, param.shift_filler if segnet else param.bias_filler)
        self.by_batch = param.bn_mode != INFERENCE if segnet else self.phase == TRAIN and not param.frozen
        self.moving = not segnet
        if self.num_tops > 1 and not (segnet and self.by_batch):
            raise self.error(f"found {self.num_tops} tops, expected 1: only SegNet's BN shows a batch's mean", "top", 1)
        self.eps: float = SEGNET_EPS if segnet else param.eps
        self.inverse = fork == "happynear"  # blobs[3] is 1 / std
        if self.moving:
            self.add_blob(size)
            self.add_blob(size, value=float(param.frozen or self.inverse))
            self.not_learned = frozenset(range(4) if param.frozen else (2, 3))

    def takes_stored(self, index: int, shape: Shape) -> bool:
        """Compare shapes without axes of size 1: TSN's and happynear's files have (1, C)."""
        return [n for n in shape if n != 1] == [n for n in self.blob_shapes[index] if n != 1]

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shown = [(1, self.channels, 1, 1)] * (self.num_tops - 1)
        return [*as_before(self, bottom_shapes, self.channels), *shown]

    def forward(self, data: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        """Return the normalized values and the other tops; in training, also update the averages."""
        slope, bias = (self.blob(i).reshape(-1, *(1,) * (data.dim() - 2)) for i in (0, 1))
        if not self.by_batch and not self.moving:
            return data * slope + bias
        if self.by_batch:
            axes = (0, *range(2, data.dim()))
            variance, mean = torch.var_mean(data, axes, correction=0, keepdim=True)
            if self.moving:
                self._move(mean, variance)
        else:
            mean, variance = (self.blob(i).detach().reshape_as(slope) for i in (2, 3))
            if self.inverse:
                return (data - mean) * variance * slope + bias
        top = (data - mean) / (variance + self.eps).sqrt() * slope + bias
        shown = [each.detach().reshape(1, -1, 1, 1) for each in (mean, variance)]
        return top if self.num_tops == 1 else (top, *shown[: self.num_tops - 1])

    def _move(self, mean: torch.Tensor, variance: torch.Tensor) -> None:
        momentum = value(self.param, "bn_param").momentum
        with torch.no_grad():
            for i, batch in ((2, mean), (3, (variance + self.eps).rsqrt() if self.inverse else variance)):
                self.blob(i).mul_(momentum).add_(batch.reshape(self.blob_shapes[i]), alpha=1 - momentum)

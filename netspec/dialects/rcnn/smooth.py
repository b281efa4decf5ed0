"""The smooth L1 loss of boxes, in the versions of several forks: Fast R-CNN, SSD, R-FCN."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.dialects.gradients import with_gradient_of
from netspec.dialects.registry import added_value
from netspec.layers import Layer
from netspec.layers.contract.base import Shape
from netspec.layers.loss.base import VALID, Loss, normalization_mode, normalizer
from netspec.proto.schema import value

NORMALIZED = ("loss_param", "loss_param.normalization", "loss_param.pre_fixed_normalizer")


def four(shape: Shape) -> Shape:
    """Return a shape with trailing ones, up to four axes."""
    return (*shape, 1, 1, 1)[: max(4, len(shape))]


def divisor(layer: Layer, items: int, each: int, valid: torch.Tensor | None) -> torch.Tensor | float:
    """Return the divisor of the losses of ``items`` times ``each`` predictions, at least 1."""
    param = layer.param.loss_param
    if added_value(param, "normalization") == "PRE_FIXED":
        return max(1.0, value(param, "pre_fixed_normalizer"))
    return normalizer(normalization_mode(param, VALID), items, each, valid)


class SmoothL1Loss(Loss):
    """Sum of outside weight x smooth(inside weight x (prediction - target)), divided by the number of items N.

    smooth(d) = 0.5 (sigma d)^2 if |d| < 1 / sigma^2, else |d| - 0.5 / sigma^2. Without loss_weight, it is a loss only
    in SSD. R-FCN's (with loss_param or a second top) has no outside weights, is divided by N H W or according to
    loss_param, and its gradient omits the weights.

    bottom[0]  predictions (N, ...)
    bottom[1]  targets, the same shape
    bottom[2]  optional: inside weights, the same shape; gets no gradient
    bottom[3]  optional: outside weights, the same shape; gets no gradient
    top[0]     the loss, ()
    top[1]     optional, R-FCN's: the loss of each region (N, 1, H, W); its gradient is ignored
    Fork: rbgirshick/caffe-fast-rcnn, src/caffe/layers/smooth_L1_loss_layer.cu; daijifeng001/caffe-rfcn; weiliu89/caffe
    """

    bottoms, tops = (2, 4), (1, 2)
    label_bottoms = frozenset({2, 3})

    def setup(self) -> None:
        self.fork = self.found_fork()
        self.by_pixel = self.fork == "rfcn"
        if self.by_pixel and len(self.bottom_shapes) > 3:
            raise self.error(
                "found outside weights, which R-FCN's loss (loss_param, a second top) has not", "bottom", 3
            )
        sigma = 1.0 if self.by_pixel else value(self.param, "smooth_l1_loss_param").sigma
        if not sigma > 0:
            raise self.error(f"sigma must be above 0, found {sigma:g}", "smooth_l1_loss_param", "sigma")
        self.knee = 1 / (sigma * sigma)

    def found_fork(self) -> str:
        """The dialect that defines this layer."""
        return self.context.fork

    @property
    @override
    def default_loss_weight(self) -> float:
        return float(self.fork in ("ssd", "yolo"))

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shapes of the tops; the bottoms must have the same shape, except for trailing ones."""
        full = [four(shape) for shape in bottom_shapes]
        for i, shape in enumerate(full):
            if shape != full[0]:
                message = f"found bottoms of shapes {bottom_shapes[0]} and {bottom_shapes[i]}, expected equal shapes"
                raise self.error(message, "bottom", i)
        return [(), (full[0][0], 1, *full[0][2:])][: self.num_tops]

    def forward(
        self, predictions: torch.Tensor, targets: torch.Tensor, *weights: torch.Tensor
    ) -> torch.Tensor | tuple[torch.Tensor, ...]:
        inside, outside = (*(weight.detach().reshape_as(predictions) for weight in weights), None, None)[:2]
        difference = predictions - targets.reshape_as(predictions)
        weighted = difference if inside is None else difference * inside
        if self.by_pixel:
            weighted = with_gradient_of(lambda: difference, weighted)
        losses = F.smooth_l1_loss(weighted, torch.zeros_like(weighted), reduction="none", beta=self.knee)
        if not self.by_pixel:
            return (losses if outside is None else losses * outside).sum() / len(predictions)
        items, channels, *pixels = four(tuple(losses.shape))
        loss = losses.sum() / divisor(self, items, math.prod(pixels), None)
        each = losses.detach().reshape(items, channels, *pixels).sum(1, keepdim=True)
        return (loss, each) if self.num_tops > 1 else loss


class SmoothL1LossOHEM(SmoothL1Loss):
    """R-FCN's SmoothL1Loss, with the name in Microsoft's and Intel's forks: the sum, and the sum of each region.

    With normalization: PRE_FIXED, the sum is divided by pre_fixed_normalizer.

    bottom[0]  predictions (N, C) or (N, C, H, W)
    bottom[1]  targets, the same shape
    bottom[2]  optional: weights, the same shape; gets no gradient, and the gradient omits them
    top[0]     the loss, ()
    top[1]     optional: the loss of each region (N, 1, H, W); its gradient is ignored
    Fork: intel/caffe, src/caffe/layers/smooth_L1_loss_ohem_layer.cpp
    """

    bottoms = (2, 3)
    label_bottoms = frozenset({2})
    not_exported = "it is for training"

    @override
    def found_fork(self) -> str:
        return "rfcn"

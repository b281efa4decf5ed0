"""The smooth L1 loss of boxes, in the versions of several forks: Fast R-CNN, SSD, R-FCN."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.dialects.signatures import fork_of
from netspec.layers import Layer
from netspec.layers.contract.base import Shape
from netspec.layers.contract.exporting import refusal
from netspec.layers.contract.targets import OnnxGraph, TorchCode, rounded
from netspec.layers.loss.base import BATCH_SIZE, VALID, Loss, normalization_mode, normalizer, onnx_normalized_sum
from netspec.proto.schema import added_value, value

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


class _Weighted(torch.autograd.Function):
    """weight x, with a gradient that omits the weight, as in R-FCN (whose weights are 0 and 1)."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, weight: torch.Tensor) -> torch.Tensor:
        return x * weight

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None]:
        return grads[0], None


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
        if sigma <= 0:
            raise self.error(f"sigma must be above 0, found {sigma:g}", "smooth_l1_loss_param", "sigma")
        self.knee = 1 / (sigma * sigma)

    def found_fork(self) -> str:
        """The dialect that defines this layer."""
        return fork_of(self)

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
        if inside is not None:
            difference = _Weighted.apply(difference, inside) if self.by_pixel else difference * inside
        losses = F.smooth_l1_loss(difference, torch.zeros_like(difference), reduction="none", beta=self.knee)
        if not self.by_pixel:
            return (losses if outside is None else losses * outside).sum() / len(predictions)
        items, _, *pixels = four(tuple(losses.shape))
        loss = losses.sum() / divisor(self, items, math.prod(pixels), None)
        each = losses.detach().reshape(items, losses.shape[1], *pixels).sum(1, keepdim=True)
        return (loss, each) if self.num_tops > 1 else loss

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        if self.by_pixel:
            raise refusal(self, "ONNX", "R-FCN's loss is for training")
        predictions, *others = bottoms
        shape = graph.shape_of(predictions)
        aligned = [
            bottom if self.bottom_shapes[i] == self.bottom_shapes[0] else graph.node("Reshape", bottom, shape)
            for i, bottom in enumerate(others, 1)
        ]
        difference = graph.node("Sub", predictions, aligned[0])
        if len(aligned) > 1:
            difference = graph.node("Mul", difference, aligned[1])
        length = graph.node("Abs", difference)
        knee = graph.constant(self.knee)
        square = graph.node("Mul", graph.node("Mul", difference, difference), graph.constant(0.5 / self.knee))
        linear = graph.node("Sub", length, graph.constant(0.5 * self.knee))
        losses = graph.node("Where", graph.node("Less", length, knee), square, linear)
        if len(aligned) > 2:
            losses = graph.node("Mul", losses, aligned[2])
        return onnx_normalized_sum(graph, losses, "", BATCH_SIZE)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if len(set(self.bottom_shapes)) > 1 or self.by_pixel:
            raise refusal(self, "PyTorch", "it is exported for bottoms of one shape, and not as R-FCN's")
        knee = rounded(self.knee)
        if len(bottoms) == 2:
            template = 'F.smooth_l1_loss({x}, {y}, beta={knee}, reduction="sum") / {x}.shape[0]'
            return code.call(template, x=bottoms[0], y=bottoms[1], knee=knee)
        template = f"{code.function(weighted_smooth_l1_loss)}({', '.join(bottoms)}, beta={{knee}})"
        return code.call(template, knee=knee)


def weighted_smooth_l1_loss(predictions, targets, inside, outside=1.0, beta=1.0):
    """Return the weighted sum of the smooth L1 losses of weighted differences, divided by N."""
    x, y = inside * predictions, inside * targets
    losses = F.smooth_l1_loss(x, y, beta=beta, reduction="none")
    return (outside * losses).sum() / predictions.shape[0]


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

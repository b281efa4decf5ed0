"""Losses of margins and distances: HingeLoss, SigmoidCrossEntropyLoss, EuclideanLoss, ContrastiveLoss."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F

from netspec.exact import libm
from netspec.exact.pointwise import pointwise
from netspec.layers.contract.base import Shape
from netspec.layers.contract.registry import register
from netspec.layers.loss.base import (
    BATCH_SIZE,
    ClassLoss,
    Loss,
    ignore_label,
    normalization_mode,
    normalizer,
)


@register("HingeLoss", "hinge_loss_param")
class HingeLoss(ClassLoss):
    """One-vs-all hinge loss: the sum of max(0, 1 - s x) / N, where s is 1 at the label and -1 elsewhere.

    With norm L2, each term is squared, without a factor 1/2.

    bottom[0]  scores (N, C, ...): all but the first axis are the classes
    bottom[1]  labels, N of them
    top[0]     the loss, ()
    Caffe: src/caffe/layers/hinge_loss_layer.cpp
    """

    L2 = 2  # caffe.proto: enum HingeLossParameter.Norm

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        x, label = self.scores_and_labels(scores, labels)
        self.valid(label, None)
        sign = torch.ones_like(x).scatter(1, label.unsqueeze(1), -1)
        margins = F.relu(1 + sign * x)
        arithmetic = self.arithmetic(margins)
        squared = self.param.hinge_loss_param.norm == self.L2
        return (arithmetic.sums_of_squares if squared else arithmetic.sums_of_magnitudes)(margins) / self.outer


@register("SigmoidCrossEntropyLoss", "loss_param", "sigmoid_param")
class SigmoidCrossEntropyLoss(Loss):
    """Cross entropy of sigmoid(x) and targets with any values, summed and normalized (default BATCH_SIZE).

    bottom[0]  x (N, ...)
    bottom[1]  targets, as many; those whose integer part is loss_param.ignore_label are ignored
    top[0]     the loss, ()
    Caffe: src/caffe/layers/sigmoid_cross_entropy_loss_layer.cpp
    """

    def setup(self) -> None:
        self.ignore_label = ignore_label(self.param.loss_param)
        self.normalization = normalization_mode(self.param.loss_param, BATCH_SIZE)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shapes = super().reshape(bottom_shapes)
        data, target = bottom_shapes
        if math.prod(data) != math.prod(target):
            raise self.error(f"found bottoms of shapes {data} and {target}, expected the same count", "bottom")
        return shapes

    def forward(self, x: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        targets = targets.detach().reshape(x.shape)
        valid = None if self.ignore_label is None else targets.long() != self.ignore_label
        arithmetic = self.arithmetic(x)
        losses = arithmetic.sigmoid_cross_entropy(x, targets)
        if valid is not None:
            losses = losses.where(valid, 0)
        return arithmetic.total(losses) / normalizer(self.normalization, x.shape[0], math.prod(x.shape[1:]), valid)


@register("EuclideanLoss")
class EuclideanLoss(Loss):
    """The sum of (a - b)^2 / (2 N).

    bottom[0]  a (N, ...)
    bottom[1]  b, as many values per item; also gets a gradient
    top[0]     the loss, ()
    Caffe: src/caffe/layers/euclidean_loss_layer.cpp
    """

    label_bottoms = frozenset()

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shapes = super().reshape(bottom_shapes)
        a, b = bottom_shapes
        if math.prod(a[1:]) != math.prod(b[1:]):
            raise self.error(f"found bottoms of shapes {a} and {b}, expected as many values per item", "bottom")
        return shapes

    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        difference = a - b.reshape(a.shape)
        return self.arithmetic(difference).sums_of_squares(difference) / (2 * a.shape[0])


@register("ContrastiveLoss", "contrastive_loss_param")
class ContrastiveLoss(Loss):
    """The sum of d^2 over similar pairs and of max(margin - d, 0)^2 over the others, / (2 N); d = |a - b|.

    With legacy_version, dissimilar pairs have max(margin - d^2, 0). As in Caffe, the gradient divides by d + 1e-4, so
    that it is finite at distance 0.

    bottom[0]  a (N, C) or (N, C, 1, 1)
    bottom[1]  b, the same shape
    bottom[2]  N labels, cast to integers: 0 dissimilar, any other value similar
    top[0]     the loss, ()
    Caffe: src/caffe/layers/contrastive_loss_layer.cpp
    """

    bottoms = (3, 3)
    label_bottoms = frozenset({2})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shapes = super().reshape(bottom_shapes)
        a, b, label = bottom_shapes
        for i, shape in enumerate((a, b)):
            if not 2 <= len(shape) <= 4 or math.prod(shape[2:]) != 1:
                raise self.error(f"found a bottom of shape {shape}, expected (N, C) or (N, C, 1, 1)", "bottom", i)
        if a[1] != b[1]:
            raise self.error(f"found bottoms of shapes {a} and {b}, expected the same number of channels", "bottom", 1)
        if label[:1] != a[:1] or math.prod(label[1:]) != 1:
            raise self.error(f"found labels of shape {label}, expected one per pair: ({a[0]},)", "bottom", 2)
        return shapes

    def forward(self, a: torch.Tensor, b: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
        margin, legacy = self.param.contrastive_loss_param.margin, self.param.contrastive_loss_param.legacy_version
        similar = label.reshape(-1).long() != 0
        arithmetic = self.arithmetic(a, small=True)

        def measured(difference: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            """Return d^2, and what the margin is compared with."""
            squared = arithmetic.sums_of_squares(difference, 1)
            return squared, squared if legacy else libm.sqrt(squared)

        def compute(difference: torch.Tensor) -> torch.Tensor:
            squared, distance = measured(difference)
            lacking = (margin - distance).clamp(min=0)
            losses = torch.where(similar, squared, lacking if legacy else lacking.square())
            return arithmetic.total(losses) / len(losses) / 2

        def gradient(difference: torch.Tensor, _: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
            alpha, (_, distance) = diff / len(difference), measured(difference)
            lacking = margin - distance
            dissimilar = -alpha if legacy else -alpha * lacking / (distance + 1e-4)
            return torch.where(similar, alpha, dissimilar.where(lacking > 0, 0)).unsqueeze(1) * difference

        return pointwise(a.flatten(1) - b.flatten(1), compute, gradient)

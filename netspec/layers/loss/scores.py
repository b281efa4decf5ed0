"""Scores of classes against labels: SoftmaxWithLoss, InfogainLoss, MultinomialLogisticLoss, Accuracy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from google.protobuf.message import DecodeError

from netspec.data.blobs import to_array
from netspec.exact import SMALL_ITEM
from netspec.exact.arithmetic import AsTorch
from netspec.files.limits import read_bytes
from netspec.layers.contract.base import Shape
from netspec.layers.contract.registry import register
from netspec.layers.loss.base import (
    VALID,
    Classified,
    ClassLoss,
    Loss,
    ignore_label,
    normalization_mode,
    normalizer,
)
from netspec.proto.schema import BlobProto

FLT_MIN = 1.17549435e-38  # the minimum argument of the logarithm in SoftmaxWithLoss
LOG_THRESHOLD = 1e-20  # the same in MultinomialLogisticLoss and InfogainLoss


class SoftmaxLoss(Loss, Classified):
    """Base of the two losses that begin with a softmax, which is their optional second top, without a gradient."""

    tops = (1, 2)
    normalization: int

    def reshape_tops(self, bottom_shapes: Sequence[Shape], axis: int, *path: str) -> Sequence[Shape]:
        """Return the shapes of the tops; ``axis`` is the axis of the classes."""
        shapes = [*super().reshape(bottom_shapes), bottom_shapes[0]]
        self.reshape_scores(bottom_shapes, axis, *path)
        return shapes[: self.num_tops]

    def sum_up(
        self, losses: torch.Tensor, valid: torch.Tensor | None, total: Callable[[torch.Tensor], torch.Tensor]
    ) -> torch.Tensor:
        """Return the normalized sum, by ``total``, of the losses (outer, inner) that count."""
        if valid is not None:
            losses = losses.where(valid, 0)
        return total(losses) / normalizer(self.normalization, self.outer, self.inner, valid)


class _NegativeLogOfSoftmax(torch.autograd.Function):
    """-log(max(p, FLT_MIN)) of the labels' classes. p is the softmax."""

    @staticmethod
    def forward(
        ctx: Any, scores: torch.Tensor, label: torch.Tensor, arithmetic: AsTorch
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the losses (outer, inner) and p, for scores (outer, classes, inner) and labels (outer, inner)."""
        p = arithmetic.softmax(scores, 1)
        ctx.save_for_backward(p, label)
        ctx.mark_non_differentiable(p)
        chosen = p.gather(1, label.unsqueeze(1)).squeeze(1).clamp(min=FLT_MIN)
        return -arithmetic.log(chosen), p

    @staticmethod
    def backward(ctx: Any, diff: torch.Tensor, *_: Any) -> tuple[torch.Tensor, None, None]:
        """Return (p - 1 at the label's class) times the losses' gradient."""
        p, label = ctx.saved_tensors
        of_label = torch.zeros_like(p).scatter_(1, label.unsqueeze(1), 1)
        return (p - of_label) * diff.unsqueeze(1), None, None


@register("SoftmaxWithLoss", "loss_param", "softmax_param")
class SoftmaxWithLoss(SoftmaxLoss):
    """-log(softmax(scores)[label]), summed and normalized.

    The probability is at least FLT_MIN in the logarithm, so the loss of one prediction is 87.34 at most. The gradient
    of its label is still p - 1. Caffe refuses a second top unless loss_weight is given twice; this layer does not. As
    in Caffe, the second top has no gradient.

    bottom[0]  scores (N, C, ...), C at softmax_param.axis
    bottom[1]  labels, one per prediction, (N,), (N, 1, ...) or (N, ...)
    top[0]     the loss, ()
    top[1]     optional: the softmax, bottom[0]'s shape
    Caffe: src/caffe/layers/softmax_loss_layer.cpp
    """

    def setup(self) -> None:
        """Read the ignored label and the normalization (default VALID)."""
        self.ignore_label = ignore_label(self.param.loss_param)
        self.normalization = normalization_mode(self.param.loss_param, VALID)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return self.reshape_tops(bottom_shapes, self.param.softmax_param.axis, "softmax_param", "axis")

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        x, label = self.scores_and_labels(scores, labels)
        valid = self.valid(label, self.ignore_label)
        arithmetic = self.arithmetic(x, small=math.prod(x.shape[1:]) <= SMALL_ITEM)
        losses, p = _NegativeLogOfSoftmax.apply(x, label if valid is None else label * valid, arithmetic)
        return (self.sum_up(losses, valid, arithmetic.total), p.reshape(scores.shape))[: self.num_tops]


@register("InfogainLoss", "infogain_loss_param", "loss_param")
class InfogainLoss(SoftmaxLoss):
    """-sum over classes of H[label, class] log(softmax(scores)[class]), summed and normalized.

    The probability is at least 1e-20 in the logarithm; the gradient ignores this limit.

    bottom[0]  scores (N, C, ...), C at infogain_loss_param.axis
    bottom[1]  labels, one per prediction
    bottom[2]  optional: the matrix H, C x C numbers in any shape; without it a BlobProto file is read (source)
    top[0]     the loss, ()
    top[1]     optional: the softmax, bottom[0]'s shape, without gradient
    Caffe: src/caffe/layers/infogain_loss_layer.cpp
    """

    bottoms = (2, 3)
    label_bottoms = frozenset({1, 2})

    def setup(self) -> None:
        """Read the ignored label, the normalization (default VALID) and, without a third bottom, the matrix."""
        loss_param, source = self.param.loss_param, self.param.infogain_loss_param.source
        if loss_param.HasField("normalize"):
            message = "InfogainLoss does not take the old field normalize; use normalization"
            raise self.error(message, "loss_param", "normalize")
        self.ignore_label = ignore_label(loss_param)
        self.normalization = loss_param.normalization
        self.matrix: torch.Tensor | None
        self.register_buffer("matrix", None, persistent=False)
        if len(self.bottom_shapes) == 3:
            return
        if not source:
            message = "found neither a third bottom nor a source, expected the infogain matrix from one of them"
            raise self.error(message, "infogain_loss_param")
        if self.context.options.open_data:
            self.matrix = self._read_matrix(source)

    def _read_matrix(self, source: str) -> torch.Tensor:
        try:
            values = to_array(BlobProto.FromString(read_bytes(source)))
        except (OSError, DecodeError, ValueError) as fault:
            message = f'cannot read the infogain matrix "{source}" (a binary BlobProto is expected): {fault}'
            raise self.error(message, "infogain_loss_param", "source") from None
        return torch.tensor(values, device=self.context.device)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        axis = self.param.infogain_loss_param.axis
        shapes = self.reshape_tops(bottom_shapes, axis, "infogain_loss_param", "axis")
        if len(bottom_shapes) == 3:
            self._check_matrix(bottom_shapes[2], "bottom", 2)
        elif self.matrix is not None:
            self._check_matrix(tuple(self.matrix.shape), "infogain_loss_param", "source")
        return shapes

    def _check_matrix(self, shape: Shape, *path: str | int) -> None:
        if math.prod(shape) != self.classes**2:
            message = f"found an infogain matrix of shape {shape}, expected {self.classes} x {self.classes} numbers"
            raise self.error(message, *path)

    def forward(self, scores: torch.Tensor, labels: torch.Tensor, *given: torch.Tensor) -> tuple[torch.Tensor, ...]:
        x, label = self.scores_and_labels(scores, labels)
        valid = self.valid(label, self.ignore_label)
        matrix = given[0] if given else self.matrix
        assert matrix is not None, "setup reads the matrix unless it is a bottom"
        gain = matrix.detach().to(x.dtype).reshape(self.classes, self.classes)
        weights = gain[label if valid is None else label * valid]  # (outer, inner, classes)
        arithmetic = self.arithmetic(x)
        losses, p = arithmetic.infogain(x, weights, LOG_THRESHOLD)
        loss = self.sum_up(losses, None if valid is None else valid.unsqueeze(2), arithmetic.total)
        return (loss, p.reshape(scores.shape))[: self.num_tops]


@register("MultinomialLogisticLoss")
class MultinomialLogisticLoss(ClassLoss):
    """-log(probabilities[label]) / N; the probability is at least 1e-20, also in the gradient -1 / p.

    bottom[0]  probabilities (N, C, ...): all but the first axis are the classes
    bottom[1]  labels, N of them
    top[0]     the loss, ()
    Caffe: src/caffe/layers/multinomial_logistic_loss_layer.cpp
    """

    least = LOG_THRESHOLD

    def forward(self, probabilities: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        p, label = self.scores_and_labels(probabilities, labels)
        self.valid(label, None)
        arithmetic = self.arithmetic(p)
        chosen = arithmetic.floored(p.gather(1, label.unsqueeze(1)), self.least)
        return -arithmetic.total(arithmetic.log(chosen)) / self.outer


@register("Accuracy", "accuracy_param")
class Accuracy(Classified):
    """The share of predictions whose label is among the top_k scores. Scores equal to the label's count as higher.

    It is 0 if every label is ignored. It has no gradient.

    bottom[0]  scores (N, C, ...), C at accuracy_param.axis
    bottom[1]  labels, one per prediction
    top[0]     the accuracy, ()
    top[1]     optional: the accuracy of each class, (C,); 0 for a class that does not occur
    Caffe: src/caffe/layers/accuracy_layer.cpp
    """

    bottoms = (2, 2)
    tops = (1, 2)

    def setup(self) -> None:
        self.top_k: int = self.param.accuracy_param.top_k
        self.ignore_label = ignore_label(self.param.accuracy_param)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.reshape_scores(bottom_shapes, self.param.accuracy_param.axis, "accuracy_param", "axis")
        if self.top_k > self.classes:
            raise self.error(
                f"found top_k {self.top_k}, expected at most the {self.classes} classes", "accuracy_param", "top_k"
            )
        return [(), (self.classes,)][: self.num_tops]

    @torch.no_grad()
    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        x, label = self.scores_and_labels(scores, labels)
        valid = self.valid(label, self.ignore_label)
        if valid is None:
            valid = torch.ones_like(label, dtype=torch.bool)
        label = label * valid
        better = (x >= x.gather(1, label.unsqueeze(1))).sum(1) - 1  # the label's own score is not higher
        right = ((better < self.top_k) & valid).to(x.dtype)
        accuracy = right.sum() / valid.sum().clamp(min=1)
        if self.num_tops == 1:
            return (accuracy,)
        zeros = x.new_zeros(self.classes)
        hits = zeros.scatter_add(0, label.flatten(), right.flatten())
        occurrences = zeros.scatter_add(0, label.flatten(), valid.to(x.dtype).flatten())
        return accuracy, hits / occurrences.clamp(min=1)

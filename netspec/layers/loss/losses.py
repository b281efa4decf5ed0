"""Losses, and Accuracy. Each returns its plain value: whoever sums the losses applies loss_weight.

Caffe: include/caffe/layers/loss_layer.hpp
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from google.protobuf.message import DecodeError

from netspec.data.blobs import to_array
from netspec.exact import SMALL_ITEM, libm
from netspec.exact.blas import dots, sum_in_order
from netspec.exact.losses import Infogain, Logarithm, SigmoidCrossEntropy, softmax
from netspec.exact.sums import RowMagnitudes, RowSquares
from netspec.layers.base import Shape
from netspec.layers.loss.base import (
    BATCH_SIZE,
    VALID,
    Classified,
    Floor,
    Loss,
    ignore_label,
    normalization_mode,
    normalizer,
    total,
)
from netspec.layers.registry import register
from netspec.proto.schema import BlobProto

FLT_MIN = 1.17549435e-38  # SoftmaxWithLoss takes no logarithm of less
LOG_THRESHOLD = 1e-20  # nor MultinomialLogisticLoss and InfogainLoss of less than this


class SoftmaxLoss(Loss, Classified):
    """Base of the two losses that begin with a softmax, their optional second top, which brings no gradient."""

    tops = (1, 2)
    normalization: int

    def reshape_tops(self, bottom_shapes: Sequence[Shape], axis: int, *path: str) -> Sequence[Shape]:
        """Return the shapes of the tops; the classes lie along an axis."""
        shapes = [*super().reshape(bottom_shapes), bottom_shapes[0]]
        self.reshape_scores(bottom_shapes, axis, *path)
        return shapes[: self.num_tops]

    def sum_up(self, losses: torch.Tensor, valid: torch.Tensor | None, exact: bool) -> torch.Tensor:
        """Return the normalised sum of the losses (outer, inner) that count."""
        if valid is not None:
            losses = losses.where(valid, 0)
        return total(losses, exact) / normalizer(self.normalization, self.outer, self.inner, valid)


class _NegativeLogOfSoftmax(torch.autograd.Function):
    """-log p of the labels' classes, p being the softmax; the logarithm is of no less than FLT_MIN."""

    @staticmethod
    def forward(ctx: Any, scores: torch.Tensor, label: torch.Tensor, exact: bool) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the losses (outer, inner) and p, for scores (outer, classes, inner) and labels (outer, inner)."""
        p = softmax(scores) if exact else F.softmax(scores, 1)
        ctx.save_for_backward(p, label)
        ctx.mark_non_differentiable(p)
        chosen = p.gather(1, label.unsqueeze(1)).squeeze(1).clamp(min=FLT_MIN)
        return -(libm.log(chosen) if exact else chosen.log()), p

    @staticmethod
    def backward(ctx: Any, diff: torch.Tensor, *_: Any) -> tuple[torch.Tensor, None, None]:
        """Return (p - 1 at the label's class) times the losses' gradient."""
        p, label = ctx.saved_tensors
        of_label = torch.zeros_like(p).scatter_(1, label.unsqueeze(1), 1)
        return (p - of_label) * diff.unsqueeze(1), None, None


@register("SoftmaxWithLoss", "loss_param", "softmax_param")
class SoftmaxWithLoss(SoftmaxLoss):
    """-log(softmax(scores)[label]), summed and normalised.

    The logarithm is taken of no less than FLT_MIN, so one prediction costs 87.34 at most; its label's gradient is p - 1
    all the same. Real Caffe refuses a second top unless loss_weight is written twice; here it needs nothing. As in
    Caffe no gradient comes from it.

    bottom[0]  scores (N, C, ...), C at softmax_param.axis
    bottom[1]  labels, one a prediction, (N,), (N, 1, ...) or (N, ...)
    top[0]     the loss, ()
    top[1]     optional: the softmax, bottom[0]'s shape
    Caffe: src/caffe/layers/softmax_loss_layer.cpp
    """

    def setup(self) -> None:
        """Read the ignored label and the normalisation (default VALID)."""
        self.ignore_label = ignore_label(self.param.loss_param)
        self.normalization = normalization_mode(self.param.loss_param, VALID)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the tops' shapes."""
        return self.reshape_tops(bottom_shapes, self.param.softmax_param.axis, "softmax_param", "axis")

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the loss and, where there is a second top, the softmax."""
        x, label = self.scores_and_labels(scores, labels)
        valid = self.valid(label, self.ignore_label)
        exact = self.is_exact(x, small=math.prod(x.shape[1:]) <= SMALL_ITEM)
        losses, p = _NegativeLogOfSoftmax.apply(x, label if valid is None else label * valid, exact)
        return (self.sum_up(losses, valid, exact), p.reshape(scores.shape))[: self.num_tops]


@register("InfogainLoss", "infogain_loss_param", "loss_param")
class InfogainLoss(SoftmaxLoss):
    """-sum over classes of H[label, class] log(softmax(scores)[class]), summed and normalised.

    The logarithm is taken of no less than 1e-20; the gradient takes no notice of that.

    bottom[0]  scores (N, C, ...), C at infogain_loss_param.axis
    bottom[1]  labels, one a prediction
    bottom[2]  optional: the matrix H, C x C numbers in any shape; without it a BlobProto file is read (source)
    top[0]     the loss, ()
    top[1]     optional: the softmax, bottom[0]'s shape, without gradient
    Caffe: src/caffe/layers/infogain_loss_layer.cpp
    """

    bottoms = (2, 3)
    label_bottoms = frozenset({1, 2})

    def setup(self) -> None:
        """Read the ignored label, the normalisation (default VALID) and, without a third bottom, the matrix."""
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
        if self.context.open_data:
            self.matrix = self._read_matrix(source)

    def _read_matrix(self, source: str) -> torch.Tensor:
        try:
            values = to_array(BlobProto.FromString(Path(source).read_bytes()))
        except (OSError, DecodeError, ValueError) as fault:
            message = f'cannot read the infogain matrix "{source}" (a binary BlobProto is expected): {fault}'
            raise self.error(message, "infogain_loss_param", "source") from None
        return torch.tensor(values, device=self.context.device)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the tops' shapes."""
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
        """Return the loss and, where there is a second top, the softmax."""
        x, label = self.scores_and_labels(scores, labels)
        valid = self.valid(label, self.ignore_label)
        matrix = given[0] if given else self.matrix
        assert matrix is not None, "setup reads the matrix where no bottom brings it"
        gain = matrix.detach().to(x.dtype).reshape(self.classes, self.classes)
        weights = gain[label if valid is None else label * valid]  # (outer, inner, classes)
        if self.is_exact(x):
            losses, p = Infogain.apply(x, weights, LOG_THRESHOLD)
            counted = None if valid is None else valid.unsqueeze(2)
            loss = self.sum_up(losses, counted, exact=True)
        else:
            log_p = F.log_softmax(x, 1)
            losses = -(weights.movedim(2, 1) * Floor.apply(log_p, math.log(LOG_THRESHOLD))).sum(1)
            loss, p = self.sum_up(losses, valid, exact=False), log_p.detach().exp()
        return (loss, p.reshape(scores.shape))[: self.num_tops]


@register("MultinomialLogisticLoss")
class MultinomialLogisticLoss(Loss, Classified):
    """-log(probabilities[label]) / N; the probability is floored at 1e-20, for the gradient -1 / p as well.

    bottom[0]  probabilities (N, C, ...): all but the first axis are the classes
    bottom[1]  labels, N of them
    top[0]     the loss, ()
    Caffe: src/caffe/layers/multinomial_logistic_loss_layer.cpp
    """

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the scalar top's shape."""
        shapes = super().reshape(bottom_shapes)
        data, labels = bottom_shapes
        self.reshape_scores([(data[0], math.prod(data[1:])), labels], 1)
        return shapes

    def forward(self, probabilities: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """Return the loss."""
        p, label = self.scores_and_labels(probabilities, labels)
        self.valid(label, None)
        chosen = Floor.apply(p.gather(1, label.unsqueeze(1)), LOG_THRESHOLD)
        exact = self.is_exact(chosen)
        return -total(Logarithm.apply(chosen) if exact else chosen.log(), exact) / self.outer


@register("HingeLoss", "hinge_loss_param")
class HingeLoss(Loss, Classified):
    """One against all: the sum of max(0, 1 - s x) / N, s being 1 at the label and -1 elsewhere.

    With norm L2 each term is squared; there is no half.

    bottom[0]  scores (N, C, ...): all but the first axis are the classes
    bottom[1]  labels, N of them
    top[0]     the loss, ()
    Caffe: src/caffe/layers/hinge_loss_layer.cpp
    """

    L2 = 2  # caffe.proto: enum HingeLossParameter.Norm

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the scalar top's shape."""
        shapes = super().reshape(bottom_shapes)
        data, labels = bottom_shapes
        self.reshape_scores([(data[0], math.prod(data[1:])), labels], 1)
        return shapes

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        """Return the loss."""
        x, label = self.scores_and_labels(scores, labels)
        self.valid(label, None)
        sign = torch.ones_like(x).scatter(1, label.unsqueeze(1), -1)
        margins = F.relu(1 + sign * x)
        squared = self.param.hinge_loss_param.norm == self.L2
        if self.is_exact(margins):
            return (RowSquares if squared else RowMagnitudes).apply(margins.reshape(1, -1))[0] / self.outer
        return (margins.square() if squared else margins).sum() / self.outer


@register("SigmoidCrossEntropyLoss", "loss_param", "sigmoid_param")
class SigmoidCrossEntropyLoss(Loss):
    """Cross entropy of sigmoid(x) and targets of any value, summed and normalised (default BATCH_SIZE).

    bottom[0]  x (N, ...)
    bottom[1]  targets, as many; those that cast to loss_param.ignore_label are left out
    top[0]     the loss, ()
    Caffe: src/caffe/layers/sigmoid_cross_entropy_loss_layer.cpp
    """

    def setup(self) -> None:
        """Read the ignored label and the normalisation."""
        self.ignore_label = ignore_label(self.param.loss_param)
        self.normalization = normalization_mode(self.param.loss_param, BATCH_SIZE)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the scalar top's shape."""
        shapes = super().reshape(bottom_shapes)
        data, target = bottom_shapes
        if math.prod(data) != math.prod(target):
            raise self.error(f"found bottoms of shapes {data} and {target}, expected the same count", "bottom")
        return shapes

    def forward(self, x: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
        """Return the loss."""
        targets = targets.detach().reshape(x.shape)
        valid = None if self.ignore_label is None else targets.long() != self.ignore_label
        exact = self.is_exact(x)
        if exact:
            losses = SigmoidCrossEntropy.apply(x, targets)
        else:
            losses = F.binary_cross_entropy_with_logits(x, targets, reduction="none")
        if valid is not None:
            losses = losses.where(valid, 0)
        return total(losses, exact) / normalizer(self.normalization, x.shape[0], math.prod(x.shape[1:]), valid)


@register("EuclideanLoss")
class EuclideanLoss(Loss):
    """The sum of (a - b)^2 / (2 N).

    bottom[0]  a (N, ...)
    bottom[1]  b, as many numbers an item; gets a gradient too
    top[0]     the loss, ()
    Caffe: src/caffe/layers/euclidean_loss_layer.cpp
    """

    label_bottoms = frozenset()

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the scalar top's shape."""
        shapes = super().reshape(bottom_shapes)
        a, b = bottom_shapes
        if math.prod(a[1:]) != math.prod(b[1:]):
            raise self.error(f"found bottoms of shapes {a} and {b}, expected as many numbers an item", "bottom")
        return shapes

    def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        """Return the loss."""
        difference = a - b.reshape(a.shape)
        exact = self.is_exact(difference)
        squares = RowSquares.apply(difference.reshape(1, -1))[0] if exact else difference.square().sum()
        return squares / (2 * a.shape[0])


class _Contrastive(torch.autograd.Function):
    """Caffe's gradient divides by the distance + 1e-4: not quite the derivative, and finite at distance 0."""

    @staticmethod
    def forward(
        ctx: Any, a: torch.Tensor, b: torch.Tensor, similar: torch.Tensor, margin: float, legacy: bool, exact: bool
    ) -> torch.Tensor:
        difference = a - b
        rows = difference.unsqueeze(2)
        squared = dots(rows, rows).squeeze(1) if exact else difference.square().sum(1)
        distance = libm.sqrt(squared)
        dissimilar = (margin - squared).clamp(min=0) if legacy else (margin - distance).clamp(min=0).square()
        ctx.save_for_backward(difference, squared if legacy else distance, similar)
        ctx.margin, ctx.legacy = margin, legacy
        losses = torch.where(similar, squared, dissimilar)
        return (sum_in_order(losses) if exact else losses.sum()) / len(a) / 2

    @staticmethod
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        difference, distance, similar = ctx.saved_tensors
        alpha = grads[0] / len(difference)
        lacking = ctx.margin - distance
        dissimilar = -alpha if ctx.legacy else -alpha * lacking / (distance + 1e-4)
        factor = torch.where(similar, alpha, dissimilar.where(lacking > 0, 0))
        grad = factor.unsqueeze(1) * difference
        return grad, -grad, None, None, None, None


@register("ContrastiveLoss", "contrastive_loss_param")
class ContrastiveLoss(Loss):
    """The sum of d^2 over similar pairs and of max(margin - d, 0)^2 over the others, / (2 N); d = |a - b|.

    legacy_version takes max(margin - d^2, 0) for dissimilar pairs.

    bottom[0]  a (N, C) or (N, C, 1, 1)
    bottom[1]  b, the same shape
    bottom[2]  N labels, cast to integers: 0 dissimilar, any other value similar
    top[0]     the loss, ()
    Caffe: src/caffe/layers/contrastive_loss_layer.cpp
    """

    bottoms = (3, 3)
    label_bottoms = frozenset({2})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the scalar top's shape."""
        shapes = super().reshape(bottom_shapes)
        a, b, label = bottom_shapes
        for i, shape in enumerate((a, b)):
            if not 2 <= len(shape) <= 4 or math.prod(shape[2:]) != 1:
                raise self.error(f"found a bottom of shape {shape}, expected (N, C) or (N, C, 1, 1)", "bottom", i)
        if a[1] != b[1]:
            raise self.error(f"found bottoms of shapes {a} and {b}, expected the same number of channels", "bottom", 1)
        if label[:1] != a[:1] or math.prod(label[1:]) != 1:
            raise self.error(f"found labels of shape {label}, expected one a pair: ({a[0]},)", "bottom", 2)
        return shapes

    def forward(self, a: torch.Tensor, b: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
        """Return the loss."""
        p = self.param.contrastive_loss_param
        similar = label.reshape(-1).long() != 0
        exact = self.is_exact(a, small=True)
        return _Contrastive.apply(a.flatten(1), b.flatten(1), similar, p.margin, p.legacy_version, exact)


@register("Accuracy", "accuracy_param")
class Accuracy(Classified):
    """The share of predictions whose label is among the top_k scores; a tie with the label's score counts against it.

    It is 0 where every label is ignored. No gradient.

    bottom[0]  scores (N, C, ...), C at accuracy_param.axis
    bottom[1]  labels, one a prediction
    top[0]     the accuracy, ()
    top[1]     optional: the accuracy of each class, (C,); 0 for a class that does not occur
    Caffe: src/caffe/layers/accuracy_layer.cpp
    """

    bottoms = (2, 2)
    tops = (1, 2)

    def setup(self) -> None:
        """Read top_k and the ignored label."""
        self.top_k: int = self.param.accuracy_param.top_k
        self.ignore_label = ignore_label(self.param.accuracy_param)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the tops' shapes."""
        self.reshape_scores(bottom_shapes, self.param.accuracy_param.axis, "accuracy_param", "axis")
        if self.top_k > self.classes:
            raise self.error(
                f"found top_k {self.top_k}, expected at most the {self.classes} classes", "accuracy_param", "top_k"
            )
        return [(), (self.classes,)][: self.num_tops]

    @torch.no_grad()
    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the accuracy and, where there is a second top, that of each class."""
        x, label = self.scores_and_labels(scores, labels)
        valid = self.valid(label, self.ignore_label)
        if valid is None:
            valid = torch.ones_like(label, dtype=torch.bool)
        label = label * valid
        better = (x >= x.gather(1, label.unsqueeze(1))).sum(1) - 1  # the label's own score is no better
        right = ((better < self.top_k) & valid).to(x.dtype)
        accuracy = right.sum() / valid.sum().clamp(min=1)
        if self.num_tops == 1:
            return (accuracy,)
        zeros = x.new_zeros(self.classes)
        hits = zeros.scatter_add(0, label.flatten(), right.flatten())
        occurrences = zeros.scatter_add(0, label.flatten(), valid.to(x.dtype).flatten())
        return accuracy, hits / occurrences.clamp(min=1)

"""Scores of classes against labels: SoftmaxWithLoss, InfogainLoss, MultinomialLogisticLoss, Accuracy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from google.protobuf.message import DecodeError

from netspec.data.blobs import to_array
from netspec.exact import SMALL_ITEM
from netspec.exact.arithmetic import AsTorch
from netspec.files.limits import read_bytes
from netspec.layers.contract.base import Shape
from netspec.layers.contract.exporting import refusal
from netspec.layers.contract.registry import register
from netspec.layers.contract.targets import OnnxGraph, TorchCode
from netspec.layers.loss.base import (
    BATCH_SIZE,
    FULL,
    NONE,
    VALID,
    Classified,
    ClassLoss,
    Loss,
    ignore_label,
    normalization_mode,
    normalizer,
    onnx_normalized_sum,
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

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        scores, labels = self.onnx_scores_and_labels(graph, *bottoms)
        valid, labels = self.onnx_valid(graph, labels, self.ignore_label)
        softmax = graph.node("Softmax", scores, axis=1)
        chosen = graph.node("GatherElements", softmax, labels, axis=1)
        losses = graph.node("Neg", graph.node("Log", graph.node("Max", chosen, graph.constant(FLT_MIN))))
        loss = onnx_normalized_sum(graph, losses, valid, self.normalization)
        return (loss,) if self.num_tops == 1 else (loss, graph.reshape_to_top(softmax, 1))

    def to_torch(self, code: TorchCode, *bottoms: str) -> Sequence[str]:
        scores, labels = self.bottom_shapes
        y = bottoms[1] if labels == (scores[0], *scores[2:]) else code.call("{y}.squeeze(1)", y=bottoms[1])
        if scores[1] != self.classes or labels not in ((scores[0], *scores[2:]), (scores[0], 1, *scores[2:])):
            raise refusal(self, "PyTorch", "it is exported for scores (N, C, ...) and labels (N, ...) or (N, 1, ...)")
        if self.ignore_label is None and self.normalization in (FULL, VALID):
            loss = code.call("F.cross_entropy({x}, {y}.long())", x=bottoms[0], y=y)
        else:
            divisor = {FULL: "all", VALID: "counted", BATCH_SIZE: "items", NONE: "none"}[self.normalization]
            options = {} if self.ignore_label is None else {"ignore": self.ignore_label}
            given = ", ".join([f'divide_by="{divisor}"', *(f"{name}={{{name}}}" for name in options)])
            loss = code.call(f"{code.function(softmax_loss)}({{x}}, {{y}}, {given})", x=bottoms[0], y=y, **options)
        return (loss,) if self.num_tops == 1 else (loss, code.call("F.softmax({x}, dim=1)", x=bottoms[0]))


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
    not_exported = "PyTorch has no loss with an infogain matrix"
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

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        scores, labels = self.onnx_scores_and_labels(graph, *bottoms[:2])
        valid, labels = self.onnx_valid(graph, labels, self.ignore_label)
        if len(bottoms) == 3:
            matrix = graph.reshape(bottoms[2], [self.classes, self.classes])
        elif self.matrix is not None:
            matrix = graph.constant(self.matrix.reshape(self.classes, self.classes))
        else:
            raise refusal(self, "ONNX", "the infogain matrix was not read")
        log_p = graph.node("LogSoftmax", scores, axis=1)
        floored = graph.node("Max", log_p, graph.constant(math.log(LOG_THRESHOLD)))
        rows = graph.node("Gather", matrix, graph.node("Squeeze", labels, graph.constant([1])), axis=0)
        weighted = graph.node("Mul", graph.node("Transpose", rows, perm=[0, 2, 1]), floored)
        losses = graph.node("Neg", graph.node("ReduceSum", weighted, graph.constant([1]), keepdims=1))
        loss = onnx_normalized_sum(graph, losses, valid, self.normalization)
        return (loss,) if self.num_tops == 1 else (loss, graph.reshape_to_top(graph.node("Exp", log_p), 1))


@register("MultinomialLogisticLoss")
class MultinomialLogisticLoss(ClassLoss):
    """-log(probabilities[label]) / N; the probability is at least 1e-20, also in the gradient -1 / p.

    bottom[0]  probabilities (N, C, ...): all but the first axis are the classes
    bottom[1]  labels, N of them
    top[0]     the loss, ()
    Caffe: src/caffe/layers/multinomial_logistic_loss_layer.cpp
    """

    least = LOG_THRESHOLD
    torch_call = "F.nll_loss(torch.log({x}.flatten(1).clamp(min={least})), {y}.flatten().long())"

    def forward(self, probabilities: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        p, label = self.scores_and_labels(probabilities, labels)
        self.valid(label, None)
        arithmetic = self.arithmetic(p)
        chosen = arithmetic.floored(p.gather(1, label.unsqueeze(1)), self.least)
        return -arithmetic.total(arithmetic.log(chosen)) / self.outer

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        p, labels = self.onnx_scores_and_labels(graph, *bottoms)
        chosen = graph.node("Max", graph.node("GatherElements", p, labels, axis=1), graph.constant(self.least))
        return onnx_normalized_sum(graph, graph.node("Neg", graph.node("Log", chosen)), "", BATCH_SIZE)


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

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        x, labels = self.onnx_scores_and_labels(graph, *bottoms)
        counted, known = self.onnx_valid(graph, labels, self.ignore_label)
        own = graph.node("GatherElements", x, known, axis=1)
        as_good = graph.cast(graph.node("GreaterOrEqual", x, own), "float32")
        rank = graph.node("ReduceSum", as_good, graph.constant([1]), keepdims=1)
        right = graph.cast(graph.node("LessOrEqual", rank, graph.constant(float(self.top_k))), "float32")
        accuracy = onnx_normalized_sum(graph, right, counted, VALID)
        if self.num_tops == 1:
            return (accuracy,)
        classes = graph.constant(torch.arange(self.classes).reshape(-1, 1))
        of_class = graph.cast(graph.node("Equal", labels, classes), "float32")  # an ignored label may also be a class
        of_class = graph.node("Mul", of_class, counted) if counted else of_class
        axes = graph.constant([0, 2])
        occurrences = graph.node("ReduceSum", of_class, axes, keepdims=0)
        hits = graph.node("ReduceSum", graph.node("Mul", of_class, right), axes, keepdims=0)
        return accuracy, graph.node("Div", hits, graph.node("Max", occurrences, graph.constant(1.0)))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str | Sequence[str]:
        if self.num_tops > 1 or self.inner != math.prod(self.bottom_shapes[0][2:]):
            raise refusal(self, "PyTorch", "it is exported for scores (N, C, ...), without the accuracy of each class")
        function = code.function(accuracy)
        template = f"{function}({', '.join(bottoms)}, top_k={{top_k}}, ignore_label={{ignore}})"
        return code.call(template, top_k=self.top_k, ignore=self.ignore_label)


def softmax_loss(scores, labels, divide_by, ignore=-100):
    """Return the sum of the cross entropy of softmax(scores), divided by the number of labels."""
    labels = labels.long()
    total = F.cross_entropy(scores, labels, ignore_index=ignore, reduction="sum")
    counted = (labels != ignore).sum().clamp(min=1)
    items = labels.shape[0]
    counts = {"all": labels.numel(), "counted": counted, "items": items, "none": 1}
    return total / counts[divide_by]


def accuracy(scores, labels, top_k, ignore_label):
    """Return the share of labels among the top_k scores; an equal score counts as higher."""
    scores = scores.flatten(2) if scores.dim() > 2 else scores[:, :, None]
    labels = labels.reshape(scores.shape[0], -1).long()
    counted = torch.ones_like(labels)
    if ignore_label is not None:
        counted = (labels != ignore_label).long()
    own = scores.gather(1, (labels * counted)[:, None])
    right = ((scores >= own).sum(1) <= top_k) & (counted > 0)
    return right.sum() / counted.sum().clamp(min=1)

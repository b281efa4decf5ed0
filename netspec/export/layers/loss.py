"""Exporters of the losses and Accuracy."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F

from netspec.export.exporter import Exporter, exports, rounded
from netspec.export.expression import Expression, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.loss.base import (
    BATCH_SIZE,
    FULL,
    NONE,
    VALID,
)
from netspec.layers.loss.losses import ContrastiveLoss, EuclideanLoss, HingeLoss, SigmoidCrossEntropyLoss
from netspec.layers.loss.scores import (
    FLT_MIN,
    LOG_THRESHOLD,
    Accuracy,
    InfogainLoss,
    MultinomialLogisticLoss,
    SoftmaxWithLoss,
)


class ClassifiedExport(Exporter):
    def onnx_scores_and_labels(self, graph: OnnxGraph, scores: str, labels: str) -> tuple[str, str]:
        """Write scores as (outer, classes, inner) and integer labels as (outer, 1, inner)."""
        inner = self.layer.inner if None not in graph.sizes(0)[1:] else -1
        outer = -1 if inner > 0 else 0  # a free size after axis 0: then the classes are axis 1
        scores = graph.reshape(scores, [outer, self.layer.classes, inner])
        shape = graph.node(
            "Concat", graph.shape_of(scores, 0, 1), graph.constant([1]), graph.shape_of(scores, 2), axis=0
        )
        return scores, graph.cast(graph.node("Reshape", labels, shape), "int64")

    def onnx_valid(self, graph: OnnxGraph, labels: str, ignore_label: int | None) -> tuple[str, str]:
        """Write which labels count, as 0 or 1 (empty: all of them), and the labels with 0 for ignored ones."""
        if ignore_label is None:
            return "", labels
        valid = graph.cast(graph.node("Not", graph.node("Equal", labels, graph.constant(ignore_label))), "int64")
        return graph.cast(valid, "float32"), graph.node("Mul", labels, valid)

    def torch_scores_and_labels(self, x: Expression, y: Expression, axis: int) -> tuple[Expression, Expression]:
        """Return scores (outer, classes, ...) and labels (outer, ...), from scores with the classes on ``axis``."""
        scores, labels = self.layer.bottom_shapes
        axis %= len(scores)
        before, after = scores[:axis], scores[axis + 1 :]
        if labels == (*before, 1, *after):
            y = y.squeeze(axis)
        elif labels != (*before, *after):
            y = y.reshape(x.select(axis, 0).shape)
        if axis == 0:
            return x[None], y[None]
        return (x.flatten(0, axis - 1), y.flatten(0, axis - 1)) if axis > 1 else (x, y)


def onnx_normalized_sum(graph: OnnxGraph, losses: str, valid: str, mode: int) -> str:
    """Write the sum of losses (outer, ...), divided as :func:`normalizer` says; an empty ``valid``: all count."""
    if valid:
        losses = graph.node("Mul", losses, valid)
    if mode == VALID and valid:
        counted = graph.node("Max", graph.node("ReduceSum", valid, keepdims=0), graph.constant(1.0))
        return graph.node("Div", graph.node("ReduceSum", losses, keepdims=0), counted)
    if mode in (FULL, VALID):
        return graph.node("ReduceMean", losses, keepdims=0)
    total = graph.node("ReduceSum", losses, keepdims=0)
    return total if mode == NONE else graph.node("Div", total, onnx_items(graph, losses))


def onnx_items(graph: OnnxGraph, value: str) -> str:
    """Write the number of items, the size of axis 0, as a floating-point scalar."""
    return graph.cast(graph.node("Squeeze", graph.shape_of(value, 0, 1)), "float32")


@exports(HingeLoss)
class HingeLossExport(ClassifiedExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        x, labels = self.onnx_scores_and_labels(graph, *bottoms)
        classes = graph.constant(torch.arange(layer.classes).reshape(-1, 1))
        of_label = graph.cast(graph.node("Equal", labels, classes), "float32")
        sign = graph.node("Sub", graph.constant(1.0), graph.node("Mul", of_label, graph.constant(2.0)))
        margins = graph.node("Relu", graph.node("Add", graph.constant(1.0), graph.node("Mul", sign, x)))
        if layer.param.hinge_loss_param.norm == layer.L2:
            margins = graph.node("Mul", margins, margins)
        return onnx_normalized_sum(graph, margins, "", BATCH_SIZE)

    def to_torch(self, code: TorchCode, x: Expression, y: Expression) -> Expression:
        return call(hinge_loss, x, y, norm=2 if self.layer.param.hinge_loss_param.norm == self.layer.L2 else 1)


@exports(SigmoidCrossEntropyLoss)
class SigmoidCrossEntropyLossExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        x, targets = bottoms
        if layer.bottom_shapes[0] != layer.bottom_shapes[1]:
            targets = graph.node("Reshape", targets, graph.shape_of(x))
        softplus = graph.node("Softplus", graph.node("Neg", graph.node("Abs", x)))
        linear = graph.node("Sub", graph.node("Relu", x), graph.node("Mul", x, targets))
        valid = ""
        if layer.ignore_label is not None:
            ignored = graph.node("Equal", graph.cast(targets, "int64"), graph.constant(layer.ignore_label))
            valid = graph.cast(graph.node("Not", ignored), "float32")
        return onnx_normalized_sum(graph, graph.node("Add", linear, softplus), valid, layer.normalization)

    def to_torch(self, code: TorchCode, x: Expression, y: Expression) -> Expression:
        layer = self.layer
        if layer.ignore_label is not None:
            raise self.refusal("PyTorch", "torch's binary cross entropy cannot ignore a label")
        if layer.bottom_shapes[0] != layer.bottom_shapes[1]:
            y = y.reshape(x.shape)
        if layer.normalization in (FULL, VALID):
            return call(F.binary_cross_entropy_with_logits, x, y)
        if layer.normalization == NONE:
            return call(F.binary_cross_entropy_with_logits, x, y, reduction="sum")
        return call(sigmoid_loss, x, y)


@exports(EuclideanLoss)
class EuclideanLossExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        a, b = (graph.node("Flatten", bottom, axis=1) for bottom in bottoms)
        difference = graph.node("Sub", a, b)
        total = graph.node("ReduceSum", graph.node("Mul", difference, difference), keepdims=0)
        return graph.node("Div", total, graph.node("Mul", onnx_items(graph, a), graph.constant(2.0)))

    def to_torch(self, code: TorchCode, x: Expression, y: Expression) -> Expression:
        if self.layer.bottom_shapes[0] != self.layer.bottom_shapes[1]:
            x, y = x.flatten(1), y.flatten(1)
        return (x - y).square().sum() / (2 * x.shape[0])


@exports(ContrastiveLoss)
class ContrastiveLossExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        p = self.layer.param.contrastive_loss_param
        a, b = (graph.node("Flatten", bottom, axis=1) for bottom in bottoms[:2])
        difference = graph.node("Sub", a, b)
        squared = graph.node("ReduceSum", graph.node("Mul", difference, difference), graph.constant([1]), keepdims=0)
        distance = squared if p.legacy_version else graph.node("Sqrt", squared)
        dissimilar = graph.node("Relu", graph.node("Sub", graph.constant(p.margin), distance))
        if not p.legacy_version:
            dissimilar = graph.node("Mul", dissimilar, dissimilar)
        label = graph.cast(graph.reshape(bottoms[2], [-1]), "int64")
        losses = graph.node("Where", graph.node("Equal", label, graph.constant(0)), dissimilar, squared)
        return graph.node("Mul", graph.node("ReduceMean", losses, keepdims=0), graph.constant(0.5))

    def to_torch(self, code: TorchCode, a: Expression, b: Expression, similar: Expression) -> Expression:
        p = self.layer.param.contrastive_loss_param
        loss = legacy_contrastive_loss if p.legacy_version else contrastive_loss
        return call(loss, a, b, similar, margin=rounded(p.margin))


@exports(SoftmaxWithLoss)
class SoftmaxWithLossExport(ClassifiedExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        layer = self.layer
        scores, labels = self.onnx_scores_and_labels(graph, *bottoms)
        valid, labels = self.onnx_valid(graph, labels, layer.ignore_label)
        softmax = graph.node("Softmax", scores, axis=1)
        chosen = graph.node("GatherElements", softmax, labels, axis=1)
        losses = graph.node("Neg", graph.node("Log", graph.node("Max", chosen, graph.constant(FLT_MIN))))
        loss = onnx_normalized_sum(graph, losses, valid, layer.normalization)
        return (loss,) if layer.num_tops == 1 else (loss, graph.reshape_to_top(softmax, 1))

    def to_torch(self, code: TorchCode, scores: Expression, labels: Expression) -> Sequence[Expression]:
        layer = self.layer
        axis = layer.param.softmax_param.axis % len(layer.bottom_shapes[0])
        x, y = self.torch_scores_and_labels(scores, labels, axis)
        if layer.ignore_label is None and layer.normalization in (FULL, VALID):
            loss = call(F.cross_entropy, x, y.long())
        else:
            divisor = {FULL: "all", VALID: "counted", BATCH_SIZE: "items", NONE: "none"}[layer.normalization]
            options = {} if layer.ignore_label is None else {"ignore": layer.ignore_label}
            loss = call(softmax_loss, x, y, divide_by=divisor, **options)
        return (loss, call(F.softmax, scores, dim=axis))[: layer.num_tops]


@exports(InfogainLoss)
class InfogainLossExport(ClassifiedExport):
    not_exported = "PyTorch has no loss with an infogain matrix"

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        layer = self.layer
        scores, labels = self.onnx_scores_and_labels(graph, *bottoms[:2])
        valid, labels = self.onnx_valid(graph, labels, layer.ignore_label)
        if len(bottoms) == 3:
            matrix = graph.reshape(bottoms[2], [layer.classes, layer.classes])
        elif layer.matrix is not None:
            matrix = graph.constant(layer.matrix.reshape(layer.classes, layer.classes))
        else:
            raise self.refusal("ONNX", "the infogain matrix was not read")
        log_p = graph.node("LogSoftmax", scores, axis=1)
        floored = graph.node("Max", log_p, graph.constant(math.log(LOG_THRESHOLD)))
        rows = graph.node("Gather", matrix, graph.node("Squeeze", labels, graph.constant([1])), axis=0)
        weighted = graph.node("Mul", graph.node("Transpose", rows, perm=[0, 2, 1]), floored)
        losses = graph.node("Neg", graph.node("ReduceSum", weighted, graph.constant([1]), keepdims=1))
        loss = onnx_normalized_sum(graph, losses, valid, layer.normalization)
        return (loss,) if layer.num_tops == 1 else (loss, graph.reshape_to_top(graph.node("Exp", log_p), 1))


@exports(MultinomialLogisticLoss)
class MultinomialLogisticLossExport(ClassifiedExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        p, labels = self.onnx_scores_and_labels(graph, *bottoms)
        chosen = graph.node("Max", graph.node("GatherElements", p, labels, axis=1), graph.constant(self.layer.least))
        return onnx_normalized_sum(graph, graph.node("Neg", graph.node("Log", chosen)), "", BATCH_SIZE)

    def to_torch(self, code: TorchCode, p: Expression, labels: Expression) -> Expression:
        least = self.layer.least
        return call(F.nll_loss, call(torch.log, p.flatten(1).clamp(min=least)), labels.flatten().long())


@exports(Accuracy)
class AccuracyExport(ClassifiedExport):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        layer = self.layer
        x, labels = self.onnx_scores_and_labels(graph, *bottoms)
        counted, known = self.onnx_valid(graph, labels, layer.ignore_label)
        own = graph.node("GatherElements", x, known, axis=1)
        as_good = graph.cast(graph.node("GreaterOrEqual", x, own), "float32")
        rank = graph.node("ReduceSum", as_good, graph.constant([1]), keepdims=1)
        right = graph.cast(graph.node("LessOrEqual", rank, graph.constant(float(layer.top_k))), "float32")
        accuracy = onnx_normalized_sum(graph, right, counted, VALID)
        if layer.num_tops == 1:
            return (accuracy,)
        classes = graph.constant(torch.arange(layer.classes).reshape(-1, 1))
        of_class = graph.cast(graph.node("Equal", labels, classes), "float32")  # an ignored label may also be a class
        of_class = graph.node("Mul", of_class, counted) if counted else of_class
        axes = graph.constant([0, 2])
        occurrences = graph.node("ReduceSum", of_class, axes, keepdims=0)
        hits = graph.node("ReduceSum", graph.node("Mul", of_class, right), axes, keepdims=0)
        return accuracy, graph.node("Div", hits, graph.node("Max", occurrences, graph.constant(1.0)))

    def to_torch(self, code: TorchCode, scores: Expression, labels: Expression) -> Expression:
        layer = self.layer
        if layer.num_tops > 1:
            raise self.refusal("PyTorch", "it is exported without the accuracy of each class")
        x, y = self.torch_scores_and_labels(scores, labels, layer.param.accuracy_param.axis)
        return call(accuracy, x, y, top_k=layer.top_k, ignore_label=layer.ignore_label)


def sigmoid_loss(scores, targets):
    """Return the cross entropy of sigmoid(scores), summed for each item and averaged over the items."""
    total = F.binary_cross_entropy_with_logits(scores, targets, reduction="sum")
    return total / scores.shape[0]


def contrastive_loss(a, b, similar, margin):
    """Return the mean over pairs of d**2 / 2 if similar, else max(margin - d, 0)**2 / 2."""
    squared = (a - b).flatten(1).square().sum(1)
    dissimilar = F.relu(margin - squared.sqrt()).square()
    return torch.where(similar.flatten().long() != 0, squared, dissimilar).mean() / 2


def legacy_contrastive_loss(a, b, similar, margin):
    """Return the mean over pairs of d**2 / 2 if similar, else max(margin - d**2, 0) / 2."""
    squared = (a - b).flatten(1).square().sum(1)
    dissimilar = F.relu(margin - squared)
    return torch.where(similar.flatten().long() != 0, squared, dissimilar).mean() / 2


def hinge_loss(scores, labels, norm):
    """Return the sum of max(0, 1 - s x)**norm / N, where s is 1 at the label, else -1."""
    scores, labels = scores.flatten(1), labels.flatten().long()
    sign = torch.ones_like(scores).scatter(1, labels[:, None], -1)
    return F.relu(1 + sign * scores).pow(norm).sum() / scores.shape[0]


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

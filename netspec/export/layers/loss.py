"""The expressions of the losses and Accuracy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F

from netspec.export.exporter import exports, refusal, rounded
from netspec.export.expression import Expression, call
from netspec.export.formats.torch_code import TorchCode
from netspec.export.layers.normalization import root
from netspec.layers.loss.base import BATCH_SIZE, FULL, NONE, VALID
from netspec.layers.loss.losses import ContrastiveLoss, EuclideanLoss, HingeLoss, SigmoidCrossEntropyLoss
from netspec.layers.loss.scores import Accuracy, InfogainLoss, MultinomialLogisticLoss, SoftmaxWithLoss

DIVISORS = {FULL: "all", VALID: "counted", BATCH_SIZE: "items", NONE: "none"}


def _scores_and_labels(layer: Any, x: Expression, y: Expression, axis: int) -> tuple[Expression, Expression]:
    """Return scores (outer, classes, ...) and labels (outer, ...), from scores with the classes on ``axis``."""
    scores, labels = layer.bottom_shapes[:2]
    axis %= len(scores)
    before, after = scores[:axis], scores[axis + 1 :]
    if labels == (*before, 1, *after):
        y = y.squeeze(axis)
    elif labels != (*before, *after):
        y = y.reshape(x.select(axis, 0).shape)
    if axis == 0:
        return x[None], y[None]
    return (x.flatten(0, axis - 1), y.flatten(0, axis - 1)) if axis > 1 else (x, y)


def _normalized(layer: Any) -> dict[str, Any]:
    """Return the options of a loss that say what its sum is divided by, and which label is ignored."""
    ignored = {} if layer.ignore_label is None else {"ignore": layer.ignore_label}
    return {"divide_by": DIVISORS[layer.normalization], **ignored}


@exports(HingeLoss)
def hinge(layer: Any, code: TorchCode, x: Expression, y: Expression) -> Expression:
    return call(hinge_loss, x, y, norm=2 if layer.param.hinge_loss_param.norm == layer.L2 else 1)


@exports(SigmoidCrossEntropyLoss)
def sigmoid_cross_entropy(layer: Any, code: TorchCode, x: Expression, y: Expression) -> Expression:
    same = layer.bottom_shapes[0] == layer.bottom_shapes[1]
    return call(sigmoid_loss, x, y if same else y.reshape(x.shape), **_normalized(layer))


@exports(EuclideanLoss)
def euclidean(layer: Any, code: TorchCode, x: Expression, y: Expression) -> Expression:
    if layer.bottom_shapes[0] != layer.bottom_shapes[1]:
        x, y = x.flatten(1), y.flatten(1)
    return (x - y).square().sum() / (2 * x.shape[0])


@exports(ContrastiveLoss)
def contrastive(layer: Any, code: TorchCode, a: Expression, b: Expression, similar: Expression) -> Expression:
    param = layer.param.contrastive_loss_param
    loss = legacy_contrastive_loss if param.legacy_version else contrastive_loss
    return call(loss, a, b, similar, margin=rounded(param.margin))


@exports(SoftmaxWithLoss)
def softmax_with_loss(layer: Any, code: TorchCode, scores: Expression, labels: Expression) -> Sequence[Expression]:
    axis = layer.param.softmax_param.axis % len(layer.bottom_shapes[0])
    loss = call(softmax_loss, *_scores_and_labels(layer, scores, labels, axis), **_normalized(layer))
    return (loss, call(F.softmax, scores.detach(), dim=axis))[: layer.num_tops]


@exports(InfogainLoss)
def infogain(layer: Any, code: TorchCode, scores: Expression, labels: Expression, *given: Expression) -> Any:
    if not given and layer.matrix is None:
        raise refusal(layer, "the infogain matrix was not read")
    matrix = given[0] if given else code.buffer(layer.matrix)
    axis = layer.param.infogain_loss_param.axis % len(layer.bottom_shapes[0])
    x, y = _scores_and_labels(layer, scores, labels, axis)
    loss = call(infogain_loss, x, y, matrix.reshape(layer.classes, layer.classes), **_normalized(layer))
    return (loss, call(F.softmax, scores.detach(), dim=axis))[: layer.num_tops]


@exports(MultinomialLogisticLoss)
def multinomial_logistic(layer: Any, code: TorchCode, p: Expression, labels: Expression) -> Expression:
    return call(logistic_loss, p, labels, least=layer.least)


@exports(Accuracy)
def accuracies(
    layer: Any, code: TorchCode, scores: Expression, labels: Expression
) -> Expression | Sequence[Expression]:
    x, y = _scores_and_labels(layer, scores, labels, layer.param.accuracy_param.axis)
    options = {"top_k": layer.top_k, "ignore": layer.ignore_label}
    share = call(accuracy, x, y, **options)
    return share if layer.num_tops == 1 else (share, call(accuracy_by_class, x, y, **options))


def divided(losses, labels, divide_by, ignore):
    """Return the sum of the losses whose label counts, divided by a number of them."""
    every, items, counted = labels.numel(), labels.shape[0], labels.numel()
    if ignore is not None:
        valid = (labels != ignore).to(losses.dtype)
        losses, counted = losses * valid, valid.sum().clamp(min=1)
    counts = {"all": every, "counted": counted, "items": items, "none": 1}
    return losses.sum() / counts[divide_by]


def log_softmax(scores, least):
    """Return the logarithms of softmax(scores), at least a number, which their gradient does not know."""
    found = F.log_softmax(scores, 1)
    return found + (found.clamp(min=least) - found).detach()


def softmax_loss(scores, labels, divide_by, ignore=None):
    """Return the sum of -log(softmax(scores)[label]), at most 87.3 each, divided as ``divide_by`` says."""
    labels = labels.long()
    chosen = labels if ignore is None else labels * (labels != ignore)
    losses = -log_softmax(scores, -87.33654).gather(1, chosen[:, None])[:, 0]
    return divided(losses, labels, divide_by, ignore)


def infogain_loss(scores, labels, matrix, divide_by, ignore=None):
    """Return the sum of -matrix[label] log(softmax(scores)), divided as ``divide_by`` says."""
    labels = labels.long()
    chosen = labels if ignore is None else labels * (labels != ignore)
    weights = matrix.detach()[chosen].movedim(-1, 1)
    losses = -(weights * log_softmax(scores, -46.0517)).sum(1)
    return divided(losses, labels, divide_by, ignore)


def logistic_loss(p, labels, least):
    """Return the mean of -log(p[label])."""
    chosen = p.flatten(1).gather(1, labels.reshape(-1, 1).long())
    return -chosen.clamp(min=least).log().mean()


def sigmoid_loss(x, targets, divide_by, ignore=None):
    """Return the sum of the cross entropy of sigmoid(x) and targets, divided as ``divide_by`` says."""
    targets = targets.detach()
    losses = targets * F.softplus(-x) + (1 - targets) * F.softplus(x)
    return divided(losses, targets.long(), divide_by, ignore)


def contrastive_loss(a, b, similar, margin):
    """Return the mean over pairs of d**2 / 2 if similar, else max(margin - d, 0)**2 / 2."""
    squared = (a - b).flatten(1).square().sum(1)
    dissimilar = F.relu(margin - root(squared, 1e-4)).square()
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


def hits(scores, labels, top_k, ignore):
    """Return labels, which of them count, and which of these are among the top_k scores; equal scores are higher."""
    scores, labels = scores.detach(), labels[:, None].long()
    counted = torch.ones_like(labels) if ignore is None else (labels != ignore).long()
    labels = labels * counted
    rank = (scores >= scores.gather(1, labels)).to(scores.dtype).sum(1, keepdim=True)
    counted = counted.to(scores.dtype)
    return labels, counted, (rank <= top_k).to(scores.dtype) * counted


def accuracy(scores, labels, top_k, ignore):
    """Return the share of labels that are among the top_k scores."""
    _, counted, right = hits(scores, labels, top_k, ignore)
    return right.sum() / counted.sum().clamp(min=1)


def accuracy_by_class(scores, labels, top_k, ignore):
    """Return the share of the labels of each class that are among the top_k scores."""
    labels, counted, right = hits(scores, labels, top_k, ignore)
    classes = torch.arange(scores.shape[1], device=scores.device)
    of_class = (labels.reshape(-1, 1) == classes).to(scores.dtype)
    shares = [(of_class * x.reshape(-1, 1)).sum(0) for x in (right, counted)]
    return shares[0] / shares[1].clamp(min=1)

"""The base classes of losses: comparison of scores and labels, ignored labels, and normalization.

Caffe: include/caffe/layers/loss_layer.hpp
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from netspec.layers.contract.base import Layer, Shape

FULL, VALID, BATCH_SIZE, NONE = 0, 1, 2, 3  # caffe.proto: enum LossParameter.NormalizationMode


class Loss(Layer):
    """Base of losses: one scalar top, and the same number of items in every bottom."""

    bottoms = (2, 2)
    is_loss = True
    label_bottoms = frozenset({1})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        data, label = bottom_shapes[:2]
        if data[:1] != label[:1]:
            raise self.error(f"found bottoms of shapes {data} and {label}, expected the same number of items", "bottom")
        return [()]


class Classified(Layer):
    """Base of the layers that compare class scores along an axis with integer labels."""

    label_bottoms = frozenset({1})

    def reshape_scores(self, bottom_shapes: Sequence[Shape], axis: int, *path: str) -> None:
        """Set outer x classes x inner from the scores. Raise SpecError for a label count other than outer x inner."""
        scores, labels = bottom_shapes[:2]
        axis = self.canonical_axis(axis, scores, *path)
        self.outer, self.inner = math.prod(scores[:axis]), math.prod(scores[axis + 1 :])
        self.classes = scores[axis]
        if math.prod(labels) != self.outer * self.inner:
            raise self.error(
                f"found {math.prod(labels)} labels, shape {labels}, for {self.outer * self.inner} predictions, shape "
                f"{scores}; expected one label (0 to {self.classes - 1}) per prediction along axis {axis}",
                "bottom",
                1,
            )

    def scores_and_labels(self, scores: torch.Tensor, labels: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return scores as (outer, classes, inner) and integer labels as (outer, inner)."""
        return scores.reshape(self.outer, self.classes, self.inner), labels.reshape(self.outer, self.inner).long()

    def valid(self, labels: torch.Tensor, ignore_label: int | None) -> torch.Tensor | None:
        """Return which labels count (None: all of them). Raises SpecError for a label that is not a class."""
        valid = None if ignore_label is None else labels != ignore_label
        counted = labels if valid is None else labels[valid]
        if counted.numel():
            low, high = (int(v) for v in torch.stack(counted.aminmax()).tolist())
            if low < 0 or high >= self.classes:
                wrong = low if low < 0 else high
                raise self.error(
                    f"found label {wrong}, expected 0 to {self.classes - 1}: the scores have {self.classes} classes",
                    "bottom",
                    1,
                )
        return valid


class ClassLoss(Loss, Classified):
    """Base of losses of scores, in which all axes but the first are the classes."""

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shapes = super().reshape(bottom_shapes)
        data, labels = bottom_shapes
        self.canonical_axis(0, data, "bottom")
        self.reshape_scores([(data[0], math.prod(data[1:])), labels], 1)
        return shapes


def ignore_label(param: Any) -> int | None:
    """Return the ignored label of a LossParameter or an AccuracyParameter."""
    return param.ignore_label if param.HasField("ignore_label") else None


def normalization_mode(loss_param: Any, default: int) -> int:
    """Return the mode: ``normalization`` wins over the older ``normalize``."""
    if loss_param.HasField("normalization"):
        return loss_param.normalization
    if loss_param.HasField("normalize"):
        return VALID if loss_param.normalize else BATCH_SIZE
    return default


def normalizer(mode: int, outer: int, inner: int, valid: torch.Tensor | None) -> torch.Tensor | float:
    """Return the divisor of a summed loss, at least 1."""
    if mode == VALID and valid is not None:
        return valid.sum().clamp(min=1)
    return float(max(1, {FULL: outer * inner, VALID: outer * inner, BATCH_SIZE: outer, NONE: 1}[mode]))

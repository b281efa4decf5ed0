"""Connectionist temporal classification for the dialect text: losses, and decoding.

Graves et al., Connectionist Temporal Classification, ICML 2006.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
import torch.nn.functional as F

from netspec.dialects.checks import check_at_least_1
from netspec.dialects.gradients import with_gradient_of
from netspec.layers import Layer
from netspec.layers.contract.base import Shape
from netspec.proto.schema import value

LOSS, DECODER = "ctc_loss_param", "ctc_decoder_param"


def check_scores(layer: Layer, scores: Shape) -> None:
    """Raise SpecError for scores that are not (T, N, C)."""
    if len(scores) < 3 or not scores[0] or any(size != 1 for size in scores[3:]):
        raise layer.error(f"found scores of shape {scores}, expected (T, N, C)", "bottom", 0)


def _collapsed(classes: Iterable[int], blank: int, merge: bool) -> list[int]:
    """Return the labels of a path without blanks; with ``merge``, runs of equal labels count once."""
    before, found = -1, []
    for each in classes:
        if each != blank and not (merge and each == before):
            found.append(each)
        before = each
    return found


def edit_distance(first: Sequence[int], second: Sequence[int]) -> int:
    """Return the minimum number of insertions, deletions and replacements between two sequences."""
    row = list(range(len(second) + 1))
    for i, a in enumerate(first, 1):
        above, row[0] = row[0], i
        for j, b in enumerate(second, 1):
            above, row[j] = row[j], min(row[j] + 1, row[j - 1] + 1, above + (a != b))
    return row[-1]


class CTCGreedyDecoder(Layer):
    """Decode the most probable class of each step, without blanks; runs of equal classes count once.

    With labels, compute the agreement instead: the mean of 1 - edit distance / the longer length, and the number of
    correct sequences. If probabilities are equal, the first class counts. blank_index: -1 is the last class.

    bottom[0]  probabilities or scores (T, N, C)
    bottom[1]  optional: labels (N, L) up to the first negative one; blanks among them are ignored
    top[0]     classes (N, T, 1, 1), -1 after the last; with labels, the agreement (1, 2, 1, 1)
    Fork: senlinuc/caffe_ocr, src/caffe/layers/ctc_decoder_layer.cpp
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({0, 1})
    not_exported = "how long a text is follows from the values"

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        scores = bottom_shapes[0]
        check_scores(self, scores)
        if len(bottom_shapes) > 1 and bottom_shapes[1][:1] != scores[1:2]:
            raise self.error(f"found labels of shape {bottom_shapes[1]}, expected ({scores[1]}, L)", "bottom", 1)
        return [(1, 2, 1, 1) if len(bottom_shapes) > 1 else (scores[1], scores[0], 1, 1)]

    def forward(self, scores: torch.Tensor, *labels: torch.Tensor) -> torch.Tensor:
        """Return the classes, or their agreement with the labels."""
        param = value(self.param, DECODER)
        blank = param.blank_index if param.blank_index >= 0 else scores.shape[2] - 1
        paths = first_maxima(scores.flatten(2)).T.tolist()
        found = [_collapsed(path, blank, param.ctc_merge_repeated) for path in paths]
        if not labels:
            top = scores.new_full(self.top_shapes[0], -1)
            for row, text in zip(top, found, strict=True):
                row[: len(text), 0, 0] = torch.tensor(text, dtype=top.dtype)
            return top
        wrong, right = 0.0, 0
        for text, row in zip(found, labels[0].reshape(len(found), -1).tolist(), strict=True):
            ended = next((i for i, label in enumerate(row) if label < 0), len(row))
            true = [int(label + 0.5) for label in row[:ended] if int(label + 0.5) != blank]
            if true or text:
                distance = edit_distance(true, text)
                wrong += distance / max(len(true), len(text))
                right += distance == 0
        return scores.new_tensor([1 - wrong / len(found), right / len(found)]).reshape(1, 2, 1, 1)


def first_maxima(scores: torch.Tensor) -> torch.Tensor:
    """Return the first index of the maximum along the last axis of scores (T, N, C): (T, N)."""
    return (scores == scores.amax(dim=2, keepdim=True)).byte().argmax(dim=2)


class LabelsequenceAccuracy(Layer):
    """The share of correct sequences, whose greedy decoding equals the labels without blanks.

    bottom[0]  scores (N, T, C)
    bottom[1]  labels (N, L)
    top[0]     the share of correct sequences, ()
    Fork: xmfbit/warpctc-caffe, src/caffe/layers/labelsequence_accuracy_layer.cpp
    """

    bottoms = (2, 2)
    label_bottoms = frozenset({0, 1})
    not_exported = "it is for tests"

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        scores, labels = bottom_shapes
        if len(scores) < 3 or labels[:1] != scores[:1]:
            raise self.error(f"found shapes {scores} and {labels}, expected (N, T, C) and (N, L)", "bottom")
        return [()]

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        blank = value(self.param, "labelsequence_accuracy_param").blank_label
        paths, texts = first_maxima(scores.flatten(2)).tolist(), labels.reshape(len(labels), -1).long().tolist()
        right = [
            _collapsed(path, blank, True) == [label for label in text if label != blank]
            for path, text in zip(paths, texts, strict=True)
        ]
        return scores.new_tensor(sum(right) / len(right))


class _CtcLoss(Layer):
    """Base of the two CTC losses."""

    is_loss = True
    label_bottoms = frozenset({1, 2, 3})
    not_exported = "it is for training"

    def loss(self, scores: torch.Tensor, texts: Sequence[Sequence[int]], steps: Sequence[int], blank: int) -> Any:
        """Return the mean of the costs, with the gradient of their sum, for the text and the steps of each sequence.

        Scores are (T, N, C). A text that does not fit costs 0, as in warp-ctc.
        """
        scores = scores.flatten(2)
        classes, labels = scores.shape[2], [label for text in texts for label in text]
        if wrong := [label for label in (*labels, blank) if not 0 <= label < classes]:
            raise self.error(f"found label {wrong[0]}, expected 0 to {classes - 1}", "bottom")
        if wrong := [count for count in steps if not 0 <= count <= len(scores)]:
            raise self.error(f"found {wrong[0]} steps, expected 0 to {len(scores)}", "bottom")
        flat = torch.tensor(labels, dtype=torch.long, device=scores.device)
        sizes: Any = list(steps), [len(text) for text in texts]
        total = F.ctc_loss(F.log_softmax(scores, 2), flat, sizes[0], sizes[1], blank, "sum", zero_infinity=True)
        return with_gradient_of(lambda: total, total / len(texts))


class CTCLoss(_CtcLoss):
    """The mean of -log of the probability of each text, which is the sum over all paths that collapse to it.

    The gradient is that of the sum, not of the mean, as in the forks. A text that is too long for its steps costs 0.
    With two bottoms, all steps are used, and labels equal to blank_index are ignored. With three, the
    format is that of the fork's data.

    bottom[0]  scores (T, N, C), before the softmax
    bottom[1]  labels (N, L); with three bottoms: 0 where a sequence begins, else 1 (T, N); with four: number of steps
               of each sequence (N,)
    bottom[2]  with three: labels (T, N), negative after the last, counted from 0 without a blank if blank_index is
               0; with four: lengths of the texts (N,)
    bottom[3]  with four: labels (L, N)
    top[0]     the loss, ()
    Fork: senlinuc/caffe_ocr, src/caffe/layers/warp_ctc_loss_layer.cpp; ChWick/caffe, ctc_loss_layer.cpp
    """

    bottoms = (2, 4)

    def setup(self) -> None:
        """Raise SpecError for settings that warp-ctc does not support."""
        param = value(self.param, LOSS)
        if param.output_delay or param.preprocess_collapse_repeated or not param.ctc_merge_repeated:
            raise self.error(
                "output_delay, preprocess_collapse_repeated and ctc_merge_repeated: false are not known", LOSS
            )
        self.blank: int = param.blank_index

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the scalar top; the bottoms must have equal numbers of sequences."""
        scores, *others = bottom_shapes
        check_scores(self, scores)
        items = scores[1]
        axes = {1: [0], 2: [1, 1], 3: [0, 0, 1]}[len(others)]
        for i, (shape, axis) in enumerate(zip(others, axes, strict=True), 1):
            if shape[axis : axis + 1] != (items,):
                raise self.error(f"found shape {shape}, expected {items} sequences along axis {axis}", "bottom", i)
        return [()]

    def forward(self, scores: torch.Tensor, *others: torch.Tensor) -> torch.Tensor:
        count, items, classes = scores.shape[:3]
        blank = self.blank if self.blank >= 0 else classes - 1
        rows = [other.detach().reshape(other.shape[0], -1).cpu() for other in others]
        if len(others) == 1:
            texts = [[int(label) for label in row if int(label) != blank] for row in rows[0].tolist()]
            return self.loss(scores, texts, [count] * items, blank)
        if len(others) == 3:
            steps, lengths = (each.flatten().long().tolist() for each in rows[:2])
            texts = [rows[2][:length, n].long().tolist() for n, length in enumerate(lengths)]
            return self.loss(scores, texts, steps, blank)
        shift, steps, texts = int(blank == 0), [], []
        for goes_on, labels in zip(rows[0].T.tolist(), rows[1].T.tolist(), strict=True):
            begun = next((t for t, c in enumerate(goes_on) if t and int(c + 0.5) == 0), count)
            ended = next((t for t, label in enumerate(labels) if label < 0), len(labels))
            texts.append([int(label + 0.5) + shift for label in labels[:ended]])
            steps.append(begun if ended else 0)
        return self.loss(scores, texts, steps, blank)


class CtcLoss(_CtcLoss):
    """The CTC loss of xmfbit/warpctc-caffe: the mean of -log of the probability of each text, over all time_step steps.

    The gradient is that of the sum, not of the mean, as in the fork.

    bottom[0]  scores (T, N, alphabet_size), before the softmax
    bottom[1]  labels (N, L); those equal to blank_label are ignored
    top[0]     the loss, ()
    Fork: xmfbit/warpctc-caffe, src/caffe/layers/ctc_loss_layer.cpp
    """

    bottoms = (2, 2)

    def setup(self) -> None:
        self.settings = value(self.param, LOSS)
        check_at_least_1(self, LOSS, "alphabet_size", "time_step")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        scores, labels = bottom_shapes
        check_scores(self, scores)
        param = self.settings
        if labels[:1] != scores[1:2] or scores[2] != param.alphabet_size or scores[0] < param.time_step:
            expected = f"({param.time_step}, N, {param.alphabet_size}) and (N, L)"
            raise self.error(f"found shapes {scores} and {labels}, expected {expected}", "bottom")
        return [()]

    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        blank = self.settings.blank_label
        texts = [
            [int(label) for label in row if int(label) != blank] for row in labels.reshape(len(labels), -1).tolist()
        ]
        return self.loss(scores, texts, [self.settings.time_step] * len(texts), blank)

"""Reading text: connectionist temporal classification (CTC), sequences turned around, an LSTM with one bias.

Forks: ChWick/caffe and senlinuc/caffe_ocr; xmfbit/warpctc-caffe; junhyukoh/caffe-lstm (Lstm). Graves et al.,
Connectionist Temporal Classification, ICML 2006.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.layers import Layer, register
from netspec.layers.base import Shape
from netspec.layers.targets import OnnxGraph, TorchCode
from netspec.proto.schema import has, value

DECLARATIONS = """
message ContinuationIndicatorParameter {
  optional uint32 time_step = 1 [default = 0];
  optional uint32 batch_size = 2 [default = 0];
}
message ReverseParameter {
  optional int32 axis = 1 [default = 0];
}
message ReverseTimeParameter {
  optional bool copy_remaining = 1 [default = false];
}
message CTCDecoderParameter {
  optional int32 blank_index = 1 [default = 0];
  optional bool ctc_merge_repeated = 2 [default = true];
}
message CTCLossParameter {
  optional int32 output_delay = 1 [default = 0];
  optional int32 blank_index = 2 [default = 0];
  optional bool preprocess_collapse_repeated = 3 [default = false];
  optional bool ctc_merge_repeated = 4 [default = true];
  optional int32 loss_calculation_t = 5 [default = 0];
  // xmfbit/warpctc-caffe
  optional uint32 alphabet_size = 11 [default = 0];
  optional uint32 time_step = 12 [default = 0];
  optional int32 blank_label = 13 [default = 0];
}
message LabelsequenceAccuracyParameter {
  optional int32 blank_label = 1 [default = 0];
}
message LSTMParameter {
  optional uint32 num_output = 1;
  optional float clipping_threshold = 2 [default = 0];
  optional FillerParameter weight_filler = 3;
  optional FillerParameter bias_filler = 4;
  optional uint32 batch_size = 5 [default = 1];
}
extend LayerParameter {
  optional ContinuationIndicatorParameter continuation_indicator_param = 1170;
  optional ReverseParameter reverse_param = 1171;
  optional ReverseTimeParameter reverse_time_param = 1172;
  optional CTCDecoderParameter ctc_decoder_param = 1173;
  optional CTCLossParameter ctc_loss_param = 1174;
  optional LabelsequenceAccuracyParameter labelsequence_accuracy_param = 1175;
  optional LSTMParameter lstm_param = 1176;
}
"""

LOSS, DECODER = "ctc_loss_param", "ctc_decoder_param"


@register("ContinuationIndicator", "continuation_indicator_param")
class ContinuationIndicator(Layer):
    """Say where sequences go on, for a recurrent layer: 0 at the first step, 1 at all others.

    bottom[i]  optional, not read
    top[0]     (time_step, batch_size)
    Fork: xmfbit/warpctc-caffe, src/caffe/layers/continuation_indicator_layer.cpp
    """

    bottoms = (0, 1)
    label_bottoms = frozenset({0})

    @override
    def setup(self) -> None:
        param = value(self.param, "continuation_indicator_param")
        for name in ("time_step", "batch_size"):
            if getattr(param, name) < 1:
                raise self.error(f"{name} must be given and be at least 1", "continuation_indicator_param", name)
        self.size = (param.time_step, param.batch_size)

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return [self.size]

    @override
    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        top = torch.ones(self.size, device=self.context.device)
        top[0] = 0
        return top

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.constant(self.forward().cpu())

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.call("torch.ones({size}).index_fill(0, torch.tensor([0]), 0)", size=self.size)


@register("Reverse", "reverse_param")
class Reverse(Layer):
    """Turn an axis around: what was first is last. By default axis 0, the time.

    bottom[0]  any shape
    top[0]     the same shape
    Fork: senlinuc/caffe_ocr, src/caffe/layers/reverse_layer.cpp
    """

    @override
    def setup(self) -> None:
        self.axis = self.canonical_axis(value(self.param, "reverse_param").axis, self.bottom_shapes[0], "reverse_param")

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return bottom_shapes

    @override
    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data.flip(self.axis)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        first, last, step = (graph.constant([n]) for n in (-1, -(2**31), -1))
        return graph.node("Slice", bottoms[0], first, last, graph.constant([self.axis]), step)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.call("{x}.flip({axis})", x=bottoms[0], axis=self.axis)


@register("ReverseTime", "reverse_time_param")
class ReverseTime(Layer):
    """Turn the first steps of each sequence around; what lies behind is copied with copy_remaining, else 0.

    bottom[0]  sequences (T, N, ...)
    bottom[1]  how many steps each has (N,); gets no gradient
    top[0]     the shape of bottom[0]
    Fork: senlinuc/caffe_ocr, src/caffe/layers/reverse_time_layer.cpp, which leaves what lies behind unwritten
    """

    bottoms = (2, 2)
    label_bottoms = frozenset({1})

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        data, lengths = bottom_shapes
        if lengths != data[1:2]:
            raise self.error(f"found lengths of shape {lengths}, expected {data[1:2]}", "bottom", 1)
        return [data]

    @override
    def forward(self, data: torch.Tensor, lengths: torch.Tensor) -> torch.Tensor:
        steps, length = torch.arange(len(data), device=data.device)[:, None], lengths.long().clamp(0, len(data))
        inside = steps < length
        source = torch.where(inside, length - 1 - steps, steps)
        extra = (1,) * (data.dim() - 2)
        top = data.gather(0, source.reshape(*source.shape, *extra).expand_as(data))
        copies = value(self.param, "reverse_time_param").copy_remaining
        return top if copies else top * inside.reshape(*inside.shape, *extra)


def _collapsed(classes: Iterable[int], blank: int, merge: bool) -> list[int]:
    """Return a path's labels: without blanks, and with ``merge`` one of each run of equal ones."""
    before, found = -1, []
    for each in classes:
        if each != blank and not (merge and each == before):
            found.append(each)
        before = each
    return found


def edit_distance(first: Sequence[int], second: Sequence[int]) -> int:
    """Return the fewest insertions, deletions and replacements that make one sequence of the other."""
    row = list(range(len(second) + 1))
    for i, a in enumerate(first, 1):
        above, row[0] = row[0], i
        for j, b in enumerate(second, 1):
            above, row[j] = row[j], min(row[j] + 1, row[j - 1] + 1, above + (a != b))
    return row[-1]


@register("CTCGreedyDecoder", DECODER)
class CTCGreedyDecoder(Layer):
    """Read off the most probable class of each step: without blanks, and one of each run of equal ones.

    With labels, say instead how well that agrees with them: 1 - edit distance / the longer length, as a mean, and how
    many are right. Of equal probabilities the first class counts. blank_index: -1 is the last class.

    bottom[0]  probabilities or scores (T, N, C)
    bottom[1]  optional: labels (N, L), blanks among them not counted; they end at the first negative one
    top[0]     classes (N, T, 1, 1), -1 after the last; with labels the agreement (1, 2, 1, 1)
    Fork: senlinuc/caffe_ocr, src/caffe/layers/ctc_decoder_layer.cpp
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({0, 1})
    not_exported = "how long a text is follows from the values"

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        scores = bottom_shapes[0]
        if len(scores) < 3 or any(size != 1 for size in scores[3:]):
            raise self.error(f"found scores of shape {scores}, expected (T, N, C)", "bottom", 0)
        if len(bottom_shapes) > 1 and bottom_shapes[1][:1] != scores[1:2]:
            raise self.error(f"found labels of shape {bottom_shapes[1]}, expected ({scores[1]}, L)", "bottom", 1)
        return [(1, 2, 1, 1) if len(bottom_shapes) > 1 else (scores[1], scores[0], 1, 1)]

    @override
    def forward(self, scores: torch.Tensor, *labels: torch.Tensor) -> torch.Tensor:
        """Return the classes, or how well they agree with the labels."""
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
        for text, row in zip(found, labels[0].flatten(1).tolist(), strict=True):
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


@register("LabelsequenceAccuracy", "labelsequence_accuracy_param")
class LabelsequenceAccuracy(Layer):
    """Say how many sequences are read without a fault: the greedy decoding equals the labels without blanks.

    bottom[0]  scores (T, N, C)
    bottom[1]  labels (N, L)
    top[0]     the share of right ones, ()
    Fork: xmfbit/warpctc-caffe, src/caffe/layers/labelsequence_accuracy_layer.cpp
    """

    bottoms = (2, 2)
    label_bottoms = frozenset({0, 1})
    not_exported = "it is for tests"

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        scores, labels = bottom_shapes
        if len(scores) < 3 or labels[:1] != scores[1:2]:
            raise self.error(f"found shapes {scores} and {labels}, expected (T, N, C) and (N, L)", "bottom")
        return [()]

    @override
    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        blank = value(self.param, "labelsequence_accuracy_param").blank_label
        paths, texts = first_maxima(scores.flatten(2)).T.tolist(), labels.flatten(1).long().tolist()
        right = [
            _collapsed(path, blank, True) == [label for label in text if label != blank]
            for path, text in zip(paths, texts, strict=True)
        ]
        return scores.new_tensor(sum(right) / len(right))


class _Ctc(torch.autograd.Function):
    """The mean of the costs, 0 for a text that does not fit; the gradient is that of their sum, as warp-ctc's is."""

    @staticmethod
    @override
    def forward(ctx: Any, scores: torch.Tensor, given: tuple[Any, ...], blank: int) -> torch.Tensor:
        flat, steps, lengths = given
        with torch.enable_grad():
            leaf = scores.detach().requires_grad_()
            costs = F.ctc_loss(F.log_softmax(leaf, 2), flat, steps, lengths, blank, "none", zero_infinity=True)
            total = costs.sum()
        ctx.save_for_backward(*(torch.autograd.grad(total, leaf) if scores.requires_grad else ()))
        return total.detach() / len(lengths)

    @staticmethod
    @override
    def backward(ctx: Any, *grads: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return ctx.saved_tensors[0] * grads[0], None, None


class _CtcLoss(Layer):
    """Base of the two CTC losses: what they share is computed by :class:`_Ctc`."""

    is_loss = True
    label_bottoms = frozenset({1, 2, 3})
    not_exported = "it is for training"

    def check_scores(self, scores: Shape) -> None:
        """Refuse scores that are not (T, N, C)."""
        if len(scores) < 3 or any(size != 1 for size in scores[3:]):
            raise self.error(f"found scores of shape {scores}, expected (T, N, C)", "bottom", 0)

    def loss(self, scores: torch.Tensor, texts: Sequence[Sequence[int]], steps: Sequence[int], blank: int) -> Any:
        """Return the loss of scores (T, N, C) for a text and a number of steps of each sequence."""
        scores = scores.flatten(2)
        classes, labels = scores.shape[2], [label for text in texts for label in text]
        if wrong := [label for label in labels if not 0 <= label < classes]:
            raise self.error(f"found label {wrong[0]}, expected 0 to {classes - 1}", "bottom")
        flat = torch.tensor(labels, dtype=torch.long, device=scores.device)
        return _Ctc.apply(scores, (flat, list(steps), [len(text) for text in texts]), blank)


@register("CTCLoss", LOSS)
class CTCLoss(_CtcLoss):
    """-log of the probability of a text: the sum over all paths through the steps that collapse to it, as a mean.

    The gradient is that of the sum, not of the mean, as in the forks. A text that does not fit its steps costs 0.
    Two bottoms: all steps count, and labels equal to blank_index are left out. Three: as the fork's own data are.

    bottom[0]  scores (T, N, C), before the softmax
    bottom[1]  labels (N, L); with three bottoms: 0 where a sequence begins, 1 where it goes on (T, N); with four: steps
               of each sequence (N,)
    bottom[2]  with three: labels (T, N), negative after the last, counted from 0 without a blank where blank_index is
               0; with four: lengths of the texts (N,)
    bottom[3]  with four: labels (L, N)
    top[0]     the loss, ()
    Fork: senlinuc/caffe_ocr, src/caffe/layers/warp_ctc_loss_layer.cpp; ChWick/caffe, ctc_loss_layer.cpp
    """

    bottoms = (2, 4)

    @override
    def setup(self) -> None:
        """Refuse what warp-ctc does not compute."""
        param = value(self.param, LOSS)
        if param.output_delay or param.preprocess_collapse_repeated or not param.ctc_merge_repeated:
            raise self.error(
                "output_delay, preprocess_collapse_repeated and ctc_merge_repeated: false are not known", LOSS
            )
        self.blank: int = param.blank_index

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the scalar top's shape; the bottoms must have as many sequences."""
        scores, *others = bottom_shapes
        self.check_scores(scores)
        items = scores[1]
        axes = {1: [0], 2: [1, 1], 3: [0, 0, 1]}[len(others)]
        for i, (shape, axis) in enumerate(zip(others, axes, strict=True), 1):
            if shape[axis : axis + 1] != (items,):
                raise self.error(f"found shape {shape}, expected {items} sequences along axis {axis}", "bottom", i)
        return [()]

    @override
    def forward(self, scores: torch.Tensor, *others: torch.Tensor) -> torch.Tensor:
        """Return the loss."""
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


@register("WarpCTCLoss", LOSS)
class WarpCTCLoss(CTCLoss):
    """CTCLoss by another name.

    bottom[0]  scores (T, N, C), before the softmax
    bottom[i]  as CTCLoss has them
    top[0]     the loss, ()
    Fork: senlinuc/caffe_ocr, src/caffe/layers/warp_ctc_loss_layer.cpp
    """


@register("CtcLoss", LOSS)
class CtcLoss(_CtcLoss):
    """The CTC loss of xmfbit/warpctc-caffe: -log of the probability of a text, as a mean; all of time_step steps count.

    The gradient is that of the sum, not of the mean, as in the fork.

    bottom[0]  scores (T, N, alphabet_size), before the softmax
    bottom[1]  labels (N, L), those equal to blank_label left out
    top[0]     the loss, ()
    Fork: xmfbit/warpctc-caffe, src/caffe/layers/ctc_loss_layer.cpp
    """

    bottoms = (2, 2)

    @override
    def setup(self) -> None:
        self.settings = param = value(self.param, LOSS)
        for name in ("alphabet_size", "time_step"):
            if getattr(param, name) < 1:
                raise self.error(f"{name} must be given and be at least 1", LOSS, name)

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        scores, labels = bottom_shapes
        self.check_scores(scores)
        param = self.settings
        if labels[:1] != scores[1:2] or scores[2] != param.alphabet_size or scores[0] < param.time_step:
            expected = f"({param.time_step}, N, {param.alphabet_size}) and (N, L)"
            raise self.error(f"found shapes {scores} and {labels}, expected {expected}", "bottom")
        return [()]

    @override
    def forward(self, scores: torch.Tensor, labels: torch.Tensor) -> torch.Tensor:
        blank = self.settings.blank_label
        texts = [[int(label) for label in row if int(label) != blank] for row in labels.flatten(1).tolist()]
        return self.loss(scores, texts, [self.settings.time_step] * len(texts), blank)


@register("Lstm", "lstm_param")
class Lstm(Layer):
    """An LSTM over all steps, from a state of zeros; its gates in the order input, forget, output, new.

    With bottom[1] a sequence may go on from the last pass: where that is 0, a new one begins.

    bottom[0]  (T, N, C)
    bottom[1]  optional: 0 where a sequence begins, 1 where it goes on (T, N); gets no gradient
    top[0]     (T, N, num_output)
    blobs[0]   weights of the input (4 num_output, C)
    blobs[1]   weights of the state (4 num_output, num_output)
    blobs[2]   biases (4 num_output,)
    Fork: junhyukoh/caffe-lstm; senlinuc/caffe_ocr, src/caffe/layers/lstm_layer_Junhyuk.cpp
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({1})
    not_exported = "its steps are a loop"

    @property
    def remembers(self) -> bool:
        """Whether it goes on from one pass to the next."""
        return len(self.bottom_shapes) > 1

    @override
    def setup(self) -> None:
        """Make the blobs; the state begins at 0."""
        param, shape = value(self.param, "lstm_param"), self.bottom_shapes[0]
        if param.num_output < 1:
            raise self.error("num_output must be given and be at least 1", "lstm_param", "num_output")
        if len(shape) != 3:
            raise self.error(f"found a bottom of shape {shape}, expected (T, N, C)", "bottom", 0)
        self.size, self.clip = param.num_output, param.clipping_threshold
        for sizes, name in (((shape[2],), "weight_filler"), ((self.size,), "weight_filler"), ((), "bias_filler")):
            self.add_blob((4 * self.size, *sizes), getattr(param, name) if has(param, name) else None)
        self.state: tuple[torch.Tensor, ...] = ()

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        data, *begins = bottom_shapes
        if len(data) != 3 or data[2] != self.blob_shapes[0][1]:
            raise self.error(f"found a bottom of shape {data}, expected (T, N, {self.blob_shapes[0][1]})", "bottom", 0)
        if begins and begins[0][:2] != data[:2]:
            raise self.error(f"found a bottom of shape {begins[0]}, expected {data[:2]}", "bottom", 1)
        return [(*data[:2], self.size)]

    @override
    def forward(self, data: torch.Tensor, *begins: torch.Tensor) -> torch.Tensor:
        """Return the outputs of all steps."""
        of_input, of_state, bias = (self.blob(i) for i in range(3))
        gates = data @ of_input.T + bias
        zeros = data.new_zeros(2, data.shape[1], self.size)
        h, c = self.state if begins and self.state and self.state[0].shape == zeros[0].shape else zeros.unbind()
        goes_on = begins[0].detach().reshape(data.shape[:2]) != 0 if begins else None
        tops = []
        for t, gate in enumerate(gates.unbind()):
            before = c
            if goes_on is not None:
                kept = goes_on[t, :, None]
                gate, before = torch.where(kept, gate + h @ of_state.T, gate), torch.where(kept, c, 0)
            elif t > 0:
                gate = gate + h @ of_state.T
            if self.clip > 0 and gate.requires_grad:
                gate.register_hook(lambda diff: diff.clamp(-self.clip, self.clip))
            i, f, o = gate[:, : 3 * self.size].sigmoid().chunk(3, dim=1)
            c = f * before + i * gate[:, 3 * self.size :].tanh()
            h = o * c.tanh()
            tops.append(h)
        if begins:
            self.state = (h.detach(), c.detach())
        return torch.stack(tops)

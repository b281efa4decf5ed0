"""Text recognition: connectionist temporal classification (CTC), reversed sequences, an LSTM with one bias.

Forks: ChWick/caffe and senlinuc/caffe_ocr; xmfbit/warpctc-caffe; junhyukoh/caffe-lstm (Lstm). Graves et al.,
Connectionist Temporal Classification, ICML 2006.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch

from netspec.dialects.checks import check_at_least_1
from netspec.dialects.text.ctc import (
    DECODER,
    LOSS,
    CTCGreedyDecoder,
    CTCLoss,
    CtcLoss,
    LabelsequenceAccuracy,
)
from netspec.layers import Layer, register
from netspec.layers.activation import Activation
from netspec.layers.contract.base import Shape, State
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


@register("ContinuationIndicator", "continuation_indicator_param")
class ContinuationIndicator(Layer):
    """The continuation indicator for a recurrent layer: 0 at the first step, 1 at all others.

    bottom[i]  optional, not used
    top[0]     (time_step, batch_size)
    Fork: xmfbit/warpctc-caffe, src/caffe/layers/continuation_indicator_layer.cpp
    """

    bottoms = (0, 1)
    label_bottoms = frozenset({0})

    def setup(self) -> None:
        param = value(self.param, "continuation_indicator_param")
        check_at_least_1(self, "continuation_indicator_param", "time_step", "batch_size")
        self.size = (param.time_step, param.batch_size)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return [self.size]

    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        top = torch.ones(self.size, device=self.context.device)
        top[0] = 0
        return top


@register("Reverse", "reverse_param")
class Reverse(Activation):
    """Reverse an axis, by default axis 0, the time.

    bottom[0]  any shape
    top[0]     the same shape
    Fork: senlinuc/caffe_ocr, src/caffe/layers/reverse_layer.cpp
    """

    def setup(self) -> None:
        self.axis = self.canonical_axis(value(self.param, "reverse_param").axis, self.bottom_shapes[0], "reverse_param")

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data.flip(self.axis)


@register("ReverseTime", "reverse_time_param")
class ReverseTime(Layer):
    """Reverse the first steps of each sequence. The other steps are copied with copy_remaining; otherwise they are 0.

    bottom[0]  sequences (T, N, ...)
    bottom[1]  the number of steps of each sequence (N,); gets no gradient
    top[0]     the shape of bottom[0]
    Fork: senlinuc/caffe_ocr, src/caffe/layers/reverse_time_layer.cpp, which does not write the other steps
    """

    bottoms = (2, 2)
    label_bottoms = frozenset({1})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        data, lengths = bottom_shapes
        if lengths != data[1:2]:
            raise self.error(f"found lengths of shape {lengths}, expected {data[1:2]}", "bottom", 1)
        return [data]

    def forward(self, data: torch.Tensor, lengths: torch.Tensor) -> torch.Tensor:
        steps, length = torch.arange(len(data), device=data.device)[:, None], lengths.long().clamp(0, len(data))
        inside = steps < length
        source = torch.where(inside, length - 1 - steps, steps)
        extra = (1,) * (data.dim() - 2)
        top = data.gather(0, source.reshape(*source.shape, *extra).expand_as(data))
        copies = value(self.param, "reverse_time_param").copy_remaining
        return top if copies else top.masked_fill(~inside.reshape(*inside.shape, *extra), 0)  # also where it is NaN


@register("Lstm", "lstm_param")
class Lstm(Layer):
    """An LSTM over all steps with zero initial state; the order of the gates is input, forget, output, candidate.

    With bottom[1], a sequence can continue from the previous pass; a new one begins where bottom[1] is 0.

    bottom[0]  (T, N, C); in junhyukoh's fork (T N, C), with N in batch_size
    bottom[1]  optional: 0 where a sequence begins, else 1 (T, N), or (T N, 1); gets no gradient
    top[0]     (T, N, num_output), or (T N, num_output)
    blobs[0]   weights of the input (4 num_output, C)
    blobs[1]   weights of the state (4 num_output, num_output)
    blobs[2]   biases (4 num_output,)
    Fork: junhyukoh/caffe-lstm; senlinuc/caffe_ocr, src/caffe/layers/lstm_layer_Junhyuk.cpp
    """

    bottoms = (1, 2)
    label_bottoms = frozenset({1})
    not_exported = "its steps are a loop"

    @property
    def changes_itself(self) -> bool:
        """Whether the state continues in the next pass."""
        return len(self.bottom_shapes) > 1

    def setup(self) -> None:
        """Add the blobs; the initial state is 0."""
        param, shape = value(self.param, "lstm_param"), self.bottom_shapes[0]
        check_at_least_1(self, "lstm_param", "num_output")
        if len(shape) not in (2, 3) or not shape[0]:
            raise self.error(f"found a bottom of shape {shape}, expected (T, N, C) or (T N, C)", "bottom", 0)
        self.size, self.clip, self.items = param.num_output, param.clipping_threshold, param.batch_size
        for sizes, name in (((shape[-1],), "weight_filler"), ((self.size,), "weight_filler"), ((), "bias_filler")):
            self.add_blob((4 * self.size, *sizes), getattr(param, name) if has(param, name) else None)
        self.state: tuple[torch.Tensor, ...] = ()

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        data, *begins = bottom_shapes
        columns = self.blob_shapes[0][1]
        if data[-1] != columns or len(data) != len(self.bottom_shapes[0]):
            raise self.error(f"found a bottom of shape {data}, expected {columns} columns", "bottom", 0)
        if len(data) == 2 and (self.items < 1 or data[0] % self.items):
            message = f"found {data[0]} rows, expected a multiple of batch_size {self.items}"
            raise self.error(message, "bottom", 0)
        if begins and (math.prod(begins[0]) != math.prod(data[:-1]) or begins[0][0] != data[0]):
            raise self.error(f"found a bottom of shape {begins[0]}, expected {data[:-1]}", "bottom", 1)
        return [(*data[:-1], self.size)]

    def forward(self, data: torch.Tensor, *begins: torch.Tensor) -> torch.Tensor:
        of_input, of_state, bias = (self.blob(i) for i in range(3))
        shape = (*data.shape[:-1], self.size)
        data = data if data.dim() == 3 else data.reshape(-1, self.items, data.shape[1])
        gates = data @ of_input.T + bias
        zeros = data.new_zeros(2, data.shape[1], self.size)
        h, c = self.state if begins and self.state and self.state[0].shape == zeros[0].shape else zeros.unbind()
        continues = begins[0].detach().reshape(data.shape[:2]) != 0 if begins else None
        tops = []
        for t, gate in enumerate(gates.unbind()):
            before = c
            if continues is not None:
                kept = continues[t, :, None]
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
        return torch.stack(tops).reshape(shape)

    def running_state(self) -> State:
        return {"state": self.state} if self.changes_itself else {}

    def resume(self, state: Mapping[str, Any]) -> None:
        items = self.bottom_shapes[0][1] if len(self.bottom_shapes[0]) == 3 else self.items
        found, shape = state["state"], (items, self.size)
        if found and [s.shape for s in found] != [shape] * 2:
            raise self.error(f"found states of shapes {[tuple(s.shape) for s in found]}, expected 2 of {shape}")
        self.state = tuple(s.to(self.context.device) for s in found)


register("CTCGreedyDecoder", DECODER)(CTCGreedyDecoder)
register("LabelsequenceAccuracy", "labelsequence_accuracy_param")(LabelsequenceAccuracy)
register("CTCLoss", LOSS)(CTCLoss)
register("WarpCTCLoss", LOSS)(type("WarpCTCLoss", (CTCLoss,), {"__doc__": CTCLoss.__doc__}))
register("CtcLoss", LOSS)(CtcLoss)

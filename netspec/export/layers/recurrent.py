"""Exporters of RNN, LSTM, LSTMUnit."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.export.exporter import Exporter, exports
from netspec.export.expression import Expression, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.recurrent import LSTM, RNN, LSTMUnit

# These functions are copied into exported source code.


def rnn(x, cont, w_x, bias, w_h, w_o, bias_o, x_static, w_static, h):
    """Return the outputs (T, N, D) and the last state of a recurrent net.

    Where cont (T, N) is 0 a sequence begins.
    """
    inputs = F.linear(x, w_x, bias)
    if x_static is not None:
        inputs = inputs + F.linear(x_static, w_static)
    h = inputs.new_zeros(x.shape[1], w_h.shape[1]) if h is None else h[0]
    outputs = []
    for t in range(x.shape[0]):
        h = torch.tanh(inputs[t] + F.linear(cont[t, :, None] * h, w_h))
        outputs.append(torch.tanh(F.linear(h, w_o, bias_o)))
    return torch.stack(outputs), h[None]


def lstm(x, cont, w_x, bias, w_h, x_static, w_static, h, c):
    """Return the outputs (T, N, D) and the last states of an LSTM.

    Where cont (T, N) is 0 a sequence begins. The gates are input, forget, output and
    candidate.
    """
    inputs = F.linear(x, w_x, bias)
    if x_static is not None:
        inputs = inputs + F.linear(x_static, w_static)
    zeros = inputs.new_zeros(x.shape[1], w_h.shape[1])
    h, c = (zeros, zeros) if h is None else (h[0], c[0])
    outputs = []
    for t in range(x.shape[0]):
        keep = cont[t, :, None]
        i, f, o, g = (inputs[t] + F.linear(keep * h, w_h)).chunk(4, dim=1)
        c = keep * torch.sigmoid(f) * c + torch.sigmoid(i) * torch.tanh(g)
        h = torch.sigmoid(o) * torch.tanh(c)
        outputs.append(h)
    return torch.stack(outputs), h[None], c[None]


def lstm_unit(cell, gates, cont):
    """Return the next cell and hidden state; the gates are input, forget, output and candidate."""
    i, f, o, g = gates.chunk(4, dim=-1)
    cell = cont * torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(g)
    return cell, torch.sigmoid(o) * torch.tanh(cell)


class RecurrentExport(Exporter):
    torch_function: Callable[..., Any]
    blob_names: ClassVar[tuple[str, ...]]

    @property
    def export_note(self) -> str:
        """Return a note that the state is lost between runs; with expose_hidden, it is an input and an output."""
        if self.layer.exposed:
            return ""
        names = ", ".join(self.layer.state_names)
        return f"its state ({names}) starts at zero in every run; in Caffe it continues in the next run if cont is 1"

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        layer = self.layer
        steps = graph.size(0, 0, "its time steps are unrolled")
        streams = graph.size(0, 1, "its state has a row for each stream")
        x, cont, *others = bottoms
        rows = layer.gates * layer.hidden
        vectors = graph.reshape(x, [steps * streams, math.prod(layer.bottom_shapes[0][2:])])
        inputs = graph.node("Gemm", vectors, graph.blob(0), graph.blob(1), transB=1)
        inputs = graph.reshape(inputs, [steps, streams, rows])
        if layer.has_static:
            static = graph.node("Flatten", others[0], axis=1)
            inputs = graph.node("Add", inputs, graph.node("Gemm", static, graph.blob(2), transB=1))
        keep = graph.reshape(cont, [steps, streams, 1])
        state = list(others[layer.has_static :])
        if not layer.exposed:
            state = [graph.constant(torch.zeros(1, streams, layer.hidden))] * len(layer.state_names)
        ones = graph.constant([1] * steps)
        parts = [
            [value] if steps == 1 else graph.nodes("Split", value, ones, outputs=steps, axis=0)
            for value in (inputs, keep)
        ]
        outputs = []
        for gate_input, kept in zip(*parts, strict=True):
            output, state = self.onnx_step(graph, gate_input, kept, state)
            outputs.append(output)
        top = outputs[0] if steps == 1 else graph.node("Concat", *outputs, axis=0)
        return (top, *state) if layer.exposed else (top,)

    def onnx_step(self, graph: OnnxGraph, inputs: str, keep: str, state: Sequence[str]) -> tuple[str, list[str]]:
        """Write one time step like :meth:`step`, with an axis of size 1 before the streams."""
        raise NotImplementedError

    def onnx_product(self, graph: OnnxGraph, value: str, blob: int) -> str:
        """Return the product with a learnable matrix."""
        return graph.node("MatMul", value, graph.node("Transpose", graph.blob(blob), perm=[1, 0]))

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Expression | Sequence[Expression]:
        layer = self.layer
        x, cont, *others = bottoms
        names = [name for name in self.blob_names if layer.has_static or name != "w_static"]
        weights = [code.parameter(i, name=name) for i, name in enumerate(names)]
        static = [others[0].flatten(1), weights.pop(2)] if layer.has_static else [None, None]
        state = others[layer.has_static :] or [None] * len(layer.state_names)
        x = x if len(layer.bottom_shapes[0]) == 3 else x.flatten(2)
        made = call(self.torch_function, x, cont, *weights, *static, *state)
        return made if layer.exposed else (made[0],)


@exports(RNN)
class RNNExport(RecurrentExport):
    torch_function = staticmethod(rnn)
    blob_names = ("w_x", "bias", "w_static", "w_h", "w_o", "bias_o")

    @override
    def onnx_step(self, graph: OnnxGraph, inputs: str, keep: str, state: Sequence[str]) -> tuple[str, list[str]]:
        hidden = 2 + self.layer.has_static
        kept = graph.node("Mul", keep, state[0])
        h = graph.node("Tanh", graph.node("Add", inputs, self.onnx_product(graph, kept, hidden)))
        output = graph.node("Add", self.onnx_product(graph, h, hidden + 1), graph.blob(hidden + 2))
        return graph.node("Tanh", output), [h]


def _onnx_unit(graph: OnnxGraph, cell: str, gate_input: str, keep: str, units: int) -> tuple[str, str]:
    """Write what :func:`netspec.exact.pointwise.lstm_unit` computes."""
    parts = graph.constant([units] * 4)
    i, f, o, g = graph.nodes("Split", gate_input, parts, outputs=4, axis=-1)
    i, f, o = (graph.node("Sigmoid", gate) for gate in (i, f, o))
    kept = graph.node("Mul", graph.node("Mul", keep, f), cell)
    cell = graph.node("Add", kept, graph.node("Mul", i, graph.node("Tanh", g)))
    return cell, graph.node("Mul", o, graph.node("Tanh", cell))


@exports(LSTM)
class LSTMExport(RecurrentExport):
    torch_function = staticmethod(lstm)
    blob_names = ("w_x", "bias", "w_static", "w_h")

    @override
    def onnx_step(self, graph: OnnxGraph, inputs: str, keep: str, state: Sequence[str]) -> tuple[str, list[str]]:
        h, c = state
        recurrent = self.onnx_product(graph, graph.node("Mul", keep, h), 2 + self.layer.has_static)
        c, h = _onnx_unit(graph, c, graph.node("Add", inputs, recurrent), keep, self.layer.hidden)
        return h, [h, c]


@exports(LSTMUnit)
class LSTMUnitExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        cell, gates, cont = bottoms
        keep = graph.node("Unsqueeze", cont, graph.constant([2]))
        return _onnx_unit(graph, cell, gates, keep, self.layer.bottom_shapes[0][2])

    def to_torch(self, code: TorchCode, cell: Expression, gates: Expression, cont: Expression) -> Expression:
        return call(lstm_unit, cell, gates, cont[..., None])

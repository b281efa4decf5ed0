"""The expressions of RNN, LSTM, LSTMUnit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
import torch.nn.functional as F

from netspec.export.exporter import exports
from netspec.export.expression import Expression, call
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.recurrent import LSTM, RNN, LSTMUnit


@exports(RNN)
def recurrent_net(layer: Any, code: TorchCode, *bottoms: Expression) -> Expression | Sequence[Expression]:
    return _recurrent(layer, code, rnn, ["w_x", "bias", "w_static", "w_h", "w_o", "bias_o"], bottoms)


@exports(LSTM)
def long_short_term_memory(layer: Any, code: TorchCode, *bottoms: Expression) -> Expression | Sequence[Expression]:
    return _recurrent(layer, code, lstm, ["w_x", "bias", "w_static", "w_h"], bottoms)


def _recurrent(
    layer: Any, code: TorchCode, function: Callable[..., Any], names: list[str], bottoms: Sequence[Expression]
) -> Expression | Sequence[Expression]:
    x, cont, *others = bottoms
    if code.onnx:
        code.size(0, 0, "its time steps are unrolled")
    weights = [code.parameter(i, name=n) for i, n in enumerate(n for n in names if layer.has_static or n != "w_static")]
    static = [others[0].flatten(1), weights.pop(2)] if layer.has_static else [None, None]
    state = others[layer.has_static :] or [None] * len(layer.state_names)
    x = x if len(layer.bottom_shapes[0]) == 3 else x.flatten(2)
    made = call(function, x, cont, *weights, *static, *state)
    return made if layer.exposed else (made[0],)


@exports(LSTMUnit)
def unit(layer: Any, code: TorchCode, cell: Expression, gates: Expression, cont: Expression) -> Expression:
    return call(lstm_unit, cell, gates, cont[..., None])


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

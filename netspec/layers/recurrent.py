"""Recurrent layers, computed one time step at a time.

Caffe: src/caffe/layers/recurrent_layer.cpp, which unrolls the time steps into a separate net
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import torch
from typing_extensions import override

from netspec.exact import libm
from netspec.exact.arithmetic import AsTorch
from netspec.exact.pointwise import tanh_gradient
from netspec.layers.contract.base import Layer, Shape, State
from netspec.layers.contract.registry import register


class Recurrent(Layer):
    """Base of RNN and LSTM.

    The hidden state is kept for the next forward pass, until a cont of 0 begins a new sequence. It is 0 at first, and
    after the number of streams has changed. With expose_hidden, bottoms and tops hold the state instead. Gradients do
    not pass from a batch to the previous one, not even through these bottoms and tops. Unlike in Caffe, the number of
    time steps can differ between batches.
    """

    bottoms = (2, 5)
    tops = (1, 3)
    label_bottoms = frozenset({1})
    ignores = frozenset({"recurrent_param.debug_info"})
    state_names: ClassVar[tuple[str, ...]]
    changes_itself = True
    ignores_frozen = True  # the gradients are those of the separate net, which does not know lr_mult
    how: AsTorch  # the arithmetic of the current forward pass
    gates: ClassVar[int] = 1  # number of inputs of a hidden unit

    def setup(self) -> None:
        """Add the blobs for x, x_static and h; subclasses append theirs."""
        p = self.param.recurrent_param
        if p.num_output <= 0:
            message = f"found num_output {p.num_output}, expected a positive number"
            raise self.error(message, "recurrent_param", "num_output")
        self.hidden: int = p.num_output
        self.exposed: bool = p.expose_hidden
        exposed = len(self.state_names) * self.exposed
        self.has_static = len(self.bottom_shapes) == 3 + exposed
        self.ignores_propagate_down = frozenset({0, 2} if self.has_static else {0})
        if len(self.bottom_shapes) != 2 + self.has_static + exposed:
            names = ", ".join(("x", "cont", "[x_static]", *self.state_names[:exposed]))
            raise self.error(f"found {len(self.bottom_shapes)} bottom blob(s), expected {names}", "bottom")
        if self.num_tops != 1 + exposed:
            names = ", ".join(("the output", *self.state_names[:exposed]))
            raise self.error(f"found {self.num_tops} top blob(s), expected {names}", "top")
        x = self.bottom_shapes[0]
        if len(x) < 3:
            raise self.error(f"found a bottom of shape {x}, expected (time steps, streams, inputs, ...)", "bottom", 0)
        if self.has_static and len(self.bottom_shapes[2]) < 2:
            message = f"found x_static of shape {self.bottom_shapes[2]}, expected (streams, inputs, ...)"
            raise self.error(message, "bottom", 2)
        rows = self.gates * self.hidden
        self.add_blob((rows, math.prod(x[2:])), p.weight_filler)
        self.add_blob((rows,), p.bias_filler)
        if self.has_static:
            self.add_blob((rows, math.prod(self.bottom_shapes[2][1:])), p.weight_filler)
        self.add_blob((rows, self.hidden), p.weight_filler)
        self.state: tuple[torch.Tensor, ...] = ()

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        x, cont = bottom_shapes[:2]
        steps, streams = x[:2]
        if tuple(cont) != (steps, streams):
            raise self.error(f"found cont of shape {cont}, expected {(steps, streams)} for x of shape {x}", "bottom", 1)
        if self.has_static and bottom_shapes[2][:1] != (streams,):
            message = f"found x_static of shape {bottom_shapes[2]}, expected ({streams}, ...) for x of shape {x}"
            raise self.error(message, "bottom", 2)
        state = (1, streams, self.hidden)
        first = 2 + self.has_static
        for i, shape in enumerate(bottom_shapes[first:], first):
            if shape != state:
                message = f"found {self.state_names[i - first]} of shape {shape}, expected {state}"
                raise self.error(message, "bottom", i)
        return [(steps, streams, self.hidden), *[state] * (self.num_tops - 1)]

    def forward(self, x: torch.Tensor, cont: torch.Tensor, *others: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return the output of every time step and, if exposed, the last state."""
        steps, streams = x.shape[:2]
        self.how = self.arithmetic(x)
        inputs = self.multiply(x.reshape(steps * streams, -1), 0, bias=1).reshape(steps, streams, -1)
        statics: Sequence[torch.Tensor] = ()
        if self.has_static:
            static = self.multiply(others[0].reshape(streams, -1), 2)
            statics = self.how.copies(static, steps)
        state = self._first_state(x, others[self.has_static :])
        kept = cont.detach().to(x.dtype).unsqueeze(2)
        outputs = []
        for t, keep in enumerate(kept):
            output, state = self.step((inputs[t], *statics[t : t + 1]), keep, state)
            outputs.append(output)
        last = tuple(s.detach() for s in state)
        if self.exposed:
            return torch.stack(outputs), *(s.unsqueeze(0) for s in last)
        self.state = last
        return (torch.stack(outputs),)

    def running_state(self) -> State:
        return {"state": self.state}

    def resume(self, state: Mapping[str, Any]) -> None:
        found: tuple[torch.Tensor, ...] = state["state"]
        shape = (self.bottom_shapes[0][1], self.hidden)
        if found and [s.shape for s in found] != [shape] * len(self.state_names):
            raise self.error(f"found states of shapes {[tuple(s.shape) for s in found]}, expected {shape}")
        self.state = found

    def multiply_adds(self) -> int:
        """Return the number of weights, times the time steps (once for x_static) and the streams."""
        steps, streams = self.bottom_shapes[0][:2]
        matrices = [math.prod(shape) for shape in self.blob_shapes if len(shape) == 2]
        once = matrices.pop(1) if self.has_static else 0
        return streams * (steps * sum(matrices) + once)

    def step(
        self, inputs: tuple[torch.Tensor, ...], keep: torch.Tensor, state: tuple[torch.Tensor, ...]
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        """Compute one time step; return its output (streams, hidden) and the state after it.

        ``inputs`` are the products with x (and the bias) and with x_static, each (streams, gates * hidden). ``keep``
        (streams, 1) is cont of this step.
        """
        raise NotImplementedError

    def multiply(self, vectors: torch.Tensor, weight: int, bias: int | None = None) -> torch.Tensor:
        """Return the products of vectors (M, K) with a matrix, given by the index of its blob, plus the bias."""
        matrix, added = self.blob(weight), None if bias is None else self.blob(bias)
        return self.how.product_of_step(vectors, matrix, added)

    def carry(self, hidden: torch.Tensor, keep: torch.Tensor, inputs: tuple[torch.Tensor, ...]) -> torch.Tensor:
        """Return the sum of the inputs and, unless a sequence begins, the product for the previous hidden state."""
        total = self.multiply(keep * hidden, 2 + self.has_static)
        for brought in inputs:
            total = total + brought
        return total

    def _first_state(self, x: torch.Tensor, given: Sequence[torch.Tensor]) -> tuple[torch.Tensor, ...]:
        if self.exposed:
            return tuple(s.detach().squeeze(0) for s in given)
        shape = (x.shape[1], self.hidden)
        if self.state and self.state[0].shape == shape:
            return tuple(s.to(x) for s in self.state)
        return (x.new_zeros(shape),) * len(self.state_names)


@register("RNN", "recurrent_param")
class RNN(Recurrent):
    """h_t = tanh(W_hh (cont_t h_{t-1}) + W_xh x_t + b_h [+ W_xh_static x_static]), o_t = tanh(W_ho h_t + b_o).

    bottom[0]  x (T, N, ...): T time steps of N streams
    bottom[1]  cont (T, N): 0 where a sequence begins, else 1
    bottom[2]  optional: x_static (N, ...), the same for all time steps
    bottom[i]  with expose_hidden, after those: h_0 (1, N, num_output)
    top[0]     o (T, N, num_output)
    top[1]     with expose_hidden: h_T (1, N, num_output)
    blobs[i]   W_xh, b_h, [W_xh_static], W_hh, W_ho, b_o: (num_output, inputs) and (num_output,)
    Caffe: src/caffe/layers/rnn_layer.cpp
    """

    bottoms = (2, 4)
    tops = (1, 2)
    state_names = ("h",)

    def setup(self) -> None:
        super().setup()
        p = self.param.recurrent_param
        self.add_blob((self.hidden, self.hidden), p.weight_filler)
        self.add_blob((self.hidden,), p.bias_filler)

    @override
    def step(
        self, inputs: tuple[torch.Tensor, ...], keep: torch.Tensor, state: tuple[torch.Tensor, ...]
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        """Compute one time step; see :meth:`Recurrent.step`."""
        last = 2 + self.has_static
        h = self._tanh(self.carry(state[0], keep, inputs))
        return self._tanh(self.multiply(h, last + 1, bias=last + 2)), (h,)

    def _tanh(self, x: torch.Tensor) -> torch.Tensor:
        return self.how.function(x, torch.tanh, libm.tanh, tanh_gradient)


@register("LSTM", "recurrent_param")
class LSTM(Recurrent):
    """Long short-term memory; its gate order is input, forget, output, candidate (i, f, o, g).

    [i f o g] = W_xc x_t + b_c + W_hc (cont_t h_{t-1}) [+ W_xc_static x_static],
    c_t = cont_t sigmoid(f) c_{t-1} + sigmoid(i) tanh(g), h_t = sigmoid(o) tanh(c_t).

    bottom[0]  x (T, N, ...): T time steps of N streams
    bottom[1]  cont (T, N): 0 where a sequence begins, else 1
    bottom[2]  optional: x_static (N, ...), the same for all time steps
    bottom[i]  with expose_hidden, after those: h_0, c_0 (1, N, num_output)
    top[0]     h (T, N, num_output)
    top[1..2]  with expose_hidden: h_T, c_T (1, N, num_output)
    blobs[i]   W_xc, b_c, [W_xc_static], W_hc: (4 num_output, inputs) and (4 num_output,)
    Caffe: src/caffe/layers/lstm_layer.cpp
    """

    state_names = ("h", "c")
    gates = 4

    @override
    def step(
        self, inputs: tuple[torch.Tensor, ...], keep: torch.Tensor, state: tuple[torch.Tensor, ...]
    ) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        """Compute one time step; see :meth:`Recurrent.step`."""
        h, c = state
        c, h = self.how.lstm_unit(c, self.carry(h, keep, inputs), keep)
        return h, (h, c)


@register("LSTMUnit")
class LSTMUnit(Layer):
    """One time step of an LSTM from the inputs of its gates, without blobs.

    bottom[0]  c_{t-1} (1, N, D)
    bottom[1]  gate inputs (1, N, 4 D): input, forget, output, candidate
    bottom[2]  cont (1, N): 0 where a sequence begins, else 1
    top[0]     c_t (1, N, D)
    top[1]     h_t (1, N, D)
    Caffe: src/caffe/layers/lstm_unit_layer.cpp
    """

    bottoms = (3, 3)
    tops = (2, 2)
    label_bottoms = frozenset({2})

    def setup(self) -> None:
        if any(self.param.propagate_down[:2]):  # Caffe computes both gradients if one is needed
            self.ignores_propagate_down = frozenset({0, 1})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        cell, gates, cont = bottom_shapes
        if len(cell) != 3 or cell[0] != 1:
            raise self.error(f"found a cell of shape {cell}, expected (1, streams, units)", "bottom", 0)
        _, streams, units = cell
        if tuple(gates) != (1, streams, 4 * units):
            raise self.error(f"found gates of shape {gates}, expected {(1, streams, 4 * units)}", "bottom", 1)
        if tuple(cont) != (1, streams):
            raise self.error(f"found cont of shape {cont}, expected {(1, streams)}", "bottom", 2)
        return [cell, cell]

    def forward(self, cell: torch.Tensor, gates: torch.Tensor, cont: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        return self.arithmetic(gates).lstm_unit(cell, gates, cont.detach().to(cell.dtype).unsqueeze(2))

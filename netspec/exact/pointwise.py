"""Functions of one tensor with Caffe's gradient, most of them elementwise, and the unit of an LSTM."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from netspec.exact import libm

Gradient = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], torch.Tensor]


class Pointwise(torch.autograd.Function):
    """Apply ``compute(bottom)``; its gradient is ``gradient(bottom, top, diff)``, as Caffe computes it."""

    @staticmethod
    def forward(
        ctx: Any, bottom: torch.Tensor, compute: Callable[[torch.Tensor], torch.Tensor], gradient: Gradient
    ) -> torch.Tensor:
        top = compute(bottom)
        ctx.gradient = gradient
        ctx.save_for_backward(bottom, top)
        return top

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, diff: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        return ctx.gradient(*ctx.saved_tensors, diff), None, None


def pointwise(
    bottom: torch.Tensor, compute: Callable[[torch.Tensor], torch.Tensor], gradient: Gradient
) -> torch.Tensor:
    """Apply ``compute`` with Caffe's gradient, as :class:`Pointwise` does; without gradients that takes less time."""
    return Pointwise.apply(bottom, compute, gradient) if torch.is_grad_enabled() else compute(bottom)


def tanh_gradient(bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
    """Return the gradient of a hyperbolic tangent (src/caffe/layers/tanh_layer.cpp)."""
    return diff * (1 - top * top)


def lstm_unit(cell: torch.Tensor, gates: torch.Tensor, cont: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the next cell and hidden state (N, D); the gates (N, 4 D) are input, forget, output and candidate."""
    i, f, o, g = gates.chunk(4, dim=-1)
    cell = cont * torch.sigmoid(f) * cell + torch.sigmoid(i) * torch.tanh(g)
    return cell, torch.sigmoid(o) * torch.tanh(cell)


class CellUpdate(torch.autograd.Function):
    """One time step of an LSTM.

    cell     (N, D)
    gates    (N, 4 D): input, forget, output, candidate
    keep     (N, 1): 0 where a sequence begins, else 1
    returns  the next cell and hidden state, (N, D)

    Caffe: src/caffe/layers/lstm_unit_layer.cpp
    """

    @staticmethod
    def forward(
        ctx: Any, cell: torch.Tensor, gates: torch.Tensor, keep: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        i, f, o = (_sigmoid(gate) for gate in gates.chunk(4, -1)[:3])
        f, g = keep * f, _tanh(gates.chunk(4, -1)[3])
        following = f * cell + i * g
        squashed = _tanh(following)
        ctx.save_for_backward(cell, i, f, o, g, squashed)
        return following, o * squashed

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, cell_diff: torch.Tensor, hidden_diff: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        cell, i, f, o, g, squashed = ctx.saved_tensors
        total = cell_diff + hidden_diff * o * (1 - squashed * squashed)
        gates = (
            total * g * i * (1 - i),
            total * cell * f * (1 - f),
            hidden_diff * squashed * o * (1 - o),
            total * i * (1 - g * g),
        )
        return total * f, torch.cat(gates, -1), None


def _sigmoid(values: torch.Tensor) -> torch.Tensor:
    return (1 / (1 + libm.exp(-values).double())).to(values.dtype)


def _tanh(values: torch.Tensor) -> torch.Tensor:
    return (2 / (1 + libm.exp(-2 * values.double())) - 1).to(values.dtype)

"""Kernels of activations (netspec/layers/activation.py, powers.py)."""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

import math
from functools import partial

import torch
import torch.nn.functional as F

from netspec.exact import ALL
from netspec.fast.entry import Entry
from netspec.fast.folding import Folds
from netspec.fast.kernels import RELU, Activation, Buffer, Learning, clip
from netspec.layers.activation import BNLL, ELU, Clip, PReLU, ReLU, Rounded, Sigmoid, Swish, TanH, Threshold
from netspec.layers.contract.learned import values_of
from netspec.layers.powers import AbsVal, Exp, Log, Power
from netspec.run.recorded import Kernels


def _relu_folds(layer: ReLU) -> Folds:
    if not layer.slope:
        return Folds(activation=RELU)
    return Folds(activation=Activation(f"leaky_relu {layer.slope}", partial(F.leaky_relu_, negative_slope=layer.slope)))


def _learn_relu(layer: ReLU, how: Learning) -> Kernels | None:
    if layer.slope:
        return None
    buffers, gradient = (Buffer(), Buffer()), torch.ops.aten.threshold_backward.grad_input

    def forward(x: torch.Tensor) -> torch.Tensor:
        return torch.clamp_min(x, 0, out=buffers[0].like(x))

    def backward(diff: torch.Tensor) -> torch.Tensor:
        top = buffers[0].like(diff)
        return gradient(diff, top, 0, grad_input=buffers[1].like(top))  # with strides as in autograd

    return Kernels(forward, backward)


def _learn_prelu(layer: PReLU, how: Learning) -> Kernels | None:
    shape = layer.bottom_shapes[0]
    if layer.context.options.exact == ALL or math.prod(shape) == 0:
        return None
    slopes = values_of(layer.blob(0))
    gradients, given, total = torch.ops.aten._prelu_kernel_backward.default, slopes, how.sums[0]
    flat, by_channel = slopes.reshape(-1), slopes.view(1, -1, *(1,) * (len(shape) - 2))

    def forward(x: torch.Tensor) -> torch.Tensor:
        nonlocal given
        given = x
        return torch.prelu(x, flat)

    def backward(diff: torch.Tensor) -> torch.Tensor:
        found, terms = gradients(diff, given, by_channel)
        if total is not None:
            total.add_(terms.sum_to_size(by_channel.shape).view(total.shape))
        return found

    return Kernels(forward, backward)


def _learn_tanh(layer: TanH, how: Learning) -> Kernels | None:
    if layer.context.options.exact == ALL:
        return None
    buffers, gradient = (Buffer(), Buffer()), torch.ops.aten.tanh_backward.grad_input

    def forward(x: torch.Tensor) -> torch.Tensor:
        return torch.tanh(x, out=buffers[0].like(x))

    def backward(diff: torch.Tensor) -> torch.Tensor:
        return gradient(diff, buffers[0].like(diff), grad_input=buffers[1].like(diff))

    return Kernels(forward, backward)


def _in_place(activation: Activation, layer: Rounded) -> Folds:
    return Folds(activation=None if layer.context.options.exact == ALL else activation)


def _clip_folds(layer: Clip) -> Folds:
    return Folds(activation=clip(layer.low, layer.high) if layer.low <= layer.high else None)


ENTRIES = {
    ReLU: Entry(learning=_learn_relu, folds=_relu_folds, fresh=True, any_layout=True),
    PReLU: Entry(learning=_learn_prelu, fresh=True, any_layout=True),
    Sigmoid: Entry(folds=partial(_in_place, Activation("sigmoid", torch.sigmoid_)), fresh=True, any_layout=True),
    TanH: Entry(
        learning=_learn_tanh, folds=partial(_in_place, Activation("tanh", torch.tanh_)), fresh=True, any_layout=True
    ),
    Clip: Entry(folds=_clip_folds, fresh=True, any_layout=True),
    Power: Entry(any_layout=True),
    **dict.fromkeys((BNLL, ELU, Swish, Exp, Log, Threshold, AbsVal), Entry(fresh=True, any_layout=True)),
}

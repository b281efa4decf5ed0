"""The expressions of the activations, and of Power, Exp, Log and AbsVal."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from netspec.export.exporter import exports
from netspec.export.expression import Expression, call, plain
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.activation import BNLL, ELU, Clip, PReLU, ReLU, Sigmoid, Swish, TanH, Threshold
from netspec.layers.powers import AbsVal, Exp, Log, Power

exports(Sigmoid)(plain(torch.sigmoid))
exports(TanH)(plain(torch.tanh))
exports(BNLL)(plain(F.softplus))
exports(AbsVal)(plain(torch.abs))


def scaled_and_shifted(x: Expression, scale: float, shift: float) -> Expression:
    """Return scale x + shift, without parts that have no effect."""
    x = float(scale) * x if scale != 1 else x
    return x + float(shift) if shift > 0 else x - abs(float(shift)) if shift else x


@exports(ReLU)
def relu(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(F.leaky_relu, x, layer.slope) if layer.slope else call(F.relu, x)


@exports(PReLU)
def prelu(layer: Any, code: TorchCode, x: Expression) -> Expression:
    slopes = layer.blob(0).reshape(-1)
    return code.module(nn.PReLU, len(slopes), state={"weight": slopes})(x)


@exports(ELU)
def elu(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(F.elu, x) if layer.alpha == 1 else call(F.elu, x, alpha=layer.alpha)


@exports(Threshold)
def threshold(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(torch.gt, x, layer.threshold).to(x.dtype)


@exports(Clip)
def clip(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(torch.clamp, x, layer.low, max(layer.low, layer.high))


@exports(Swish)
def swish(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(F.silu, x) if layer.beta == 1 else x * call(torch.sigmoid, layer.beta * x)


@exports(Power)
def power(layer: Any, code: TorchCode, x: Expression) -> Expression:
    if layer.power * layer.scale == 0:
        return call(torch.full_like, x, layer.shift).pow(layer.power)
    x = scaled_and_shifted(x, layer.scale, layer.shift)
    return x if layer.power == 1 else call(torch.pow, x, layer.power)


@exports(Exp)
def exp(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(torch.exp, scaled_and_shifted(x, layer.scale, layer.shift))


@exports(Log)
def log(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return scaled_and_shifted(call(torch.log, scaled_and_shifted(x, layer.scale, layer.shift)), layer.base_scale, 0)

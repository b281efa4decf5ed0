"""The expressions of InnerProduct, Dropout, Embed, Scale and Bias."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch.nn.functional as F
from torch import nn

from netspec.export.exporter import exports
from netspec.export.expression import TRAINING, Expression, call, with_axes
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.common import Dropout, Embed, InnerProduct
from netspec.layers.scale import Bias, Scale
from netspec.proto.schema import TRAIN


@exports(InnerProduct)
def inner_product(layer: Any, code: TorchCode, x: Expression) -> Expression:
    weight = layer.blob(0).t() if layer.param.inner_product_param.transpose else layer.blob(0)
    state, options = {"weight": weight}, {"bias": False}
    if len(layer.blobs) > 1:
        state, options = {"weight": weight, "bias": layer.blob(1)}, {}
    linear = code.module(nn.Linear, layer.inputs, weight.shape[0], state=state, **options)
    flat = len(layer.bottom_shapes[0]) == layer.axis + 1
    return linear(x if flat else x.flatten(*([layer.axis] if layer.axis else [])))


@exports(Dropout)
def dropout(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(F.dropout, x, layer.ratio, TRAINING) if layer.phase == TRAIN else x


@exports(Embed)
def embed(layer: Any, code: TorchCode, x: Expression) -> Expression:
    top = code.module(nn.Embedding, *layer.blob_shapes[0], state={"weight": layer.blob(0)})(x.long())
    return top + code.parameter(1) if len(layer.blobs) > 1 else top


@exports(Scale)
def scale(layer: Any, code: TorchCode, *bottoms: Expression) -> Expression:
    top = bottoms[0] * _operand(layer, code, bottoms, 0)
    biased = layer.param.scale_param.bias_term
    return top + _operand(layer, code, bottoms[:1], len(layer.blobs) - 1) if biased else top


@exports(Bias)
def bias(layer: Any, code: TorchCode, *bottoms: Expression) -> Expression:
    return bottoms[0] + _operand(layer, code, bottoms, 0)


def _operand(layer: Any, code: TorchCode, bottoms: Sequence[Expression], blob: int) -> Expression:
    """Return the second bottom or a learnable blob, broadcast over the first bottom's axes from ``axis`` on."""
    axes = len(layer.bottom_shapes[0]) - layer.axis
    if len(bottoms) > 1:
        return with_axes(bottoms[1], axes - len(layer.bottom_shapes[1]))
    shape = layer.blob_shapes[blob]
    name = "" if len(layer.blobs) == 1 else ("scale", "bias")[blob]
    return code.parameter(blob, (*shape, *(1,) * (axes - len(shape))), name)

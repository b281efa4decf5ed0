"""Kernels of InnerProduct and Dropout (netspec/layers/common.py)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F

from netspec.exact import SMALL_PRODUCT
from netspec.exact.products import SummedProducts, VectorProducts
from netspec.fast import fused
from netspec.fast.entry import Entry
from netspec.fast.folding import Absorbed, Folds, blob_like, copy_of
from netspec.fast.kernels import (
    Buffer,
    Inference,
    Kernel,
    Learning,
    operation_kernel,
    operation_kernels,
    with_activation,
)
from netspec.layers.common import Dropout, InnerProduct
from netspec.proto.schema import TRAIN
from netspec.run.recorded import Kernels


def _inner_product(layer: InnerProduct, how: Inference) -> Kernel | None:
    weight, bias = layer.blob(0), layer.blob(1) if len(layer.blobs) > 1 else None
    transposed, top_shape = layer.param.inner_product_param.transpose, layer.top_shapes[0]
    rows = math.prod(top_shape[:-1])
    one_by_one = (rows, layer.inputs)
    if layer.arithmetic(weight).is_caffes and math.prod(layer.bottom_shapes[0]):
        return operation_kernel(VectorProducts(transposed), layer, one_by_one, how)
    weight = weight.t() if transposed else weight
    # A single vector is multiplied as fast as memory gives the weights, whatever their layout.
    if rows == 1:
        multiply = with_activation(fused.vector_product(weight, bias), how.activation)
    elif how.pack and fused.suits(weight) and rows * weight.numel() > SMALL_PRODUCT:
        multiply = fused.product(weight, bias, how)
    else:
        multiply = with_activation(lambda vectors: F.linear(vectors, weight, bias), how.activation)
    if layer.axis == 1:
        return lambda data: multiply(data.reshape(one_by_one))
    return lambda data: multiply(data.reshape(one_by_one)).view(top_shape)


def _learn_inner_product(layer: InnerProduct, how: Learning) -> Kernels | None:
    top_shape, inputs = layer.top_shapes[0], layer.inputs
    if math.prod(top_shape) == 0 or inputs == 0:
        return None
    products = VectorProducts if layer.arithmetic(layer.blob(0)).is_caffes else SummedProducts
    rows = math.prod(top_shape[:-1])
    shapes = ((rows, inputs), (rows, top_shape[-1]))
    return operation_kernels(products(layer.param.inner_product_param.transpose), layer, shapes, how)


def _inner_product_folds(layer: InnerProduct) -> Folds:
    def absorb(scale: torch.Tensor, shift: torch.Tensor) -> Absorbed:
        param = copy_of(layer.param)
        param.inner_product_param.bias_term = True
        outputs = param.inner_product_param.num_output
        bias = blob_like(layer, 1, shift) if len(layer.blobs) > 1 else torch.zeros_like(shift)
        factors = scale.expand(outputs)
        factors = factors if param.inner_product_param.transpose else factors[:, None]
        return Absorbed(param, (blob_like(layer, 0, scale) * factors, scale * bias + shift))

    return Folds(absorb=absorb if layer.axis == 1 else None)


def _learn_dropout(layer: Dropout, how: Learning) -> Kernels:
    """Return kernels that use the same random mask for the numbers and for their gradients."""
    if layer.phase != TRAIN:
        return Kernels(lambda data: data, lambda diff: diff)
    draws, buffers, share = layer.context.random, (Buffer(), Buffer()), 1 - layer.ratio
    kept = torch.empty(layer.bottom_shapes[0])

    def forward(data: torch.Tensor) -> torch.Tensor:
        kept.bernoulli_(share, generator=draws.on(data.device)).mul_(1 / share)
        return torch.mul(data, kept, out=buffers[0].like(data))

    def backward(diff: torch.Tensor) -> torch.Tensor:
        return torch.mul(diff, kept, out=buffers[1].like(diff))

    return Kernels(forward, backward)


ENTRIES = {
    InnerProduct: Entry(_inner_product, _learn_inner_product, _inner_product_folds, fresh=True, any_layout=True),
    Dropout: Entry(learning=_learn_dropout),
}

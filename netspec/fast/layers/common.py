"""Kernels of InnerProduct and Dropout (netspec/layers/common.py)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F

from netspec.exact import SMALL_PRODUCT
from netspec.fast import fused
from netspec.fast.entry import Entry
from netspec.fast.folding import Absorbed, Folds, blob_like, copy_of
from netspec.fast.kernels import (
    Buffer,
    Inference,
    Kernel,
    Learning,
    copies,
    product_kernel,
    weight_and_bias,
    with_activation,
)
from netspec.fast.products import PreparedVectors, Weights, fixed_weights
from netspec.layers.common import Dropout, InnerProduct
from netspec.proto.schema import TRAIN
from netspec.run.recorded import Kernels


def _inner_product(layer: InnerProduct, how: Inference) -> Kernel | None:
    weight, bias = layer.blob(0), layer.blob(1) if len(layer.blobs) > 1 else None
    transposed, top_shape = layer.param.inner_product_param.transpose, layer.top_shapes[0]
    rows = math.prod(top_shape[:-1])
    one_by_one = (rows, layer.inputs)
    if layer.arithmetic(weight).is_caffes and math.prod(layer.bottom_shapes[0]):
        learned = fixed_weights(*copies(layer.values(), how))
        return product_kernel(PreparedVectors(layer.bottom_shapes[0], top_shape, transposed, learned), how)
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
    (weight, bias), sums = weight_and_bias(layer, how)
    transposed = layer.param.inner_product_param.transpose
    top_shape, inputs, wanted = layer.top_shapes[0], layer.inputs, how.wanted[0]
    if math.prod(top_shape) == 0 or inputs == 0:
        return None
    if layer.arithmetic(weight).is_caffes:
        product = PreparedVectors(layer.bottom_shapes[0], top_shape, transposed, Weights(weight, bias, *sums), wanted)
        return Kernels(product.forward, product.backward)
    tops = weight.new_empty(math.prod(top_shape[:-1]), top_shape[-1])
    top, matrix = tops.view(top_shape), weight if transposed else weight.t()
    diff = torch.empty(layer.bottom_shapes[0]) if wanted else None
    vectors_diff = None if diff is None else diff.view(-1, inputs)
    vectors = tops

    def forward(data: torch.Tensor) -> torch.Tensor:
        nonlocal vectors
        vectors = data.reshape(-1, inputs)
        if bias is None:
            torch.mm(vectors, matrix, out=tops)
        else:
            torch.addmm(bias, vectors, matrix, out=tops)
        return top

    def backward(top_diff: torch.Tensor) -> torch.Tensor | None:
        tops_diff = top_diff.reshape(tops.shape)
        if sums[0] is not None:
            sums[0].addmm_(*((vectors.t(), tops_diff) if transposed else (tops_diff.t(), vectors)))
        if sums[1] is not None:
            sums[1].add_(tops_diff.sum(0))
        if vectors_diff is not None:
            torch.mm(tops_diff, matrix.t(), out=vectors_diff)
        return diff

    return Kernels(forward, backward)


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

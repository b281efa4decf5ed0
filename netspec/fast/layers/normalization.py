"""Kernels of BatchNorm (netspec/layers/normalization.py)."""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

import math

import torch

from netspec.exact.by_torch import normalized_batch
from netspec.fast.entry import Entry
from netspec.fast.folding import Affine, Folds, blob_in_double
from netspec.fast.kernels import Buffer, Learning
from netspec.layers.normalization import BatchNorm, means
from netspec.run.recorded import Kernels


def affine(layer: BatchNorm) -> Affine:
    """Return the scale and shift of each channel by a BatchNorm with stored statistics."""
    mean, variance = means(*(blob_in_double(layer, i) for i in range(3)))
    scale = (variance + layer.eps).rsqrt()
    return scale, -mean * scale


def _folds(layer: BatchNorm) -> Folds:
    return Folds(affine=(lambda: affine(layer)) if layer.use_global_stats else None)


def _learn(layer: BatchNorm, how: Learning) -> Kernels | None:
    shape = layer.top_shapes[0]
    if layer.use_global_stats or math.prod(shape) == 0 or len(shape) == 1 or layer.arithmetic(layer.blob(0)).is_caffes:
        return None
    buffer, rectifies, sums = Buffer(), layer.rectifies, [*how.sums[3:], None, None][:2]
    needed = [how.wanted[0], *(total is not None for total in sums)]
    gradients, rectified = torch.ops.aten.native_batch_norm_backward, torch.ops.aten.threshold_backward.grad_input
    given = top = mean = deviation = torch.empty(0)

    def forward(data: torch.Tensor) -> torch.Tensor:
        nonlocal given, top, mean, deviation
        made, given, *batch = normalized_batch(data, torch.native_batch_norm, layer.factors(), layer.eps)
        layer.add(batch[0], batch[1])
        top, mean, deviation = made
        return top.relu_() if rectifies else top

    def backward(diff: torch.Tensor) -> torch.Tensor | None:
        if rectifies:
            diff = rectified(diff, top, 0, grad_input=buffer.like(top))
        factors = layer.factors()[0]
        found, *learned = gradients(diff, given, factors, None, None, mean, deviation, True, layer.eps, needed)
        for total, gradient in zip(sums, learned, strict=True):
            if total is not None:
                total.add_(gradient)
        return found

    return Kernels(forward, backward)


ENTRIES = {BatchNorm: Entry(learning=_learn, folds=_folds, fresh=True, any_layout=True)}

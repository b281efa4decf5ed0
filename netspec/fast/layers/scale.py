"""Kernels of Scale and Bias (netspec/layers/scale.py)."""

from __future__ import annotations

import math

import torch

from netspec.exact.channels import ChannelProducts
from netspec.fast.entry import Entry
from netspec.fast.folding import Absorbed, Affine, Folds, blob_in_double, copy_of
from netspec.fast.kernels import Learning, operation_kernels
from netspec.layers.scale import Bias, Scale
from netspec.run.recorded import Kernels


def _learn_scale(layer: Scale, how: Learning) -> Kernels | None:
    shape = layer.bottom_shapes[0]
    if not layer.by_channel or math.prod(shape) == 0:
        return None
    # Otherwise autograd computes the gradient of each layer from zero, before it adds those of layers that share blobs.
    if not (layer.arithmetic(layer.blob(0)).is_caffes and layer.context.options.accumulate_in_place):
        return None
    seen = (*shape[:2], math.prod(shape[2:]))
    return operation_kernels(ChannelProducts(), layer, (seen, seen), how)


def _scale_folds(layer: Scale) -> Folds:
    if not layer.by_channel:
        return Folds()

    def affine() -> Affine:
        scale = blob_in_double(layer, 0)
        return scale, blob_in_double(layer, 1) if len(layer.blobs) > 1 else torch.zeros_like(scale)

    def absorb_before(scale: torch.Tensor, shift: torch.Tensor) -> Absorbed:
        param = copy_of(layer.param)
        param.scale_param.bias_term = True
        factor, offset = (values.to(scale) for values in affine())
        return Absorbed(param, (factor * scale, factor * shift + offset))

    return Folds(affine=affine, absorb_before=absorb_before)


def _bias_folds(layer: Bias) -> Folds:
    def affine() -> Affine:
        shift = blob_in_double(layer, 0)
        return torch.ones_like(shift), shift

    by_channel = len(layer.bottom_shapes) == 1 and layer.axis == 1 and len(layer.blob_shapes[0]) == 1
    return Folds(affine=affine if by_channel else None)


ENTRIES = {
    Scale: Entry(learning=_learn_scale, folds=_scale_folds, fresh=True, any_layout=True),
    Bias: Entry(folds=_bias_folds),
}

"""The expressions of layers of netspec/dialects/segmentation."""

from __future__ import annotations

from typing import Any

import torch.nn.functional as F

from netspec.export.exporter import exports, refusal
from netspec.export.expression import Expression, call
from netspec.export.formats.torch_code import TorchCode
from netspec.export.layers.normalization import by_statistics, is_module, normalize_batch
from netspec.proto.schema import value


@exports("netspec.dialects.segmentation.segnet.Upsample")
def upsample(layer: Any, code: TorchCode, x: Expression, *mask: Expression) -> Expression:
    param, scale = value(layer.param, "upsample_param"), (layer.scale_h, layer.scale_w)
    if not mask:
        return call(F.interpolate, x, scale_factor=scale[0] if scale[0] == scale[1] else scale)
    size = tuple(layer.top_shapes[0][2:])
    if code.onnx:
        for axis in (2, 3):
            code.size(0, axis, "its mask counts the pixels of the enlarged map")
    elif None in code.sizes(0)[2:] and not param.HasField("upsample_h"):
        cut = (param.pad_out_h, param.pad_out_w)
        sides = [x.shape[2 + k] * scale[k] for k in (0, 1)]
        size = tuple(side - 1 if cut[k] else side for k, side in enumerate(sides))
    return call(unpool, x, *mask, size)


@exports("netspec.dialects.segmentation.segnet.BN")
def bn(layer: Any, code: TorchCode, x: Expression) -> Expression:
    if layer.num_tops > 1:
        raise refusal(layer, "it shows a batch's mean")
    weight, bias, *statistics = (layer.blob(i).reshape(-1) for i in range(len(layer.blobs)))
    if layer.moving and not layer.by_batch:
        mean, variance = statistics
        variance = variance.pow(-2) - layer.eps if layer.inverse else variance
        if is_module(layer):
            return by_statistics(layer, code, x, mean, variance, weight=weight, bias=bias)
        x = by_statistics(layer, code, x, mean, variance)
    x = call(normalize_batch, x, eps=layer.eps) if layer.by_batch else x
    shape = (layer.channels, *(1,) * (len(layer.bottom_shapes[0]) - 2))
    return x * code.parameter(0, shape, "slope") + code.parameter(1, shape, "bias")


def unpool(x, mask, size):
    """Copy each value to the pixel of a larger map that the mask gives; the others are 0."""
    empty = x.new_zeros(*x.shape[:2], size[0] * size[1])
    return empty.scatter(2, mask.flatten(2).long(), x.flatten(2)).unflatten(2, size)

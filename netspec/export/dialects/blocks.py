"""The expressions of layers of netspec/dialects/blocks, faces, video and yolo."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from netspec.export.exporter import exports, refusal, rounded
from netspec.export.expression import Expression, call, plain, with_axes
from netspec.export.formats.torch_code import TorchCode
from netspec.export.layers.common import dropout
from netspec.export.layers.normalization import batch_norm, by_statistics, is_module
from netspec.export.layers.vision import convolved, each, means_of_padded
from netspec.layers.vision import pooling
from netspec.proto.schema import TRAIN, value

SLOPES, BIASES = 3, 4  # blobs of NVIDIA's BatchNorm

exports("netspec.dialects.blocks.blocks.ShuffleChannel")(plain(F.channel_shuffle, "group"))
exports("netspec.dialects.faces.happynear.Cosine")(plain(torch.cos))
exports("netspec.dialects.faces.happynear.Flip")(plain(torch.Tensor.flip, "axes"))


@exports("netspec.dialects.blocks.blocks.Axpy")
def axpy(layer: Any, code: TorchCode, a: Expression, x: Expression, y: Expression) -> Expression:
    return with_axes(a, len(layer.bottom_shapes[1]) - len(layer.bottom_shapes[0])) * x + y


@exports("netspec.dialects.blocks.blocks.Interp")
def interp(layer: Any, code: TorchCode, x: Expression, *like: Expression) -> Expression:
    param = value(layer.param, "interp_param")
    cut = (param.pad_beg, param.pad_end) * 2
    x = call(F.pad, x, cut) if any(cut) else x
    if like:
        size = like[0].shape[2:]
    elif None not in code.sizes(0)[2:] or param.HasField("height"):
        size = tuple(layer.top_shapes[0][2:])
    else:
        size = call(zoomed_size, x, param.shrink_factor, param.zoom_factor)
    return call(F.interpolate, x, size=size, mode="bilinear", align_corners=True)


@exports("netspec.dialects.blocks.blocks.DeephiResize")
def deephi_resize(layer: Any, code: TorchCode, x: Expression) -> Expression:
    p, mode = layer.settings, "nearest" if layer.nearest else "bilinear"
    if p.new_height:
        return call(F.interpolate, x, tuple(layer.top_shapes[0][2:]), mode=mode)
    return call(F.interpolate, x, scale_factor=(p.scale_h, p.scale_w), mode=mode, recompute_scale_factor=True)


@exports("netspec.dialects.blocks.filters.Convolution")
def padded_convolution(layer: Any, code: TorchCode, *bottoms: Expression) -> Sequence[Expression]:
    sides = tuple(layer.sides)
    padded = [call(F.pad, bottom, sides) for bottom in bottoms] if any(sides) else bottoms
    return convolved(layer, code, (nn.Conv1d, nn.Conv2d, nn.Conv3d), padded)


@exports("netspec.dialects.blocks.filters.Pooling")
def padded_pooling(layer: Any, code: TorchCode, x: Expression) -> Expression:
    for axis in (2, 3):
        code.size(0, axis, "its windows follow from the map's size")
    if layer.method == pooling.AVE:
        return means_of_padded(code, x, layer.frame, layer.kernel, layer.stride, layer.areas())
    padded = call(F.pad, x, tuple(layer.frame), value=-torch.inf)
    return call(F.max_pool2d, padded, each(layer.kernel), each(layer.stride))


@exports("netspec.dialects.blocks.filters.Dropout")
def scaled_dropout(layer: Any, code: TorchCode, x: Expression) -> Expression:
    if value(layer.param.dropout_param, "scale_train"):
        return dropout(layer, code, x)
    if layer.phase == TRAIN:
        raise refusal(layer, "torch's dropout scales in training, this one in testing")
    return x * (1 - layer.ratio)


@exports("netspec.dialects.blocks.layout.CropCenter")
def crop_center(layer: Any, code: TorchCode, x: Expression) -> Expression:
    cuts = [part.start for part in layer.window]
    return x[tuple(slice(cut, -cut) if cut else slice(None) for cut in cuts)]


@exports("netspec.dialects.blocks.layout.Reorg")
def reorg(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(reorganized, x, layer.stride, layer.reverse)


@exports("netspec.dialects.blocks.normalize.Normalize")
def normalized(layer: Any, code: TorchCode, x: Expression) -> Expression | Sequence[Expression]:
    axes, eps = len(layer.bottom_shapes[0]), rounded(layer.eps)
    over = tuple(range(1, axes)) if layer.across else 1
    if layer.blobs:
        shape = (*layer.blob_shapes[0], *(1,) * (axes - 2)) if layer.blob_shapes[0] else ()
        return call(normalize, x, code.parameter(0, shape), over, eps=eps)
    size = call(length, x, over, eps, layer.squares)
    if layer.num_tops == 1:
        return x / size
    lengths = with_axes(size, len(layer.top_shapes[1]) - axes)
    return [x / size, lengths if layer.passes_length else lengths.detach()]


@exports("netspec.dialects.blocks.nvidia.BatchNorm")
def nvidias_batch_norm(layer: Any, code: TorchCode, x: Expression) -> Expression:
    if not layer.scales:
        return batch_norm(layer, code, x)
    if layer.use_global_stats and is_module(layer):
        affine = {"weight": layer.blob(SLOPES), "bias": layer.blob(BIASES)}
        return by_statistics(layer, code, x, *layer.stored_statistics(), **affine)
    shape = (layer.channels, *(1,) * (len(layer.bottom_shapes[0]) - 2))
    return batch_norm(layer, code, x) * code.parameter(SLOPES, shape, "slope") + code.parameter(BIASES, shape, "bias")


@exports("netspec.dialects.blocks.order.Reordered")
def reordered(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return x.permute(*layer.perm)


@exports("netspec.dialects.blocks.relu6.Capped")
def capped(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(F.relu6, x) if layer.slope == 0 else call(F.leaky_relu, x, layer.slope).clamp(max=6)


@exports("netspec.dialects.faces.happynear.Arccos")
def arccos(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(arc_cosine, x)


@exports("netspec.dialects.video.flownet.NegReLU")
def neg_relu(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(negative_relu, x, rounded(layer.param.relu_param.negative_slope))


@exports("netspec.dialects.yolo.yolo.HardSigmoid")
def hard_sigmoid(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return call(hardened_sigmoid, x)


def zoomed_size(x, shrink, zoom):
    """Return the height and width of a map of which every shrink-th pixel is kept and the steps are zoomed."""
    return [(n - 1) // shrink * zoom + 1 for n in x.shape[2:]]


def normalize(x, scale, axes, eps):
    """Divide by the length over some axes, and multiply by learnable scales.

    The gradient is the fork's, which multiplies by the scales last.
    """
    scaled = x.detach() + scale.detach() * (x - x.detach())
    found = scaled / length(scaled, axes, eps, squares=True)
    return scale * found.detach() + (found - found.detach())


def length(x, axes, eps, squares):
    """Return the length over some axes, or the sum of absolute values."""
    total = (x.square() if squares else x.abs()).sum(axes, keepdim=True) + eps
    return total.sqrt() if squares else total


def reorganized(x, stride, reverse):
    """Return pixels as channels, as Darknet does, or with ``reverse`` channels as pixels."""
    images, channels, height, width = x.shape
    few = channels // stride**2
    if reverse:
        x = x.reshape(images, stride, stride, few, height, width)
        x = x.permute(0, 3, 4, 1, 5, 2)
        return x.reshape(images, few, height * stride, width * stride)
    x = x.reshape(images, few, height, stride, width, stride).permute(0, 3, 5, 1, 2, 4)
    return x.reshape(images, channels * stride**2, height // stride, width // stride)


def arc_cosine(x):
    """Return the arc cosine; above 0.99, its gradient is that at 0.99."""
    at = x.detach()
    slope = -(1 - at.clamp(max=0.99).square()).rsqrt()
    return at.acos() + slope * (x - at)


def negative_relu(x, slope):
    """Return min(x, 0) + slope max(x, 0)."""
    return torch.where(x < 0, x, slope * x)


def hardened_sigmoid(x):
    """Return 0.2 x + 0.5 between 0 and 1; its gradient is 0.2 everywhere."""
    line = 0.2 * x + 0.5
    return line + (line.clamp(0, 1) - line).detach()

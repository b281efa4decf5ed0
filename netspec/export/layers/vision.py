"""The expressions of the convolutions, Im2col, Pooling, SPP."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import nn
from torch.nn import functional as F

from netspec.export.exporter import exports, refusal
from netspec.export.expression import Expression, call
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.contract.base import Shape
from netspec.layers.vision.convolution import Convolution, Deconvolution
from netspec.layers.vision.pooling import MAX, SPP, STOCHASTIC, Pooling
from netspec.layers.vision.sliding import Im2col
from netspec.layers.vision.windows import CEIL, SMALLEST, Windows
from netspec.proto.schema import TRAIN


def each(sizes: Shape) -> Shape | int:
    """Return the sizes along some axes; one number if all are the same."""
    return sizes[0] if len(set(sizes)) == 1 else tuple(sizes)


def geometry(layer: Any) -> dict[str, Any]:
    """Return the arguments of a filter that are not usual; one number if all axes have the same."""
    given = {"stride": (layer.stride, 1), "padding": (layer.pad, 0), "dilation": (layer.dilation, 1)}
    unusual = {name: each(values) for name, (values, usual) in given.items() if set(values) - {usual}}
    return {"kernel_size": each(layer.kernel) if layer.kernel else 1, **unusual}


def _whole(layer: Any, code: TorchCode, x: Expression) -> Expression:
    """Return a bottom padded so that the filter, if it is longer than the map, fits once."""
    zeros = layer.overhang(layer.bottom_shapes[0])
    for axis, more in zip(range(len(layer.bottom_shapes[0])), zeros[::-2], strict=False):
        if more:
            code.size(0, layer.channel_axis + 1 + axis, "its filter is larger than the map")
    return call(F.pad, x, tuple(zeros)) if any(zeros) else x


def _filtered(layer: Any, code: TorchCode, x: Expression, made: Any) -> Expression:
    """Return ``made`` of a bottom as (N, C, spatial axes, at least one), with the axes of the top."""
    axis, bottom = layer.channel_axis, x
    x = _whole(layer, code, x)
    x = x if layer.spatial_axes else x[..., None]
    y = made(x if axis == 1 else x[None] if axis == 0 else x.flatten(0, axis - 1))
    y = y if layer.spatial_axes else y[..., 0]
    return y if axis == 1 else y[0] if axis == 0 else y.unflatten(0, bottom.shape[:axis])


@exports(Im2col)
def im2col(layer: Any, code: TorchCode, x: Expression) -> Expression:
    if layer.spatial_axes != 2:
        raise refusal(layer, "PyTorch has it for 2 spatial axes")
    for axis in (-2, -1):
        code.size(0, len(layer.bottom_shapes[0]) + axis, "its windows are counted in advance")
    return _filtered(layer, code, x, lambda x: call(lay_out_windows, x, layer.top_shapes[0][-2], **geometry(layer)))


@exports(Convolution)
def convolution(layer: Any, code: TorchCode, *bottoms: Expression) -> Sequence[Expression]:
    return convolved(layer, code, (nn.Conv1d, nn.Conv2d, nn.Conv3d), bottoms)


@exports(Deconvolution)
def deconvolution(layer: Any, code: TorchCode, *bottoms: Expression) -> Sequence[Expression]:
    return convolved(layer, code, (nn.ConvTranspose1d, nn.ConvTranspose2d, nn.ConvTranspose3d), bottoms)


def convolved(
    layer: Any, code: TorchCode, classes: Sequence[type[nn.Module]], bottoms: Sequence[Expression]
) -> Sequence[Expression]:
    """Return the bottoms through one module, of the class for 1, 2 or 3 spatial axes."""
    if layer.spatial_axes > 3:
        raise refusal(layer, f"PyTorch has none of {layer.spatial_axes} spatial axes")
    weight = layer.blob(0) if layer.spatial_axes else layer.blob(0)[..., None]
    options, state = geometry(layer), {"weight": weight}
    if layer.group != 1:
        options["groups"] = layer.group
    if len(layer.blobs) > 1:
        state["bias"] = layer.blob(1)
    else:
        options["bias"] = False
    cls = classes[max(layer.spatial_axes - 1, 0)]
    module = code.module(cls, layer.channels, layer.num_output, state=state, **options)
    return [_filtered(layer, code, bottom, module) for bottom in bottoms]


def pooled(layer: Any, code: TorchCode, x: Expression, windows: Windows, mask: bool = False) -> Expression:
    """Return the pooled maps; with ``mask``, the maps and the mask."""
    method = layer.method if isinstance(layer, Pooling) else layer.param.spp_param.pool
    if layer.phase == TRAIN and method == STOCHASTIC:
        raise refusal(layer, "STOCHASTIC pooling draws random numbers in the training phase")
    if any(r >= k for r, k in zip(windows.reach, windows.kernel, strict=True)):
        raise refusal(layer, "windows with stride > kernel can lie outside the map; use round_mode: FLOOR")
    kernel = each(windows.kernel)
    options = {"stride": each(windows.stride)} if windows.stride != windows.kernel else {}
    beyond = any(r > p for r, p in zip(windows.reach, windows.pad, strict=True))
    if any(2 * p > k for p, k in zip(windows.pad, windows.kernel, strict=True)):  # more than torch allows
        frame = (windows.pad[1], windows.reach[1], windows.pad[0], windows.reach[0])
        if mask:
            return call(max_pool_of_padded, x, frame, kernel, **options)
        if method == MAX:
            return call(F.max_pool2d, call(F.pad, x, frame, value=-math.inf), kernel, **options)
        for axis in (2, 3) if beyond else ():
            code.size(0, axis, "the areas of its windows are counted in advance")
        return means_of_padded(code, x, frame, windows.kernel, windows.stride, windows.areas(torch.zeros(())))
    options |= {"padding": each(windows.pad)} if any(windows.pad) else {}
    options |= {"ceil_mode": True} if windows.round_mode == CEIL and windows.stride != (1, 1) else {}
    if mask:
        return call(max_pool_with_mask, x, kernel, **options)
    if method == STOCHASTIC:
        mean = call(F.avg_pool2d, x, kernel, **options).clamp(min=SMALLEST)
        return call(F.avg_pool2d, x.square(), kernel, **options) / mean
    return call(F.max_pool2d if method == MAX else F.avg_pool2d, x, kernel, **options)


def means_of_padded(
    code: TorchCode, x: Expression, frame: Sequence[int], kernel: Shape, stride: Shape, areas: torch.Tensor
) -> Expression:
    """Return the sums over the windows of a padded map, divided by their areas."""
    means = call(F.avg_pool2d, call(F.pad, x, tuple(frame)), each(kernel), each(stride))
    shares = (areas / math.prod(kernel)).float()
    return means if bool((shares == 1).all()) else means / code.buffer(shares)


@exports(Pooling)
def pooling(layer: Any, code: TorchCode, x: Expression) -> Expression:
    mask = layer.num_tops > 1
    if not layer.param.pooling_param.global_pooling:
        return pooled(layer, code, x, layer.windows, mask)
    if layer.method == STOCHASTIC or mask:
        for axis in (2, 3):
            code.size(0, axis, "its only window is the whole map")
        return pooled(layer, code, x, layer.windows, mask)
    return call(F.adaptive_max_pool2d if layer.method == MAX else F.adaptive_avg_pool2d, x, 1)


@exports(SPP)
def spp(layer: Any, code: TorchCode, x: Expression) -> Expression:
    for axis in (2, 3):
        code.size(0, axis, "the windows of its pyramid depend on the map's size")
    levels = [pooled(layer, code, x, windows) for windows in layer.levels]
    return levels[0] if len(levels) == 1 else call(torch.cat, [level.flatten(1) for level in levels], dim=1)


def max_pool_with_mask(x, kernel_size, **geometry):
    """Return the maxima, and the pixels that have them, as numbers of x's type."""
    top, pixels = F.max_pool2d(x, kernel_size, return_indices=True, **geometry)
    return top, pixels.to(x.dtype)


def max_pool_of_padded(x, frame, kernel_size, stride=None):
    """Return the maxima of a padded map, and the pixels of the map itself that have them."""
    left, _, above, _ = frame
    padded = F.pad(x, frame, value=-torch.inf)
    top, pixels = F.max_pool2d(padded, kernel_size, stride, return_indices=True)
    row = torch.div(pixels, padded.shape[3], rounding_mode="floor")
    column = pixels - row * padded.shape[3]
    return top, ((row - above) * x.shape[3] + column - left).to(x.dtype)


def lay_out_windows(x, rows, **geometry):
    """Return the pixels under each position of a filter as channels (N, C K, H, W)."""
    return F.unfold(x, **geometry).unflatten(2, (rows, -1))

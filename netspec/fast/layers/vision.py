"""Kernels of convolutions and pooling (netspec/layers/vision)."""

# pyright: reportPrivateImportUsage=false
from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F

from netspec.exact import SMALL_PRODUCT
from netspec.exact.layout import channels_side_by_side, in_shape, laid_out_like, map_by_map, of_one_channel
from netspec.exact.products import ColumnProducts, Filter
from netspec.fast import fused
from netspec.fast.entry import Entry
from netspec.fast.folding import Absorbed, Folds, blob_like, copy_of
from netspec.fast.kernels import (
    Inference,
    Kernel,
    Learning,
    operation_kernel,
    operation_kernels,
    padded,
    with_activation,
)
from netspec.layers.vision.convolution import Convolution, Deconvolution
from netspec.layers.vision.pooling import AVE, STOCHASTIC, Pooling
from netspec.layers.vision.windows import CEIL, LOWEST, max_pool
from netspec.run.recorded import Kernels, recorded


def is_usual(layer: Convolution) -> bool:
    """Return whether torch has this convolution: a single bottom (N, C, H, W), the same padding on both sides."""
    over_maps = layer.channel_axis == 1 and layer.spatial_axes == 2 and not any(layer.overhang(layer.bottom_shapes[0]))
    return over_maps and len(layer.bottom_shapes) == 1 and math.prod(layer.top_shapes[0]) > 0


def convolution(layer: Convolution, how: Inference) -> Kernel | None:
    """Return the kernel of a usual convolution; None for others."""
    if not is_usual(layer):
        return None
    shape, sliding = layer.bottom_shapes[0], Filter(layer.kernel, layer.stride, layer.pad, layer.dilation)
    weight, bias = layer.blob(0), layer.blob(1) if len(layer.blobs) > 1 else None
    if layer.arithmetic(weight).is_caffes:
        return operation_kernel(ColumnProducts(sliding, layer.group), layer, shape, how)
    if sliding.reads_padding_alone:
        return None
    if shape[0] * layer.work > SMALL_PRODUCT and how.pack and fused.suits(weight):
        return fused.convolution(shape, weight, bias, sliding, layer.group, how)
    geometry = (layer.stride, layer.pad, layer.dilation, layer.group)
    return with_activation(lambda maps: torch.conv2d(of_one_channel(maps), weight, bias, *geometry), how.activation)


def learn_convolution(layer: Convolution, how: Learning) -> Kernels | None:
    """Return the training kernels of a usual convolution; None for others."""
    if not is_usual(layer):
        return None
    shape, sliding = layer.bottom_shapes[0], Filter(layer.kernel, layer.stride, layer.pad, layer.dilation)
    weight, bias = padded(layer.values())
    if layer.arithmetic(weight).is_caffes:
        return operation_kernels(ColumnProducts(sliding, layer.group), layer, (shape, layer.top_shapes[0]), how)
    if sliding.reads_padding_alone:
        return None
    lay_out = channels_side_by_side if math.prod(shape) > 2 * weight.numel() else map_by_map
    wanted, sums, geometry = how.wanted[0], padded(how.sums), (sliding.stride, sliding.pad, sliding.dilation)
    needed = (wanted, *(total is not None for total in sums))
    bias_shape = None if bias is None else list(bias.shape)
    top_shape, group = layer.top_shapes[0], layer.group
    gradients = torch.ops.aten.convolution_backward.default
    maps = laid_out = weight

    def forward(x: torch.Tensor) -> torch.Tensor:
        nonlocal maps, laid_out
        maps = in_shape(x, shape)
        laid_out = lay_out(maps)
        return in_shape(torch.conv2d(laid_out, weight, bias, *geometry, group), top_shape)

    def backward(diff: torch.Tensor) -> torch.Tensor | None:
        maps_diff, *found = gradients(
            in_shape(diff, top_shape), laid_out, weight, bias_shape, *geometry, False, [0, 0], group, needed
        )
        for total, gradient in zip(sums, found, strict=True):
            if total is not None:
                total.add_(gradient)
        return in_shape(laid_out_like(maps, maps_diff), shape) if wanted else None

    return Kernels(forward, backward)


def convolution_folds(layer: Convolution) -> Folds:
    """Return how a convolution or deconvolution absorbs scales and shifts of the channels of its top."""

    def absorb(scale: torch.Tensor, shift: torch.Tensor) -> Absorbed:
        param = copy_of(layer.param)
        param.convolution_param.bias_term = True
        bias = blob_like(layer, 1, shift) if len(layer.blobs) > 1 else torch.zeros_like(shift)
        return Absorbed(param, (_scaled_filters(layer, scale.expand(layer.num_output)), scale * bias + shift))

    return Folds(absorb=absorb if layer.channel_axis == 1 else None)


def _scaled_filters(layer: Convolution, scale: torch.Tensor) -> torch.Tensor:
    """Return blobs[0] with the filters of output channel c multiplied by ``scale[c]``."""
    filters = blob_like(layer, 0, scale)
    if not isinstance(layer, Deconvolution):
        return filters * scale.reshape(-1, *(1,) * (filters.dim() - 1))
    grouped = filters.reshape(layer.group, -1, *filters.shape[1:])
    factors = scale.reshape(layer.group, 1, -1, *(1,) * layer.spatial_axes)
    return (grouped * factors).reshape(filters.shape)


def _deconvolution(layer: Deconvolution, how: Inference) -> Kernel | None:
    weight, bias = layer.blob(0), layer.blob(1) if len(layer.blobs) > 1 else None
    usual = layer.channel_axis == 1 and layer.spatial_axes == 2 and len(layer.bottom_shapes) == 1
    exact, large = layer.arithmetic(weight).is_caffes, layer.multiply_adds() > SMALL_PRODUCT
    if not (usual and not exact and large and how.pack and fused.suits(weight)):
        return None
    shape, sliding = layer.bottom_shapes[0], Filter(layer.kernel, layer.stride, layer.pad, layer.dilation)
    if layer.group == 1:
        return fused.deconvolution(shape, weight, bias, sliding, how)
    fits = all(p < e for p, e in zip(layer.pad, layer.extent, strict=True))
    if layer.group == layer.channels == layer.num_output and fits and max(layer.stride) <= 2:
        return fused.spread_by_channel(shape, weight, bias, sliding, how)
    return None


def _has_kernels(layer: Pooling) -> bool:
    usual = layer.num_tops == 1 and layer.method != STOCHASTIC and layer.windows.known_to_torch
    return usual and math.prod(layer.top_shapes[0]) > 0


def _pooling(layer: Pooling, how: Inference) -> Kernel | None:
    if not _has_kernels(layer):
        return None
    windows = layer.windows
    geometry, ceil = (windows.kernel, windows.stride, windows.pad), windows.round_mode == CEIL
    if layer.method == AVE:
        return with_activation(lambda maps: F.avg_pool2d(maps, *geometry, ceil, True), how.activation)

    def kernel(maps: torch.Tensor) -> torch.Tensor:
        values = torch.max_pool2d(maps, *geometry, 1, ceil)
        # As in max_pool: torch returns NaN if a window contains NaN, Caffe does not.
        return values if values.amin().item() > LOWEST else max_pool(maps, windows)[0]

    return with_activation(kernel, how.activation)


def _learn_pooling(layer: Pooling, how: Learning) -> Kernels | None:
    """Return the kernels. If a window has no maximum, autograd records the run."""
    if not _has_kernels(layer):
        return None
    windows = layer.windows
    record, trace = recorded(layer.run, how.wanted)
    geometry, ceil = (windows.kernel, windows.stride, windows.pad), windows.round_mode == CEIL
    given = bottom = indices = torch.empty(0)
    if layer.method == AVE:
        spread_evenly = torch.ops.aten.avg_pool2d_backward.default

        def average(maps: torch.Tensor) -> torch.Tensor:
            nonlocal bottom
            bottom = maps
            return F.avg_pool2d(maps, *geometry, ceil, True)

        return Kernels(average, lambda diff: spread_evenly(diff, bottom, *geometry, ceil, True, None))
    spread, is_usual = torch.ops.aten.max_pool2d_with_indices_backward.default, True

    def forward(maps: torch.Tensor) -> Any:
        nonlocal given, bottom, indices, is_usual
        given, bottom = maps, channels_side_by_side(maps)
        values, indices = F.max_pool2d(bottom, *geometry, 1, ceil, return_indices=True)
        is_usual = values.amin().item() > LOWEST  # as in max_pool, because torch treats NaN differently
        return values if is_usual else record(maps)

    def backward(diff: torch.Tensor) -> Any:
        if not is_usual:
            return trace(diff)
        found = spread(diff, bottom, *geometry, [1, 1], ceil, indices)
        return found if bottom is given else found.contiguous()

    return Kernels(forward, backward)


CONVOLUTION = Entry(convolution, learn_convolution, convolution_folds, fresh=True, any_layout=True)
ENTRIES = {
    Convolution: CONVOLUTION,
    Deconvolution: Entry(_deconvolution, folds=convolution_folds, fresh=True, any_layout=True),
    Pooling: Entry(_pooling, _learn_pooling, fresh=True, any_layout=True),
}

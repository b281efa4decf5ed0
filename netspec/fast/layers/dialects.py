"""Kernels of layers of dialects, by the path of the class, so that a dialect is imported only if a net uses it."""

from __future__ import annotations

from typing import Any

from netspec.fast.entry import Entry
from netspec.fast.folding import Affine, Folds, blob_in_double
from netspec.fast.kernels import Inference, Kernel, Learning, clip
from netspec.fast.layers.normalization import affine
from netspec.fast.layers.vision import CONVOLUTION, convolution, convolution_folds, learn_convolution
from netspec.run.recorded import Kernels


def _capped_folds(layer: Any) -> Folds:
    return Folds(activation=None if layer.slope else clip(0, 6))


def _padded(layer: Any, how: Inference) -> Kernel | None:
    return None if any(layer.sides) else convolution(layer, how)


def _learn_padded(layer: Any, how: Learning) -> Kernels | None:
    return None if any(layer.sides) else learn_convolution(layer, how)


def _nvidia_folds(layer: Any) -> Folds:
    def with_slopes() -> Affine:
        scale, shift = affine(layer)
        if not layer.scales:
            return scale, shift
        slope, bias = (blob_in_double(layer, i) for i in (3, 4))
        return scale * slope, shift * slope + bias

    return Folds(affine=with_slopes if layer.use_global_stats else None)


def _bn_folds(layer: Any) -> Folds:
    def by_moving() -> Affine:
        slope, bias = (blob_in_double(layer, i).reshape(-1) for i in (0, 1))
        if not layer.moving:
            return slope, bias
        mean, variance = (blob_in_double(layer, i).reshape(-1) for i in (2, 3))
        scale = slope * (variance if layer.inverse else (variance + layer.eps).rsqrt())
        return scale, bias - mean * scale

    return Folds(affine=None if layer.by_batch else by_moving)


_CAPPED = Entry(folds=_capped_folds, fresh=True, any_layout=True)
ENTRIES = {
    "netspec.dialects.blocks.blocks.ConvolutionDepthwise": CONVOLUTION,
    "netspec.dialects.blocks.blocks.DepthwiseConvolution": CONVOLUTION,
    "netspec.dialects.blocks.blocks.ReLU6": _CAPPED,
    "netspec.dialects.blocks.filters.Convolution": Entry(
        _padded, _learn_padded, convolution_folds, fresh=True, any_layout=True
    ),
    "netspec.dialects.blocks.filters.ReLU": _CAPPED,
    "netspec.dialects.blocks.nvidia.BatchNorm": Entry(folds=_nvidia_folds),
    "netspec.dialects.segmentation.segnet.BN": Entry(folds=_bn_folds),
    "netspec.dialects.video.c3d.Convolution3D": CONVOLUTION,
    "netspec.dialects.video.c3d.NdConvolution": CONVOLUTION,
}

"""Video volumes (N, C, L, H, W): convolution and pooling over time, height and width.

Forks: facebookarchive/C3D, version 1.1 (Convolution3D, Pooling3D); chuckcho/video-caffe (NdConvolution, NdPooling,
which run only on GPUs, with cuDNN).
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import torch
import torch.nn.functional as F
from typing_extensions import override

from netspec.dialects.checks import check_at_least_1
from netspec.dialects.gradients import with_gradient_of
from netspec.layers import Layer, register
from netspec.layers.contract.base import Shape
from netspec.layers.vision.convolution import Convolution
from netspec.layers.vision.pooling import AVE, MAX, STOCHASTIC
from netspec.layers.vision.windows import LOWEST
from netspec.proto.schema import has, value

DECLARATIONS = """
message Convolution3DParameter {
  optional uint32 num_output = 1;
  optional bool bias_term = 2 [default = true];
  optional uint32 pad = 3 [default = 0];
  optional uint32 kernel_size = 4;
  optional uint32 group = 5 [default = 1];
  optional uint32 kernel_depth = 6;
  optional uint32 stride = 7 [default = 1];
  optional uint32 temporal_stride = 8 [default = 1];
  optional FillerParameter weight_filler = 9;
  optional FillerParameter bias_filler = 10;
  optional uint32 filter_group = 11 [default = 1];
  optional uint32 temporal_pad = 12 [default = 0];
}
message Pooling3DParameter {
  enum PoolMethod { MAX = 0; AVE = 1; STOCHASTIC = 2; }
  optional PoolMethod pool = 1 [default = MAX];
  optional uint32 kernel_size = 2;
  optional uint32 stride = 3 [default = 1];
  optional uint32 pad = 4 [default = 0];
  optional uint32 kernel_depth = 5;
  optional uint32 temporal_stride = 6 [default = 1];
}
extend ConvolutionParameter {
  optional BlobShape pad_shape = 7777;
  optional BlobShape kernel_shape = 7778;
  optional BlobShape stride_shape = 7779;
}
extend PoolingParameter {
  optional BlobShape pad_shape = 7777;
  optional BlobShape kernel_shape = 7778;
  optional BlobShape stride_shape = 7779;
}
extend LayerParameter {
  optional Convolution3DParameter convolution3d_param = 6661;
  optional Pooling3DParameter pooling3d_param = 6662;
}
"""

SHAPES = ("kernel_shape", "stride_shape", "pad_shape")


@register("Convolution3D", "convolution3d_param")
class Convolution3D(Convolution):
    """Caffe's Convolution over time, height and width.

    filter_group only affects memory; the fork does not read ``group``.

    bottom[0]  (N, C, L, H, W)
    top[0]     (N, num_output, L', H', W'),  L' = (L + 2 temporal_pad - kernel_depth) // temporal_stride + 1
    blobs[0]   filters (num_output, C, kernel_depth, kernel_size, kernel_size)
    blobs[1]   bias    (num_output,)                                   unless bias_term: false
    Fork: facebookarchive/C3D, C3D-v1.1/src/caffe/layers/convolution3d_layer.cpp
    """

    bottoms, tops = (1, 1), (1, 1)

    def setup(self) -> None:
        given: Any = value(self.param, "convolution3d_param")
        if len(self.bottom_shapes[0]) != 5:
            raise self.error(f"found a bottom of shape {self.bottom_shapes[0]}, expected (N, C, L, H, W)", "bottom", 0)
        check_at_least_1(self, "convolution3d_param", "kernel_size", "kernel_depth")
        self.param = copy.deepcopy(self.param)
        param = self.param.convolution_param
        param.num_output, param.bias_term = given.num_output, given.bias_term
        param.kernel_size.extend((given.kernel_depth, given.kernel_size, given.kernel_size))
        param.stride.extend((given.temporal_stride, given.stride, given.stride))
        param.pad.extend((given.temporal_pad, given.pad, given.pad))
        for name in ("weight_filler", "bias_filler"):
            if given.HasField(name):
                getattr(param, name).CopyFrom(getattr(given, name))
        super().setup()


@register("NdConvolution", "convolution_param", *(f"convolution_param.{name}" for name in SHAPES))
class NdConvolution(Convolution):
    """Caffe's Convolution, with kernel, stride and pad given as shapes: ``kernel_shape { dim: 3 dim: 3 dim: 3 }``.

    bottom[i]  (N, C, spatial axes: up to three)
    top[i]     (N, num_output, ...) as Convolution's
    blobs[0]   filters (num_output, C / group, kernel_shape)
    blobs[1]   bias    (num_output,)                                   unless bias_term: false
    Fork: chuckcho/video-caffe, src/caffe/layers/cudnn_ndconv_layer.cpp
    """

    def setup(self) -> None:
        kernel, stride, pad = _shapes(self, "convolution_param")
        if not kernel:
            raise self.error("kernel_shape is missing", "convolution_param")
        self.param = copy.deepcopy(self.param)
        param = self.param.convolution_param
        for name, numbers in (("kernel_size", kernel), ("stride", stride), ("pad", pad)):
            getattr(param, name)[:] = numbers
        super().setup()


def _shapes(layer: Layer, group: str) -> list[Shape]:
    """Return kernel_shape, stride_shape and pad_shape, or () for one that is not given."""
    param, axes = getattr(layer.param, group), len(layer.bottom_shapes[0]) - 2
    found = []
    for name in SHAPES:
        numbers = tuple(value(param, name).dim) if has(param, name) else ()
        if numbers and (len(numbers) != axes or min(numbers) < (name != "pad_shape")):
            message = f"found {name} {numbers}, expected a number for each of {axes} spatial axes"
            raise layer.error(message, group, name)
        found.append(numbers)
    return found


class _VolumePooling(Layer):
    """Base of pooling layers for volumes."""

    group: str
    kernel: Shape
    stride: Shape
    pad: Shape
    drops_last = False  # along a padded axis: a window that begins past the map and its padding
    whole_kernel = False  # what an average divides by; else what of a window lies in the map and its padding
    not_exported = "it pools volumes"

    def read(self) -> tuple[int, Shape, Shape, Shape]:
        """Return the method, kernel, stride and pad; () means a kernel as large as the map, or the default."""
        raise NotImplementedError

    def setup(self) -> None:
        self.method, self.kernel, self.stride, self.pad = self.read()
        if self.method == STOCHASTIC:
            raise self.error("there is no STOCHASTIC pooling of volumes, in the fork neither", self.group, "pool")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the shape of the top, rounded up as in Caffe's Pooling except for its rule for padding."""
        shape, counts = bottom_shapes[0], []
        self.frame: list[int] = []  # in the order of F.pad
        lengths: list[torch.Tensor] = []
        kernel = self.kernel or shape[2:]
        axes = zip(shape[2:], kernel, self.stride or (1,) * len(kernel), self.pad or (0,) * len(kernel), strict=True)
        for size, length, stride, pad in axes:
            count = -(-(size + 2 * pad - length) // stride) + 1
            count -= self.drops_last and pad > 0 and (count - 1) * stride >= size + pad
            if count < 1 or (count - 1) * stride - pad >= size or length <= pad:
                raise self.error(f"no window of {kernel} fits a map of {shape[2:]}, or one lies outside", self.group)
            self.frame = [pad, (count - 1) * stride + length - pad - size, *self.frame]
            starts = torch.arange(count, dtype=torch.float64) * stride - pad
            lengths.append((starts + length).clamp(max=size + pad) - starts)
            counts.append(count)
        self.areas = torch.tensor(float(math.prod(kernel)) if self.whole_kernel else 1.0, dtype=torch.float64)
        for length in lengths if not self.whole_kernel else ():
            self.areas = self.areas[..., None] * length
        ones = (1,) * (3 - len(kernel))
        self.windows = (*ones, *kernel), (*ones, *(self.stride or (1,) * len(kernel)))
        return [(*shape[:2], *counts)]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        padded = F.pad(data, self.frame, value=LOWEST if self.method == MAX else 0.0)
        volume = padded.reshape(*data.shape[:2], *[1] * (5 - data.dim()), *padded.shape[2:])
        if self.method == MAX:
            return self.largest(volume).reshape(self.top_shapes[0])
        kernel, stride = self.windows
        sums = F.avg_pool3d(volume, kernel, stride, divisor_override=1).reshape(self.top_shapes[0])
        return sums / self.areas.to(sums)

    def largest(self, volume: torch.Tensor) -> torch.Tensor:
        """Return the maximum of each window of (N, C, L, H, W); the first of equal pixels gets the gradient."""
        kernel, stride = self.windows
        return F.max_pool3d(volume, kernel, stride)


@register("Pooling3D", "pooling3d_param")
class Pooling3D(_VolumePooling):
    """Reduce each window over time, height and width to its maximum or its average.

    Every pixel equal to a window's maximum gets the gradient. Only AVE has padding; it counts as zeros, up to ``pad``
    beyond the map.

    bottom[0]  (N, C, L, H, W)
    top[0]     (N, C, L', H', W'),  L' = ceil((L - kernel_depth) / temporal_stride) + 1,
               H' = ceil((H + 2 pad - kernel_size) / stride) + 1
    Fork: facebookarchive/C3D, C3D-v1.1/src/caffe/layers/pool3d_layer.cpp
    """

    group = "pooling3d_param"

    @override
    def read(self) -> tuple[int, Shape, Shape, Shape]:
        p: Any = value(self.param, self.group)
        if len(self.bottom_shapes[0]) != 5:
            raise self.error(f"found a bottom of shape {self.bottom_shapes[0]}, expected (N, C, L, H, W)", "bottom", 0)
        check_at_least_1(self, self.group, "kernel_size", "kernel_depth", "stride", "temporal_stride")
        if p.pad and p.pool != AVE:
            raise self.error("only AVE pooling has padding", self.group, "pad")
        sides = (p.kernel_depth, p.kernel_size), (p.temporal_stride, p.stride), (0, p.pad)
        kernel, stride, pad = ((first, other, other) for first, other in sides)
        return p.pool, kernel, stride, pad

    @override
    def largest(self, volume: torch.Tensor) -> torch.Tensor:
        (kernel, stride), top = self.windows, super().largest(volume)

        def largest() -> torch.Tensor:
            total = torch.zeros_like(top)
            for offset in torch.cartesian_prod(*map(torch.arange, kernel)).tolist():
                ends = zip(offset, top.shape[2:], stride, strict=True)
                pixels = volume[(..., *(slice(o, o + (n - 1) * s + 1, s) for o, n, s in ends))]
                total = total + pixels.where(pixels == top, 0)
            return total

        return with_gradient_of(largest, top)


@register("NdPooling", "pooling_param", *(f"pooling_param.{name}" for name in SHAPES))
class NdPooling(_VolumePooling):
    """Reduce each window to its maximum or its average: ``kernel_shape { dim: 1 dim: 2 dim: 2 }``.

    An average is divided by the volume of the kernel; padding and pixels beyond it count as zeros, as in cuDNN.

    bottom[0]  (N, C, spatial axes: up to three)
    top[0]     (N, C, ...), along each axis ceil((size + 2 pad - kernel) / stride) + 1; one less where it is padded and
               the last window would begin past the map and its padding; 1 with global_pooling
    Fork: chuckcho/video-caffe, src/caffe/layers/cudnn_ndpooling_layer.cpp
    """

    group = "pooling_param"
    drops_last = whole_kernel = True

    @override
    def read(self) -> tuple[int, Shape, Shape, Shape]:
        p = self.param.pooling_param
        if not 3 <= len(self.bottom_shapes[0]) <= 5:
            raise self.error(f"found a bottom of shape {self.bottom_shapes[0]}, expected 1 to 3 spatial axes", "bottom")
        kernel, stride, pad = _shapes(self, self.group)
        if not kernel and not p.global_pooling:
            raise self.error("kernel_shape is missing", self.group)
        return p.pool, () if p.global_pooling else kernel, stride, pad

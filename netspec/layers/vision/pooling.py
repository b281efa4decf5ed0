"""Pooling and SPP."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from netspec.layers.contract.base import Layer, Shape
from netspec.layers.contract.registry import register
from netspec.layers.vision.windows import (
    Pair,
    Windows,
    average_pool,
    max_pool,
    sampled_pool,
    weighted_pool,
)
from netspec.proto.schema import TRAIN

MAX, AVE, STOCHASTIC = 0, 1, 2  # caffe.proto: enum PoolingParameter.PoolMethod, and SPPParameter's
HIGHEST_PYRAMID = 16  # levels: 4^16 / 3 windows


class _PoolingBase(Layer):
    """Base of Pooling and SPP."""

    def check_pad(self, windows: Windows, method: int, field: str) -> None:
        """Raise SpecError for padding as long as the kernel, or for a method other than MAX and AVE, as in Caffe."""
        if any(windows.pad) and method == STOCHASTIC:
            raise self.error("STOCHASTIC pooling does not support padding", field)
        if any(p and p >= k for p, k in zip(windows.pad, windows.kernel, strict=True)):
            raise self.error(f"pad {windows.pad} must be less than the kernel {windows.kernel}", field)

    def pool(self, maps: torch.Tensor, windows: Windows, method: int) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return the pooled maps (N, C, down, across) and, for MAX, the index of each maximum."""
        if maps.shape[1] == 0:  # torch takes no maps without channels
            empty = maps.new_empty(*maps.shape[:2], *windows.count)
            return empty, empty if method == MAX else None
        if method == MAX:
            return max_pool(maps, windows)
        if method == AVE:
            return average_pool(maps, windows), None
        if self.phase == TRAIN:
            return sampled_pool(maps, windows, self.context.random.on(maps.device)), None
        return weighted_pool(maps, windows), None


@register("Pooling", "pooling_param")
class Pooling(_PoolingBase):
    """Reduce each window of a map to its maximum, its average, or a random pixel.

    bottom[0]  (N, C, H, W)
    top[0]     (N, C, H', W'),  H' = ceil((H + 2 pad - kernel) / stride) + 1, or floor with round_mode: FLOOR; one less
               if there is padding and the last window would begin past the padded map; 1 with global_pooling
    top[1]     MAX only, optional: the index row * W + column of each maximum in the map, or -1 for none
    Caffe: src/caffe/layers/pooling_layer.cpp; for STOCHASTIC, which Caffe has only on GPUs, pooling_layer.cu
    """

    tops = (1, 2)

    def setup(self) -> None:
        param = self.param.pooling_param
        self.method: int = param.pool
        if self.num_tops > 1 and self.method != MAX:
            raise self.error("only MAX pooling has a second top, the mask", "top", 1)
        if param.global_pooling:
            for name in ("kernel_size", "kernel_h", "kernel_w"):
                if param.HasField(name):
                    raise self.error(f"global_pooling takes the whole map: remove {name}", "pooling_param", name)
        else:
            self.kernel = self._pair("kernel_size", "kernel_h", "kernel_w", least=1)
        self.stride = self._pair("stride", "stride_h", "stride_w", least=1)
        self.pad = self._pair("pad", "pad_h", "pad_w", least=0)
        if param.global_pooling and (self.pad != (0, 0) or self.stride != (1, 1)):
            raise self.error("global_pooling requires pad 0 and stride 1", "pooling_param", "global_pooling")

    def _pair(self, name: str, name_h: str, name_w: str, least: int) -> Pair:
        param, field = self.param.pooling_param, "pooling_param"
        given = [n for n in (name_h, name_w) if param.HasField(n)]
        if given and param.HasField(name):
            raise self.error(f"found both {name} and {given[0]}; give one of them", field, given[0])
        if len(given) == 1:
            raise self.error(f"found {given[0]} only; give both {name_h} and {name_w}, or {name}", field, given[0])
        if not given and name == "kernel_size" and not param.HasField(name):
            message = "kernel_size (or kernel_h and kernel_w, or global_pooling) is missing"
            raise self.error(message, field)
        pair = (getattr(param, name_h), getattr(param, name_w)) if given else (getattr(param, name),) * 2
        if min(pair) < least:
            raise self.error(
                f"{name} must be at least {least}, found {pair[0]} x {pair[1]}", field, (given or [name])[0]
            )
        return pair

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shape, param = bottom_shapes[0], self.param.pooling_param
        if len(shape) != 4:
            raise self.error(f"pooling needs a bottom of 4 axes (N, C, H, W), found shape {shape}", "bottom")
        size = (shape[2], shape[3])
        kernel = size if param.global_pooling else self.kernel
        self.windows = Windows(size, kernel, self.stride, self.pad, param.round_mode)
        self.check_pad(self.windows, self.method, "pooling_param")
        if min(self.windows.count) < 1 or min(size) < 1:
            message = f"no window of {kernel} at stride {self.stride}, pad {self.pad}, fits a map of {size}"
            raise self.error(message, "pooling_param")
        return [(*shape[:2], *self.windows.count)] * self.num_tops

    def forward(self, data: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        values, indices = self.pool(data, self.windows, self.method)
        return values if indices is None or self.num_tops == 1 else (values, indices.to(values.dtype))


@register("SPP", "spp_param")
class SPP(_PoolingBase):
    """Pool a map into 1, 2 x 2, 4 x 4, ... windows, which gives the same number of features for any size of the map.

    bottom[0]  (N, C, H, W)
    top[0]     (N, C (1 + 4 + 16 + ...)) with ``pyramid_height`` terms, level by level; (N, C, 1, 1) for height 1
    Caffe: src/caffe/layers/spp_layer.cpp
    """

    def setup(self) -> None:
        if self.param.spp_param.pyramid_height < 1:
            raise self.error("pyramid_height must be at least 1", "spp_param", "pyramid_height")
        if self.param.spp_param.pyramid_height > HIGHEST_PYRAMID:
            message = f"pyramid_height must be at most {HIGHEST_PYRAMID}, so that an int can count its windows"
            raise self.error(message, "spp_param", "pyramid_height")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the number of features, and compute the windows of each level."""
        shape, param = bottom_shapes[0], self.param.spp_param
        if len(shape) != 4:
            raise self.error(f"SPP needs a bottom of 4 axes (N, C, H, W), found shape {shape}", "bottom")
        if 0 in shape[2:]:
            raise self.error(f"found maps of {shape[2]} x {shape[3]} pixels, expected at least one", "bottom")
        self.levels = [_pyramid_level(2**level, (shape[2], shape[3])) for level in range(param.pyramid_height)]
        for windows in self.levels:
            self.check_pad(windows, param.pool, "spp_param")
        if len(self.levels) == 1:
            return [(*shape[:2], *self.levels[0].count)]
        return [(shape[0], shape[1] * sum(w.count[0] * w.count[1] for w in self.levels))]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        copies = self.arithmetic(data).copies(data, len(self.levels))  # Caffe's SPP is a separate net with a Split
        method = self.param.spp_param.pool
        pooled = [self.pool(copy, windows, method)[0] for copy, windows in zip(copies, self.levels, strict=True)]
        return pooled[0] if len(pooled) == 1 else torch.cat([level.flatten(1) for level in pooled], dim=1)


def _pyramid_level(bins: int, size: Pair) -> Windows:
    """Return ``bins`` x ``bins`` adjacent windows that cover a map of ``size``."""
    kernel = (-(-size[0] // bins), -(-size[1] // bins))
    pad = ((kernel[0] * bins - size[0] + 1) // 2, (kernel[1] * bins - size[1] + 1) // 2)
    return Windows(size, kernel, kernel, pad)

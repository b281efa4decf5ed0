"""Layers that normalize each image separately: LRN, MVN."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from netspec.exact.lrn import Settings
from netspec.layers.contract.base import MOST, Layer, Shape, is_in_place
from netspec.layers.contract.registry import register

ACROSS_CHANNELS = 0  # caffe.proto: enum LRNParameter.NormRegion


@register("LRN", "lrn_param")
class LRN(Layer):
    """Divide each value by (k + alpha m) ** beta, where m is the mean of the squares of its neighbors.

    With n = ``local_size``, the neighbors are n channels (ACROSS_CHANNELS), or n x n pixels (WITHIN_CHANNEL, where k is
    1 and cannot be set). Neighbors outside the map count as zeros.

    bottom[0]  (N, C, H, W)
    top[0]     the same shape
    Caffe: src/caffe/layers/lrn_layer.cpp
    """

    def setup(self) -> None:
        param = self.param.lrn_param
        if param.local_size % 2 == 0 or param.local_size > MOST:
            expected = "odd" if param.local_size % 2 == 0 else f"at most {MOST}"
            raise self.error(f"local_size must be {expected}, found {param.local_size}", "lrn_param", "local_size")
        if param.norm_region == ACROSS_CHANNELS:
            self.ignores_propagate_down = frozenset({0})
        else:
            self.ignores = frozenset({"lrn_param.k"})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if len(bottom_shapes[0]) != 4:
            raise self.error(f"LRN needs a bottom of 4 axes (N, C, H, W), found shape {bottom_shapes[0]}", "bottom")
        return bottom_shapes

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        if self.param.lrn_param.norm_region == ACROSS_CHANNELS:
            return self.arithmetic(data).across_channels(data, self.settings)
        return self.arithmetic(data).within_channel(data, self.settings)

    @property
    def gradient_reads(self) -> frozenset[str]:
        across = self.param.lrn_param.norm_region == ACROSS_CHANNELS
        return frozenset({"top"} if across and not is_in_place(self) else ())

    @property
    def settings(self) -> Settings:
        """The size, alpha, beta and k of the prototxt."""
        param = self.param.lrn_param
        return Settings(param.local_size, param.alpha, param.beta, param.k)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return self.arithmetic(bottom).across_channels_gradient(bottom, top, diff, self.settings)


@register("MVN", "mvn_param")
class MVN(Layer):
    """Subtract the mean of each map and divide by its standard deviation plus ``eps``.

    A map is one channel of an image or, with ``across_channels``, the whole image.

    bottom[0]  (N, C, H, W); up to four axes
    top[0]     (N, C, H, W); always four axes, missing ones are 1
    Caffe: src/caffe/layers/mvn_layer.cpp
    """

    ignores_propagate_down = frozenset({0})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shape = bottom_shapes[0]
        if len(shape) > 4:
            raise self.error(f"MVN takes up to 4 axes (N, C, H, W), found shape {shape}", "bottom")
        return [(*shape, *(1,) * (4 - len(shape)))]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        param = self.param.mvn_param
        eps = param.eps if param.normalize_variance else None
        return self.arithmetic(data).standardized(self._maps(data), eps).reshape(self.top_shapes[0])

    @property
    def gradient_reads(self) -> frozenset[str]:
        if not self.param.mvn_param.normalize_variance:
            return frozenset()
        return frozenset({"top", "kept"} if is_in_place(self) else {"top"})  # Caffe keeps the variance, but not the top

    def _maps(self, blob: torch.Tensor) -> torch.Tensor:
        """Return the maps of a bottom or top as rows."""
        shape, outer = self.top_shapes[0], 1 if self.param.mvn_param.across_channels else 2
        return blob.reshape(math.prod(shape[:outer]), math.prod(shape[outer:]))

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        maps, tops, diffs = self._maps(bottom), self._maps(top), self._maps(diff)
        found = self.arithmetic(bottom).standardized_gradient(maps, tops, diffs, self.param.mvn_param.eps)
        return found.reshape(bottom.shape)

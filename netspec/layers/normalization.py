"""BatchNorm, and functions for layers of forks that normalize a batch."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from typing_extensions import override

from netspec.exact import SMALL_ITEM
from netspec.exact.arithmetic import AsTorch, Function
from netspec.layers.contract.base import Layer, Param, Shape
from netspec.layers.contract.registry import register
from netspec.proto.schema import TEST


@register("BatchNorm", "batch_norm_param")
class BatchNorm(Layer):
    """Subtract each channel's mean and divide by its standard deviation, of the batch, or averages in testing.

    y = (x - mean) / sqrt(var + eps) with the biased variance of the batch, or with blobs[0 and 1] / blobs[2] if
    ``use_global_stats`` (the default in the test phase). Training adds to the sums: S = S moving_average_fraction + the
    batch's mean, its unbiased variance, or 1. Layers that share the blobs add one after the other.

    bottom[0]  (N, C) or (N, C, ...); (N,) is one channel
    top[0]     the same shape
    blobs[0]   sum of means     (C,)
    blobs[1]   sum of variances (C,)
    blobs[2]   sum of weights   (1,)        the divisor of the others; all three are not learned (lr_mult 0)
    Caffe: src/caffe/layers/batch_norm_layer.cpp
    """

    ignores_propagate_down = frozenset({0})
    joined: tuple[Layer, ...] = ()  # a Scale and a ReLU after it that it also computes, in training
    rectifies = False  # whether they include a ReLU
    first_weight = 0.0  # what blobs[2] begins with

    def setup(self) -> None:
        """Add the sums, all zero. Raise SpecError for a ``param`` that would train them."""
        param = self.param.batch_norm_param
        self.check_params()
        self.use_global_stats: bool = (
            param.use_global_stats if param.HasField("use_global_stats") else self.phase == TEST
        )
        if not self.bottom_shapes[0]:
            raise self.error("BatchNorm needs at least 1 axis, found a scalar", "bottom")
        self.channels = _with_channels(self.bottom_shapes[0])[1]
        for shape, start in (((self.channels,), 0.0), ((self.channels,), 0.0), ((1,), self.first_weight)):
            self.add_blob(shape, value=start)

    def check_params(self) -> None:
        """Raise SpecError for a ``param`` that would train the sums."""
        for i, spec in enumerate(self.param.param[:3]):
            if spec.lr_mult != 0:
                message = f"BatchNorm's blobs are statistics, not learned: set lr_mult: 0, found {spec.lr_mult:g}"
                raise self.error(message, "param", i, "lr_mult")

    @override
    def param_spec(self, j: int, given: Param | None) -> Param:
        return given or replace(super().param_spec(j, None), lr_mult=0.0)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        as_before(self, [_with_channels(bottom_shapes[0])], self.channels)
        return bottom_shapes

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        """Return the normalized values; in training also add the batch's statistics to the sums."""
        return self.normalized(data) if data.dim() > 1 else self.normalized(data[:, None])[:, 0]

    def normalized(self, data: torch.Tensor) -> torch.Tensor:
        """Do the same for (N, C, ...)."""
        arithmetic = self.arithmetic(data)
        if self.use_global_stats:
            return self.by_stored_statistics(arithmetic)(data)
        top, mean, variance, unbiased = arithmetic.normalized_batch(data, self.eps, *self.factors())
        self.add(mean, variance, unbiased)
        return top.relu_() if self.rectifies else top

    @property
    def eps(self) -> float:
        """The constant added to the variance."""
        return self.param.batch_norm_param.eps

    def stored_statistics(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the stored mean and variance of each channel, (C,)."""
        with torch.no_grad():
            return means(*(self.blob(i) for i in range(3)))

    def by_stored_statistics(self, arithmetic: AsTorch) -> Function:
        """Return a function that normalizes a bottom by the present stored statistics."""
        return arithmetic.normalizes(*self.stored_statistics(), self.eps)

    def joined_with(self, after: Layer) -> Layer | None:
        """Return this layer joined with a Scale of its channels or a ReLU after it, for one kernel of torch."""
        kind = after.joins_as
        fits = (kind == "scale" and not self.joined) or (kind == "relu" and not self.rectifies)
        if not fits or self.use_global_stats or self.arithmetic(self.blob(0)).is_caffes:
            return None
        made = copy.copy(self)
        made.joined, made.rectifies = (*self.joined, after), kind == "relu"
        return made

    def factors(self) -> tuple[torch.Tensor | None, torch.Tensor | None]:
        """Return the factors and biases of the Scale that it was joined with."""
        blobs = [layer.blob(j) for layer in self.joined for j in range(len(layer.blobs))]
        return blobs[0] if blobs else None, blobs[1] if len(blobs) > 1 else None

    @torch.no_grad()
    def add(self, mean: torch.Tensor, variance: torch.Tensor, unbiased: float = 1.0) -> None:
        """Add a batch's statistics to the sums; ``unbiased`` is what makes the variance unbiased."""
        keep = self.param.batch_norm_param.moving_average_fraction
        self.blob(0).mul_(keep).add_(mean)
        self.blob(1).mul_(keep).add_(variance, alpha=unbiased)
        self.blob(2).mul_(keep).add_(1)

    @property
    def small(self) -> bool:
        return math.prod(self.bottom_shapes[0][1:]) <= SMALL_ITEM


def _with_channels(shape: Shape) -> Shape:
    """Return a shape (N, C, ...); a single axis is that of the items."""
    return shape if len(shape) != 1 else (*shape, 1)


def as_before(layer: Layer, shapes: Sequence[Shape], channels: int) -> Sequence[Shape]:
    """Return the shape of a bottom (N, C) or (N, C, ...). Raise SpecError for another number of channels."""
    shape = shapes[0]
    if len(shape) < 2 or shape[1] != channels:
        raise layer.error(f"found a bottom of shape {shape}, expected {channels} channels as before", "bottom")
    return shapes


def means(means: torch.Tensor, variances: torch.Tensor, weight: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the sums divided by their weight, or 0 if nothing was added yet."""
    factor = torch.where(weight == 0, 0, 1 / weight)
    return means * factor, variances * factor

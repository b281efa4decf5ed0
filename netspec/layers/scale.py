"""Scale and Bias, which scale and shift values by learnable numbers or another blob."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from netspec.data.blobs import Shape
from netspec.exact import SMALL_ITEM
from netspec.layers.contract.base import Layer
from netspec.layers.contract.registry import register


class _Affine(Layer):
    """Base of Scale and Bias: an operand, learnable or a second bottom, is broadcast over some axes."""

    bottoms = (1, 2)

    def learned_shape(self, param: Any, field: str) -> Shape:
        """Return the shape of a learnable operand: ``num_axes`` axes of the bottom from ``axis`` on (-1: all)."""
        shape = self.bottom_shapes[0]
        axis = self.canonical_axis(param.axis, shape, field, "axis")
        if param.num_axes < -1:
            raise self.error(f"num_axes must be at least -1, found {param.num_axes}", field, "num_axes")
        end = len(shape) if param.num_axes == -1 else axis + param.num_axes
        if end > len(shape):
            message = f"{param.num_axes} axes from axis {axis} on exceed the bottom of shape {shape}"
            raise self.error(message, field, "num_axes")
        return shape[axis:end]

    def locate(self, shapes: Sequence[Shape], param: Any, field: str) -> int:
        """Return the first axis of the operand in the first bottom; raise SpecError if the shapes do not match."""
        shape = shapes[0]
        axis = 0
        for operand in (*shapes[1:], *self.blob_shapes):
            axis = self.canonical_axis(param.axis, shape, field, "axis") if operand else 0
            if shape[axis : axis + len(operand)] != operand:
                message = f"an operand of shape {operand} does not match the bottom's axes from {axis} on, {shape}"
                raise self.error(message, "bottom", len(shapes) - 1)
        return axis


@register("Scale", "scale_param")
class Scale(_Affine):
    """Multiply by learnable factors or by a second bottom; with bias_term, add a learnable bias.

    bottom[0]  any shape
    bottom[1]  optional, the factors: bottom[0]'s shape from ``axis`` on, for the number of its axes
    top[0]     bottom[0]'s shape
    blobs[0]   factors, bottom[0]'s shape from ``axis`` for ``num_axes``    unless bottom[1] is given
    blobs[1]   bias, the shape of the factors                               with bias_term: true; blobs[0] if bottom[1]
    Caffe: src/caffe/layers/scale_layer.cpp
    """

    def setup(self) -> None:
        param = self.param.scale_param
        shape = self.bottom_shapes[1] if len(self.bottom_shapes) > 1 else self.learned_shape(param, "scale_param")
        if len(self.bottom_shapes) == 1:
            self.add_blob(shape, param.filler if param.HasField("filler") else None, value=1.0)
        if param.bias_term:
            self.add_blob(shape, param.bias_filler)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.axis = self.locate(bottom_shapes, self.param.scale_param, "scale_param")
        return [bottom_shapes[0]]

    def forward(self, data: torch.Tensor, factors: torch.Tensor | None = None) -> torch.Tensor:
        scale = self.blob(0) if factors is None else factors
        bias = self.blob(len(self.blobs) - 1) if self.param.scale_param.bias_term else None
        return self.arithmetic(data).scaled(data, self.axis, scale, bias)

    @property
    def small(self) -> bool:
        shape, axes = self.bottom_shapes[0], len((*self.bottom_shapes[1:], *self.blob_shapes)[0])
        return self.axis == 1 and axes == 1 and math.prod(shape[1:]) <= SMALL_ITEM

    @property
    def by_channel(self) -> bool:
        """Whether it multiplies each channel by a learnable factor."""
        return len(self.bottom_shapes) == 1 and self.axis == 1 and len(self.blob_shapes[0]) == 1

    @property
    def joins_as(self) -> str:
        return "scale" if self.by_channel else ""


@register("Bias", "bias_param")
class Bias(_Affine):
    """Add a learnable bias or a second bottom.

    bottom[0]  any shape
    bottom[1]  optional, the bias: bottom[0]'s shape from ``axis`` on, for the number of its axes
    top[0]     bottom[0]'s shape
    blobs[0]   bias, bottom[0]'s shape from ``axis`` for ``num_axes``       unless bottom[1] is given
    Caffe: src/caffe/layers/bias_layer.cpp
    """

    def setup(self) -> None:
        param = self.param.bias_param
        if len(self.bottom_shapes) == 1:
            self.add_blob(self.learned_shape(param, "bias_param"), param.filler)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.axis = self.locate(bottom_shapes, self.param.bias_param, "bias_param")
        return [bottom_shapes[0]]

    def forward(self, data: torch.Tensor, bias: torch.Tensor | None = None) -> torch.Tensor:
        return self.arithmetic(data).scaled(data, self.axis, None, self.blob(0) if bias is None else bias)

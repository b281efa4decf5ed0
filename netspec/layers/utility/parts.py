"""Layers that divide and join blobs: Concat, Slice, Crop, BatchReindex, Filter."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch

from netspec.layers.contract.base import Layer, Shape
from netspec.layers.contract.registry import register


def _axis(layer: Layer, shape: Shape, param_name: str, old_name: str) -> int:
    """Return the axis of a Concat or a Slice, from ``axis`` or from the field with the older name."""
    p: Any = getattr(layer.param, param_name)
    if not p.HasField(old_name):
        return layer.canonical_axis(p.axis, shape, param_name, "axis")
    if p.HasField("axis"):
        raise layer.error(f"found both axis and {old_name}, expected one of them", param_name, old_name)
    return layer.canonical_axis(getattr(p, old_name), shape, param_name, old_name)


@register("Concat", "concat_param")
class Concat(Layer):
    """Join the bottoms along an axis (default 1; concat_dim is its older name).

    bottom[i]  shapes that are equal except for that axis
    top[0]     the bottoms, one after the other
    Caffe: src/caffe/layers/concat_layer.cpp
    """

    bottoms = (1, None)

    def setup(self) -> None:
        if len(self.bottom_shapes) == 1:  # not copied
            self.shares = frozenset({"data", "diff"})
            self.ignores_propagate_down = frozenset({0})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        first = bottom_shapes[0]
        self.axis = axis = _axis(self, first, "concat_param", "concat_dim")
        for i, shape in enumerate(bottom_shapes):
            others = zip(first[:axis] + first[axis + 1 :], shape[:axis] + shape[axis + 1 :], strict=False)
            if len(shape) != len(first) or any(a != b for a, b in others):
                message = f"found bottoms of shapes {first} and {shape}, expected equal shapes except along axis {axis}"
                raise self.error(message, "bottom", i)
        return [(*first[:axis], sum(shape[axis] for shape in bottom_shapes), *first[axis + 1 :])]

    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        return bottoms[0] if len(bottoms) == 1 else torch.cat(bottoms, self.axis)


@register("Slice", "slice_param")
class Slice(Layer):
    """Split the bottom along an axis (default 1; slice_dim is its older name), before each slice_point, or evenly.

    bottom[0]  any shape
    top[i]     part i of that axis, of which the last may be empty; the other axes are unchanged
    Caffe: src/caffe/layers/slice_layer.cpp
    """

    tops = (1, None)

    def setup(self) -> None:
        if self.num_tops == 1:  # not copied
            self.shares = frozenset({"data", "diff"})
            self.ignores_propagate_down = frozenset({0})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shape = bottom_shapes[0]
        self.axis = axis = _axis(self, shape, "slice_param", "slice_dim")
        points, size = list(self.param.slice_param.slice_point), shape[axis]
        if points:
            if len(points) != self.num_tops - 1:
                message = f"found {len(points)} slice_point, expected {self.num_tops - 1}: one fewer than tops"
                raise self.error(message, "slice_param", "slice_point")
            self.sizes = [end - start for start, end in zip([0, *points], [*points, size], strict=True)]
            if min(self.sizes[:-1]) <= 0 or self.sizes[-1] < 0 or self.num_tops > size:
                expected = f"increasing values from 1 to {size}, the size of axis {axis}"
                message = f"found slice_point {points} for a bottom of shape {shape}, expected {expected}"
                raise self.error(message, "slice_param", "slice_point")
        elif size % self.num_tops:
            message = f"axis {axis} of the bottom, shape {shape}, cannot be divided evenly into {self.num_tops} tops"
            raise self.error(message, "slice_param")
        else:
            self.sizes = [size // self.num_tops] * self.num_tops
        return [(*shape[:axis], part, *shape[axis + 1 :]) for part in self.sizes]

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return x.split(self.sizes, self.axis)


@register("Crop", "crop_param")
class Crop(Layer):
    """Crop a blob to the size of another, from ``axis`` on.

    bottom[0]  the blob to crop, any shape
    bottom[1]  a blob of the wanted size, with at least as many axes; gets no gradient
    top[0]     bottom[0]'s shape before ``axis``, bottom[1]'s from there on
    Caffe: src/caffe/layers/crop_layer.cpp
    """

    bottoms = (2, 2)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the wanted shape, and set the position of the window."""
        data, wanted = bottom_shapes
        param = self.param.crop_param
        axis = self.canonical_axis(param.axis, data, "crop_param", "axis")
        cut = len(data) - axis
        if len(wanted) < len(data):
            raise self.error(f"cannot crop a blob of shape {data} to shape {wanted}, which has fewer axes", "bottom", 1)
        offsets = tuple(param.offset or (0,))
        if len(offsets) not in (1, cut):
            message = f"found offset {len(offsets)} times, expected once or once for each of {cut} cropped axes"
            raise self.error(message, "crop_param", "offset")
        offsets = offsets if len(offsets) == cut else offsets * cut
        self.window = [slice(None)] * axis
        for i, offset in enumerate(offsets, start=axis):
            if offset + wanted[i] > data[i]:
                message = f"offset {offset} and size {wanted[i]} of the crop exceed axis {i}, of size {data[i]}"
                raise self.error(message, "crop_param", "offset", i - axis)
            self.window.append(slice(offset, offset + wanted[i]))
        return [(*data[:axis], *wanted[axis : len(data)])]

    def forward(self, data: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
        return data[tuple(self.window)]


@register("BatchReindex")
class BatchReindex(Layer):
    """Select items of the batch by index; the gradients of an item that is selected several times are added.

    bottom[0]  (N, ...)
    bottom[1]  indices (M,), each from 0 to N - 1
    top[0]     (M, ...)
    Caffe: src/caffe/layers/batch_reindex_layer.cpp
    """

    bottoms = (2, 2)
    label_bottoms = frozenset({1})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        data, indices = bottom_shapes
        self.canonical_axis(0, data, "bottom", 0)
        if len(indices) != 1:
            raise self.error(f"found indices of shape {indices}, expected one axis", "bottom", 1)
        return [(*indices, *data[1:])]

    def forward(self, x: torch.Tensor, indices: torch.Tensor) -> torch.Tensor:
        chosen = indices.long()
        wrong = chosen[(chosen < 0) | (chosen >= x.shape[0])]
        if wrong.numel():
            raise self.error(f"found index {int(wrong[0])}, expected 0 to {x.shape[0] - 1}", "bottom", 1)
        return x.index_select(0, chosen)


@register("Filter")
class Filter(Layer):
    """Keep the items whose selector is not 0. Their number is known only at run time.

    bottom[i]  (N, ...)
    bottom[-1] the selector (N,) or (N, 1, ...)
    top[i]     the kept items of bottom[i]; declared as (N, ...)
    Caffe: src/caffe/layers/filter_layer.cpp
    """

    bottoms = (2, None)
    tops = (1, None)
    counted_axis = 0

    def setup(self) -> None:
        filtered = len(self.bottom_shapes) - 1
        if self.num_tops != filtered:
            message = f"found {self.num_tops} top blob(s), expected {filtered}: one per bottom except the selector"
            raise self.error(message, "top")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        *data, selector = bottom_shapes
        if math.prod(selector[1:]) != 1:
            raise self.error(f"found a selector of shape {selector}, expected one number per item", "bottom", len(data))
        for i, shape in enumerate(data):
            if shape[:1] != selector[:1]:
                message = f"found shape {shape} and a selector of shape {selector}, expected equal numbers of items"
                raise self.error(message, "bottom", i)
        return data

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        *data, selector = bottoms
        kept = selector.reshape(-1).nonzero().squeeze(1)
        return tuple(x.index_select(0, kept) for x in data)

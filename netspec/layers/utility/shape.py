"""Layers that change the shape of a blob or repeat it: Flatten, Reshape, Split, Tile."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from netspec.layers.contract.base import Layer, Shape, refuse_in_place
from netspec.layers.contract.registry import register


class _OtherShape(Layer):
    """A layer that returns its bottom in another shape."""

    shares = frozenset({"data", "diff"})
    ignores_propagate_down = frozenset({0})

    def setup(self) -> None:
        refuse_in_place(self)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.reshape(self.top_shapes[0])


@register("Flatten", "flatten_param")
class Flatten(_OtherShape):
    """Join the axes from axis (default 1) to end_axis (default the last) into one.

    bottom[0]  any shape
    top[0]     the same values, shape[:axis] + (product,) + shape[end_axis + 1:]
    Caffe: src/caffe/layers/flatten_layer.cpp
    """

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        p, shape = self.param.flatten_param, bottom_shapes[0]
        first = self.canonical_axis(p.axis, shape, "flatten_param", "axis")
        last = self.canonical_axis(p.end_axis, shape, "flatten_param", "end_axis")
        if first > last:
            message = f"found axis {p.axis} after end_axis {p.end_axis} for a bottom of shape {shape}"
            raise self.error(message, "flatten_param")
        return [(*shape[:first], math.prod(shape[first : last + 1]), *shape[last + 1 :])]


@register("Reshape", "reshape_param")
class Reshape(_OtherShape):
    """Replace num_axes axes (default all) from axis on by those of shape; 0 copies the bottom's axis, -1 is inferred.

    bottom[0]  any shape
    top[0]     the same values, shape[:axis] + reshape_param.shape + shape[axis + num_axes:]
    Caffe: src/caffe/layers/reshape_layer.cpp
    """

    def setup(self) -> None:
        super().setup()
        self.new_axes = list(self.param.reshape_param.shape.dim)
        if self.new_axes.count(-1) > 1 or min(self.new_axes, default=0) < -1:
            message = f"found shape {self.new_axes}, expected at most one -1 (inferred) and nothing below it"
            raise self.error(message, "reshape_param", "shape")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        p, shape = self.param.reshape_param, bottom_shapes[0]
        start = p.axis if p.axis >= 0 else len(shape) + p.axis + 1
        if not 0 <= start <= len(shape):
            raise self.error(f"axis {p.axis} is out of range for a bottom of shape {shape}", "reshape_param", "axis")
        end = len(shape) if p.num_axes == -1 else start + p.num_axes
        if not start <= end <= len(shape):
            message = f"num_axes {p.num_axes} from axis {start} on is out of range for a bottom of shape {shape}"
            raise self.error(message, "reshape_param", "num_axes")
        top = [*shape[:start], *self.new_axes, *shape[end:]]
        for i, size in enumerate(self.new_axes, start):
            if size == 0:
                if i >= len(shape):
                    message = f"found a 0 for axis {i}, but a bottom of shape {shape} has no such axis to copy"
                    raise self.error(message, "reshape_param", "shape")
                top[i] = shape[i]
        if -1 in top:
            known = math.prod(size for size in top if size != -1)
            top[top.index(-1)] = math.prod(shape) // known if known else 0
        if math.prod(top) != math.prod(shape):
            message = (
                f"cannot make shape {tuple(self.new_axes)} of a bottom of shape {shape}: {tuple(top)} holds "
                f"{math.prod(top)} numbers, but the bottom {math.prod(shape)}"
            )
            raise self.error(message, "reshape_param", "shape")
        return [tuple(top)]


@register("Split")
class Split(Layer):
    """Pass the bottom to several layers and add their gradients. Nets insert it automatically.

    bottom[0]  any shape
    top[i]     the bottom
    Caffe: src/caffe/layers/split_layer.cpp
    """

    tops = (1, None)
    shares = frozenset({"data"})
    passes_on = True

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return [bottom_shapes[0]] * self.num_tops

    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return one tensor per top, so that each has its own gradient."""
        return self.arithmetic(x).copies(x, self.num_tops)


@register("Tile", "tile_param")
class Tile(Layer):
    """Repeat the bottom along an axis (default 1), tiles times.

    bottom[0]  any shape
    top[0]     that axis tiles times as long
    Caffe: src/caffe/layers/tile_layer.cpp
    """

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        p, shape = self.param.tile_param, bottom_shapes[0]
        self.axis = axis = self.canonical_axis(p.axis, shape, "tile_param", "axis")
        if p.tiles <= 0:
            raise self.error(f"found tiles {p.tiles}, expected a positive number", "tile_param", "tiles")
        self.repeats = tuple(p.tiles if i == axis else 1 for i in range(len(shape)))
        return [(*shape[:axis], shape[axis] * p.tiles, *shape[axis + 1 :])]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.arithmetic(x).tiles(x, self.axis, self.param.tile_param.tiles)

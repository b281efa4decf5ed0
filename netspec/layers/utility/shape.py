"""Utilities that only move values: shapes, parts, copies, rows."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from typing_extensions import override

from netspec.exact import switch
from netspec.exact.sums import Copies, Tiles
from netspec.layers.base import Layer, Shape
from netspec.layers.registry import register
from netspec.layers.targets import OnnxGraph, TorchCode
from netspec.layers.training import Kernels, Learning


def _axis(layer: Layer, shape: Shape, param_name: str, old_name: str) -> int:
    """Return the axis of a Concat or a Slice, given as ``axis`` or by the older name, which may not be negative."""
    p: Any = getattr(layer.param, param_name)
    if not p.HasField(old_name):
        return layer.canonical_axis(p.axis, shape, param_name, "axis")
    if p.HasField("axis"):
        raise layer.error(f"found both axis and {old_name}, expected one of them", param_name, old_name)
    return layer.canonical_axis(getattr(p, old_name), shape, param_name, old_name)


class _OtherShape(Layer):
    """A layer whose top has its bottom's numbers in another shape."""

    shares = frozenset({"data", "diff"})
    traceable = True

    @override
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return x.reshape(self.top_shapes[0])

    def prepare_training(self, learning: Learning) -> Kernels:
        (shape,), (top_shape,) = self.bottom_shapes, self.top_shapes
        return lambda x: x.reshape(top_shape), lambda diff: diff.reshape(shape)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.reshape_to_top(bottoms[0])

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.reshape_to_top(bottoms[0])


@register("Flatten", "flatten_param")
class Flatten(_OtherShape):
    """Join the axes from axis (default 1) to end_axis (default the last) into one.

    bottom[0]  any shape
    top[0]     the same numbers, shape[:axis] + (product,) + shape[end_axis + 1:]
    Caffe: src/caffe/layers/flatten_layer.cpp
    """

    @override
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
    """Replace num_axes axes (default all) from axis on by those of shape: 0 copies the bottom's axis, -1 is inferred.

    bottom[0]  any shape
    top[0]     the same numbers, shape[:axis] + reshape_param.shape + shape[axis + num_axes:]
    Caffe: src/caffe/layers/reshape_layer.cpp
    """

    @override
    def setup(self) -> None:
        self.new_axes = list(self.param.reshape_param.shape.dim)
        if self.new_axes.count(-1) > 1 or min(self.new_axes, default=0) < -1:
            message = f"found shape {self.new_axes}, expected at most one -1 (inferred) and nothing below it"
            raise self.error(message, "reshape_param", "shape")

    @override
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
                f"{math.prod(top)} numbers, the bottom {math.prod(shape)}"
            )
            raise self.error(message, "reshape_param", "shape")
        return [tuple(top)]


@register("Concat", "concat_param")
class Concat(Layer):
    """Join the bottoms along an axis (default 1; concat_dim is its older name).

    bottom[i]  shapes that are equal but for that axis
    top[0]     the bottoms, one after the other
    Caffe: src/caffe/layers/concat_layer.cpp
    """

    bottoms = (1, None)
    traceable = True

    @override
    def setup(self) -> None:
        if len(self.bottom_shapes) == 1:  # it is not copied
            self.shares = frozenset({"data", "diff"})

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        first = bottom_shapes[0]
        self.axis = axis = _axis(self, first, "concat_param", "concat_dim")
        for i, shape in enumerate(bottom_shapes):
            others = zip(first[:axis] + first[axis + 1 :], shape[:axis] + shape[axis + 1 :], strict=False)
            if len(shape) != len(first) or any(a != b for a, b in others):
                message = f"found bottoms of shapes {first} and {shape}, expected equal shapes except along axis {axis}"
                raise self.error(message, "bottom", i)
        return [(*first[:axis], sum(shape[axis] for shape in bottom_shapes), *first[axis + 1 :])]

    @override
    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        return bottoms[0] if len(bottoms) == 1 else torch.cat(bottoms, self.axis)

    def prepare_training(self, learning: Learning) -> Kernels:
        axis, sizes = self.axis, [shape[self.axis] for shape in self.bottom_shapes]
        return lambda *bottoms: torch.cat(bottoms, axis), lambda diff: diff.split(sizes, axis)

    any_layout = True

    @property
    def fresh(self) -> bool:
        """Whether the top is memory of its own."""
        return len(self.bottom_shapes) > 1

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Concat", *bottoms, axis=self.axis)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        if len(bottoms) == 1:
            return bottoms[0]
        return code.call(f"torch.cat([{', '.join(bottoms)}], dim={{axis}})", axis=self.axis)


@register("Slice", "slice_param")
class Slice(Layer):
    """Cut the bottom along an axis (default 1; slice_dim is its older name): before each slice_point, or evenly.

    bottom[0]  any shape
    top[i]     part i of that axis, the other axes whole
    Caffe: src/caffe/layers/slice_layer.cpp
    """

    tops = (1, None)
    traceable = True

    @override
    def setup(self) -> None:
        if self.num_tops == 1:  # it is not copied
            self.shares = frozenset({"data", "diff"})

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        shape = bottom_shapes[0]
        self.axis = axis = _axis(self, shape, "slice_param", "slice_dim")
        points, size = list(self.param.slice_param.slice_point), shape[axis]
        if points:
            if len(points) != self.num_tops - 1:
                message = f"found {len(points)} slice_point, expected {self.num_tops - 1}: one fewer than tops"
                raise self.error(message, "slice_param", "slice_point")
            self.sizes = [end - start for start, end in zip([0, *points], [*points, size], strict=True)]
            if min(self.sizes) <= 0:
                expected = f"increasing values above 0 and below {size}, the size of axis {axis}"
                message = f"found slice_point {points} for a bottom of shape {shape}, expected {expected}"
                raise self.error(message, "slice_param", "slice_point")
        elif size % self.num_tops:
            message = f"axis {axis} of the bottom, shape {shape}, cannot be cut evenly into {self.num_tops} tops"
            raise self.error(message, "slice_param")
        else:
            self.sizes = [size // self.num_tops] * self.num_tops
        return [(*shape[:axis], part, *shape[axis + 1 :]) for part in self.sizes]

    @override
    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return x.split(self.sizes, self.axis)

    any_layout = True

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        if self.num_tops == 1:
            return [graph.node("Identity", *bottoms)]
        points = list(self.param.slice_param.slice_point)
        if graph.sizes(0)[self.axis] is not None:
            return graph.nodes("Split", *bottoms, graph.constant(self.sizes), outputs=self.num_tops, axis=self.axis)
        if not points:
            return graph.nodes("Split", *bottoms, outputs=self.num_tops, axis=self.axis, num_outputs=self.num_tops)
        axis = graph.constant([self.axis])
        return [
            graph.node("Slice", *bottoms, graph.constant([start]), graph.constant([end]), axis)
            for start, end in zip([0, *points], [*points, 2**62], strict=True)
        ]

    def to_torch(self, code: TorchCode, *bottoms: str) -> str | Sequence[str]:
        if self.num_tops == 1:
            return bottoms
        if len(set(self.sizes)) == 1 and not self.param.slice_param.slice_point:
            return code.call("{x}.chunk({count}, dim={axis})", x=bottoms[0], count=self.num_tops, axis=self.axis)
        if code.sizes(0)[self.axis] is not None:
            return code.call("{x}.split({sizes}, dim={axis})", x=bottoms[0], sizes=list(self.sizes), axis=self.axis)
        points = list(self.param.slice_param.slice_point)
        return code.call("{x}.tensor_split({points}, dim={axis})", x=bottoms[0], points=points, axis=self.axis)


@register("Split")
class Split(Layer):
    """Give the bottom to several layers; their gradients are added. Nets insert it automatically.

    bottom[0]  any shape
    top[i]     the bottom
    Caffe: src/caffe/layers/split_layer.cpp
    """

    tops = (1, None)
    traceable = True
    shares = frozenset({"data"})

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the bottom's shape for each top."""
        return [bottom_shapes[0]] * self.num_tops

    @override
    def forward(self, x: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Return one tensor per top, so that each has its own gradient."""
        if self.num_tops > 2 and self.is_exact(x):  # of two, either order gives the same sum
            return Copies.apply(x, self.num_tops)
        return tuple(x.view_as(x) for _ in range(self.num_tops))

    def prepare_training(self, learning: Learning) -> Kernels:
        """Return the kernels; gradients are added in Caffe's order, or in the order of autograd: the last one first."""
        order = 1 if self.num_tops > 2 and switch.applies(self.context.options.exact, torch.empty(1)) else -1
        tops = self.num_tops

        def backward(*diffs: torch.Tensor | None) -> torch.Tensor:
            first, *others = [diff for diff in diffs[::order] if diff is not None]
            return sum(others, first)

        return lambda x: (x,) * tops, backward

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        return bottoms * self.num_tops

    @property
    def passes_on(self) -> bool:
        return True

    def to_torch(self, code: TorchCode, *bottoms: str) -> Sequence[str]:
        return bottoms * self.num_tops


@register("Tile", "tile_param")
class Tile(Layer):
    """Repeat the bottom along an axis (default 1), tiles times.

    bottom[0]  any shape
    top[0]     that axis tiles times as long
    Caffe: src/caffe/layers/tile_layer.cpp
    """

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        p, shape = self.param.tile_param, bottom_shapes[0]
        self.axis = axis = self.canonical_axis(p.axis, shape, "tile_param", "axis")
        if p.tiles <= 0:
            raise self.error(f"found tiles {p.tiles}, expected a positive number", "tile_param", "tiles")
        self.repeats = [p.tiles if i == axis else 1 for i in range(len(shape))]
        return [(*shape[:axis], shape[axis] * p.tiles, *shape[axis + 1 :])]

    @override
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if self.is_exact(x):
            values = x.reshape(math.prod(x.shape[: self.axis]), -1)
            return Tiles.apply(values, self.repeats[self.axis]).reshape(self.top_shapes[0])
        return x.repeat(self.repeats)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Tile", *bottoms, graph.constant(self.repeats))

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.call("{x}.repeat({repeats})", x=bottoms[0], repeats=tuple(self.repeats))


@register("BatchReindex")
class BatchReindex(Layer):
    """Choose items of the batch by index; the gradients of an item chosen more than once add up.

    bottom[0]  (N, ...)
    bottom[1]  indices (M,), each from 0 to N - 1
    top[0]     (M, ...)
    Caffe: src/caffe/layers/batch_reindex_layer.cpp
    """

    bottoms = (2, 2)
    label_bottoms = frozenset({1})

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        data, indices = bottom_shapes
        if len(indices) != 1:
            raise self.error(f"found indices of shape {indices}, expected one axis", "bottom", 1)
        return [(*indices, *data[1:])]

    @override
    def forward(self, x: torch.Tensor, indices: torch.Tensor) -> torch.Tensor:
        chosen = indices.long()
        wrong = chosen[(chosen < 0) | (chosen >= x.shape[0])]
        if wrong.numel():
            raise self.error(f"found index {int(wrong[0])}, expected 0 to {x.shape[0] - 1}", "bottom", 1)
        return x.index_select(0, chosen)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Gather", bottoms[0], graph.cast(bottoms[1], "int64"), axis=0)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.call("{x}[{index}.long()]", x=bottoms[0], index=bottoms[1])


@register("Filter")
class Filter(Layer):
    """Keep the items whose selector is not 0; how many there are shows only at run time.

    bottom[i]  (N, ...)
    bottom[-1] the selector (N,) or (N, 1, ...)
    top[i]     the kept items of bottom[i]; declared as (N, ...)
    Caffe: src/caffe/layers/filter_layer.cpp
    """

    bottoms = (2, None)
    tops = (1, None)
    counted_axis = 0

    @override
    def setup(self) -> None:
        filtered = len(self.bottom_shapes) - 1
        if self.num_tops != filtered:
            message = f"found {self.num_tops} top blob(s), expected {filtered}: one per bottom except the selector"
            raise self.error(message, "top")

    @override
    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        *data, selector = bottom_shapes
        if math.prod(selector[1:]) != 1:
            raise self.error(f"found a selector of shape {selector}, expected one number per item", "bottom", len(data))
        for i, shape in enumerate(data):
            if shape[:1] != selector[:1]:
                message = (
                    f"found a bottom of shape {shape} and a selector of shape {selector}, expected equally many items"
                )
                raise self.error(message, "bottom", i)
        return data

    @override
    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        *data, selector = bottoms
        kept = selector.reshape(-1).nonzero().squeeze(1)
        return tuple(x.index_select(0, kept) for x in data)

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        *data, selector = bottoms
        dropped = graph.node("Equal", graph.reshape(selector, [-1]), graph.constant(0.0))
        kept = graph.node("Squeeze", graph.node("NonZero", graph.node("Not", dropped)), graph.constant([0]))
        return [graph.node("Gather", x, kept, axis=0) for x in data]

    def to_torch(self, code: TorchCode, *bottoms: str) -> Sequence[str]:
        *data, selector = bottoms
        return [code.call("{x}[{selector}.flatten() != 0]", x=x, selector=selector) for x in data]

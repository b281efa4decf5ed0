"""Exporters of the layers of netspec/layers/utility."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial, reduce
from operator import mul, ne

import torch
import torch.nn.functional as F

from netspec.export.exporter import Exporter, exports
from netspec.export.expression import Expression, Plain, call, with_axes
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.utility.arithmetic import ArgMax, Eltwise, Parameter, Reduction, Silence, Softmax
from netspec.layers.utility.parts import BatchReindex, Concat, Crop, Filter, Slice
from netspec.layers.utility.python import Python
from netspec.layers.utility.shape import Flatten, Reshape, Split, Tile


@exports(Eltwise)
class EltwiseExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        if layer.operation == layer.SUM:
            scaled = zip(bottoms, layer.coeff, strict=True)
            bottoms = tuple(x if c == 1 else graph.node("Mul", x, graph.constant(c)) for x, c in scaled)
        op = {layer.SUM: "Add", layer.PROD: "Mul", layer.MAX: "Max"}[layer.operation]
        top, *others = bottoms
        for bottom in others:
            top = graph.node(op, top, bottom)
        return top

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Expression:
        layer = self.layer
        if layer.operation == layer.MAX:
            return reduce(partial(call, torch.maximum), bottoms)
        if layer.operation == layer.PROD:
            return reduce(mul, bottoms)
        first, *others = zip(bottoms, layer.coeff, strict=True)
        top = first[0] if abs(first[1]) == 1 else abs(first[1]) * first[0]
        top = -top if first[1] < 0 else top
        for x, coeff in others:
            term = x if abs(coeff) == 1 else abs(coeff) * x
            top = top - term if coeff < 0 else top + term
        return top


@exports(Reduction)
class ReductionExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        p, (data,) = layer.param.reduction_param, bottoms
        if p.operation == layer.ASUM:
            data = graph.node("Abs", data)
        elif p.operation == layer.SUMSQ:
            data = graph.node("Mul", data, data)
        axes = list(range(layer.axis, len(layer.bottom_shapes[0])))
        if p.operation == layer.MEAN:
            top = graph.node("ReduceMean", data, axes=axes, keepdims=0)
        else:
            top = graph.node("ReduceSum", data, graph.constant(axes), keepdims=0)
        return top if p.coeff == 1 else graph.node("Mul", top, graph.constant(p.coeff))

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        p = layer.param.reduction_param
        x = x.abs() if p.operation == layer.ASUM else x.square() if p.operation == layer.SUMSQ else x
        axes = tuple(range(layer.axis, len(layer.bottom_shapes[0])))
        over = {"dim": axes[0] if len(axes) == 1 else axes} if layer.axis else {}
        top = x.mean(**over) if p.operation == layer.MEAN else x.sum(**over)
        return top if p.coeff == 1 else p.coeff * top


@exports(ArgMax)
class ArgMaxExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str | Sequence[str]:
        layer = self.layer
        p, (data,) = layer.param.argmax_param, bottoms
        axis = 1 if layer.axis is None else layer.axis
        if layer.axis is None:
            data = graph.node("Flatten", data, axis=1)
        # For equal values, TopK returns the smaller index first; in the reversed axis, that is the larger one.
        backwards = (graph.constant([-1]), graph.constant([-(2**62)]), graph.constant([axis]), graph.constant([-1]))
        reverse = graph.node("Slice", data, *backwards)
        values, order = graph.nodes("TopK", reverse, graph.constant([p.top_k]), outputs=2, axis=axis)
        last = graph.node("Sub", graph.shape_of(data, axis, axis + 1), graph.constant([1]))
        indices = graph.cast(graph.node("Sub", last, order), "float32")
        if layer.axis is not None:
            return values if p.out_max_val else indices
        columns = [indices, values] if p.out_max_val else [indices]
        one = graph.constant([1])
        top = graph.node("Concat", *(graph.node("Unsqueeze", column, one) for column in columns), axis=1)
        ones = len(layer.top_shapes[0]) - 3
        return graph.node("Unsqueeze", top, graph.constant(list(range(3, 3 + ones)))) if ones > 0 else top

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        p = layer.param.argmax_param
        if layer.axis is None and len(layer.bottom_shapes[0]) > 2:
            x = x.flatten(1)
        found = call(arg_max, x, dim=1 if layer.axis is None else layer.axis, top_k=p.top_k)
        if layer.axis is not None:
            return found[1 if p.out_max_val else 0]
        top = call(torch.stack, found, 1) if p.out_max_val else found[0][:, None]
        return with_axes(top, len(layer.top_shapes[0]) - 3)


@exports(Softmax)
class SoftmaxExport(Exporter):
    onnx_op, onnx_attributes = "Softmax", ("axis",)
    torch_call = Plain(F.softmax, dim="axis")


@exports(Silence)
class SilenceExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        return ()

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Sequence[Expression]:
        return ()


@exports(Parameter)
class ParameterExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Identity", graph.blob(0))

    def to_torch(self, code: TorchCode) -> Sequence[Expression]:
        return (code.parameter(0),)


@exports(Concat)
class ConcatExport(Exporter):
    onnx_op, onnx_attributes = "Concat", ("axis",)

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Expression:
        return bottoms[0] if len(bottoms) == 1 else call(torch.cat, list(bottoms), dim=self.layer.axis)


@exports(Slice)
class SliceExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        layer = self.layer
        if layer.num_tops == 1:
            return [graph.node("Identity", *bottoms)]
        points = list(layer.param.slice_param.slice_point)
        if graph.sizes(0)[layer.axis] is not None:
            return graph.nodes("Split", *bottoms, graph.constant(layer.sizes), outputs=layer.num_tops, axis=layer.axis)
        if not points:
            return graph.nodes("Split", *bottoms, outputs=layer.num_tops, axis=layer.axis)
        axis = graph.constant([layer.axis])
        return [
            graph.node("Slice", *bottoms, graph.constant([start]), graph.constant([end]), axis)
            for start, end in zip([0, *points], [*points, 2**62], strict=True)
        ]

    def to_torch(self, code: TorchCode, x: Expression) -> Expression | Sequence[Expression]:
        layer = self.layer
        points = list(layer.param.slice_param.slice_point)
        if layer.num_tops == 1:
            return (x,)
        if len(set(layer.sizes)) == 1 and not points:
            return x.chunk(layer.num_tops, dim=layer.axis)
        if code.sizes(0)[layer.axis] is not None:
            return x.split(list(layer.sizes), dim=layer.axis)
        return x.tensor_split(points, dim=layer.axis)


@exports(Crop)
class CropExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        axis = next((i for i, part in enumerate(layer.window) if part != slice(None)), 0)
        starts = [part.start or 0 for part in layer.window[axis:]]
        wanted = graph.shape_of(bottoms[1], axis, len(layer.window))
        start = graph.constant(starts)
        axes = graph.constant(list(range(axis, len(layer.window))))
        return graph.node("Slice", bottoms[0], start, graph.node("Add", wanted, start), axes)

    def to_torch(self, code: TorchCode, x: Expression, like: Expression) -> Expression:
        parts = []
        for axis, part in enumerate(self.layer.window):
            size = like.shape[axis]
            cut = slice(part.start, part.start + size) if part.start else slice(None, size)
            parts.append(part if part == slice(None) else cut)
        return x[tuple(parts)]


@exports(BatchReindex)
class BatchReindexExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Gather", bottoms[0], graph.cast(bottoms[1], "int64"), axis=0)

    def to_torch(self, code: TorchCode, x: Expression, chosen: Expression) -> Expression:
        return x[chosen.long()]


@exports(Filter)
class FilterExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        *data, selector = bottoms
        dropped = graph.node("Equal", graph.reshape(selector, [-1]), graph.constant(0.0))
        kept = graph.node("Squeeze", graph.node("NonZero", graph.node("Not", dropped)), graph.constant([0]))
        return [graph.node("Gather", x, kept, axis=0) for x in data]

    def to_torch(self, code: TorchCode, *bottoms: Expression) -> Sequence[Expression]:
        *data, selector = bottoms
        return [x[call(ne, selector.flatten(), 0)] for x in data]


@exports(Flatten, Reshape)
class OtherShapeExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.reshape_to_top(bottoms[0])

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        return code.reshape_to_top(x)


@exports(Split)
class SplitExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        return bottoms * self.layer.num_tops

    def to_torch(self, code: TorchCode, x: Expression) -> Sequence[Expression]:
        return (x,) * self.layer.num_tops


@exports(Tile)
class TileExport(Exporter):
    torch_call = Plain(torch.Tensor.repeat, "repeats")

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Tile", *bottoms, graph.constant(self.layer.repeats))


@exports(Python)
class PythonExport(Exporter):
    not_exported = "it runs Python code"


def arg_max(x, dim, top_k):
    """Return the indices (in x's type) and values of the largest; of equal ones, the last comes first."""
    values, order = torch.sort(x.flip(dim), dim=dim, descending=True, stable=True)
    indices = (x.shape[dim] - 1 - order).to(x.dtype)
    return indices.narrow(dim, 0, top_k), values.narrow(dim, 0, top_k)

"""The expressions of the layers of netspec/layers/utility, of DummyData and HDF5Output."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial, reduce
from operator import mul, ne
from typing import Any

import torch
import torch.nn.functional as F

from netspec.export.exporter import exports, refusal
from netspec.export.expression import Expression, call, plain, with_axes
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.data.hdf5 import HDF5Output
from netspec.layers.data.memory import DummyData
from netspec.layers.utility.arithmetic import ArgMax, Eltwise, Parameter, Reduction, Silence, Softmax
from netspec.layers.utility.parts import BatchReindex, Concat, Crop, Filter, Slice
from netspec.layers.utility.python import Python
from netspec.layers.utility.shape import Flatten, Reshape, Split, Tile

exports(Softmax)(plain(F.softmax, dim="axis"))
exports(Tile)(plain(torch.Tensor.repeat, "repeats"))


@exports(Eltwise)
def eltwise(layer: Any, code: TorchCode, *bottoms: Expression) -> Expression:
    if layer.operation == layer.MAX:
        top = call(larger, bottoms[0], bottoms[1])
        return reduce(lambda top, x: call(larger, x, top), bottoms[2:], top)
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
def reduction(layer: Any, code: TorchCode, x: Expression) -> Expression:
    p = layer.param.reduction_param
    x = x.abs() if p.operation == layer.ASUM else x.square() if p.operation == layer.SUMSQ else x
    axes = tuple(range(layer.axis, len(layer.bottom_shapes[0])))
    over = {"dim": axes[0] if len(axes) == 1 else axes} if layer.axis else {}
    top = x.mean(**over) if p.operation == layer.MEAN else x.sum(**over)
    return top if p.coeff == 1 else p.coeff * top


@exports(ArgMax)
def argmax(layer: Any, code: TorchCode, x: Expression) -> Expression:
    p = layer.param.argmax_param
    if layer.axis is None and (axes := len(layer.bottom_shapes[0])) != 2:
        x = x.flatten(1) if axes > 2 else x[:, None]
    found = call(arg_max, x, dim=1 if layer.axis is None else layer.axis, top_k=p.top_k)
    if layer.axis is not None:
        return found[1 if p.out_max_val else 0]
    top = call(torch.stack, found, 1) if p.out_max_val else found[0][:, None]
    return with_axes(top, len(layer.top_shapes[0]) - 3)


@exports(Silence)
def silence(layer: Any, code: TorchCode, *bottoms: Expression) -> Sequence[Expression]:
    return ()


@exports(Parameter)
def parameter(layer: Any, code: TorchCode) -> Sequence[Expression]:
    return (code.parameter(0),)


@exports(DummyData)
def dummy_data(layer: Any, code: TorchCode) -> Sequence[Expression]:
    fixed = [blob for blob in layer.filled_once() if blob is not None]
    if len(fixed) < layer.num_tops:
        raise refusal(layer, "its values are random")
    return [code.buffer(values) for values in fixed]


@exports(Concat)
def concat(layer: Any, code: TorchCode, *bottoms: Expression) -> Expression:
    return bottoms[0] if len(bottoms) == 1 else call(torch.cat, list(bottoms), dim=layer.axis)


@exports(Slice)
def cut(layer: Any, code: TorchCode, x: Expression) -> Expression | Sequence[Expression]:
    points = list(layer.param.slice_param.slice_point)
    if layer.num_tops == 1:
        return (x,)
    if code.sizes(0)[layer.axis] is None:  # in the middle of a slice that only the input's size determines
        return x.tensor_split(points or layer.num_tops, dim=layer.axis)
    if len(set(layer.sizes)) == 1 and not points:
        return x.chunk(layer.num_tops, dim=layer.axis)
    return x.split(list(layer.sizes), dim=layer.axis)


@exports(Crop)
def crop(layer: Any, code: TorchCode, x: Expression, like: Expression) -> Expression:
    parts = []
    for axis, part in enumerate(layer.window):
        size = like.shape[axis]
        end = slice(part.start, part.start + size) if part.start else slice(None, size)
        parts.append(part if part == slice(None) else end)
    return x[tuple(parts)]


@exports(BatchReindex)
def batch_reindex(layer: Any, code: TorchCode, x: Expression, chosen: Expression) -> Expression:
    return x[chosen.long()]


@exports(Filter)
def kept(layer: Any, code: TorchCode, *bottoms: Expression) -> Sequence[Expression]:
    *data, selector = bottoms
    return [x[call(ne, selector.flatten(), 0)] for x in data]


@exports(Flatten, Reshape)
def other_shape(layer: Any, code: TorchCode, x: Expression) -> Expression:
    return code.reshape_to_top(x)


@exports(Split)
def split(layer: Any, code: TorchCode, x: Expression) -> Sequence[Expression]:
    return (x,) * layer.num_tops


def _never(reason: str, layer: Any, code: TorchCode, *bottoms: Expression) -> Any:
    raise refusal(layer, reason)


exports(Python)(partial(_never, "it runs Python code"))
exports(HDF5Output)(partial(_never, "it writes a file"))


def larger(x, y):
    """Return the larger of two values; of equal ones, the second gets the gradient."""
    return torch.where(x > y, x, y)


def arg_max(x, dim, top_k):
    """Return the indices (in x's type) and values of the largest; of equal ones, the last comes first."""
    x = x.detach().flip(dim)
    values, order = torch.sort(x, dim=dim, descending=True, stable=True)
    indices = (x.shape[dim] - 1 - order).to(x.dtype)
    return indices.narrow(dim, 0, top_k), values.narrow(dim, 0, top_k)

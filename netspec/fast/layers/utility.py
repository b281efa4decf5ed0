"""Kernels of layers that add, cut, join and reshape blobs (netspec/layers/utility)."""

from __future__ import annotations

import torch

from netspec.fast.entry import Entry
from netspec.fast.kernels import Inference, Kernel, Learning, with_activation
from netspec.layers.utility.arithmetic import Eltwise, Softmax
from netspec.layers.utility.parts import Concat, Slice
from netspec.run.recorded import Kernels


def _adds_two(layer: Eltwise) -> bool:
    return layer.operation == layer.SUM and layer.coeff == [1.0, 1.0]


def _eltwise(layer: Eltwise, how: Inference) -> Kernel | None:
    if not _adds_two(layer):
        return None
    return with_activation(torch.Tensor.add_ if how.reuse else torch.add, how.activation)


def _learn_eltwise(layer: Eltwise, how: Learning) -> Kernels | None:
    return Kernels(torch.add, lambda diff: (diff, diff)) if _adds_two(layer) else None


def _learn_concat(layer: Concat, how: Learning) -> Kernels:
    axis, sizes = layer.axis, [shape[layer.axis] for shape in layer.bottom_shapes]
    return Kernels(lambda *bottoms: torch.cat(bottoms, axis), lambda diff: diff.split(sizes, axis))


ENTRIES = {
    Eltwise: Entry(_eltwise, _learn_eltwise, fresh=True, any_layout=True),
    Softmax: Entry(fresh=True, any_layout=True),
    Concat: Entry(learning=_learn_concat, fresh=lambda layer: len(layer.bottom_shapes) > 1, any_layout=True),
    Slice: Entry(any_layout=True),
}

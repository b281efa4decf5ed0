"""Which layers compute the gradient of a blob with ``lr_mult: 0``, as Caffe's do.

Such a gradient moves no weight. But ``clip_gradients`` counts it, and the history of AdaGrad, Adam and the like has it.

Caffe: Net::Init (src/caffe/net.cpp), Layer::set_param_propagate_down (include/caffe/layer.hpp)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from netspec.graph.plan import Backward, Plan
from netspec.layers.contract.base import Layer


def needs_backward(plan: Plan, i: int, layer: Layer) -> bool:
    """Return whether Caffe takes layer ``i`` for one that learns.

    It reads the prototxt, where the ``lr_mult: 0`` is missing that BatchNorm gives to its own blobs.
    """
    given = plan.net.layer[i].param
    return any(j >= len(given) or given[j].lr_mult != 0 for j in range(len(layer.blobs)))


def compute_caffes_gradients(plan: Plan, layers: Sequence[Layer], backward: Backward) -> None:
    """Make each layer compute the gradients of those blobs of which Caffe's layer computes them.

    Of layers that share a blob, one may do so and another not, because ``lr_mult: 0`` need be given only once.
    """
    computed = []
    for i, layer in enumerate(layers):
        asked = [_is_asked(plan, i, layer, j) for j in range(len(layer.blobs))]
        all_of_them = layer.ignores_frozen and backward.layers[i]
        computed.append([all_of_them or each for each in asked])
    pairs = [pair for layer, row in zip(layers, computed, strict=True) for pair in zip(layer.blobs, row, strict=True)]
    wanted = {id(blob) for blob, yes in pairs if yes}
    for layer, row in zip(layers, computed, strict=True):
        for blob in layer.blobs:
            blob.requires_grad_(id(blob) in wanted)
        if held := frozenset(j for j, blob in enumerate(layer.blobs) if blob.requires_grad and not row[j]):
            layer.held = held


def _is_asked(plan: Plan, i: int, layer: Layer, j: int) -> bool:
    given, specs = plan.net.layer[i].param, plan.nodes[i].params
    own = replace(specs[j], lr_mult=given[j].lr_mult) if j < len(given) else None
    return plan.net.force_backward or layer.param_spec(j, own).lr_mult != 0

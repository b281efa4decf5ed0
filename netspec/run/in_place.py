"""Gradients of consecutive in-place layers, as they result from Caffe's shared memory.

Caffe's backward reads bottom and top from memory. If a later layer has overwritten them in place, it reads that
layer's result. For example, if an in-place Sigmoid follows an in-place ReLU, every value is positive, and the ReLU
passes every gradient. Nets were trained with these gradients, so they are computed here too. This matters only for
layers whose backward reads overwritten data; other layers keep a copy or a mask.

``gradient_reads`` of a layer lists what its backward reads: the "bottom", only the "sign" of the bottom (which its
own top has too), or the "top".
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from netspec.graph.plan import Node, Plan
from netspec.layers.contract.base import Layer
from netspec.layers.contract.gradients import gradient_from_memory, gradient_reads


@dataclass
class Memory:
    """The contents of a part of Caffe's memory at the end of the forward pass."""

    data: torch.Tensor | None = None


def is_overwritten(layer: Layer, node: Node, plan: Plan) -> bool:
    """Return whether the layer's backward reads data that this layer, or a later one, has overwritten."""
    reads = gradient_reads(layer)
    if not reads:
        return False
    in_place, later = node.in_place[0], plan.final[node.tops[0]] != node.tops[0]
    return ("bottom" in reads and in_place) or ("sign" in reads and in_place and later) or ("top" in reads and later)


def run_overwritten(layer: Layer, bottom: torch.Tensor, memory: Memory, in_place: bool) -> tuple[torch.Tensor, ...]:
    """Run a layer; its gradient reads ``memory`` as its top and, if it is in place, as its bottom."""
    held = in_place and bool(gradient_reads(layer) & {"bottom", "sign"})
    return (_Overwritten.apply(bottom, layer, memory, held),)


class _Overwritten(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, bottom: torch.Tensor, layer: Layer, memory: Memory, bottom_is_held: bool) -> torch.Tensor:
        ctx.layer, ctx.memory, ctx.bottom_is_held = layer, memory, bottom_is_held
        if not bottom_is_held:
            ctx.save_for_backward(bottom)
        return layer.run(bottom)[0]

    @staticmethod
    def backward(ctx: Any, diff: torch.Tensor) -> Any:
        held = ctx.memory.data
        bottom = held if ctx.bottom_is_held else ctx.saved_tensors[0]
        return gradient_from_memory(ctx.layer, bottom, held, diff), None, None, None

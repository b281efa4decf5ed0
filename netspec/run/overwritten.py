"""The gradient of a layer whose data a later layer overwrites in place.

Caffe's backward reads bottom and top from memory. If a later layer has overwritten them in place, it reads that layer's
result. For example, if an in-place Sigmoid follows an in-place ReLU, every value is positive, and the ReLU passes every
gradient. Nets were trained with these gradients, so they are computed here too. It matters only for layers with a
backward pass that reads overwritten data; other layers keep a copy or a mask. ``gradient_reads`` of a layer lists what
its backward reads: the "bottom", only the "sign" of the bottom (which its own top has too), or the "top".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch

from netspec.graph.plan import Node, Plan
from netspec.layers.contract.base import Layer


@dataclass
class Memory:
    """The contents of a part of Caffe's memory at the end of the forward pass."""

    data: torch.Tensor | None = None


class Overwritten(NamedTuple):
    """A layer whose gradient reads memory.

    ``final`` is the value that is in the memory of its top at the end of the forward pass. ``holds_bottom``: its bottom
    is in that memory too, so the gradient reads it there.
    """

    layer: Layer
    final: int
    holds_bottom: bool

    def run(self, bottoms: Sequence[torch.Tensor], memory: Memory) -> tuple[torch.Tensor, ...]:
        """Run the layer; its gradient by autograd reads ``memory``, which later layers must fill."""
        return (_FromMemory.apply(self, memory, *bottoms),)

    def gradients(
        self, bottoms: Sequence[torch.Tensor], memory: torch.Tensor, diff: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Return the gradients of the bottoms, from the memory of the top at the end of the forward pass."""
        return self.layer.gradients_from_memory([memory] if self.holds_bottom else bottoms, memory, diff)


def reader_of_memory(layer: Layer, node: Node, plan: Plan) -> Overwritten:
    """Return the Overwritten of a layer with ``gradient_reads``."""
    holds_bottom = node.in_place[0] and bool(layer.gradient_reads & {"bottom", "sign"})
    return Overwritten(layer, plan.final[node.tops[0]], holds_bottom)


def overwritten(layer: Layer, node: Node, plan: Plan) -> Overwritten | None:
    """Return the layer as Overwritten if its gradient reads data that it, or a later one, has overwritten."""
    reads = layer.gradient_reads
    if not reads:
        return None
    in_place, later = node.in_place[0], plan.final[node.tops[0]] != node.tops[0]
    is_read = ("bottom" in reads and in_place) or ("sign" in reads and in_place and later) or ("top" in reads and later)
    return reader_of_memory(layer, node, plan) if is_read else None


class _FromMemory(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, reader: Overwritten, memory: Memory, *bottoms: torch.Tensor) -> torch.Tensor:
        ctx.reader, ctx.memory = reader, memory
        if not reader.holds_bottom:
            ctx.save_for_backward(*bottoms)
        return reader.layer.run(*bottoms)[0]

    @staticmethod
    def backward(ctx: Any, diff: torch.Tensor) -> Any:
        return None, None, *ctx.reader.gradients(ctx.saved_tensors, ctx.memory.data, diff)

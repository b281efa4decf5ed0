"""The base of layers that permute axes: SSD's Permute and CRNN's Transpose."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from netspec.data.blobs import Shape
from netspec.layers import Layer
from netspec.layers.contract.targets import OnnxGraph, TorchCode


class Reordered(Layer):
    """Base of layers that permute axes: axis i of the top is axis ``order[i]`` of the bottom."""

    order: list[int]

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if len(bottom_shapes[0]) != len(self.order):
            message = f"found a bottom of shape {bottom_shapes[0]}, expected {len(self.order)} axes as before"
            raise self.error(message, "bottom")
        return [tuple(bottom_shapes[0][axis] for axis in self.order)]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data.permute(self.order).contiguous()

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.node("Transpose", *bottoms, perm=self.order)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        return code.call(f"{{x}}.permute({', '.join(map(str, self.order))})", x=bottoms[0])

"""The base of layers that permute axes: SSD's Permute and CRNN's Transpose."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from netspec.data.blobs import Shape
from netspec.layers import Layer


class Reordered(Layer):
    """Base of layers that permute axes: axis i of the top is axis ``perm[i]`` of the bottom."""

    perm: list[int]

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        if len(bottom_shapes[0]) != len(self.perm):
            message = f"found a bottom of shape {bottom_shapes[0]}, expected {len(self.perm)} axes as before"
            raise self.error(message, "bottom")
        return [tuple(bottom_shapes[0][axis] for axis in self.perm)]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        return data.permute(self.perm).contiguous()

"""ReLU with an upper limit of 6, with the names of several forks."""

from __future__ import annotations

import torch

from netspec.layers.activation import ReLU


class Capped(ReLU):
    """min(max(x, 0) + slope min(x, 0), 6). The gradient at 0 is that of the negative side; at 6 it is 0."""

    @property
    def gradient_reads(self) -> frozenset[str]:
        return frozenset({"bottom"})

    @property
    def joins_as(self) -> str:
        return ""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.where(x >= 6, 6, super().forward(x))

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return super().caffes_gradient(bottom, top, diff).where(bottom < 6, 0)

"""ReLU with an upper limit of 6, with the names of several forks."""

from __future__ import annotations

import torch
import torch.nn.functional as F

from netspec.layers.activation import Activation


class Capped(Activation):
    """min(max(x, 0) + slope min(x, 0), 6). The gradient at 0 is that of the negative side; at 6 it is 0.

    A subclass sets ``slope`` in its ``setup``.
    """

    gradient_reads = frozenset({"bottom"})
    slope: float

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return torch.where(x >= 6, 6, F.leaky_relu(x, self.slope) if self.slope else F.relu(x))

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return torch.where(bottom > 0, diff, diff * self.slope).where(bottom < 6, 0)

"""Products of vectors with class weights, with a larger angle at the label: L-Softmax and SphereFace."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from netspec.dialects.checks import check_at_least_1
from netspec.layers.contract.base import Shape, State
from netspec.layers.loss.base import Classified
from netspec.proto.schema import value

Margin = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]


def double(c: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return psi(angle) for cosine c, the monotonically decreasing extension of cos(2 angle), and its slope."""
    sign = c.sign()
    return 2 * sign * c**2 - 1, 4 * sign * c


def triple(c: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Like :func:`double`, for cos(3 angle)."""
    far = (c.abs() - 0.5).sign()
    return far * (4 * c**3 - 3 * c) + c.sign() * (1 + far) - 2, far * (12 * c**2 - 3)


def quadruple(c: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Like :func:`double`, for cos(4 angle)."""
    sign = c.sign() * (2 * c**2 - 1).sign()
    return sign * (8 * c**4 - 8 * c**2 + 1) + 2 * c.sign() + sign - 3, sign * (32 * c**3 - 16 * c)


MARGINS: Sequence[Margin | None] = (None, double, triple, quadruple)  # indexed by the values of the enum


class MarginProduct(Classified):
    """Base of the products with a margin of type SINGLE (none), DOUBLE, TRIPLE or QUADRUPLE.

    lambda = max(base (1 + gamma i)^-power, lambda_min) in pass i, counted from ``iteration`` + 1.

    bottom[0]  (M, ...): vectors of length K from ``axis`` on
    bottom[1]  labels (M,)
    top[0]     (M, num_output)
    top[1]     optional: lambda (1,)
    blobs[0]   weights (num_output, K)
    """

    bottoms, tops = (2, 2), (1, 2)
    not_exported = "it is for training; what is used is its bottom"
    message: str

    def setup(self) -> None:
        self.settings = p = value(self.param, self.message)
        check_at_least_1(self, self.message, "num_output")
        shape, self.classes = self.bottom_shapes[0], p.num_output
        self.axis = self.canonical_axis(p.axis, shape, self.message, "axis")
        self.length = torch.Size(shape[self.axis :]).numel()
        self.add_blob((p.num_output, self.length), p.weight_filler)
        self.margin, self.passes = MARGINS[p.type], int(p.iteration)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        vectors, labels = (torch.Size(shape) for shape in bottom_shapes)
        found = vectors[: self.axis].numel()
        if vectors[self.axis :].numel() != self.length or labels.numel() != found:
            message = f"{found} vectors of length {self.length}, and as many labels"
            raise self.error(f"found bottoms of shapes {bottom_shapes}, expected {message}", "bottom")
        return [(*vectors[: self.axis], self.classes), (1,)][: self.num_tops]

    def forward(self, x: torch.Tensor, labels: torch.Tensor) -> torch.Tensor | tuple[torch.Tensor, ...]:
        p, labels = self.settings, labels.flatten().long()
        self.valid(labels, None)
        self.passes += 1
        weight = max(p.base * (1 + p.gamma * self.passes) ** -p.power, p.lambda_min)
        top = self.products(x.reshape(-1, self.length), labels, 1 / (1 + weight)).reshape(self.top_shapes[0])
        return top if self.num_tops == 1 else (top, x.new_full((1,), weight))

    def products(self, x: torch.Tensor, labels: torch.Tensor, share: float) -> torch.Tensor:
        """Return the products (M, num_output) of vectors (M, K); the margin is weighted by ``share``."""
        raise NotImplementedError

    def running_state(self) -> State:
        return {"passes": self.passes}

    def resume(self, state: Mapping[str, Any]) -> None:
        self.passes = int(state["passes"])

"""Sums over blobs and over their axes, each with its gradient: Split, Eltwise, Reduction, Tile, and the losses'."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from netspec.exact.blas import dots, sum_in_order, sum_of_magnitudes
from netspec.exact.pointwise import pointwise


def row_sums(rows: torch.Tensor, factor: float) -> torch.Tensor:
    """Return the sum of each row times a factor: its product with a constant vector (caffe_cpu_dot), (M, K) to (M,)."""

    def compute(rows: torch.Tensor) -> torch.Tensor:
        return dots(rows.unsqueeze(2), torch.full_like(rows, factor).unsqueeze(2)).squeeze(1)

    return pointwise(rows, compute, lambda rows, _, diff: (diff * factor).unsqueeze(1).expand_as(rows))


def row_squares(rows: torch.Tensor) -> torch.Tensor:
    """Sum up the squares of each row (caffe_cpu_dot of it with itself): (M, K) to (M,)."""

    def compute(rows: torch.Tensor) -> torch.Tensor:
        return dots(rows.unsqueeze(2), rows.unsqueeze(2)).squeeze(1)

    return pointwise(rows, compute, lambda rows, sums, diff: rows * (2 * diff).unsqueeze(1))


def row_magnitudes(rows: torch.Tensor) -> torch.Tensor:
    """Sum up the absolute values of each row (caffe_cpu_asum): (M, K) to (M,)."""

    def compute(rows: torch.Tensor) -> torch.Tensor:
        return torch.stack([sum_of_magnitudes(row) for row in rows])

    return pointwise(rows, compute, lambda rows, sums, diff: rows.sign() * diff.unsqueeze(1))


class Copies(torch.autograd.Function):
    """Return a tensor several times; add their gradients, beginning with the first.

    Caffe: src/caffe/layers/split_layer.cpp
    """

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, count: int) -> tuple[torch.Tensor, ...]:
        """Return the tensors; they share their memory."""
        ctx.set_materialize_grads(False)
        return tuple(values.view_as(values) for _ in range(count))

    @staticmethod
    def backward(ctx: Any, *diffs: torch.Tensor | None) -> tuple[torch.Tensor | None, None]:
        found = [diff for diff in diffs if diff is not None]
        return sum(found[1:], found[0]) if found else None, None


def tiles(values: torch.Tensor, count: int) -> torch.Tensor:
    """Repeat a tensor along a new axis: (outer, inner) to (outer, count, inner).

    Caffe: src/caffe/layers/tile_layer.cpp
    """
    return pointwise(
        values, lambda values: values.unsqueeze(1).repeat(1, count, 1), lambda values, top, diff: sum_in_order(diff, 1)
    )


class Product(torch.autograd.Function):
    """Multiply tensors element by element.

    The gradient of a factor is the gradient of the top times the product of the other factors. Unless ``stable``, this
    product is computed as the top divided by the factor.

    Caffe: src/caffe/layers/eltwise_layer.cpp
    """

    @staticmethod
    def forward(ctx: Any, stable: bool, *bottoms: torch.Tensor) -> torch.Tensor:
        ctx.stable = stable
        top = product(bottoms)
        ctx.save_for_backward(top, *bottoms)
        return top

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, diff: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        top, *bottoms = ctx.saved_tensors
        diffs = [
            product_gradient(ctx.stable, bottoms, i, top, diff) if is_needed else None
            for i, is_needed in enumerate(ctx.needs_input_grad[1:])
        ]
        return None, *diffs


def product_gradient(
    stable: bool, bottoms: Sequence[torch.Tensor], i: int, top: torch.Tensor, diff: torch.Tensor
) -> torch.Tensor:
    """Return the gradient of factor ``i`` of a product, from ``top`` and ``diff``, the product's."""
    others = product([*bottoms[:i], *bottoms[i + 1 :]])
    return (others if stable else torch.where(bottoms[i] == 0, others, top / bottoms[i])) * diff


def product(factors: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return the product of tensors, multiplied one after the other."""
    first, *others = factors
    for other in others:
        first = first * other
    return first

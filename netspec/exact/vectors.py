"""Matrix products of vectors with learned weights: InnerProduct, Embed, and the steps of RNN and LSTM."""

# pyright: reportPrivateImportUsage=false

from __future__ import annotations

from contextlib import nullcontext
from typing import Any

import torch
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from netspec.exact.accumulate import ParameterSums
from netspec.exact.blas import add_sums, gemm, one_thread

FEWEST_VECTORS = 64  # for fewer, the product takes less time than rounding the weights to another precision


class VectorProducts(ParameterSums):
    """Multiply vectors by a matrix.

    vectors  (M, K)
    weight   (num_output, K), or (K, num_output) where ``transposed``
    bias     (num_output,) or None
    returns  (M, num_output)

    Caffe: src/caffe/layers/inner_product_layer.cpp
    """

    @staticmethod
    def forward(
        ctx: Any,
        vectors: torch.Tensor,
        weight: torch.Tensor,
        bias: torch.Tensor | None,
        transposed: bool,
        in_place: bool,
    ) -> torch.Tensor:
        vectors = vectors.contiguous()
        ParameterSums.keep(ctx, vectors, (weight, bias), in_place)
        ctx.transposed = transposed
        tops = vectors.new_empty(len(vectors), weight.shape[1 if transposed else 0])
        with one_thread():
            gemm(vectors, weight.contiguous(), tops, b_t=not transposed)
        return tops if bias is None else tops.add_(bias)

    @staticmethod
    @once_differentiable
    @one_thread()
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        vectors, weight, _ = ctx.saved_tensors
        weight_sums, bias_sums = sums = ParameterSums.sums(ctx)
        tops_diff = tops_diff.contiguous()
        if weight_sums is not None:
            factors = (vectors, tops_diff) if ctx.transposed else (tops_diff, vectors)
            gemm(*factors, weight_sums, a_t=True, add=True)
        if bias_sums is not None:
            add_sums(tops_diff, bias_sums, axis=0)
        vectors_diff = None
        if ctx.needs_input_grad[0]:
            vectors_diff = torch.empty_like(vectors)
            gemm(tops_diff, weight.contiguous(), vectors_diff, b_t=ctx.transposed)
        return vectors_diff, *ParameterSums.for_autograd(ctx, sums), None, None


class SummedProducts(ParameterSums):
    """Like :class:`VectorProducts`, but with torch's kernels, on any device.

    In contrast to torch's own function, it adds the gradient of the weights to the sum at once. In fully connected
    layers it is the largest of all tensors, and allocating memory for it takes longer than the product itself.
    """

    @staticmethod
    def forward(
        ctx: Any,
        vectors: torch.Tensor,
        weight: torch.Tensor,
        bias: torch.Tensor | None,
        transposed: bool,
        in_place: bool,
    ) -> torch.Tensor:
        """Return the product. For few vectors it has the precision of the weights, even with autocast."""
        few, ctx.kind = len(vectors) < FEWEST_VECTORS, vectors.dtype
        vectors = vectors.to(weight.dtype) if few else vectors
        ParameterSums.keep(ctx, vectors, (weight, bias), in_place)
        ctx.transposed = transposed
        kind = weight.device.type
        autocast = few and kind in ("cpu", "cuda") and torch.is_autocast_enabled(kind)
        with torch.autocast(kind, enabled=False) if autocast else nullcontext():
            return F.linear(vectors, weight.t() if transposed else weight, bias)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        vectors, weight, _ = ctx.saved_tensors
        weight_sums, bias_sums = sums = ParameterSums.sums(ctx)
        kind = tops_diff.dtype  # of the product, which autocast may have chosen
        vectors = vectors.to(kind)
        if weight_sums is not None:
            factors = (vectors.t(), tops_diff) if ctx.transposed else (tops_diff.t(), vectors)
            if weight_sums.dtype == kind:
                weight_sums.addmm_(*factors)
            else:
                weight_sums += factors[0] @ factors[1]
        if bias_sums is not None:
            bias_sums += tops_diff.sum(0)
        vectors_diff = None
        if ctx.needs_input_grad[0]:
            vectors_diff = (tops_diff @ (weight.t() if ctx.transposed else weight).to(kind)).to(ctx.kind)
        return vectors_diff, *ParameterSums.for_autograd(ctx, sums), None, None


class ChosenRows(ParameterSums):
    """Look up rows.

    index    (M,), whole numbers
    rows     (input_dim, num_output)
    bias     (num_output,) or None
    returns  (M, num_output)

    Caffe: src/caffe/layers/embed_layer.cpp
    """

    @staticmethod
    def forward(
        ctx: Any, index: torch.Tensor, rows: torch.Tensor, bias: torch.Tensor | None, in_place: bool
    ) -> torch.Tensor:
        ParameterSums.keep(ctx, index, (rows, bias), in_place)
        tops = rows[index]
        return tops if bias is None else tops.add_(bias)

    @staticmethod
    @once_differentiable
    @one_thread()
    def backward(ctx: Any, tops_diff: torch.Tensor) -> tuple[Any, ...]:
        rows_sums, bias_sums = sums = ParameterSums.sums(ctx)
        tops_diff = tops_diff.contiguous()
        if rows_sums is not None:
            rows_sums.index_add_(0, ctx.saved_tensors[0], tops_diff)  # one after the other
        if bias_sums is not None:
            add_sums(tops_diff, bias_sums, axis=0)
        return None, *ParameterSums.for_autograd(ctx, sums), None

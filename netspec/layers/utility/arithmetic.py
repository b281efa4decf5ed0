"""Arithmetic between blobs and over axes, and Parameter, a learnable blob without bottoms."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from netspec.exact.sums import product_gradient
from netspec.layers.contract.base import Layer, Shape
from netspec.layers.contract.registry import register


@register("Eltwise", "eltwise_param")
class Eltwise(Layer):
    """Combine the bottoms elementwise: SUM (coeff_i bottom_i), PROD, or MAX.

    If values in a MAX are equal, the second bottom wins over the first, and earlier ones over later ones; only the
    winner gets the gradient. PROD's gradient is the product of the others. With stable_prod_grad: false, Caffe computes
    top / bottom, which differs in rounding (``exact: all`` reproduces this) and is NaN at 0 (not reproduced).

    bottom[i]  equal shapes, at least two
    top[0]     the same shape
    Caffe: src/caffe/layers/eltwise_layer.cpp
    """

    PROD, SUM, MAX = 0, 1, 2  # caffe.proto: enum EltwiseParameter.EltwiseOp
    bottoms = (2, None)

    def setup(self) -> None:
        p = self.param.eltwise_param
        self.operation: int = p.operation
        self.coeff: list[float] = list(p.coeff) or [1.0] * len(self.bottom_shapes)
        if len(self.coeff) != len(self.bottom_shapes):
            message = f"found {len(self.coeff)} coeff, expected none or one per bottom blob ({len(self.bottom_shapes)})"
            raise self.error(message, "eltwise_param", "coeff")
        if p.coeff and self.operation == self.PROD:
            raise self.error("found coeff for PROD, expected it for SUM only", "eltwise_param", "coeff")
        if self.operation == self.MAX:
            self.ignores = frozenset({"eltwise_param.coeff"})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        for i, shape in enumerate(bottom_shapes):
            if shape != bottom_shapes[0]:
                message = f"found bottoms of shapes {bottom_shapes[0]} and {shape}, expected equal shapes"
                raise self.error(message, "bottom", i)
        return bottom_shapes[:1]

    def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
        if self.operation == self.PROD:
            return self.arithmetic(bottoms[0]).product(bottoms, self.param.eltwise_param.stable_prod_grad)
        if self.operation == self.SUM:
            return self.arithmetic(bottoms[0]).weighted_sum(bottoms, self.coeff)
        first, second, *others = bottoms
        top = torch.where(first > second, first, second)
        for x in others:
            top = torch.where(x > top, x, top)
        return top

    @property
    def gradient_reads(self) -> frozenset[str]:
        stable, in_place = self.param.eltwise_param.stable_prod_grad, self.param.top[0] in self.param.bottom
        return frozenset({"top"} if self.operation == self.PROD and not stable and not in_place else ())

    def caffes_gradients(
        self, bottoms: Sequence[torch.Tensor], top: torch.Tensor, diff: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        return tuple(product_gradient(False, bottoms, i, top, diff) for i in range(len(bottoms)))


@register("Reduction", "reduction_param")
class Reduction(Layer):
    """Reduce the axes from axis (default 0) to the last: coeff times SUM, ASUM (of |x|), SUMSQ (of x^2) or MEAN.

    bottom[0]  any shape
    top[0]     shape[:axis]
    Caffe: src/caffe/layers/reduction_layer.cpp
    """

    SUM, ASUM, SUMSQ, MEAN = 1, 2, 3, 4  # caffe.proto: enum ReductionParameter.ReductionOp

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        p, shape = self.param.reduction_param, bottom_shapes[0]
        self.axis = self.canonical_axis(p.axis, shape, "reduction_param", "axis")
        count = math.prod(shape[self.axis :])
        self.coeff: float = p.coeff
        if p.operation == self.MEAN:
            self.coeff = p.coeff / count if count else math.nan  # Caffe divides by 0, and multiplies the sum 0 by it
        return [shape[: self.axis]]

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        operation, arithmetic = self.param.reduction_param.operation, self.arithmetic(x)
        if operation == self.ASUM:
            return arithmetic.sums_of_magnitudes(x, self.axis) * self.coeff
        if operation == self.SUMSQ:
            return arithmetic.sums_of_squares(x, self.axis) * self.coeff
        return arithmetic.sums(x, self.axis) * self.coeff


@register("ArgMax", "argmax_param")
class ArgMax(Layer):
    """Find the top_k largest values along an axis, or of each item if no axis is given. No gradient.

    Of equal values the larger index comes first.

    bottom[0]  any shape
    top[0]     with axis: that axis has size top_k; indices, or values if out_max_val;
               without: (N, 1, top_k) of indices, or (N, 2, top_k) of indices and values, then 1 for each further axis
    Caffe: src/caffe/layers/argmax_layer.cpp
    """

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        p, shape = self.param.argmax_param, bottom_shapes[0]
        axis = self.canonical_axis(p.axis, shape, "argmax_param", "axis")
        self.axis = axis if p.HasField("axis") else None
        size = math.prod(shape[1:]) if self.axis is None else shape[self.axis]
        if not 1 <= p.top_k <= size:
            raise self.error(f"found top_k {p.top_k}, expected 1 to {size}", "argmax_param", "top_k")
        if self.axis is not None:
            return [(*shape[: self.axis], p.top_k, *shape[self.axis + 1 :])]
        return [(shape[0], 1 + p.out_max_val, p.top_k, *(1 for _ in shape[3:]))]

    @torch.no_grad()
    def forward(self, x: torch.Tensor) -> torch.Tensor:
        p = self.param.argmax_param
        axis = 1 if self.axis is None else self.axis
        if self.axis is None:
            x = x.reshape(x.shape[0], math.prod(x.shape[1:]))
        # A stable sort keeps equal values in order; in the reversed axis, the larger index comes first.
        values, order = torch.sort(x.flip(axis), dim=axis, descending=True, stable=True)
        values, order = values.narrow(axis, 0, p.top_k), order.narrow(axis, 0, p.top_k)
        indices = (x.shape[axis] - 1 - order).to(x.dtype)
        if self.axis is not None:
            return values if p.out_max_val else indices
        top = torch.stack([indices, values], 1) if p.out_max_val else indices
        return top.reshape(self.top_shapes[0])


@register("Softmax", "softmax_param")
class Softmax(Layer):
    """exp(x), divided by the sum of exp(x) along an axis (default 1).

    bottom[0]  any shape
    top[0]     the same shape
    Caffe: src/caffe/layers/softmax_layer.cpp
    """

    gradient_reads = frozenset({"top"})
    ignores_propagate_down = frozenset({0})

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        self.axis = self.canonical_axis(self.param.softmax_param.axis, bottom_shapes[0], "softmax_param", "axis")
        return bottom_shapes

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.arithmetic(x).softmax(x, self.axis)

    def caffes_gradient(self, bottom: torch.Tensor, top: torch.Tensor, diff: torch.Tensor) -> torch.Tensor:
        return self.arithmetic(top).softmax_gradient(top, diff, self.axis)


@register("Silence")
class Silence(Layer):
    """Consume blobs that would otherwise be outputs of the net.

    bottom[i]  any shape
    top        none
    Caffe: src/caffe/layers/silence_layer.cpp
    """

    bottoms = (1, None)
    tops = (0, 0)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return []

    def forward(self, *bottoms: torch.Tensor) -> tuple[torch.Tensor, ...]:
        return ()


@register("Parameter", "parameter_param")
class Parameter(Layer):
    """Output a learnable blob.

    bottom     none
    top[0]     parameter_param.shape
    blobs[0]   the same shape, 0 at first
    Caffe: include/caffe/layers/parameter_layer.hpp
    """

    bottoms = (0, 0)

    def setup(self) -> None:
        self.add_blob(tuple(self.param.parameter_param.shape.dim))

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return self.blob_shapes

    def forward(self) -> torch.Tensor:
        blob = self.blob(0)
        return blob.view_as(blob)

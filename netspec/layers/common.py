"""Layers of every net: InnerProduct, Dropout, Embed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from netspec.exact import SMALL_PRODUCT
from netspec.layers.contract.base import Layer, Shape
from netspec.layers.contract.registry import register
from netspec.proto.schema import TRAIN


@register("InnerProduct", "inner_product_param")
class InnerProduct(Layer):
    """Multiply each vector by a learnable matrix; the axes from ``axis`` on form a vector of length K.

    bottom[0]  (N, ...), e.g. (N, C, H, W) with K = C H W
    top[0]     (N, num_output); the bottom's axes before ``axis``, then num_output
    blobs[0]   weights (num_output, K); (K, num_output) with transpose: true
    blobs[1]   bias    (num_output,)                                   unless bias_term: false
    Caffe: src/caffe/layers/inner_product_layer.cpp
    """

    def setup(self) -> None:
        param = self.param.inner_product_param
        if param.num_output < 1:
            raise self.error("num_output must be at least 1", "inner_product_param", "num_output")
        self.inputs = math.prod(self.bottom_shapes[0][self._axis(self.bottom_shapes[0]) :])
        shape = (self.inputs, param.num_output) if param.transpose else (param.num_output, self.inputs)
        self.add_blob(shape, param.weight_filler)
        if param.bias_term:
            self.add_blob((param.num_output,), param.bias_filler)

    def _axis(self, shape: Shape) -> int:
        return self.canonical_axis(self.param.inner_product_param.axis, shape, "inner_product_param", "axis")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        """Return the axes before ``axis`` and num_output; raise SpecError if the vectors do not fit the weights."""
        shape = bottom_shapes[0]
        self.axis = self._axis(shape)
        found = math.prod(shape[self.axis :])
        if found != self.inputs:
            message = f"bottom of shape {shape} has {found} values from axis {self.axis} on, expected {self.inputs}"
            raise self.error(message, "bottom")
        return [(*shape[: self.axis], self.param.inner_product_param.num_output)]

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        weight, bias = self.blob(0), self.blob(1) if len(self.blobs) > 1 else None
        vectors, transposed = data.flatten(self.axis), self.param.inner_product_param.transpose
        return self.arithmetic(data).inner_product(vectors, weight, bias, transposed)

    @property
    def small(self) -> bool:
        return math.prod(self.blob_shapes[0]) <= SMALL_PRODUCT

    def multiply_adds(self) -> int:
        return math.prod(self.top_shapes[0]) * self.inputs


@register("Dropout", "dropout_param")
class Dropout(Layer):
    """In the training phase, zero each value with probability ``dropout_ratio`` p and scale the others by 1 / (1 - p).

    bottom[0]  any shape
    top[0]     the same shape; in the test phase the same values
    Caffe: src/caffe/layers/dropout_layer.cpp
    """

    def setup(self) -> None:
        self.ratio: float = self.param.dropout_param.dropout_ratio
        if not 0 <= self.ratio < 1 and (self.phase == TRAIN or self.ratio != 1):  # not read in the test phase
            message = f"dropout_ratio must be at least 0 and less than 1, found {self.ratio:g}"
            raise self.error(message, "dropout_param", "dropout_ratio")

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return bottom_shapes

    def forward(self, data: torch.Tensor) -> torch.Tensor:
        """Return the kept values, scaled; in the test phase, the bottom."""
        if self.phase != TRAIN:
            return data
        kept = data.new_empty(data.shape)  # in Caffe's order, whatever the layout of the data
        kept.bernoulli_(1 - self.ratio, generator=self.context.random.on(data.device))
        return data * kept.mul_(1 / (1 - self.ratio))

    @property
    def passes_on(self) -> bool:
        """Whether the top is the bottom, unchanged: in the test phase."""
        return self.phase != TRAIN


@register("Embed", "embed_param")
class Embed(Layer):
    """Replace each index by a learnable row.

    bottom[0]  any shape; integers from 0 to input_dim - 1, in floating point; gets no gradient
    top[0]     the bottom's shape, then num_output
    blobs[0]   rows (input_dim, num_output)
    blobs[1]   bias (num_output,)                                      unless bias_term: false
    Caffe: src/caffe/layers/embed_layer.cpp
    """

    label_bottoms = frozenset({0})

    def setup(self) -> None:
        param = self.param.embed_param
        for name in ("num_output", "input_dim"):
            if getattr(param, name) < 1:
                raise self.error(f"{name} must be at least 1", "embed_param", name)
        self.add_blob((param.input_dim, param.num_output), param.weight_filler)
        if param.bias_term:
            self.add_blob((param.num_output,), param.bias_filler)

    def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
        return [(*bottom_shapes[0], self.param.embed_param.num_output)]

    def forward(self, indices: torch.Tensor) -> torch.Tensor:
        """Return the rows; raise SpecError for an invalid index."""
        rows, index = self.param.embed_param.input_dim, indices.long()
        wrong = indices[(index < 0) | (index >= rows) | (index != indices)]
        if len(wrong):
            message = f"found index {wrong[0]:g}, expected integers from 0 to {rows - 1} (input_dim - 1)"
            raise self.error(message, "bottom")
        weight, bias = self.blob(0), self.blob(1) if len(self.blobs) > 1 else None
        return self.arithmetic(weight).chosen_rows(index, weight, bias)

"""Exporters of InnerProduct, Dropout, Embed."""

from __future__ import annotations

import torch.nn.functional as F
from torch import nn

from netspec.export.exporter import Exporter, exports
from netspec.export.expression import TRAINING, Expression, call
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.common import Dropout, Embed, InnerProduct
from netspec.proto.schema import TRAIN


@exports(InnerProduct)
class InnerProductExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        layer = self.layer
        vectors = bottoms[0]
        if (layer.axis, len(layer.bottom_shapes[0])) != (1, 2):
            vectors = graph.node("Flatten", vectors, axis=layer.axis)
        bias = [graph.blob(1)] if len(layer.blobs) > 1 else []
        transposed = int(not layer.param.inner_product_param.transpose)
        top = graph.node("Gemm", vectors, graph.blob(0), *bias, transB=transposed)
        return top if layer.axis == 1 else graph.reshape_to_top(top)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        weight = layer.blob(0).t() if layer.param.inner_product_param.transpose else layer.blob(0)
        state, options = {"weight": weight}, {"bias": False}
        if len(layer.blobs) > 1:
            state, options = {"weight": weight, "bias": layer.blob(1)}, {}
        linear = code.module(nn.Linear, layer.inputs, weight.shape[0], state=state, **options)
        flat = len(layer.bottom_shapes[0]) == layer.axis + 1
        return linear(x if flat else x.flatten(*([layer.axis] if layer.axis else [])))


@exports(Dropout)
class DropoutExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        if self.layer.phase == TRAIN:
            raise self.refusal("ONNX", "it draws random numbers in the training phase")
        return graph.node("Identity", *bottoms)

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        return call(F.dropout, x, self.layer.ratio, TRAINING) if self.layer.phase == TRAIN else x


@exports(Embed)
class EmbedExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        top = graph.node("Gather", graph.blob(0), graph.cast(bottoms[0], "int64"), axis=0)
        return graph.node("Add", top, graph.blob(1)) if len(self.layer.blobs) > 1 else top

    def to_torch(self, code: TorchCode, x: Expression) -> Expression:
        layer = self.layer
        top = code.module(nn.Embedding, *layer.blob_shapes[0], state={"weight": layer.blob(0)})(x.long())
        return top + code.parameter(1) if len(layer.blobs) > 1 else top

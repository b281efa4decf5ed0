"""Exporters of InnerProduct, Dropout, Embed."""

from __future__ import annotations

from netspec.export.exporter import Exporter, exports
from netspec.export.targets import OnnxGraph, TorchCode
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

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        layer = self.layer
        weight = layer.blob(0).t() if layer.param.inner_product_param.transpose else layer.blob(0)
        state = {"weight": weight, **({"bias": layer.blob(1)} if len(layer.blobs) > 1 else {})}
        bias = "" if len(layer.blobs) > 1 else ", bias=False"
        template = f"nn.Linear({{in_channels}}, {{out_channels}}{bias})"
        linear = code.module(template, state, in_channels=layer.inputs, out_channels=weight.shape[0])
        flat = len(layer.bottom_shapes[0]) == layer.axis + 1
        vectors = bottoms[0] if flat else code.call(f"{{x}}.flatten({layer.axis or ''})", x=bottoms[0])
        return code.call("{linear}({x})", linear=linear, x=vectors)


@exports(Dropout)
class DropoutExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        if self.layer.phase == TRAIN:
            raise self.refusal("ONNX", "it draws random numbers in the training phase")
        return graph.node("Identity", *bottoms)

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        layer = self.layer
        if layer.phase != TRAIN:
            return bottoms[0]
        return code.call("F.dropout({x}, {ratio}, self.training)", x=bottoms[0], ratio=layer.ratio)


@exports(Embed)
class EmbedExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        top = graph.node("Gather", graph.blob(0), graph.cast(bottoms[0], "int64"), axis=0)
        return graph.node("Add", top, graph.blob(1)) if len(self.layer.blobs) > 1 else top

    def to_torch(self, code: TorchCode, *bottoms: str) -> str:
        layer = self.layer
        rows, width = layer.blob_shapes[0]
        template = "nn.Embedding({rows}, {out_channels})"
        table = code.module(template, {"weight": layer.blob(0)}, rows=rows, out_channels=width)
        top = code.call("{table}({x}.long())", table=table, x=bottoms[0])
        return code.call("{x} + {bias}", x=top, bias=code.parameter(1)) if len(layer.blobs) > 1 else top

"""Exporters of layers of netspec/dialects/text."""

from __future__ import annotations

import torch

from netspec.export.exporter import Exporter, exports
from netspec.export.expression import Expression, Plain
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode


@exports("netspec.dialects.text.text.ContinuationIndicator")
class ContinuationIndicatorExport(Exporter):
    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.constant(self.layer.forward().cpu())

    def to_torch(self, code: TorchCode) -> Expression:
        return code.buffer(self.layer.forward())


@exports("netspec.dialects.text.text.Reverse")
class ReverseExport(Exporter):
    torch_call = Plain(torch.Tensor.flip, "axis")

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        first, last, step = (graph.constant([n]) for n in (-1, -(2**31), -1))
        return graph.node("Slice", bottoms[0], first, last, graph.constant([self.layer.axis]), step)

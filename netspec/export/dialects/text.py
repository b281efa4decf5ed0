"""Exporters of layers of netspec/dialects/text."""

from __future__ import annotations

from netspec.export.exporter import Exporter, exports
from netspec.export.targets import OnnxGraph


@exports("netspec.dialects.text.text.ContinuationIndicator")
class ContinuationIndicatorExport(Exporter):
    torch_call = "torch.ones({size}).index_fill(0, torch.tensor([0]), 0)"

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        return graph.constant(self.layer.forward().cpu())


@exports("netspec.dialects.text.text.Reverse")
class ReverseExport(Exporter):
    torch_call = "{x}.flip({axis})"

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> str:
        first, last, step = (graph.constant([n]) for n in (-1, -(2**31), -1))
        return graph.node("Slice", bottoms[0], first, last, graph.constant([self.layer.axis]), step)

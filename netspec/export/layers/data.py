"""Exporters of the data layers that need no file."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from netspec.export.exporter import Exporter, exports
from netspec.export.expression import Expression
from netspec.export.formats.onnx import OnnxGraph
from netspec.export.formats.torch_code import TorchCode
from netspec.layers.data.hdf5 import HDF5Output
from netspec.layers.data.memory import DummyData


@exports(DummyData)
class DummyDataExport(Exporter):
    not_exported = "its values are random"

    def to_onnx(self, graph: OnnxGraph, *bottoms: str) -> Sequence[str]:
        return [graph.node("Identity", graph.constant(values)) for values in self._fixed("ONNX")]

    def _fixed(self, target: str) -> list[torch.Tensor]:
        """Return the tops, which must be constant."""
        fixed = [blob for blob in self.layer.filled_once() if blob is not None]
        if len(fixed) < self.layer.num_tops:
            raise self.refusal(target)
        return fixed

    def to_torch(self, code: TorchCode) -> Sequence[Expression]:
        return [code.buffer(values) for values in self._fixed("PyTorch")]


@exports(HDF5Output)
class HDF5OutputExport(Exporter):
    not_exported = "it writes a file"

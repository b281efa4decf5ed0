"""Nets as the ONNX models that engines run."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from netspec.export.engines.runners import Unable
from netspec.export.formats.onnx import export_onnx
from netspec.net.net import Net


def write_model(net: Net, path: Path, blobs: Iterable[str] = ()) -> None:
    """Write a net; besides its outputs the model has those of ``blobs`` that are not inputs.

    Raises SpecError where a layer cannot be exported, and Unable for a blob that the model does not have.
    """
    import onnx

    export_onnx(net, path, largest=0)
    model = onnx.load(str(path), load_external_data=False)
    there = {output.name for output in model.graph.output} | {given.name for given in model.graph.input}
    made = {name for node in model.graph.node for name in node.output}
    for blob in blobs:
        if blob in there:
            continue
        if blob not in made:
            raise Unable(f'blob "{blob}" is not in the exported net')
        model.graph.output.append(onnx.helper.make_tensor_value_info(blob, onnx.TensorProto.FLOAT, None))
    path.write_bytes(model.SerializeToString())

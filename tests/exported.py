"""Run nets here and as exported, and compare the results."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

import netspec
from golden_cases import set_parameters
from netspec.export.formats.onnx import export_onnx
from netspec.export.formats.shapes import NetShapes
from netspec.export.formats.source import class_name
from netspec.export.formats.torch import torch_source
from netspec.net.net import Net

ONNX_EXTRA = "the onnx extra is not installed: pip install 'netspec-caffe[onnx]'"
Arrays = Mapping[str, np.ndarray]
TOLERANCE = 1e-5  # of the largest element


def golden_net(case: Path) -> tuple[Net, dict[str, np.ndarray]]:
    """Return the net of a golden case, with its weights, and its inputs."""
    golden = np.load(case / "golden.npz")
    net = netspec.load_net(case / "net.prototxt", phase=json.loads(str(golden["meta"]))["phase"])
    set_parameters(net, golden, "param_init/")
    return net, {name: golden[f"in/{name}"] for name in net.inputs}


def other_inputs(net: Net, shapes: NetShapes, inputs: Arrays) -> dict[str, np.ndarray]:
    """Return inputs with one more item, row and column, or whatever else suits the net, where sizes are free."""
    value_of = {net.plan.blobs[v]: v for node in net.plan.nodes for v in node.tops if not node.bottoms}
    changed = dict(inputs)
    for free in shapes.free:
        for name, v in value_of.items():
            for axis, size in enumerate(free.tried[-1][v]) if name in changed else ():
                if size != shapes.built[v][axis]:
                    wanted = (*changed[name].shape[:axis], size, *changed[name].shape[axis + 1 :])
                    changed[name] = np.resize(changed[name], wanted)
    return changed


def trained(net: Net, seed: int = 1) -> Net:
    """Give a net random weights like those of a trained net: none is zero, and maps neither vanish nor grow."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(blob: torch.Tensor, low: float, high: float) -> None:
        blob.data.uniform_(low, high, generator=generator)

    for layer in net.layers:
        if layer.type == "BatchNorm":
            weight = 2.0
            uniform(layer.blobs[0], -0.2 * weight, 0.2 * weight)
            uniform(layer.blobs[1], 0.5 * weight, 1.5 * weight)
            layer.blobs[2].data.fill_(weight)
            continue
        for blob in layer.blobs:
            if layer.type == "BN":
                uniform(blob, 0.5, 1.5)
            elif blob.dim() >= 2:
                reach = (6 / (blob.numel() / blob.shape[0])) ** 0.5
                uniform(blob, -reach, reach)
            else:
                uniform(blob, *((0.5, 1.0) if blob is layer.blobs[0] else (-0.1, 0.1)))
    return net


def random_inputs(net: Net, seed: int = 0) -> dict[str, np.ndarray]:
    """Return normal numbers for every input of a net."""
    rng = np.random.default_rng(seed)
    return {name: rng.standard_normal(net.shapes[name]).astype(np.float32) for name in net.inputs}


def here(net: Net, inputs: Arrays) -> dict[str, np.ndarray]:
    """Return the outputs of the net itself."""
    with torch.no_grad():
        return {name: blob.numpy() for name, blob in net(**inputs).items()}


def onnx_model(net: Net, **options: Any) -> tuple[Any, list[str]]:
    """Return the exported ONNX model of a net, and its notes."""
    onnx = pytest.importorskip("onnx", reason=ONNX_EXTRA)
    _keep_functions()
    with tempfile.TemporaryDirectory() as folder:
        notes = export_onnx(net, Path(folder) / "net.onnx", **options)
        return onnx.load(Path(folder) / "net.onnx"), notes


@cache
def _keep_functions() -> None:
    """Read the functions of onnxscript once, not in each export, which would take half of its time."""
    registration = import_module("torch.onnx._internal.exporter._registration")
    apis = registration.onnxscript_apis
    apis.get_torchlib_ops = cache(apis.get_torchlib_ops)


def in_onnxruntime(model: Any, inputs: Arrays) -> dict[str, np.ndarray]:
    """Return the outputs of an ONNX model, a message or a path, that the checker passes."""
    checker = pytest.importorskip("onnx.checker", reason=ONNX_EXTRA)
    onnxruntime: Any = pytest.importorskip("onnxruntime", reason=ONNX_EXTRA)
    checker.check_model(model, full_check=True)
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 3
    source = model if isinstance(model, str) else model.SerializeToString()
    session = onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
    names = [output.name for output in session.get_outputs()]
    given = {each.name: inputs[each.name] for each in session.get_inputs()}
    return dict(zip(names, session.run(None, given), strict=True))


def in_opencv(model: Any, inputs: Arrays) -> dict[str, np.ndarray]:
    """Return the outputs of an ONNX message in OpenCV 5."""
    net = cv2.dnn.readNetFromONNX(np.frombuffer(model.SerializeToString(), np.uint8))
    for each in model.graph.input:
        net.setInput(inputs[each.name], each.name)
    names = [output.name for output in model.graph.output]
    return dict(zip(names, net.forward(names), strict=True))


def run_module(module: torch.nn.Module, net: Net, inputs: Arrays) -> dict[str, np.ndarray]:
    """Return the outputs of a module that was made from a net."""
    with torch.no_grad():
        found = module(*(torch.from_numpy(inputs[name]) for name in net.inputs))
    found = found if isinstance(found, dict) else {net.outputs[0]: found}
    return {name: value.detach().numpy() for name, value in found.items()}


def source_module(net: Net) -> torch.nn.Module:
    """Return the module of the exported source, with its weights, for inference."""
    text, state, _ = torch_source(net)
    namespace: dict[str, Any] = {"__name__": "exported", "__file__": "exported.py"}
    exec(compile(text, "exported.py", "exec"), namespace)
    module = namespace[class_name(net.name or "net")]()
    module.load_state_dict(state)
    return module.eval()


def assert_same(found: Arrays, expected: Arrays, scalars_have_an_axis: bool = False) -> None:
    """Compare all outputs; with ``scalars_have_an_axis`` a shape (1,) equals (), which OpenCV does not have."""
    assert sorted(found) == sorted(expected)
    for name, wanted in expected.items():
        got = found[name]
        if scalars_have_an_axis and wanted.shape == () and got.shape == (1,):
            got = got[0]
        assert got.shape == wanted.shape, name
        scale = max(float(np.abs(wanted).max(initial=0)), 1e-30)
        worst = float(np.abs(got.astype(np.float64) - wanted).max(initial=0)) / scale
        assert worst <= TOLERANCE, f"{name}: off by {worst:.1e} of the largest element"

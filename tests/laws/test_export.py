"""Every layer type can be exported with the same results, or is refused with a reason."""

import importlib.util
import operator
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import torch
from google.protobuf import text_format
from typing_extensions import override

from exported import ONNX_EXTRA, assert_same, here, in_onnxruntime, onnx_model, run_module, source_module
from laws.examples import EXAMPLES
from laws.test_registry import TYPES, folder  # noqa: F401
from netspec.errors import SpecError
from netspec.export.exporter import EXPORTERS, exported, exporter_class, refusal
from netspec.export.expression import Expression, Value
from netspec.export.formats.deploy import with_inputs
from netspec.export.formats.pt2 import torch_module
from netspec.graph.filter import with_state
from netspec.graph.options import BuildOptions
from netspec.layers import Layer, layer_class
from netspec.layers.contract.base import Shape
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.schema import TEST, LayerParameter
from netspec.proto.text import parse_net_text
from paths import ROOT

NOT_IN_ONNX = {"DummyData": "random", "HDF5Output": "writes a file", "Python": "code"}
NOT_IN_TORCH = NOT_IN_ONNX | {"InfogainLoss": "infogain matrix", "Accuracy": "each class"}
DATA = [name for name in TYPES if getattr(layer_class(name), "reads_data", False)]


def net_of_example(name: str, folder: Path) -> Net:  # noqa: F811
    example = EXAMPLES[name]
    text = "force_backward: false\n"
    for blob, shape in zip(example.param.bottom, example.shapes, strict=True):
        dims = " ".join(f"dim: {size}" for size in shape)
        text += f'layer {{ name: "{blob}" type: "Input" top: "{blob}" input_param {{ shape {{ {dims} }} }} }}\n'
    text += f"layer {{ {text_format.MessageToString(example.param)} }}\n"
    message, source = parse_net_text(text, "net.prototxt")
    message = with_state(message, example.param.phase if example.param.HasField("phase") else TEST)
    if name in DATA:
        message, source = with_inputs(message, source, BuildOptions(given_shapes={"data": (3, 2, 9, 9)}))
    return build_net(message, source, BuildOptions(seed=0, allow_python=True))


def test_every_layer_has_an_exporter_or_a_reason() -> None:
    for name in TYPES:
        cls = layer_class(name)
        assert cls is not None
        exporter = exporter_class(cls)
        pairs = (("to_onnx", "onnx_op"), ("to_torch", "torch_call"))
        own = [pair for pair in pairs if any(hasattr(exporter, each) for each in pair)]
        refused = hasattr(exporter, "not_exported") or name in DATA or name in NOT_IN_TORCH
        assert len(own) == 2 or refused, name


def test_exporters_are_registered_for_existing_classes() -> None:
    for path in EXPORTERS:
        module, _, cls = path.rpartition(".")
        assert f"class {cls}(" in (ROOT / module.replace(".", "/")).with_suffix(".py").read_text(), path


def test_a_class_outside_netspec_defines_its_own_export() -> None:
    class Doubled(Layer):
        @override
        def reshape(self, bottom_shapes: Sequence[Shape]) -> Sequence[Shape]:
            return bottom_shapes

        @override
        def forward(self, *bottoms: torch.Tensor) -> torch.Tensor:
            return 2 * bottoms[0]

        def to_torch(self, code: object, x: Expression) -> Expression:
            return 2 * x

    layer = Doubled(LayerParameter(name="it", bottom=["x"], top=["y"]), [(1, 2)])
    made = exported(layer, "to_torch")(None, Value(0))
    assert (made.function, made.args[0]) == (operator.mul, 2)
    assert exported(layer, "to_onnx") is exported(layer, "onnx_op") is None
    assert str(refusal(layer, "ONNX")).endswith("cannot be exported to ONNX: its class does not support it")


@pytest.mark.parametrize(("shift", "power"), [(3, 2), (0, -1), (-2, 0.5)], ids=["finite", "infinite", "NaN"])
def test_a_power_that_does_not_depend_on_its_bottom_is_exported(shift: float, power: float) -> None:
    text = f"""layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: 2 dim: 3 }} }} }}
layer {{ name: "y" type: "Power" bottom: "x" top: "y" power_param {{ scale: 0 shift: {shift} power: {power} }} }}"""
    net = build_net(*parse_net_text(text, "net.prototxt"))
    inputs = {"x": np.ones((2, 3), np.float32)}
    expected = here(net, inputs)["y"]
    found = [run_module(module, net, inputs)["y"] for module in (source_module(net), torch_module(net))]
    if importlib.util.find_spec("onnxruntime"):
        found.append(in_onnxruntime(onnx_model(net)[0], inputs)["y"])
    for y in found:
        np.testing.assert_allclose(y, expected, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("name", TYPES)
@pytest.mark.parametrize("target", ["ONNX", "PyTorch"])
def test_exported_layer_computes_the_same_or_is_refused_with_a_reason(
    name: str,
    target: str,
    folder: Path,  # noqa: F811
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    if target == "ONNX":
        pytest.importorskip("onnx", reason=ONNX_EXTRA)
    monkeypatch.chdir(folder)
    net = net_of_example(name, folder)
    write = onnx_model if target == "ONNX" else source_module
    refused = (NOT_IN_ONNX if target == "ONNX" else NOT_IN_TORCH).get(name)
    if refused:
        with pytest.raises(
            SpecError,
            match=rf'layer "{EXAMPLES[name].param.name}" \({name}\): cannot be exported to {target}: .*{refused}',
        ):
            write(net)
        net.close()
        return
    given = EXAMPLES[name].bottoms()
    inputs = {blob: given[i].float().numpy() for i, blob in enumerate(net.inputs) if i < len(given)}
    for blob in net.inputs:
        inputs.setdefault(blob, np.zeros(net.shapes[blob], np.float32))
    if name == "Silence":
        assert not net.outputs
    elif target == "ONNX":
        assert_same(in_onnxruntime(write(net)[0], inputs), here(net, inputs))  # type: ignore[index]
    else:
        for module in (source_module(net), torch_module(net)):
            assert_same(run_module(module, net, inputs), here(net, inputs))
    net.close()

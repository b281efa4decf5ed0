"""netspec.dnn on onnxruntime and OpenVINO: PyTorch's results and errors, and starts without torch."""

import logging
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from dnn_program import HERE, NETS
from fake_gpu import GPUS, NAME, gpu
from netspec import dnn
from netspec.compat.dnn.engine import Engine
from netspec.errors import SpecError
from netspec.export.engines import choice

pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")

RUNS = [
    pytest.param(name, shapes, id=f"{name}-{'x'.join(map(str, shapes[0]))}")
    for name in ("classify", "segment", "two_inputs")
    for shapes in NETS[name]
]
WITHOUT_TORCH = """
import sys
import numpy as np
from netspec import dnn

net = dnn.readNetFromCaffe(*sys.argv[1:])
net.setInput(np.ones((2, 3, 20, 20)))
net.forward()
print("torch" in sys.modules)
"""


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """A prototxt and its weights, of which the cache has no model."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return [str(shutil.copy(HERE / f"classify.{ending}", tmp_path)) for ending in ("prototxt", "caffemodel")]


def read(name: str) -> dnn.Net:
    return dnn.readNetFromCaffe(HERE / f"{name}.prototxt", HERE / f"{name}.caffemodel")


def in_torch(net: dnn.Net) -> dnn.Net:
    net._caffe.engine = None
    return net


def engine(net: dnn.Net) -> Engine:
    assert net._caffe.engine is not None
    return net._caffe.engine


def outputs(net: dnn.Net, shapes: list[list[int]]) -> dict[str, np.ndarray]:
    for name, shape in zip(net._caffe.shown, shapes, strict=True):
        net.setInput(np.random.RandomState(1).rand(*shape), name)
    names = net.getUnconnectedOutLayersNames()
    return dict(zip(names, net.forward(list(names)), strict=True))


def compare(found: dict[str, np.ndarray], expected: dict[str, np.ndarray]) -> None:
    assert list(found) == list(expected)
    for name, values in expected.items():
        assert found[name].dtype == values.dtype
        np.testing.assert_allclose(found[name], values, rtol=0, atol=1e-5 * abs(values).max(initial=1), strict=True)


@pytest.mark.parametrize("backend", ["DEFAULT", pytest.param("INFERENCE_ENGINE", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("name", "shapes"), RUNS)
def test_outputs_equal_pytorchs(name: str, shapes: list[list[int]], backend: str) -> None:
    if backend == "INFERENCE_ENGINE":
        pytest.importorskip("openvino")
    net, runs = read(name), list[Any]()
    net.setPreferableBackend(getattr(dnn, f"DNN_BACKEND_{backend}"))
    found = outputs(net, shapes)
    runs.append(engine(net).run(net._caffe.values))
    compare(found, outputs(in_torch(read(name)), shapes))
    assert runs != [None]


@pytest.mark.parametrize("shape", [(1, 3, 25, 22), (0, 3, 20, 20)], ids=["another size", "empty"])
@pytest.mark.parametrize("backend", ["DEFAULT", pytest.param("INFERENCE_ENGINE", marks=pytest.mark.slow)])
def test_inputs_that_the_exported_net_is_not_for_run_in_pytorch(shape: tuple[int, ...], backend: str) -> None:
    if backend == "INFERENCE_ENGINE":
        pytest.importorskip("openvino")
    net = read("classify")
    net.setPreferableBackend(getattr(dnn, f"DNN_BACKEND_{backend}"))
    compare(outputs(net, [list(shape)]), outputs(in_torch(read("classify")), [list(shape)]))


@pytest.mark.slow
def test_a_second_start_does_not_import_torch(files: list[str]) -> None:
    command = [sys.executable, "-c", WITHOUT_TORCH, *files]
    runs = [subprocess.run(command, capture_output=True, text=True, check=True).stdout for _ in range(2)]
    assert runs == ["True\n", "False\n"]


def test_everything_else_works_after_a_start_from_the_cache() -> None:
    shapes = NETS["classify"][0]
    expected = outputs(read("classify"), shapes)  # now the cache has the model
    net = read("classify")
    assert engine(net).is_stored
    compare(outputs(net, shapes), expected)
    assert "net" not in net._caffe.__dict__, "PyTorch's net was not needed"
    torch_net = in_torch(read("classify"))
    outputs(torch_net, shapes)
    np.testing.assert_array_equal(net.forward("conv2"), torch_net.forward("conv2"))
    np.testing.assert_array_equal(net.getParam("conv2"), torch_net.getParam("conv2"))
    for each in (net, torch_net):
        each.setParam("conv2", 0, each.getParam("conv2") * np.linspace(0, 2, 12).reshape(12, 1, 1, 1))
    changed = outputs(net, shapes)
    compare(changed, outputs(torch_net, shapes))
    assert any(abs(changed[name] - expected[name]).max() > 1e-3 for name in expected)


def test_shapes_that_only_the_engine_accepts_are_refused() -> None:
    """ONNX adds a blob to one of another size, as NumPy does; Caffe does not."""
    net = dnn.readNetFromCaffe(
        b'layer { name: "in" type: "Input" top: "a" top: "b" input_param { shape { dim: 1 dim: 4 dim: 6 dim: 6 } } }'
        b'layer { name: "sum" type: "Eltwise" bottom: "a" bottom: "b" top: "sum" }'
    )
    ones = np.ones((1, 4, 6, 6), np.float32)
    for given, fault in ((ones, False), (ones[:, :, :1, :1], True), (ones, False)):
        net.setInput(ones, "a")
        net.setInput(given, "b")
        if fault:
            with pytest.raises(dnn.DnnError) as caught:
                net.forward()
            assert caught.value.func == "forward"
        else:
            assert (net.forward() == 2).all()


def test_contents_of_files_are_stored_too(files: list[str]) -> None:
    contents = [Path(file).read_bytes() for file in files]
    expected = outputs(dnn.readNetFromCaffe(*contents), NETS["classify"][0])
    net = dnn.readNetFromCaffe(*contents)
    assert engine(net).is_stored
    compare(outputs(net, NETS["classify"][0]), expected)
    other = dnn.readNetFromCaffe(contents[0] + b"# another prototxt", contents[1])
    assert not engine(other).is_stored


def test_weights_that_lack_a_layer_are_reported_by_each_start(
    files: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    prototxt = Path(files[0])
    prototxt.write_text(prototxt.read_text().replace('name: "conv2"', 'name: "other"'))
    for _ in range(2):
        caplog.clear()
        net = dnn.readNetFromCaffe(*files)
        assert len(caplog.records) == 1
        assert not engine(net).is_stored
        net.setInput(np.ones((1, 3, 20, 20)))
        net.forward()
        assert engine(net)._model is None, "an export takes seconds"


def test_an_engine_that_is_not_installed_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    net = read("classify")
    monkeypatch.setattr(choice, "find_spec", lambda module: None)
    with pytest.raises(dnn.DnnError) as caught:
        net.setPreferableBackend(dnn.DNN_BACKEND_INFERENCE_ENGINE)
    assert isinstance(caught.value, SpecError)
    assert caught.value.func == "setPreferableBackend"


@pytest.mark.slow
@pytest.mark.skipif(not GPUS, reason="no GPU, and this torch cannot make a fake device")
@pytest.mark.parametrize("name", sorted(NETS))
def test_a_net_moves_to_a_gpu_and_back(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    shapes = NETS[name][0]
    expected = outputs(in_torch(read(name)), shapes)
    if GPUS[-1] == NAME:  # it does not see operations in inference mode
        monkeypatch.setattr(torch, "inference_mode", lambda mode=True: torch.set_grad_enabled(not mode))
    with gpu(GPUS[-1]) as device:
        for net in (read(name), in_torch(read(name))):  # not built yet, and built
            net._caffe.move(device)
            compare(outputs(net, shapes), expected)
            assert net._caffe.net.device.type == device
            layer = next(layer for layer in net.getLayerNames() if net.getLayer(layer).blobs)
            net.setParam(layer, 0, net.getParam(layer))
            compare(outputs(net, shapes), expected)
            net.setPreferableBackend(dnn.DNN_BACKEND_DEFAULT)
            compare(outputs(net, shapes), expected)


@pytest.mark.skipif("cuda" in GPUS, reason="there is a GPU")
def test_cuda_without_a_gpu_is_the_cpu_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    net, shapes = read("classify"), NETS["classify"][0]
    net.setPreferableBackend(dnn.DNN_BACKEND_CUDA)
    compare(outputs(net, shapes), outputs(in_torch(read("classify")), shapes))
    assert len(caplog.records) == 1


def test_ssds_layers_run_in_pytorch_with_a_warning_if_the_engine_was_chosen(caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("openvino")
    net, shapes = read("detect"), NETS["detect"][0]
    with caplog.at_level(logging.WARNING):
        expected = outputs(net, shapes)
        assert not caplog.records
        net.setPreferableBackend(dnn.DNN_BACKEND_INFERENCE_ENGINE)
        compare(outputs(net, shapes), expected)
    assert len(caplog.records) == 1

"""Small nets in which layers share weights, pad much, or have a loss over another axis compute the same exported."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

import netspec
from exported import ONNX_EXTRA, assert_same, here, in_onnxruntime, onnx_model, run_module, source_module, trained
from netspec.dialects import use_dialect
from netspec.export.formats.pt2 import torch_module
from netspec.net.net import Net

pytestmark = pytest.mark.slow


def given(name: str, *sizes: int) -> str:
    dims = " ".join(f"dim: {size}" for size in sizes)
    return f'layer {{ name: "{name}" type: "Input" top: "{name}" input_param {{ shape {{ {dims} }} }} }}\n'


def layer(kind: str, bottoms: str, tops: str, settings: str = "", shared: str = "") -> str:
    ends = " ".join([*(f'bottom: "{b}"' for b in bottoms.split()), *(f'top: "{t}"' for t in tops.split())])
    params = " ".join(f'param {{ name: "{name}" }}' for name in shared.split())
    return f'layer {{ name: "{kind}_{tops}" type: "{kind}" {ends} {params} {settings} }}\n'


def inner_product(bottom: str, top: str, settings: str) -> str:
    return layer("InnerProduct", bottom, top, f"inner_product_param {{ num_output: 4 {settings} }}", "w b")


SCORES = given("x", 2, 3, 3) + given("y", 2, 3)
NETS = {
    "shared": given("x", 2, 4) + inner_product("x", "a", "") + inner_product("a", "b", ""),
    "shared and transposed": given("x", 2, 4)
    + inner_product("x", "a", "")
    + inner_product("a", "b", "transpose: true"),
    "shared crosswise": given("x", 2, 4, 3, 3)
    + layer("Scale", "x", "a", "scale_param { bias_term: true }", "p q")
    + layer("Scale", "a", "b", "scale_param { bias_term: true }", "q p"),
    "mask of much padding": given("x", 1, 2, 6, 7)
    + layer("Pooling", "x", "top mask", "pooling_param { kernel_h: 5 kernel_w: 3 pad_h: 3 pad_w: 1 stride: 2 }"),
    "loss over axis 2": SCORES + layer("SoftmaxWithLoss", "x y", "loss p", "softmax_param { axis: 2 }"),
    "loss over axis 2 by items": SCORES
    + layer("SoftmaxWithLoss", "x y", "loss", "softmax_param { axis: -1 } loss_param { normalization: BATCH_SIZE }"),
    "loss that ignores a label": SCORES
    + layer("SoftmaxWithLoss", "x y", "loss", "softmax_param { axis: 2 } loss_param { ignore_label: 1 }"),
    "loss over axis 0": given("x", 3, 3)
    + given("y", 3)
    + layer("SoftmaxWithLoss", "x y", "loss", "softmax_param { axis: 0 }"),
    "accuracy over axis 0": given("x", 3, 2, 3)
    + given("y", 2, 3)
    + layer("Accuracy", "x y", "accuracy", "accuracy_param { axis: 0 }"),
    "accuracy over axis 2": SCORES + layer("Accuracy", "x y", "accuracy", "accuracy_param { axis: 2 top_k: 2 }"),
    "zoom and shrink": given("x", 1, 1, 4, 4)
    + layer("Interp", "x", "up", "interp_param { zoom_factor: 3 shrink_factor: 2 }"),
    "loss without a top": SCORES + layer("SoftmaxWithLoss", "x y", "") + layer("Accuracy", "x y", "accuracy"),
}


@pytest.mark.parametrize("name", NETS)
def test_every_target_computes_the_same(name: str, net_of: Callable[..., Net]) -> None:
    use_dialect("blocks")
    net = trained(net_of(NETS[name]))
    rng = np.random.default_rng(2)
    inputs = {blob: rng.standard_normal(net.shapes[blob]).astype(np.float32) for blob in net.inputs}
    if "y" in inputs:
        inputs["y"] = rng.integers(0, 3, net.shapes["y"]).astype(np.float32)
    expected = here(net, inputs)
    for module in (source_module(net), torch_module(net)):
        assert_same(run_module(module, net, inputs), expected)
    pytest.importorskip("onnx", reason=ONNX_EXTRA)
    assert_same(in_onnxruntime(onnx_model(net)[0], inputs), expected)


def test_dropout_of_a_net_in_phase_train_drops_and_scales(net_of: Callable[..., Net]) -> None:
    net = net_of(given("x", 4, 200) + layer("Dropout", "x", "y", "dropout_param { dropout_ratio: 0.2 }"), phase="TRAIN")
    dropped = source_module(net).train()(torch.ones(4, 200))
    assert set(dropped.unique().tolist()) == {0.0, 1.25}
    assert 0.1 < float((dropped == 0).float().mean()) < 0.3
    assert torch.equal(source_module(net)(torch.ones(4, 200)), torch.ones(4, 200))


@pytest.mark.parametrize("engine", ["onnxruntime", "openvino"])
@pytest.mark.parametrize("loss", ["SoftmaxWithLoss", "HingeLoss", "MultinomialLogisticLoss"])
def test_a_loss_without_a_top_counts_with_every_engine(engine: str, loss: str, tmp_path: object) -> None:
    pytest.importorskip(engine)
    path = f"{tmp_path}/net.prototxt"
    with open(path, "w") as file:
        file.write(given("x", 2, 3) + given("y", 2) + layer(loss, "x y", "") + layer("Accuracy", "x y", "accuracy"))
    values = {"x": torch.tensor([[0.5, 0.2, 0.3], [0.6, 0.1, 0.3]]), "y": torch.tensor([0.0, 1])}
    with torch.no_grad():
        expected, _ = netspec.load_net(path).forward_loss(**values)
        found, outputs = netspec.load_net(path, engine=engine, cache=False).forward_loss(**values)
    assert expected is not None
    assert found is not None
    assert float(expected) > 0
    assert float(found) == pytest.approx(float(expected), rel=1e-6)
    assert sorted(outputs) == ["accuracy"]

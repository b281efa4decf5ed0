"""Losses of nets that an engine runs."""

from pathlib import Path

import pytest
import torch

import netspec

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("engine", ["onnxruntime", "openvino"])
@pytest.mark.parametrize("loss", ["SoftmaxWithLoss", "HingeLoss", "MultinomialLogisticLoss"])
def test_a_loss_without_a_top_counts_with_every_engine(engine: str, loss: str, tmp_path: Path) -> None:
    pytest.importorskip(engine)
    path = tmp_path / "net.prototxt"
    path.write_text(f"""
        layer {{ name: "x" type: "Input" top: "x" input_param {{ shape {{ dim: 2 dim: 3 }} }} }}
        layer {{ name: "y" type: "Input" top: "y" input_param {{ shape {{ dim: 2 }} }} }}
        layer {{ name: "loss" type: "{loss}" bottom: "x" bottom: "y" }}
        layer {{ name: "accuracy" type: "Accuracy" bottom: "x" bottom: "y" top: "accuracy" }}
    """)
    values = {"x": torch.tensor([[0.5, 0.2, 0.3], [0.6, 0.1, 0.3]]), "y": torch.tensor([0.0, 1])}
    with torch.no_grad():
        expected, _ = netspec.load_net(path).forward_loss(**values)
        found, outputs = netspec.load_net(path, engine=engine, cache=False).forward_loss(**values)
    assert expected is not None
    assert found is not None
    assert float(expected) > 0
    assert float(found) == pytest.approx(float(expected), rel=1e-6)
    assert sorted(outputs) == ["accuracy"]

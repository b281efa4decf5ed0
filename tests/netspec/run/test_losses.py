"""A loss whose top another layer reads trains as in Caffe, where the reader overwrites the loss weight."""

from collections.abc import Callable
from pathlib import Path

import pytest

import netspec.pycaffe as caffe
from netspec.load import load_solver

NET = """
layer { name: "x" type: "DummyData" top: "x" top: "t" dummy_data_param { shape { dim: 2 dim: 3 }
  shape { dim: 2 dim: 1 } data_filler { value: 1 } data_filler { value: 0 } } }
layer { name: "w" type: "InnerProduct" bottom: "x" top: "y" inner_product_param {
  num_output: 1 bias_term: false weight_filler { value: 0.5 } } }
layer { name: "l" type: "EuclideanLoss" bottom: "y" bottom: "t" top: "l" %s }
"""
POWER = 'layer { name: "%s" type: "Power" bottom: "l" top: "%s" %s power_param { scale: %d } }'
SOLVER = 'net: "net.prototxt" base_lr: 0.1 lr_policy: "fixed" solver_mode: CPU snapshot_after_train: false'
IGNORED = POWER % ("p", "p", "", 2)


def _by_autograd(steps: int) -> float:
    solver = load_solver("solver.prototxt")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("netspec.fast.training.LARGEST", 0)
        assert solver.net.trainer() is None
    solver.step(steps)
    return solver.net.params["w"][0][0, 0].item()


def _by_kernels(steps: int) -> float:
    solver = load_solver("solver.prototxt")
    assert solver.net.trainer() is not None
    solver.step(steps)
    return solver.net.params["w"][0][0, 0].item()


def _by_pycaffe(steps: int) -> float:
    solver = caffe.get_solver("solver.prototxt")
    solver.step(steps)
    return float(solver.net.params["w"][0].data[0, 0])


@pytest.mark.parametrize("run", [_by_autograd, _by_kernels, _by_pycaffe], ids=["autograd", "kernels", "pycaffe"])
@pytest.mark.parametrize(
    ("weight", "readers", "first", "second"),
    [
        ("loss_weight: 1", IGNORED, 0.35, 0.245),
        ("loss_weight: 0.5", POWER % ("p", "p", "loss_weight: 1", 2), 0.125, 0.03125),
        ("", IGNORED, 0.5, 0.5),
        ("", 'layer { name: "p" type: "Silence" bottom: "l" }', 0.5, 0.5),
        ("", POWER % ("p", "p", "loss_weight: 1", 2), 0.2, 0.08),
        ("", IGNORED + POWER % ("q", "q", "loss_weight: 1", 3), 0.05, 0.005),
        ("", "", 0.35, 0.245),
    ],
    ids=["explicit", "half", "default", "silenced", "read_by_a_loss", "read_twice", "not_read"],
)
def test_a_loss_that_is_read_trains_as_in_caffe(
    run: Callable[[int], float],
    weight: str,
    readers: str,
    first: float,
    second: float,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The weights after one and two iterations are Caffe's own."""
    monkeypatch.chdir(tmp_path)
    Path("net.prototxt").write_text(NET % weight + readers)
    Path("solver.prototxt").write_text(SOLVER)
    assert [run(1), run(2)] == pytest.approx([first, second], rel=1e-5)

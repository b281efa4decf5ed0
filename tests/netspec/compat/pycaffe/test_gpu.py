"""pycaffe on a fake GPU, which reveals tensors on the wrong device and missing copies."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch

import netspec.pycaffe as caffe
from fake_gpu import NAME, POSSIBLE, fake_gpu
from golden_cases import LayerCase
from netspec.compat.pycaffe import mode
from paths import GOLDEN
from pycaffe_cases import compute
from pycaffe_nets import SMALL

pytestmark = pytest.mark.skipif(not POSSIBLE, reason="this torch cannot make a fake device")
LAYERS = sorted((GOLDEN / "layers").iterdir())


@pytest.fixture(autouse=True)
def _gpu(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setattr(mode, "device", lambda: torch.device(NAME))
    with fake_gpu():
        yield


@pytest.mark.slow
@pytest.mark.parametrize("folder", LAYERS, ids=lambda folder: folder.name)
def test_blobs_equal_caffes(folder: Path) -> None:
    case = LayerCase(folder)
    for key, value in compute(case).items():
        expected = case.golden[key]
        np.testing.assert_allclose(value, expected, rtol=0, atol=1e-5 * max(np.abs(expected).max(initial=0), 1e-30))


@pytest.mark.slow
def test_a_training_as_scripts_have_it(work_in: Callable[..., Path]) -> None:
    work_in("train/sgd_step")
    solver = caffe.get_solver("sgd_step/solver.prototxt")
    solver.net.copy_from("sgd_step/init.caffemodel")
    golden = np.load("sgd_step/trajectory.npz")["loss"]
    found = []
    for _ in range(6):
        solver.step(1)
        found.append(float(solver.net.blobs["loss"].data))
    np.testing.assert_allclose(found, golden[:6], rtol=1e-3)


def test_values_written_by_scripts_reach_the_gpu(net_of: Callable[..., caffe.Net]) -> None:
    net = net_of(SMALL, caffe.TRAIN)
    net.blobs["label"].data[...] = 3
    net.params["scores"][1].data[3] = 100
    assert net.forward()["cost"] == 0
    assert (net.blobs["label"].data == 3).all()
    net.params["scores"][1].data[3] = -100
    assert net.forward()["cost"] > 50
    net.backward()
    diff = net.params["scores"][1].diff
    assert diff[3] == pytest.approx(-1)
    net.clear_param_diffs()
    assert not net.params["scores"][1].diff.any()
    net.save("gpu.caffemodel")
    net.params["scores"][1].data[3] = 0
    net.copy_from("gpu.caffemodel")
    assert net.params["scores"][1].data[3] == -100

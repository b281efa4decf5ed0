"""Trained models, where they are at hand: what OpenCV or Caffe made of them."""

from pathlib import Path

import numpy as np
import pytest

from netspec import dnn
from paths import shared

OPENCV = ["ultraface_slim320", "wechat_detect", "wechat_sr"]
CAFFE = ["mtcnn_kp_det1", "mtcnn_kp_det2", "mtcnn_kp_det3"]


def read(folder: Path) -> dnn.Net:
    (prototxt,), (weights,) = folder.glob("*.prototxt"), folder.glob("*.caffemodel")
    return dnn.readNet(str(weights), str(prototxt))


@pytest.mark.slow
@pytest.mark.parametrize("name", OPENCV)
def test_outputs_equal_opencvs(name: str) -> None:
    folder = shared("golden", "models", name)
    net, expected = read(folder), np.load(folder / "opencv.npz")
    (given,) = (key for key in expected.files if key.startswith("0/in/"))
    net.setInput(expected[given])
    ends = net.getUnconnectedOutLayersNames()
    assert {f"0/out/{end}" for end in ends} == {key for key in expected.files if "/out/" in key}
    for end, output in zip(ends, net.forward(list(ends)), strict=True):
        np.testing.assert_allclose(output, expected[f"0/out/{end}"], rtol=0, atol=2e-5)


@pytest.mark.parametrize("name", CAFFE)
def test_outputs_equal_caffes_at_both_sizes(name: str) -> None:
    folder = shared("golden", "models", name)
    net, expected = read(folder), np.load(folder / "caffe.npz")
    for k in (0, 1):
        net.setInput(expected[f"{k}/in/data"])
        ends = [key.removeprefix(f"{k}/out/") for key in expected.files if key.startswith(f"{k}/out/")]
        for end, output in zip(ends, net.forward(ends), strict=True):
            np.testing.assert_allclose(output, expected[f"{k}/out/{end}"], rtol=0, atol=1e-5)

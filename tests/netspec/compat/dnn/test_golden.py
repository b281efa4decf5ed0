"""The same program with OpenCV 4.12 (tests/golden/dnn/opencv.npz) and here; trained models where they are at hand."""

import json
from pathlib import Path

import numpy as np
import pytest

import dnn_program
from netspec import dnn
from paths import shared

pytestmark = pytest.mark.slow

OPENCV = dict(np.load(dnn_program.HERE / "opencv.npz"))


@pytest.fixture(scope="module")
def ours() -> dict[str, np.ndarray]:
    return dnn_program.record(dnn)


def test_the_same_properties_are_found(ours: dict[str, np.ndarray]) -> None:
    assert sorted(ours) == sorted(OPENCV)


@pytest.mark.parametrize("key", sorted(OPENCV))
def test_equals_opencv(ours: dict[str, np.ndarray], key: str) -> None:
    found, expected = ours[key], OPENCV[key]
    assert found.shape == expected.shape
    if expected.dtype.kind == "f":
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 * max(1.0, float(abs(expected).max())))
    elif expected.dtype.kind == "U" and expected.ndim == 0:
        assert json.loads(str(found)) == json.loads(str(expected))
    else:
        np.testing.assert_array_equal(found, expected)


TRAINED = ["ultraface_slim320", "wechat_detect", "wechat_sr"]
CAFFE = ["mtcnn_kp_det1", "mtcnn_kp_det2", "mtcnn_kp_det3"]


def read(folder: Path) -> dnn.Net:
    (prototxt,), (weights,) = folder.glob("*.prototxt"), folder.glob("*.caffemodel")
    return dnn.readNet(str(weights), str(prototxt))


@pytest.mark.slow
@pytest.mark.parametrize("name", TRAINED)
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

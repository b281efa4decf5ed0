"""The way back: OpenCV 4's own reader of Caffe's files runs what is saved and what is folded here, to the same numbers.

``tests/golden/export/opencv4`` has such files and what OpenCV 4.12 made of them. NETSPEC_OPENCV4 names a Python that
has OpenCV 4, to run it afresh; with it set, this file, run as a program, writes the golden files anew.
"""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

import netspec
from exported import assert_same, here, random_inputs, trained
from netspec.export.formats.deploy import fold, write_caffe
from netspec.graph.options import BuildOptions
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.net.weights import save_weights
from netspec.proto.schema import TEST
from netspec.proto.text import parse_net_text
from paths import GOLDEN

FOLDER = GOLDEN / "export" / "opencv4"
PYTHON = os.environ.get("NETSPEC_OPENCV4", "")

TEXT = """name: "Residual"
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 3 dim: 12 dim: 12 } } }
layer { name: "conv1" type: "Convolution" bottom: "data" top: "conv1"
  convolution_param { num_output: 4 kernel_size: 3 pad: 1 stride: 2 bias_term: false } }
layer { name: "bn1" type: "BatchNorm" bottom: "conv1" top: "conv1" }
layer { name: "scale1" type: "Scale" bottom: "conv1" top: "conv1" scale_param { bias_term: true } }
layer { name: "relu1" type: "ReLU" bottom: "conv1" top: "conv1" }
layer { name: "conv2" type: "Convolution" bottom: "conv1" top: "conv2"
  convolution_param { num_output: 4 kernel_size: 3 pad: 2 dilation: 2 group: 2 } }
layer { name: "bn2" type: "BatchNorm" bottom: "conv2" top: "bn2" batch_norm_param { eps: 0.001 } }
layer { name: "scale2" type: "Scale" bottom: "bn2" top: "scale2" scale_param { bias_term: true } }
layer { name: "sum" type: "Eltwise" bottom: "conv1" bottom: "scale2" top: "sum" }
layer { name: "bn3" type: "BatchNorm" bottom: "sum" top: "bn3" }
layer { name: "scale3" type: "Scale" bottom: "bn3" top: "bn3" scale_param { bias_term: true } }
layer { name: "prelu" type: "PReLU" bottom: "bn3" top: "bn3" }
layer { name: "pool" type: "Pooling" bottom: "bn3" top: "pool" pooling_param { pool: MAX kernel_size: 3 stride: 2 } }
layer { name: "deconv" type: "Deconvolution" bottom: "pool" top: "deconv"
  convolution_param { num_output: 6 group: 2 kernel_size: 2 stride: 2 } }
layer { name: "bn4" type: "BatchNorm" bottom: "deconv" top: "bn4" }
layer { name: "drop" type: "Dropout" bottom: "bn4" top: "drop" }
layer { name: "ip" type: "InnerProduct" bottom: "drop" top: "ip" inner_product_param { num_output: 5 } }
layer { name: "prob" type: "Softmax" bottom: "ip" top: "prob" }
"""

READ = """
import sys, cv2, numpy as np
prototxt, weights, data, out = sys.argv[1:]
net = cv2.dnn.readNetFromCaffe(prototxt, weights)
net.enableFusion("folded" in prototxt)  # its own folding gets grouped deconvolutions wrong
net.setInput(np.load(data))
np.save(out, net.forward())
"""


def residual_net() -> Net:
    message, source = parse_net_text(TEXT, "residual.prototxt")
    message.state.phase = TEST
    return trained(build_net(message, source, BuildOptions(seed=0)))


def write_files(folder: Path) -> Net:
    """Write the net as it was built, and folded; return it."""
    net = residual_net()
    (folder / "built.prototxt").write_text(TEXT)
    save_weights(net, folder / "built.caffemodel")
    write_caffe(fold(net), folder / "folded")
    return net


def in_opencv_4(folder: Path, name: str, data: np.ndarray) -> np.ndarray:
    np.save(folder / "data.npy", data)
    files = [str(folder / f"{name}.{end}") for end in ("prototxt", "caffemodel")]
    subprocess.run([PYTHON, "-c", READ, *files, str(folder / "data.npy"), str(folder / "out.npy")], check=True)
    return np.load(folder / "out.npy")


@pytest.mark.parametrize("name", ["built", "folded"])
def test_opencv_4_computed_the_same_from_these_files(name: str) -> None:
    golden = np.load(FOLDER / "opencv.npz")
    net = netspec.load_net(FOLDER / f"{name}.prototxt", weights=FOLDER / f"{name}.caffemodel")
    assert len(net.layers) == {"built": 19, "folded": 12}[name]
    assert_same(here(net, {"data": golden["data"]}), {"prob": golden[name]})


def test_the_files_are_written_as_they_were(tmp_path: Path) -> None:
    write_files(tmp_path)
    for name in ("built", "folded"):
        assert (tmp_path / f"{name}.prototxt").read_text() == (FOLDER / f"{name}.prototxt").read_text()
        found = netspec.load_net(tmp_path / f"{name}.prototxt", weights=tmp_path / f"{name}.caffemodel")
        expected = netspec.load_net(tmp_path / f"{name}.prototxt", weights=FOLDER / f"{name}.caffemodel")
        for layer, blobs in expected.params.items():
            for j, blob in enumerate(blobs):
                np.testing.assert_allclose(found.params[layer][j].detach(), blob.detach(), rtol=1e-6)


@pytest.mark.skipif(not PYTHON, reason="NETSPEC_OPENCV4 names no Python that has OpenCV 4")
@pytest.mark.parametrize("name", ["built", "folded"])
def test_opencv_4_computes_the_same(name: str, tmp_path: Path) -> None:
    net = write_files(tmp_path)
    inputs = random_inputs(net)
    assert_same({"prob": in_opencv_4(tmp_path, name, inputs["data"])}, here(net, inputs))


def write_golden() -> None:
    """Write the golden files."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    data = random_inputs(write_files(FOLDER))["data"]
    outputs = {name: in_opencv_4(FOLDER, name, data) for name in ("built", "folded")}
    np.savez(FOLDER / "opencv.npz", data=data, built=outputs["built"], folded=outputs["folded"])
    for name in ("data.npy", "out.npy"):
        (FOLDER / name).unlink()


if __name__ == "__main__":
    write_golden()

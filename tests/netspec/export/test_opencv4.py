"""Prototxt and weights written here, folded or not, give the same results in OpenCV 4's reader of Caffe's files.

``tests/golden/export/opencv4`` has such files and the results of OpenCV 4.12. If NETSPEC_OPENCV4 is the path of a
Python that has OpenCV 4, the tests run it too, and this file, run as a program, writes the golden files again.
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

TEXT = (Path(__file__).parent / "nets" / "opencv4.prototxt").read_text()
READ = (Path(__file__).parent / "programs" / "read.py").read_text()


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
def test_results_equal_those_of_opencv_4_for_the_golden_files(name: str) -> None:
    golden = np.load(FOLDER / "opencv.npz")
    net = netspec.load_net(FOLDER / f"{name}.prototxt", weights=FOLDER / f"{name}.caffemodel")
    assert len(net.layers) == {"built": 19, "folded": 12}[name]
    assert_same(here(net, {"data": golden["data"]}), {"prob": golden[name]})


def test_written_files_equal_the_golden_files(tmp_path: Path) -> None:
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
def test_opencv_4_computes_the_same_from_written_files(name: str, tmp_path: Path) -> None:
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

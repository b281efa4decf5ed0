"""Every way in which public scripts use what is around nets: each a few lines of code that must run.

The names are those of a count over 493 public scripts; what they do with nets and solvers is in test_usage.py. Not here
is what single forks have in modules of their own (caffe.tools, caffe.mpi_init and the like). The lines run as in
`netspec run`: `import caffe` finds netspec.
"""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import netspec.pycaffe as pycaffe
from case_files import read_cases
from each import each
from netspec.dialects import use_dialect
from netspec.scripts import finder

pytestmark = pytest.mark.slow

NET = """
layer { name: "data" type: "Input" top: "data" input_param { shape { dim: 2 dim: 3 dim: 8 dim: 6 } } }
layer { name: "pool" type: "Pooling" bottom: "data" top: "prob" pooling_param { pool: AVE global_pooling: true } }
"""
BEFORE = """
import numpy as np
import caffe
from caffe import layers as L, params as P
from caffe.proto import caffe_pb2
net = caffe.Net('deploy.prototxt', caffe.TEST)
transformer = caffe.io.Transformer({'data': net.blobs['data'].data.shape})
image = np.random.rand(8, 6, 3)
"""
USES = read_cases("netspec/pycaffe/cases/usage_around_nets.txt")


@pytest.fixture(autouse=True)
def as_in_netspec_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Let ``import caffe`` find netspec, in a folder with a net, its weights and an image."""
    cv2 = pytest.importorskip("cv2")
    monkeypatch.chdir(tmp_path)
    Path("deploy.prototxt").write_text(NET)
    pycaffe.Net("deploy.prototxt", pycaffe.TEST).save("net.caffemodel")
    cv2.imwrite("image.png", np.zeros((8, 6, 3), np.uint8))
    use_dialect("ssd")
    use_dialect("blocks")
    finder.install()
    yield
    finder.uninstall()
    for name in [name for name in sys.modules if name == "caffe" or name.startswith("caffe.")]:
        del sys.modules[name]


@each("use", USES)
def test_what_scripts_do(use: str) -> None:
    if "draw" in use:
        pytest.importorskip("pydot")
    if any(word in USES[use]["code"] for word in ("load_image", "resize", "Classifier")):
        pytest.importorskip("skimage")
    exec(BEFORE + USES[use]["code"], {})

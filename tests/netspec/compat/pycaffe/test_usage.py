"""Every way in which public scripts use pycaffe: each a few lines of code that must run.

The names in usage.txt are those of a count over 493 public scripts. Not there is what single forks have in modules of
their own (caffe.tools, caffe.mpi_init and the like).
"""

import re
import sys
from collections.abc import Callable, Iterator

import numpy as np
import pytest

import netspec.pycaffe as caffe
from case_files import read_cases
from netspec.compat.scripts import finder
from netspec.dialects import use_dialect

pytestmark = pytest.mark.slow

CASES = read_cases("netspec/compat/pycaffe/usage.txt")
USES, AROUND = (
    dict(re.findall(r"^# (.*)\n((?:(?!# ).*\n)*)", CASES[part]["uses"] + "\n", re.M))
    for part in ("nets and solvers", "around nets")
)


@pytest.mark.parametrize("use", USES)
def test_what_scripts_do_with_nets_and_solvers(use: str, write: Callable[..., str]) -> None:
    for name in ("deploy", "memory", "train", "solver"):
        write(CASES[f"{name}.prototxt"]["text"], f"{name}.prototxt")
    net = caffe.Net("deploy.prototxt", caffe.TEST)
    net.save("usage.caffemodel")
    random = np.random.default_rng(0)
    names = {
        "caffe": caffe,
        "np": np,
        "net": net,
        "solver": caffe.SGDSolver("solver.prototxt"),
        "image": random.random((2, 3, 12, 12), np.float32),
        "images": random.random((5, 3, 12, 12), np.float32),
        "ones": np.ones((2, 5), np.float32),
    }
    exec(USES[use], names)


@pytest.fixture
def as_in_netspec_run(write: Callable[..., str]) -> Iterator[None]:
    """Let ``import caffe`` find netspec, in a folder with a net, its weights and an image."""
    cv2 = pytest.importorskip("cv2")
    write(CASES["pool.prototxt"]["text"], "deploy.prototxt")
    caffe.Net("deploy.prototxt", caffe.TEST).save("net.caffemodel")
    cv2.imwrite("image.png", np.zeros((8, 6, 3), np.uint8))
    use_dialect("ssd")
    use_dialect("blocks")
    finder.install()
    yield
    finder.uninstall()
    for name in [name for name in sys.modules if name == "caffe" or name.startswith("caffe.")]:
        del sys.modules[name]


@pytest.mark.parametrize("use", AROUND)
def test_what_scripts_do_around_nets(use: str, as_in_netspec_run: None) -> None:
    if "draw" in use:
        pytest.importorskip("pydot")
    if any(word in AROUND[use] for word in ("load_image", "resize", "Classifier")):
        pytest.importorskip("skimage")
    exec(f"{CASES['around nets']['before']}\n{AROUND[use]}", {})

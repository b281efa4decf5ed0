"""What BVLC Caffe computed, computed again through caffe.Net and the solvers: their passes are not netspec's own."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import netspec.pycaffe as caffe
from golden_cases import LayerCase, promised
from netspec.proto.schema import PHASES
from netspec.pycaffe import mode
from paths import GOLDEN

LAYERS = sorted((GOLDEN / "layers").iterdir())
TRAININGS = sorted(folder.name for folder in (GOLDEN / "train").iterdir())
TOLERANCE = 1e-5  # of the largest element


@pytest.fixture
def exact() -> Iterator[Callable[[str], None]]:
    before = mode.exact()
    yield mode.set_exact
    mode.set_exact(before)


def compute(case: LayerCase) -> dict[str, np.ndarray]:
    """Return what a script would find in the blobs, under Caffe's keys."""
    golden, meta = case.golden, case.meta
    net = caffe.Net(str(case.folder / "net.prototxt"), PHASES[meta["phase"]])
    for key, array in golden.items():
        kind, _, name = key.partition("/")
        if kind == "param_init":
            layer, _, index = name.rpartition("/")
            net.params[layer][int(index)].data[...] = array
        elif kind == "in":
            net.blobs[name].data[...] = array
    for _ in range(meta["warmup"] + 1):
        outputs = net.forward()
    if meta["grad"]:
        for key, array in golden.items():
            if key.startswith("topdiff/"):
                net.blobs[key.partition("/")[2]].diff[...] = array
        net.backward()
    found = {f"out/{name}": array for name, array in outputs.items()}
    for key in golden:
        kind, _, name = key.partition("/")
        if kind == "indiff":
            found[key] = net.blobs[name].diff
        elif kind in ("paramdiff", "param_after"):
            layer, _, index = name.rpartition("/")
            blob = net.params[layer][int(index)]
            found[key] = blob.diff if kind == "paramdiff" else blob.data
    return found


@pytest.mark.parametrize("folder", LAYERS, ids=lambda path: path.name)
def test_blobs_hold_what_caffes_held(folder: Path) -> None:
    case = LayerCase(folder)
    found = compute(case)
    assert set(found) == {key for key in case.golden if key.split("/")[0] not in ("in", "param_init", "topdiff")}
    for key, value in found.items():
        expected = case.golden[key]
        assert value.shape == expected.shape, key
        scale = max(float(np.abs(expected).max(initial=0)), 1e-30)
        worst = float(np.abs(value.astype(np.float64) - expected).max(initial=0)) / scale
        assert worst <= TOLERANCE, f"{key}: off by {worst:.2e} of the largest element"


@pytest.mark.parametrize("folder", LAYERS, ids=lambda path: path.name)
def test_blobs_hold_caffes_bits(folder: Path, exact: Callable[[str], None], same_blas: bool) -> None:
    if not same_blas:
        pytest.skip("another kind of CPU than Caffe's: its BLAS rounds differently")
    if "all" not in promised(folder):
        pytest.skip("not even netspec's own passes promise it")
    exact("all")
    case = LayerCase(folder)
    for key, value in compute(case).items():
        np.testing.assert_array_equal(value, case.golden[key], key)


@pytest.mark.parametrize("case", TRAININGS)
def test_solvers_follow_caffe(
    case: str, work_in: Callable[..., Path], exact: Callable[[str], None], same_blas: bool
) -> None:
    """A loop of step(1), as scripts have it: losses, final weights and test losses."""
    if not same_blas and case in ("adadelta", "rmsprop"):
        pytest.skip("decided by ties in max poolings, which fall as the CPU's kernels round")
    work_in(f"train/{case}")
    exact("all")
    golden = np.load(f"{case}/trajectory.npz")
    solver = caffe.get_solver(f"{case}/solver.prototxt")
    solver.net.copy_from(f"{case}/init.caffemodel")
    found = []
    for _ in golden["loss"]:
        solver.step(1)
        found.append(float(solver.net.blobs["loss"].data))
    solver.test_nets[0].share_with(solver.net)
    tested = [float(solver.test_nets[0].forward()["loss"]) for _ in golden["test/loss"]]
    assert solver.iter == len(golden["loss"])
    if solver.param.iter_size == 1:  # else the file has the mean of several passes
        np.testing.assert_allclose(found, golden["loss"], rtol=0 if same_blas else 1e-2)
    np.testing.assert_allclose(tested, golden["test/loss"], rtol=0 if same_blas else 1e-2)
    if same_blas:
        for key in golden:
            if key.startswith("final/"):
                _, layer, index = key.split("/")
                np.testing.assert_array_equal(solver.net.params[layer][int(index)].data, golden[key], key)

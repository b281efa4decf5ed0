"""Results of BVLC Caffe, repeated with caffe.Net and its solvers, because their passes differ from netspec's own."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

import netspec.pycaffe as caffe
from golden_cases import (
    EVERY,
    SAMPLED,
    STEPS,
    LayerCase,
    assert_arrays,
    assert_same_layers,
    assert_training,
    lay_out_examples,
    promised,
    set_parameters,
)
from netspec.compat.pycaffe import mode
from netspec.compat.pycaffe.solver import Solver
from netspec.exact import CHOICES
from paths import GOLDEN
from pycaffe_cases import compute

pytestmark = pytest.mark.slow

LAYERS = sorted((GOLDEN / "layers").iterdir())
# The rules of the other solvers are netspec's own; tests/netspec/solver/test_golden.py has all.
TRAININGS = ("adam", "residual_bn_private", "residual_bn_shared", "sgd_clip", "sgd_iter_size")
EXAMPLES = sorted(folder.name for folder in (GOLDEN / "examples" / "runs").iterdir())
TOLERANCE = 1e-5  # of the largest element


@pytest.fixture
def exact() -> Iterator[Callable[[str], None]]:
    before = mode.exact()
    yield caffe.set_exact
    mode.set_exact(before)


@pytest.mark.parametrize("folder", LAYERS, ids=lambda folder: folder.name)
def test_blobs_equal_caffes(folder: Path) -> None:
    case = LayerCase(folder)
    found = compute(case)
    assert set(found) == {key for key in case.golden if key.split("/")[0] not in ("in", "param_init", "topdiff")}
    assert {value.dtype for value in found.values()} == {np.dtype(np.float32)}
    assert_arrays(found, case.golden, TOLERANCE)


@pytest.mark.parametrize(
    "folder", [folder for folder in LAYERS if "all" in promised(folder)], ids=lambda folder: folder.name
)
def test_blobs_are_bit_identical_to_caffes(folder: Path, exact: Callable[[str], None], caffes_bits: bool) -> None:
    exact("all")
    case = LayerCase(folder)
    assert_arrays(compute(case), case.golden, 0 if caffes_bits else TOLERANCE)


@pytest.mark.parametrize("case", TRAININGS)
def test_solvers_follow_caffe(
    case: str, work_in: Callable[..., Path], exact: Callable[[str], None], caffes_bits: bool
) -> None:
    """A loop of step(1), as scripts have it: losses, final weights and test losses."""
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
    results = {"test/loss": tested, **{key: sampled(solver, key, "data") for key in golden if key.startswith("final/")}}
    if solver.param.iter_size == 1:  # else the file has the mean of several passes
        results["loss"] = found
    assert_training(results, golden, caffes_bits, 1e-2)


@pytest.mark.parametrize("case", STEPS)
@pytest.mark.parametrize("choice", CHOICES)
def test_each_step_equals_caffes(
    case: str,
    choice: str,
    work_in: Callable[..., Path],
    exact: Callable[[str], None],
    caffes_bits: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Outputs and weights after each of three iterations to 1e-3; ``all`` to the last bit on a CPU as Caffe's."""
    monkeypatch.chdir(work_in(f"steps/{case}"))
    exact(choice)
    golden = np.load("caffe.npz")
    solver = caffe.get_solver("solver.prototxt")
    solver.net.copy_from("init.caffemodel")
    found = {}
    for i in range(3):
        solver.step(1)
        found |= {f"{i} output {name}": solver.net.blobs[name].data.copy() for name in solver.net.outputs}
        for layer, blobs in solver.net.params.items():
            found |= {f"{i} weight {layer}[{j}]": blob.data.copy() for j, blob in enumerate(blobs)}
    assert found.keys() == set(golden.files)
    assert_arrays(found, golden, 0 if caffes_bits and choice == "all" else 1e-3)


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return lay_out_examples(tmp_path_factory.mktemp("examples"))


@pytest.mark.slow
@pytest.mark.parametrize("run", EXAMPLES)
def test_caffes_examples(
    run: str, folder: Path, exact: Callable[[str], None], caffes_bits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """LeNet, the autoencoder and the Siamese net: what is first subtracted from the weights, and ten outputs.

    tests/netspec/solver/test_examples.py trains them to the end.
    """
    monkeypatch.chdir(folder)
    exact("all")
    meta = json.loads(Path(f"examples/runs/{run}/meta.json").read_text())
    golden = np.load(f"examples/runs/{run}/trajectory.npz")
    solver = caffe.get_solver(f"examples/runs/{run}/solver.prototxt")
    solver.param.test_initialization = False
    for name in meta["init"]:
        set_parameters(solver.net.runner.net, np.load(f"examples/init/{name}.npz"))
    solver.step(1)
    updates = {key: sampled(solver, key, "diff") for key in golden.files if key.startswith("update/")}
    assert_same_layers(updates, golden, 1e-4)
    outputs = [{name: float(solver.net.blobs[name].data) for name in solver.net.outputs}]
    for _ in range(9):
        solver.step(1)
        outputs.append({name: float(solver.net.blobs[name].data) for name in solver.net.outputs})
    expected = {key: golden[key][:10] for key in golden.files if key.startswith("out/")}
    found = {key: np.array([out[key[4:]] for out in outputs]) for key in expected}
    assert_training(found, expected, caffes_bits, 0.05)


def sampled(solver: Solver, key: str, what: str) -> np.ndarray:
    """Return ``data`` or ``diff`` of the parameter KIND/LAYER/INDEX, sampled as the examples' files are."""
    _, layer, index = key.split("/")
    values = getattr(solver.net.params[layer][int(index)], what)
    return values if values.size < SAMPLED else values.reshape(-1)[::EVERY]

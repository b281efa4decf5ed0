"""Caffe's own examples, trained with ``exact: all``: LeNet, the MNIST autoencoder and the Siamese MNIST net."""

import json
from pathlib import Path

import numpy as np
import pytest

from golden_cases import assert_same_layers, lay_out_examples, parameters, set_parameters, train
from netspec.net.net import Net
from netspec.solver.solver import Solver, load_solver
from paths import GOLDEN

RUNS = sorted(folder.name for folder in (GOLDEN / "examples" / "runs").iterdir())


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``examples/``, as the paths in its prototxt files want it."""
    return lay_out_examples(tmp_path_factory.mktemp("examples"))


def start(run: str, meta: dict) -> Solver:
    """Return the solver of a run, with Caffe's first weights."""
    solver = load_solver(f"examples/runs/{run}/solver.prototxt", exact="all")
    for name in meta["init"]:
        set_parameters(solver.net, np.load(f"examples/init/{name}.npz"))
    return solver


@pytest.mark.parametrize("run", RUNS)
def test_follows_caffe(run: str, folder: Path, same_blas: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The outputs of 120 iterations, the weights after them and what the test nets then put out, to the last bit."""
    if not same_blas:
        pytest.skip("another kind of CPU than Caffe's: its BLAS rounds differently")
    monkeypatch.chdir(folder)
    meta = json.loads(Path(f"examples/runs/{run}/meta.json").read_text())
    golden = np.load(f"examples/runs/{run}/trajectory.npz")
    solver = start(run, meta)
    outputs: list[dict[str, float]] = []
    _watch(solver.net, outputs)
    train(solver, meta["iterations"])
    solver.test_all()
    solver.close()
    for key in golden.files:
        if key.startswith("out/"):
            found = np.array([out[key[4:]] for out in outputs], np.float32)
            np.testing.assert_array_equal(found, golden[key], key)
    for key, weights in parameters(solver.net, golden, "final/").items():
        np.testing.assert_array_equal(weights, golden[key], key)
    assert [{name: value for name, (value,) in scores.items()} for scores in solver.scores] == meta["tests_after"]


@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS)
def test_begins_as_caffe_does_on_every_cpu(run: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The weights after the first iteration, to 1e-4 of what was subtracted from them."""
    monkeypatch.chdir(folder)
    solver = start(run, json.loads(Path(f"examples/runs/{run}/meta.json").read_text()))
    solver.step(1)
    solver.close()
    golden = np.load(f"examples/runs/{run}/trajectory.npz")
    for learnable in solver.net.learnable:
        assert learnable.parameter.grad is not None
        learnable.parameter.data.copy_(learnable.parameter.grad)  # the update, as Caffe leaves it there
    assert_same_layers(parameters(solver.net, golden, "update/"), golden, 1e-4)


def _watch(net: Net, outputs: list[dict[str, float]]) -> None:
    """Keep the outputs of each forward pass of a net."""
    forward = net.forward_loss

    def keep(**inputs):
        loss, blobs = forward(**inputs)
        outputs.append({name: blob.item() for name, blob in blobs.items()})
        return loss, blobs

    net.forward_loss = keep  # type: ignore[method-assign]

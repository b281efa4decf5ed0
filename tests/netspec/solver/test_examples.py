"""Caffe's own examples, trained with ``exact: all``: LeNet, the MNIST autoencoder and the Siamese MNIST net."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from golden_cases import assert_training, lay_out_examples, parameters, set_parameters, train
from netspec.load import load_solver
from netspec.net.net import Net
from netspec.solver.solver import Solver
from paths import GOLDEN

RUNS = sorted(folder.name for folder in (GOLDEN / "examples" / "runs").iterdir())


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``examples/``, as the paths in its prototxt files want it."""
    return lay_out_examples(tmp_path_factory.mktemp("examples"))


@pytest.mark.parametrize("run", RUNS)
def test_training_follows_caffe(run: str, folder: Path, caffes_bits: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """The outputs of 120 iterations, the weights after them and what the test nets then put out, to the last bit.

    On other CPUs than Caffe's to a twentieth.
    """
    monkeypatch.chdir(folder)
    meta = json.loads(Path(f"examples/runs/{run}/meta.json").read_text())
    golden = np.load(f"examples/runs/{run}/trajectory.npz")
    solver = load_solver(f"examples/runs/{run}/solver.prototxt", exact="all")
    for name in meta["init"]:
        set_parameters(solver.net, np.load(f"examples/init/{name}.npz"))
    outputs = _watched(solver, monkeypatch)
    train(solver, meta["iterations"])
    solver.test_all()
    solver.close()
    found = {key: np.array([out[key[4:]] for out in outputs]) for key in golden.files if key.startswith("out/")}
    assert_training({**found, **parameters(solver.net, golden, "final/")}, golden, caffes_bits, 0.05)
    tested = [{name: value for name, (value,) in scores.items()} for scores in solver.scores]
    expected = meta["tests_after"] if caffes_bits else [pytest.approx(one, rel=0.05) for one in meta["tests_after"]]
    assert tested == expected


def _watched(solver: Solver, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, float]]:
    """Return a list that gets the outputs of each training pass of a solver."""
    run, outputs = solver.run, []

    def keep(net: Net, learns: bool = False) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        loss, blobs = run(net, learns)
        outputs.extend([{name: blob.item() for name, blob in blobs.items()}] if learns else [])
        return loss, blobs

    monkeypatch.setattr(solver, "run", keep)
    return outputs

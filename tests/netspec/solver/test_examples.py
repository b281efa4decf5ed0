"""Caffe's own examples, trained with ``exact: all``: LeNet, the MNIST autoencoder and the Siamese MNIST net."""

import json
import shutil
from pathlib import Path

import lmdb
import numpy as np
import pytest

from golden_cases import assert_same_layers, parameters, set_parameters, train
from netspec.net.net import Net
from netspec.proto.schema import Datum
from netspec.solver.solver import Solver, load_solver
from paths import GOLDEN

EXAMPLES = GOLDEN / "examples"
RUNS = sorted(folder.name for folder in (EXAMPLES / "runs").iterdir())
DATABASES = {"mnist": "mnist", "siamese": "mnist_siamese"}


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with ``examples/``, as the paths in its prototxt files want it: the records are in LMDBs there."""
    folder = tmp_path_factory.mktemp("examples")
    shutil.copytree(EXAMPLES, folder / "examples")
    for name, prefix in DATABASES.items():
        records = np.load(EXAMPLES / name / "records.npz")
        for kind in ("train", "test"):
            write(folder / "examples" / name / f"{prefix}_{kind}_lmdb", records[kind], records[f"{kind}_label"])
    return folder


def write(path: Path, images: np.ndarray, labels: np.ndarray) -> None:
    """Write images (N, C, H, W) and labels (N,) as Datums."""
    channels, height, width = images.shape[1:]
    with lmdb.open(str(path), map_size=2**26) as environment, environment.begin(write=True) as transaction:
        for i, (image, label) in enumerate(zip(images, labels, strict=True)):
            datum = Datum(channels=channels, height=height, width=width, data=image.tobytes(), label=int(label))
            transaction.put(b"%08d" % i, datum.SerializeToString())


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

"""Golden cases, computed by real Caffe: functions that load them, repeat them, and measure differences.

A folder may hold ``exact.txt``: the least build option ``exact`` with which a net repeats the case to the last bit, on
a CPU of the kind that Caffe ran on. Without that file it is "all".
"""

import json
import shutil
from collections.abc import Mapping
from pathlib import Path

import lmdb
import numpy as np
import torch
from typing_extensions import override

import netspec
from netspec.exact import CHOICES
from netspec.graph.filter import with_state
from netspec.graph.options import BuildOptions
from netspec.graph.speed import speed
from netspec.net.build import build_net
from netspec.net.net import Net
from netspec.proto.schema import PHASES, Datum
from netspec.proto.text import parse_net
from netspec.solver.training import Callback
from paths import GOLDEN

Arrays = Mapping[str, np.ndarray]
STEPS = sorted(folder.name for folder in (GOLDEN / "steps").iterdir() if folder.is_dir())
SAMPLED, EVERY = 40_000, 97  # of arrays of so many values, the files of the examples have every 97th


def promised(case: Path) -> list[str]:
    """Return the values of ``exact`` with which a case is repeated to the last bit."""
    file = case / "exact.txt"
    least = file.read_text().strip() if file.exists() else "all"
    return list(CHOICES[CHOICES.index(least) :])


def set_parameters(net: Net, arrays: Arrays, prefix: str = "") -> None:
    """Give a net the parameters that ``arrays`` has, named ``PREFIXlayer/index``."""
    for key in arrays:
        if key.startswith(prefix):
            layer, index = key[len(prefix) :].rsplit("/", 1)
            blob = net.params[layer][int(index)].data
            blob.copy_(torch.from_numpy(arrays[key]).reshape(blob.shape))


def parameters(net: Net, arrays: Arrays, prefix: str) -> dict[str, np.ndarray]:
    """Return the parameters of a net that ``arrays`` has, under the same names, sampled as the examples' files are."""
    found = {}
    for key in arrays:
        if key.startswith(prefix):
            layer, index = key[len(prefix) :].rsplit("/", 1)
            values = net.params[layer][int(index)].detach().cpu().numpy()
            found[key] = values if values.size < SAMPLED else values.reshape(-1)[::EVERY]
    return found


def assert_arrays(found: Arrays, golden: Arrays, tolerance: float, what: str = "") -> float:
    """Compare each array to ``tolerance`` of the largest element, 0 being equal bits; return the largest difference."""
    most = 0.0
    for key, value in found.items():
        expected = golden[key]
        assert value.shape == expected.shape, f"{what}: {key}"
        if not tolerance:
            np.testing.assert_array_equal(value, expected, f"{what}: {key}")
        scale = max(float(np.abs(expected).max(initial=0)), 1e-30)
        worst = float(np.abs(value.astype(np.float64) - expected).max(initial=0)) / scale
        assert worst <= tolerance, f"{what}: {key}: off by {worst:.2e} of the largest element"
        most = max(most, worst)
    return most


def assert_training(found: Arrays, golden: Arrays, bits: bool, drift: float) -> None:
    """Compare what a training put out: numbers for each iteration, ``test/...`` after it, ``final/LAYER/INDEX``.

    Without ``bits``, for a CPU that rounds in another way than Caffe's: those of the first ten iterations to 1e-4 of
    the largest, everything to ``drift``.
    """
    weights = {key: value for key, value in found.items() if key.startswith("final/")}
    numbers = {key: np.asarray(value, np.float32) for key, value in found.items() if key not in weights}
    assert_arrays(numbers, golden, 0 if bits else drift)
    if bits:
        assert_arrays(weights, golden, 0)
    else:
        begun = {key: value[:10] for key, value in numbers.items() if not key.startswith("test/")}
        assert_arrays(begun, {key: golden[key][:10] for key in begun}, 1e-4)
        assert_same_layers(weights, golden, drift)


def assert_same_layers(found: Arrays, expected: Arrays, tolerance: float) -> None:
    """Compare parameters named ``.../layer/index``: each layer's to a share of its norm."""
    for layer, distance in layer_distances(found, expected).items():
        assert distance <= tolerance, f"{layer}: off by {distance:.1e} of its norm"


def layer_distances(found: Arrays, expected: Arrays) -> dict[str, float]:
    """Return how far the parameters named ``.../layer/index`` are off, each layer's as a share of its norm.

    A blob that is zero in Caffe is not compared. Values that cancel to zero there leave rounding errors on other CPUs,
    and solvers that divide a gradient by its size turn these into a step.
    """
    distances = {}
    for layer in {key.rpartition("/")[0] for key in found}:
        names = [key for key in found if key.rpartition("/")[0] == layer and expected[key].any()]
        if names:
            theirs = np.concatenate([expected[key].reshape(-1) for key in names])
            ours = np.concatenate([found[key].reshape(-1) for key in names])
            distances[layer] = float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs))
    return distances


class LayerCase:
    """A net of one layer or a few: inputs, parameters and gradients of tops, and Caffe's results.

    Keys of ``golden``: in/BLOB, param_init/LAYER/INDEX, topdiff/BLOB, and the results out/BLOB, indiff/BLOB,
    paramdiff/LAYER/INDEX, param_after/LAYER/INDEX.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.golden = dict(np.load(folder / "golden.npz"))
        self.meta = json.loads(str(self.golden.pop("meta")))

    def compute(self, exact: str = "small", device: str = "cpu") -> dict[str, np.ndarray]:
        """Return this project's results, under Caffe's keys."""
        net, source = parse_net(self.folder / "net.prototxt")
        options = BuildOptions(device, exact=exact, accumulate_in_place=True)
        built = build_net(with_state(net, PHASES[self.meta["phase"]]), source, options)
        set_parameters(built, self.golden, "param_init/")
        inputs = {
            name: torch.from_numpy(self.golden[f"in/{name}"]).to(device).requires_grad_(bool(self.meta["grad"]))
            for name in built.inputs
        }
        for _ in range(self.meta["warmup"]):
            built(**inputs)
        outputs = built(**inputs)
        found = {f"out/{name}": blob.detach().cpu().numpy() for name, blob in outputs.items()}
        if self.meta["grad"]:
            found.update(self._gradients(built, inputs, outputs))
        return {**found, **parameters(built, self.golden, "param_after/")}

    def outputs(self, exact: str = "small", device: str = "cpu") -> dict[str, np.ndarray]:
        """Return the outputs of a run without gradients, for which nets of phase TEST are prepared."""
        net, source = parse_net(self.folder / "net.prototxt")
        built = build_net(
            with_state(net, PHASES[self.meta["phase"]]), source, BuildOptions(device, exact=exact, speed=speed())
        )
        set_parameters(built, self.golden, "param_init/")
        inputs = {name: torch.from_numpy(self.golden[f"in/{name}"]).to(device) for name in built.inputs}
        with torch.no_grad():
            for _ in range(self.meta["warmup"] + 1):
                found = built(**inputs)
        return {f"out/{name}": blob.cpu().numpy() for name, blob in found.items()}

    def _gradients(
        self, net: Net, inputs: Mapping[str, torch.Tensor], outputs: Mapping[str, torch.Tensor]
    ) -> dict[str, np.ndarray]:
        """Go backward; return the gradients that Caffe computed too.

        Without force_backward, it leaves those of what is not under a loss at zero. Torch's are real.
        """
        reached = {k: blob for k, blob in outputs.items() if blob.requires_grad and f"topdiff/{k}" in self.golden}
        diffs = [
            torch.from_numpy(self.golden[f"topdiff/{k}"]).reshape(b.shape).to(b.device) for k, b in reached.items()
        ]
        torch.autograd.backward(list(reached.values()), diffs)
        found = {f"indiff/{name}": _gradient(blob) for name, blob in inputs.items()}
        passes = zip(net.plan.nodes, net.backward_plan.layers, strict=True)
        went_back = [node.name for node, ran in passes if ran or "fork" in self.meta]  # those of forks went in any case
        for layer in set(net.params) & set(went_back):
            found.update({f"paramdiff/{layer}/{i}": _gradient(blob) for i, blob in enumerate(net.params[layer])})
        return {key: value for key, value in found.items() if key in self.golden}


def _gradient(tensor: torch.Tensor) -> np.ndarray:
    return np.zeros(tuple(tensor.shape), np.float32) if tensor.grad is None else tensor.grad.cpu().numpy()


class Losses(Callback):
    """Keeps the loss of each iteration of a solver."""

    def __init__(self, solver: netspec.Solver) -> None:
        self._solver = solver
        self.found: list[float] = []
        solver.callbacks.append(self)

    @override
    def on_iteration(self) -> None:
        self.found.append(self._solver.loss)


def train(solver: netspec.Solver, iterations: int) -> list[float]:
    """Run some iterations of a solver; return the loss of each."""
    losses = Losses(solver)
    solver.step(iterations)
    return losses.found


def lay_out_examples(folder: Path) -> Path:
    """Put ``examples/`` into a folder, as the paths in its prototxt files want it: the records are in LMDBs there."""
    source = GOLDEN / "examples"
    shutil.copytree(source, folder / "examples")
    for name, prefix in {"mnist": "mnist", "siamese": "mnist_siamese"}.items():
        records = np.load(source / name / "records.npz")
        for kind in ("train", "test"):
            path = folder / "examples" / name / f"{prefix}_{kind}_lmdb"
            _write_datums(path, records[kind], records[f"{kind}_label"])
    return folder


def _write_datums(path: Path, images: np.ndarray, labels: np.ndarray) -> None:
    """Write images (N, C, H, W) and labels (N,) as Datums."""
    channels, height, width = images.shape[1:]
    with lmdb.open(str(path), map_size=2**26) as environment, environment.begin(write=True) as transaction:
        for i, (image, label) in enumerate(zip(images, labels, strict=True)):
            datum = Datum(channels=channels, height=height, width=width, data=image.tobytes(), label=int(label))
            transaction.put(b"%08d" % i, datum.SerializeToString())

"""The files of a benchmark case, which all programs read: net, weights, ONNX model, inputs and records."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.zoo import ZOO, deploy, training
from netspec.errors import SpecError

ROOT = Path(__file__).resolve().parents[1]
PAPER = [f"siamese_{n}" for n in ("8", "128", "resnet27_256", "resnet27_512")]
SMALL = [f"small/{name}" for name in PAPER]
CATALOG = [*PAPER, *SMALL, *ZOO]
RATE, MOMENTUM, DECAY = 1e-4, 0.9, 5e-4  # of trainings; small, so that they do not diverge


@dataclass(frozen=True)
class Case:
    """One net at one batch size. ``folder`` has its files."""

    name: str
    batch: int
    folder: Path

    @property
    def prototxt(self) -> Path:
        """The file of the net."""
        return self.folder / "net.prototxt"

    @property
    def caffemodel(self) -> Path:
        """The file of the weights."""
        return self.folder / "net.caffemodel"

    @property
    def torch(self) -> Path:
        """The PyTorch module that ``netspec export --to torch`` wrote; missing if the net cannot be exported."""
        return self.folder / "net.py"

    @property
    def onnx(self) -> Path:
        """The ONNX model that ``netspec export --to onnx`` wrote."""
        return self.folder / "net.onnx"

    @property
    def inputs(self) -> Path:
        """An .npz file with the inputs by blob, or with a batch of records and labels for training."""
        return self.folder / "inputs.npz"

    @property
    def solver(self) -> Path:
        """The solver for training, without tests and snapshots."""
        return self.folder / "solver.prototxt"


@contextmanager
def forward_case(name: str, batch: int, weights: str | None = None, onnx: bool = True) -> Iterator[Case]:
    """Write the files for forward passes of a net; ``name`` is in the catalog, or the path of a prototxt.

    Without ``weights``, random weights are written. Raises SpecError for faults in the files.
    """
    import netspec
    from netspec.export.formats.onnx import export_onnx
    from netspec.proto.text import write_text

    with TemporaryDirectory(prefix="bench-") as folder:
        case = Case(name, batch, Path(folder))
        case.prototxt.write_text(write_text(with_batch(deploy_of(name), batch)))
        net = netspec.load_net(case.prototxt, "TEST", weights, seed=0)
        if weights is None:
            randomize(net)
        random = np.random.default_rng(0)
        inputs = {blob: random.standard_normal(net.shapes[blob], np.float32) for blob in net.inputs}
        if weights is None:
            calm(net, inputs)
        netspec.save_weights(net, case.caffemodel)
        write_torch(net, case.torch)
        if onnx:
            export_onnx(net, case.onnx)
        np.savez(case.inputs, allow_pickle=False, **inputs)
        yield case


@contextmanager
def training_case(name: str, batch: int) -> Iterator[Case]:
    """Write the files for training a net of the catalog, with a database of one batch."""
    import netspec
    from netspec.data.database import Writer
    from netspec.data.datum import array_to_datum
    from netspec.proto.schema import SolverParameter
    from netspec.proto.text import write_text

    if name not in CATALOG:
        raise SpecError(f'no training of "{name}"; there are: {", ".join(CATALOG)}')
    with TemporaryDirectory(prefix="bench-") as folder:
        case = Case(name, batch, Path(folder))
        source = str(case.folder / "records")
        case.prototxt.write_text(write_text(training_net(name, source, batch)))
        solver = SolverParameter(
            net=str(case.prototxt),
            base_lr=RATE,
            momentum=MOMENTUM,
            weight_decay=DECAY,
            lr_policy="fixed",
            max_iter=10**9,
        )
        solver.random_seed = 0
        case.solver.write_text(write_text(solver))
        shape, classes = record(name)
        random = np.random.default_rng(0)
        records = random.integers(0, 256, (batch, *shape), np.uint8)
        labels = np.arange(batch) % classes
        with Writer(source) as writer:
            for k, (pixels, label) in enumerate(zip(records, labels, strict=True)):
                writer.put(b"%08d" % k, array_to_datum(pixels, int(label)).SerializeToString())
        np.savez(case.inputs, allow_pickle=False, data=(records - np.float32(128)) / 128, label=labels)
        net = netspec.load_net(case.prototxt, "TRAIN", seed=0)
        netspec.save_weights(net, case.caffemodel)
        write_torch(net, case.torch)
        net.close()
        yield case


def write_torch(net: Any, path: Path) -> None:
    """Write a net as a PyTorch module, if it can be exported."""
    from netspec.export.formats.torch import export_torch

    with suppress(SpecError):
        export_torch(net, path)


def deploy_of(name: str) -> Any:
    """Return the NetParameter for deployment of a net of the catalog, or of the prototxt at this path."""
    from netspec.proto.text import read_net

    if name in ZOO:
        return deploy(name)
    return read_net(ROOT / "prototxt" / name / "deploy.prototxt" if name in CATALOG else name)


def training_net(name: str, source: str, batch: int) -> Any:
    """Return the NetParameter with which a net of the catalog is trained on the LMDB ``source``."""
    from netspec.proto.text import read_net

    if name in ZOO:
        return training(name, source, batch)
    message = read_net(ROOT / "prototxt" / name / "train_val.prototxt")
    for layer in message.layer:
        if layer.type == "Data":
            layer.data_param.source, layer.data_param.batch_size = source, batch
    return message


def record(name: str) -> tuple[tuple[int, int, int], int]:
    """Return the shape of a net's records, and the number of labels."""
    if name in ZOO:
        return ZOO[name][1], 2 if name in ("pnet", "rnet", "onet") else 10
    size = 64 if name in SMALL else 224
    return (6, size, size), 2


def with_batch(message: Any, batch: int) -> Any:
    """Return a NetParameter after setting the batch size of its inputs."""
    for layer in message.layer:
        if layer.type == "Input":
            for shape in layer.input_param.shape:
                shape.dim[0] = batch
    return message


def randomize(net: Any) -> None:
    """Set BatchNorm statistics as if after some training, and normally distributed weights if there is no filler."""
    import torch

    torch.manual_seed(0)
    with torch.no_grad():
        for layer in net.layers:
            if layer.type == "BatchNorm":
                means, variances, weight = layer.blobs
                weight.fill_(50)
                means.normal_(0, 0.1).mul_(weight)
                variances.uniform_(0.5, 1.5).mul_(weight)
                continue
            for blob in layer.blobs:
                if not blob.any():
                    blob.normal_(0, (2 / blob[0].numel()) ** 0.5 if blob.dim() > 1 else 0.1)


def calm(net: Any, inputs: dict[str, np.ndarray]) -> None:
    """Scale the last layer with weights so that its outputs are about 1 and a softmax is not saturated."""
    import torch

    last = [layer for layer in net.layers if len(layer.blobs)][-1:]
    for layer in last:
        net.keep = list(layer.param.top)
        with torch.no_grad():
            net(**inputs)
            size = net.blobs[layer.param.top[0]].std()
            for blob in layer.blobs:
                blob /= size
    net.keep = ()

"""Measures how long a training waits for data, for each kind of source: ``tools/bench feeding``.

The records are smoothed noise, so that JPEG files take as long to decode as photographs.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from benchmarks.case import CATALOG, record, training_net
from netspec.errors import SpecError

FILE_SIZE = (480, 640)  # height, width of the files that ImageData reads
SECONDS = 5.0
Say = Callable[[str], None]
BACKENDS = ("leveldb", "lmdb")  # caffe.proto: enum DataParameter.DB


def measure(names: list[str], batch: int, threads: int, say: Say) -> list[dict[str, Any]]:
    """Print and return how long each net waits for data from each source, and how long a record takes alone."""
    import torch

    import netspec
    from netspec.proto.text import write_text

    torch.set_num_threads(threads)
    say("| net | data | batch | ms per iteration | waiting for data | microseconds per record |")
    say("|---|---|---|---|---|---|")
    rows = []
    for name in names:
        if name not in CATALOG:
            raise SpecError(f'no training of "{name}"; there are: {", ".join(CATALOG)}')
        channels, height, _ = record(name)[0]
        for kind, prepare in SOURCES.items():
            if kind in IMAGES and (channels != 3 or height < 16):
                continue  # an encoded image has three channels, ImageData reads one image
            with TemporaryDirectory(prefix="feeding-") as folder:
                net = training_net(name, "", batch)
                prepare(net, Path(folder), record(name), max(256, 4 * batch) if height < 64 else 4 * batch)
                (Path(folder) / "net.prototxt").write_text(write_text(net))
                solver = netspec.load_solver(_solver(folder), device="cpu")
                spent, waited = _run(solver)
                each = _making(solver, batch)
                solver.close()
            say(f"| {name} | {kind} | {batch} | {1e3 * spent:.2f} | {100 * waited / spent:.1f} % | {1e6 * each:.1f} |")
            found = {
                "ms per iteration": 1e3 * spent,
                "waiting, ms": 1e3 * waited,
                "microseconds per record": 1e6 * each,
            }
            rows.append({"net": name, "data": kind, "batch": batch, "threads": threads, **found})
    return rows


def _making(solver: Any, batch: int) -> float:
    """Return the seconds for reading and transforming a record: the median over batches, read one after the other."""
    make = next(layer.source.batch for layer in solver.net.layers if hasattr(layer, "source"))
    times: list[float] = []
    start = time.perf_counter()
    while len(times) < 3 or time.perf_counter() - start < SECONDS / 10:
        began = time.perf_counter()
        make(len(times))
        times.append(time.perf_counter() - began)
    return statistics.median(times) / batch


def _run(solver: Any) -> tuple[float, float]:
    """Return the seconds of an iteration, and the seconds that it waits for data."""
    solver.step(2)
    start, waited, iterations = time.perf_counter(), _waited(solver), 0
    while iterations < 3 or time.perf_counter() - start < SECONDS:
        solver.step(1)
        iterations += 1
    spent = time.perf_counter() - start
    return spent / iterations, (_waited(solver) - waited) / iterations


def _waited(solver: Any) -> float:
    return sum(getattr(layer, "waited", 0.0) for layer in solver.net.layers)


def _solver(folder: str) -> str:
    path = Path(folder) / "solver.prototxt"
    path.write_text(f'net: "{folder}/net.prototxt" base_lr: 0.0001 lr_policy: "fixed" max_iter: 1000000\n')
    return str(path)


def smooth_noise(random: np.random.Generator, channels: int, height: int, width: int) -> np.ndarray:
    """Return an image (H, W, channels) of uint8 that a JPEG file needs as many bytes for as for a photograph."""
    import cv2

    coarse = random.integers(0, 256, (-(-height // 8), -(-width // 8), channels), np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC).reshape(height, width, channels)


def _pixels(net: Any, folder: Path, shape: Any, count: int) -> None:
    from netspec.data.datum import array_to_datum

    _write(net, folder, shape, count, lambda picture, label: array_to_datum(picture.transpose(2, 0, 1), label))


def _leveldb(net: Any, folder: Path, shape: Any, count: int) -> None:
    from netspec.data.datum import array_to_datum

    def datum(picture: np.ndarray, label: int) -> Any:
        return array_to_datum(picture.transpose(2, 0, 1), label)

    _write(net, folder, shape, count, datum, "leveldb")


def _hdf5(net: Any, folder: Path, shape: Any, count: int) -> None:
    from netspec.files.hdf5 import new_hdf5

    (channels, height, width), classes = shape
    tops = next(list(layer.top) for layer in net.layer if layer.type == "Data")
    with new_hdf5(folder / "rows.h5") as file:
        values = np.random.default_rng(0).standard_normal((count, channels, height, width), np.float32)
        labels = (np.arange(count) % classes).astype(np.float32)
        for top, rows in zip(tops, (values, labels), strict=False):  # a layer may have no top for the labels
            file.create_dataset(top, data=rows)
    (folder / "files.txt").write_text(f"{folder / 'rows.h5'}\n")
    for layer in net.layer:
        if layer.type == "Data":
            batch = layer.data_param.batch_size
            layer.ClearField("data_param")
            layer.ClearField("transform_param")
            layer.type = "HDF5Data"
            layer.hdf5_data_param.source, layer.hdf5_data_param.batch_size = str(folder / "files.txt"), batch


def _encoded(net: Any, folder: Path, shape: Any, count: int) -> None:
    import cv2

    from netspec.data.datum import encoded_datum

    def datum(picture: np.ndarray, label: int) -> Any:
        return encoded_datum(cv2.imencode(".jpg", picture)[1].tobytes(), label)

    _write(net, folder, shape, count, datum)


def _write(
    net: Any, folder: Path, shape: Any, count: int, datum: Callable[[np.ndarray, int], Any], backend: str = "lmdb"
) -> None:
    from netspec.data.database import Writer

    (channels, height, width), classes = shape
    random = np.random.default_rng(0)
    source = str(folder / "records")
    with Writer(source, backend) as writer:
        for k in range(count):
            picture = smooth_noise(random, channels, height, width)
            writer.put(b"%08d" % k, datum(picture, k % classes).SerializeToString())
    for layer in net.layer:
        if layer.type == "Data":
            layer.data_param.source = source
            layer.data_param.backend = BACKENDS.index(backend)


def _files(net: Any, folder: Path, shape: Any, count: int) -> None:
    import cv2

    (channels, height, width), classes = shape
    random = np.random.default_rng(0)
    lines = []
    for k in range(count):
        path = folder / f"{k}.jpg"
        cv2.imwrite(str(path), smooth_noise(random, channels, *FILE_SIZE))
        lines.append(f"{path} {k % classes}\n")
    (folder / "images.txt").write_text("".join(lines))
    for layer in net.layer:
        if layer.type == "Data":
            batch = layer.data_param.batch_size
            layer.ClearField("data_param")
            layer.type = "ImageData"
            reads = layer.image_data_param
            reads.source, reads.batch_size = str(folder / "images.txt"), batch
            reads.new_height, reads.new_width = height, width


IMAGES = ("LMDB of JPEG", "ImageData, JPEG of 640x480")
SOURCES: dict[str, Callable[[Any, Path, Any, int], None]] = {
    "LMDB of pixels": _pixels,
    "LevelDB of pixels": _leveldb,
    "HDF5 of floats": _hdf5,
    "LMDB of JPEG": _encoded,
    "ImageData, JPEG of 640x480": _files,
}

"""Writes the files of MNIST and CIFAR-10 to databases of Datums, as Caffe's examples do.

Caffe: examples/mnist/convert_mnist_data.cpp, examples/siamese/convert_mnist_siamese_data.cpp,
examples/cifar10/convert_cifar_data.cpp
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from loopclosure.progress import Progress, silent
from netspec import log
from netspec.data.database import Writer
from netspec.data.random_words import words
from netspec.errors import SpecError, Where
from netspec.files.kinds import pointer_fault, unreadable
from netspec.proto.schema import Datum

IMAGES, LABELS = 2051, 2049  # magic numbers at the start of MNIST files
CIFAR_SHAPE = (3, 32, 32)


def convert_mnist(
    images: str, labels: str, database: str, backend: str = "lmdb", progress: Progress = silent, in_pairs: bool = False
) -> None:
    """Write the images and labels of two files of MNIST into a new database. Raises SpecError.

    ``in_pairs`` writes as many random pairs instead, the same ones each time. A pair is a Datum with two channels and
    label 1 if both images show the same digit, else 0.
    """
    pixels, classes = read_idx(images, IMAGES), read_idx(labels, LABELS)
    if len(pixels) != len(classes):
        message = (
            f'found {len(classes)} labels, but "{images}" has {len(pixels)} images; these files do not belong together'
        )
        raise SpecError(message, Where(labels))
    log.info("convert_mnist_data.cpp:83", f"A total of {len(pixels)} items.")
    log.info("convert_mnist_data.cpp:84", f"Rows: {pixels.shape[1]} Cols: {pixels.shape[2]}")
    records = zip(pixels[:, None], classes, strict=True)
    if in_pairs:
        chosen = words(1, "convert/mnist_pairs", 0, len(pixels))[:, :2] % len(pixels)
        records = ((pixels[pair], classes[pair[0]] == classes[pair[1]]) for pair in chosen)
    with Writer(database, backend) as writer:
        for number, (image, label) in enumerate(progress(records, "images", len(pixels))):
            writer.put(f"{number:08d}".encode(), _datum(image, int(label)))
    log.info("convert_mnist_data.cpp:103", f"Processed {len(pixels)} files.")


def read_idx(path: str, magic: int) -> np.ndarray:
    """Read an MNIST file: images uint8 (n, rows, columns), or labels uint8 (n,). Raises SpecError."""
    data = _read(path)
    axes = 3 if magic == IMAGES else 1
    what = "images" if magic == IMAGES else "labels"
    if data[:2] == b"\x1f\x8b":
        raise SpecError("this file is compressed; unpack it with gunzip first", Where(path))
    header = np.frombuffer(data[: len(data) // 4 * 4][: 4 * (1 + axes)], ">u4")
    if not len(header) or header[0] != magic:
        found = f"found {header[0]}" if len(header) else f"found {len(data)} bytes"
        raise SpecError(f"{found}, expected a file of {what} of MNIST, which begins with {magic}", Where(path))
    if len(header) < 1 + axes:
        raise SpecError(f"found {len(data)} bytes, the file ends in its header", Where(path))
    shape = tuple(int(n) for n in header[1:])
    values = np.frombuffer(data, np.uint8, offset=4 * (1 + axes))
    if len(values) != np.prod(shape):
        message = f"found {len(values)} bytes of {what}, expected {' x '.join(map(str, shape))}"
        raise SpecError(message, Where(path))
    return values.reshape(shape)


def convert_cifar(folder: str, output: str, backend: str, progress: Progress = silent) -> None:
    """Write CIFAR-10's binary files into ``cifar10_train_BACKEND`` and ``cifar10_test_BACKEND``. Raises SpecError."""
    parts = {"train": [f"data_batch_{k}.bin" for k in range(1, 6)], "test": ["test_batch.bin"]}
    for part, files in parts.items():
        log.info("convert_cifar_data.cpp:52", f"Writing {part.capitalize()}ing data")
        records = [record for file in files for record in read_cifar(str(Path(folder) / file))]
        with Writer(str(Path(output) / f"cifar10_{part}_{backend}"), backend) as writer:
            for number, (image, label) in enumerate(progress(iter(records), "images", len(records))):
                writer.put(f"{number:05d}".encode(), _datum(image, label))


def read_cifar(path: str) -> Iterator[tuple[np.ndarray, int]]:
    """Yield the images, uint8 (3, 32, 32), red first, and labels of a binary file of CIFAR-10. Raises SpecError."""
    size = 1 + int(np.prod(CIFAR_SHAPE))
    data = np.frombuffer(_read(path), np.uint8)
    if not len(data) or len(data) % size:
        raise SpecError(f"found {len(data)} bytes, expected a multiple of {size}: a label and 3072 pixels", Where(path))
    for row in data.reshape(-1, size):
        yield row[1:].reshape(CIFAR_SHAPE), int(row[0])


def _read(path: str) -> bytes:
    try:
        data = Path(path).read_bytes()
    except OSError as fault:
        raise SpecError(unreadable(path, fault), Where(path)) from None
    if fault := pointer_fault(data):
        raise SpecError(fault, Where(path))
    return data


def _datum(image: np.ndarray, label: int) -> bytes:
    channels, height, width = image.shape
    datum = Datum(channels=channels, height=height, width=width, data=image.tobytes(), label=label)
    return datum.SerializeToString()

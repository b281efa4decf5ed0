"""The files of MNIST and CIFAR-10 become the databases that Caffe's examples make of them."""

import struct
from pathlib import Path

import numpy as np
import pytest

from lmdb_build.cli import main
from netspec.data.database import open_reader
from netspec.data.datum import datum_to_array, parse_datum
from paths import shared

CHANCE = np.random.default_rng(0)


def idx(path: Path, values: np.ndarray) -> str:
    path.write_bytes(struct.pack(">4b", 0, 0, 8, values.ndim) + struct.pack(f">{values.ndim}I", *values.shape))
    with path.open("ab") as file:
        file.write(values.tobytes())
    return str(path)


def records(path: Path) -> list[tuple[bytes, bytes]]:
    reader = open_reader(str(path))
    return [(reader.key(i), reader.record(i)) for i in range(len(reader))]


def test_mnist(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images, labels = CHANCE.integers(0, 256, (7, 5, 4), np.uint8), CHANCE.integers(0, 10, 7, np.uint8)
    files = [idx(tmp_path / "images", images), idx(tmp_path / "labels", labels)]
    assert main(["mnist", *files, str(tmp_path / "db"), "--backend=lmdb"]) == 0
    assert "A total of 7 items." in capsys.readouterr().err
    for i, (key, record) in enumerate(records(tmp_path / "db")):
        datum = parse_datum(record)
        assert key == b"%08d" % i
        assert datum.label == labels[i]
        np.testing.assert_array_equal(datum_to_array(datum), images[i][None])
    assert main(["mnist", *files, str(tmp_path / "db")]) == 1  # it is there


def test_pairs_of_mnist(tmp_path: Path) -> None:
    images, labels = CHANCE.integers(0, 256, (60, 5, 4), np.uint8), CHANCE.integers(0, 3, 60, np.uint8)
    files = [idx(tmp_path / "images", images), idx(tmp_path / "labels", labels)]
    label_of = {image.tobytes(): label for image, label in zip(images, labels, strict=True)}
    for name in ("db", "again"):
        assert main(["mnist", "--pairs", *files, str(tmp_path / name)]) == 0
    found = records(tmp_path / "db")
    assert found == records(tmp_path / "again")
    firsts, same = set(), []
    for i, (key, record) in enumerate(found):
        datum = parse_datum(record)
        first, second = (channel.tobytes() for channel in datum_to_array(datum))
        assert (key, datum.channels, datum.label) == (b"%08d" % i, 2, label_of[first] == label_of[second])
        firsts.add(first)
        same.append(datum.label)
    assert (len(found), len(firsts) > 30, 5 < sum(same) < 40) == (60, True, True)


def test_mnist_is_identical_to_caffes(tmp_path: Path) -> None:
    """Files of MNIST made from a database of Caffe's give that database again."""
    golden = shared("golden/examples/mnist/mnist_test_lmdb")
    expected = records(golden)[:500]
    datums = [parse_datum(record) for _, record in expected]
    images = np.concatenate([datum_to_array(datum) for datum in datums])
    files = [idx(tmp_path / "i", images), idx(tmp_path / "l", np.array([d.label for d in datums], np.uint8))]
    assert main(["mnist", *files, str(tmp_path / "db")]) == 0
    assert records(tmp_path / "db") == expected


def test_cifar(tmp_path: Path) -> None:
    rows = CHANCE.integers(0, 10, (12, 3073), np.uint8)
    for k, name in enumerate([*(f"data_batch_{k}.bin" for k in range(1, 6)), "test_batch.bin"]):
        (tmp_path / name).write_bytes(rows[2 * k : 2 * k + 2].tobytes())
    assert main(["cifar", str(tmp_path), str(tmp_path), "lmdb"]) == 0
    found = [*records(tmp_path / "cifar10_train_lmdb"), *records(tmp_path / "cifar10_test_lmdb")]
    assert [key for key, _ in found] == [b"%05d" % i for i in (*range(10), 0, 1)]
    for row, (_, record) in zip(rows, found, strict=True):
        datum = parse_datum(record)
        assert datum.label == row[0]
        np.testing.assert_array_equal(datum_to_array(datum).ravel(), row[1:])


def test_wrong_files_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    images = idx(tmp_path / "images", np.zeros((3, 2, 2), np.uint8))
    few = idx(tmp_path / "labels", np.zeros(2, np.uint8))
    (tmp_path / "packed").write_bytes(b"\x1f\x8b\x08\x00")
    (tmp_path / "short").write_bytes(Path(images).read_bytes()[:-1])
    (tmp_path / "test_batch.bin").write_bytes(b"x")
    for words, fault in (
        ((images, few), f'found 2 labels, but "{images}" has 3 images'),
        ((few, few), "found 2049, expected a file of images of MNIST, which begins with 2051"),
        ((str(tmp_path / "packed"), few), "this file is compressed; unpack it with gunzip first"),
        ((str(tmp_path / "short"), few), "found 11 bytes of images, expected 3 x 2 x 2"),
        ((str(tmp_path / "none"), few), "none: cannot be read: No such file or directory"),
    ):
        assert main(["mnist", *words, str(tmp_path / "db")]) == 1
        assert fault in capsys.readouterr().err
    assert main(["cifar", str(tmp_path), str(tmp_path), "lmdb"]) == 1
    assert "data_batch_1.bin: cannot be read" in capsys.readouterr().err

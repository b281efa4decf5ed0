from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import h5py
import numpy as np
import pytest

from netspec.data.hdf5 import Hdf5Sink, Hdf5Source
from netspec.data.sources import Draws, batches
from netspec.errors import SpecError, Where

PLACE = Where("net.prototxt", 4, 2)


def write(folder: Path, name: str, first: int, rows: int, **more: np.ndarray) -> None:
    numbers = np.arange(first, first + rows)
    with h5py.File(folder / name, "w") as file:
        file["data"] = np.broadcast_to(numbers[:, None, None], (rows, 2, 3)).astype(np.float64)
        file["label"] = numbers.astype(np.int32)
        for key, value in more.items():
            file[key] = value


@pytest.fixture
def listed(tmp_path: Path) -> str:
    write(tmp_path, "a.h5", 0, 5)
    write(tmp_path, "b.h5", 5, 3)
    write(tmp_path, "c.h5", 8, 4)
    (tmp_path / "list.txt").write_text("".join(f"{tmp_path}/{name}\n" for name in ("a.h5", "b.h5", "c.h5")))
    return str(tmp_path / "list.txt")


def test_batches_span_files_and_wrap(listed: str) -> None:
    source = Hdf5Source(listed, ["data", "label"], 7, where=PLACE)
    assert list(source.shapes) == [(7, 2, 3), (7,)]
    labels = [source.batch(i)[1].tolist() for i in range(2)]
    assert labels == [[0, 1, 2, 3, 4, 5, 6], [7, 8, 9, 10, 11, 0, 1]]
    data = source.batch(1)[0]
    assert data.dtype == np.float32
    assert data[:, 1, 2].tolist() == labels[1]
    assert [key.rsplit("/")[-1] for key in source.keys(1)][:3] == ["b.h5:2", "c.h5:0", "c.h5:1"]


def test_shuffling_keeps_files_together_and_changes_with_the_epoch(listed: str) -> None:
    source = Hdf5Source(listed, ["label"], 4, True, Draws(3, "x"), PLACE)
    epochs = [np.concatenate([source.batch(i)[0] for i in range(3 * e, 3 * e + 3)]).tolist() for e in range(4)]
    assert all(sorted(epoch) == list(range(12)) for epoch in epochs)
    assert len({tuple(epoch) for epoch in epochs}) == 4
    files = [0] * 5 + [1] * 3 + [2] * 4
    runs = [1 + sum(files[int(a)] != files[int(b)] for a, b in pairwise(epoch)) for epoch in epochs]
    assert runs == [3] * 4  # all rows of a file, then all of another
    again = Hdf5Source(listed, ["label"], 4, True, Draws(3, "x"), PLACE)
    assert [top.tolist() for (top,) in batches(again, 5, 3)] == [source.batch(i)[0].tolist() for i in (5, 6, 7)]


def refuse(tmp_path: Path, names: str, message: str) -> None:
    (tmp_path / "bad.txt").write_text(names)
    with pytest.raises(SpecError, match=message):
        Hdf5Source(str(tmp_path / "bad.txt"), ["data", "label"], 2, where=PLACE)


def test_invalid_files_are_reported_with_their_line(tmp_path: Path, listed: str) -> None:
    refuse(
        tmp_path,
        f"{tmp_path}/a.h5\n{tmp_path}/nix.h5\n",
        'bad.txt:2:1: HDF5 file ".*nix.h5" cannot be read: No such file or directory$',
    )
    refuse(tmp_path, "", "names no HDF5 file")
    (tmp_path / "text.h5").write_text("hello")
    refuse(tmp_path, f"{tmp_path}/text.h5", 'text.h5" cannot be read')
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["data"] = np.zeros((3, 2, 3))
    refuse(tmp_path, f"{tmp_path}/other.h5", 'no dataset "label", the name of a top; it has "data"')
    with h5py.File(tmp_path / "uneven.h5", "w") as file:
        file["data"], file["label"] = np.zeros((3, 2, 3)), np.zeros(4)
    refuse(tmp_path, f"{tmp_path}/uneven.h5", r"have \[3, 4\] rows; expected equal numbers")
    with h5py.File(tmp_path / "wide.h5", "w") as file:
        file["data"], file["label"] = np.zeros((3, 2, 4)), np.zeros(3)
    refuse(tmp_path, f"{tmp_path}/a.h5 {tmp_path}/wide.h5", "all files must agree")
    with h5py.File(tmp_path / "words.h5", "w") as file:
        file["data"], file["label"] = np.zeros((3, 2, 4)), np.array([b"x", b"y", b"z"])
    refuse(tmp_path, f"{tmp_path}/words.h5", 'dataset "label" .* has values of type .*; expected rows of numbers')
    with h5py.File(tmp_path / "bool.h5", "w") as file:
        file["data"], file["label"] = np.zeros((3, 2, 4), bool), np.zeros(3)
    refuse(tmp_path, f"{tmp_path}/bool.h5", 'dataset "data" .* has values of type bool; expected rows of numbers')
    with pytest.raises(SpecError, match=r'bool.h5" is an HDF5 file; expected a text file that lists HDF5 files'):
        Hdf5Source(str(tmp_path / "bool.h5"), ["data", "label"], 2, where=PLACE)


def test_results_are_appended_in_caffes_four_axes(tmp_path: Path) -> None:
    sink = Hdf5Sink(str(tmp_path / "out.h5"), PLACE)
    sink.append(np.arange(6.0).reshape(2, 3), np.array([1.0, 2.0]))
    sink.append(np.arange(6.0, 9.0).reshape(1, 3), np.array([3.0]))
    sink.close()
    with h5py.File(tmp_path / "out.h5") as file:
        assert sorted(file) == ["data", "label"]
        data, label = np.asarray(file["data"]), np.asarray(file["label"])
    assert data.dtype == np.float32
    assert data.shape == (3, 3, 1, 1)
    assert data.ravel().tolist() == list(range(9))
    assert label.reshape(-1).tolist() == [1, 2, 3]
    assert label.shape == (3, 1, 1, 1)


def test_results_with_another_shape_or_invalid_path_are_refused(tmp_path: Path) -> None:
    sink = Hdf5Sink(str(tmp_path / "out.h5"), PLACE)
    sink.append(np.zeros((2, 3)), np.zeros(2))
    with pytest.raises(SpecError, match=r'rows of "data" had shape \(3, 1, 1\) in earlier batches, found \(4, 1, 1\)'):
        sink.append(np.zeros((2, 4)), np.zeros(2))
    sink.close()
    with pytest.raises(SpecError, match=r"^net.prototxt:4:2: HDF5 file .* cannot be written"):
        Hdf5Sink(str(tmp_path / "nowhere" / "out.h5"), PLACE).append(np.zeros((2, 4)), np.zeros(2))

"""``netspec data show``: statistics of databases, faulty records, and pictures of records."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from netspec.data.database import Writer
from netspec.data.datum import array_to_datum, encoded_datum
from netspec.errors import SpecError
from netspec.inspect.check.survey import Survey, survey
from netspec.inspect.draw.style import as_picture, images_in, split
from netspec.inspect.records import open_records, spread
from optional_packages import leveldb
from paths import GOLDEN

Run = Callable[..., Any]


def image(seed: int, shape: tuple[int, ...] = (3, 6, 8)) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, np.uint8)


def write(path: Path, values: list[Any], backend: str = "lmdb") -> str:
    """Write a database of arrays, of (array, label), or of bytes as they are."""
    with Writer(str(path), backend) as writer:
        for number, value in enumerate(values):
            array, label = value if isinstance(value, tuple) else (value, number % 2)
            stored = array if isinstance(array, bytes) else array_to_datum(array, label).SerializeToString()
            writer.put(b"%08d" % number, stored)
    return str(path)


def look(path: str) -> Survey:
    records = open_records(path)
    return survey(records, range(len(records)))


@pytest.mark.parametrize("backend", ["lmdb", "leveldb"])
def test_statistics_are_those_of_numpy(tmp_path: Path, backend: str) -> None:
    if backend == "leveldb":
        leveldb()
    images = [image(k) for k in range(9)]
    found = look(write(tmp_path / "db", images, backend))
    together = np.stack(images)
    np.testing.assert_allclose(found.channels.mean, together.mean(axis=(0, 2, 3)))
    np.testing.assert_allclose(found.channels.deviation, together.std(axis=(0, 2, 3)))
    assert found.channels.least.tolist() == together.min(axis=(0, 2, 3)).tolist()
    assert found.channels.histogram is not None
    assert found.channels.histogram[1, 7] == (together[:, 1] == 7).sum()
    assert found.labels == {0: 5, 1: 4}
    assert (found.total, found.faults) == (9, [])
    assert found.forms == {"raw bytes, 3 x 6 x 8": 9}


def test_statistics_of_floats_have_no_histogram(tmp_path: Path) -> None:
    values = [np.random.default_rng(k).normal(size=(4, 1, 1)).astype(np.float32) for k in range(5)]
    found = look(write(tmp_path / "db", values))
    np.testing.assert_allclose(found.channels.deviation, np.stack(values).std(axis=(0, 2, 3)), rtol=1e-6)
    assert found.channels.histogram is None


def test_records_that_a_data_layer_refuses_are_errors(tmp_path: Path) -> None:
    nan = np.full((3, 6, 8), np.nan, np.float32)
    broken = encoded_datum(b"\x89PNG....", 1).SerializeToString()
    found = look(write(tmp_path / "db", [image(0), b"\xff\xff\xff", broken, image(1, (3, 6, 9)), nan, image(2)]))
    assert [(fault.number, fault.text) for fault in found.faults] == [
        (1, "is not a Datum (3 bytes)"),
        (2, "cannot be decoded as an image"),
        (3, 'is 3 x 6 x 9, the first record, "00000000", 3 x 6 x 8'),
        (4, "contains a NaN or an infinity"),
    ]
    np.testing.assert_allclose(found.channels.mean, np.stack([image(0), image(2)]).mean(axis=(0, 2, 3)))


def test_records_of_a_list_of_hdf5_files_are_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name, start in (("a.h5", 0), ("b.h5", 4)):
        with h5py.File(name, "w") as file:
            file["data"] = np.arange(start, start + 4.0).reshape(4, 1) + np.zeros((4, 5))
            file["label"] = np.arange(start, start + 4)
    Path("files.txt").write_text("a.h5\nb.h5\n")
    records = open_records("files.txt")
    assert len(records) == 8
    assert (records[5].key, records[5].label) == ("b.h5:1", 5)
    assert records[5].values is not None
    assert records[5].values.ravel().tolist() == [5.0] * 5
    assert look("a.h5").labels == dict.fromkeys(range(4), 1)


@pytest.mark.parametrize("name", ["nothing", "folder", "empty.txt"])
def test_other_files_than_databases_are_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty.txt").write_text("")
    with pytest.raises(SpecError, match=name):
        open_records(tmp_path / name)


def test_hdf5_labels_of_text_are_unlabeled_and_data_of_text_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "x.h5", "w") as file:
        file["data"], file["label"] = np.zeros((2, 3)), np.array([b"a", b"b"])
    assert look(str(tmp_path / "x.h5")).unlabeled == 2
    with h5py.File(tmp_path / "y.h5", "w") as file:
        file["data"] = np.array([b"a", b"b"])
    with pytest.raises(SpecError, match=r'HDF5 file ".*y.h5" dataset "data" has values of type \|S1, expected numbers'):
        open_records(str(tmp_path / "y.h5"))


def test_samples_are_even_and_reproducible() -> None:
    assert spread(5, None) == spread(5, 7) == [0, 1, 2, 3, 4]
    numbers = spread(1000, 40)
    assert [number // 25 for number in numbers] == list(range(40))
    assert numbers == spread(1000, 40)
    assert len({number % 2 for number in numbers}) == 2


def test_records_are_split_into_images_and_converted_to_pictures() -> None:
    pair = np.stack([image(1)[0], image(2)[0]])
    assert [images_in(values) for values in (pair, image(0), image(0, (6, 4, 4)), image(0, (6, 1, 1)))] == [2, 1, 2, 1]
    left, right = (as_picture(part) for part in split(pair, 2))
    np.testing.assert_array_equal(left, pair[0] / 255)
    np.testing.assert_array_equal(right, pair[1] / 255)
    np.testing.assert_array_equal(as_picture(image(0))[..., 0], image(0)[2] / 255)  # red is Caffe's last
    assert as_picture(np.arange(5.0).reshape(5, 1, 1)).shape == (2, 3)


@pytest.mark.slow
def test_data_show_draws_pairs_and_lists_errors_first(run: Run, tmp_path: Path) -> None:
    assert run("data", "show", "pairs/train_lmdb", "--out", "x.png", "--count", 6).status == 0
    assert cv2.imread("x.png") is not None
    path = write(tmp_path / "bad", [*(image(k) for k in range(30)), b"\xff"])
    result = run("data", "show", path, "--out", "x.svg", "--count", 4)
    assert result.out == "x.svg: 4 of 31 records\n"
    text = Path("x.svg").read_text()
    assert text.index("is not a Datum") < text.index("label 0<")
    assert "00000030" in text
    run("data", "show", GOLDEN / "images" / "lmdb_encoded", "--out", "y.svg", "--start", 4)
    assert "00000003" not in Path("y.svg").read_text()


def test_the_count_of_errors_is_red_and_no_good_record_is_left_out_for_a_bad_one(run: Run, tmp_path: Path) -> None:
    path = write(tmp_path / "bad", [image(0), image(1), b"\xff", image(3), b"\xff"])
    assert run("data", "show", path, "--out", "x.svg", "--count", 40).out == "x.svg: 5 of 5 records\n"
    (line,) = re.findall(r"<text[^>]*>errors:[^<]*</text>", Path("x.svg").read_text())
    assert "c62828" in line
    assert line.endswith(">errors: 2 records that a data layer refuses</text>")
    assert run("data", "show", path, "--out", "x.svg", "--count", 1).out == "x.svg: 1 of 5 records\n"
    one = write(tmp_path / "one", [image(0), b"\xff"])
    assert run("data", "show", one, "--out", "x.svg").out == "x.svg: 2 of 2 records\n"
    assert ">errors: 1 record that a data layer refuses<" in Path("x.svg").read_text()
    sound = write(tmp_path / "sound", [image(0)])
    run("data", "show", sound, "--out", "x.svg")
    (line,) = re.findall(r"<text[^>]*>errors: none</text>", Path("x.svg").read_text())
    assert "c62828" not in line


@pytest.mark.parametrize(
    "words",
    [("show", "db"), ("draw", "db")],
    ids=["show_without_out", "unknown"],
)
def test_invalid_arguments_of_data_have_status_2(run: Run, words: tuple[str, ...]) -> None:
    assert run("data", *words).status == 2


def test_an_unknown_image_format_is_refused(run: Run) -> None:
    assert run("data", "show", "pairs/test_lmdb", "--out", "x.html").fault.endswith(".png, .svg")

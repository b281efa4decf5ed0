"""``netspec data show``: pictures of records."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from netspec.data.database import Writer
from netspec.data.datum import array_to_datum, encoded_datum
from netspec.inspect.draw.sheet import picture, spread
from optional_packages import leveldb

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


def test_samples_are_even_and_reproducible() -> None:
    assert spread(5, 7) == [0, 1, 2, 3, 4]
    numbers = spread(1000, 40)
    assert [number // 25 for number in numbers] == list(range(40))
    assert numbers == spread(1000, 40)
    assert len({number % 2 for number in numbers}) == 2


def test_values_as_pictures() -> None:
    pair = np.stack([image(1)[0], image(2)[0]])
    both = picture(pair)
    np.testing.assert_array_equal(both[:, :8], pair[0] / 255)
    np.testing.assert_array_equal(both[:, -8:], pair[1] / 255)
    assert picture(image(0, (6, 4, 4))).shape == (4, 9, 3)
    np.testing.assert_array_equal(picture(image(0))[..., 0], image(0)[2] / 255)  # red is Caffe's last
    np.testing.assert_array_equal(picture(np.arange(5.0).reshape(5, 1, 1)), [[0, 0.25, 0.5], [0.75, 1, 0], [0, 0, 0]])
    assert picture(np.full((1, 2, 2), np.nan)).tolist() == [[0, 0], [0, 0]]


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["lmdb", "leveldb"])
def test_data_show_draws_records_and_why_one_cannot_be_read(run: Run, tmp_path: Path, backend: str) -> None:
    if backend == "leveldb":
        leveldb()
    broken = encoded_datum(b"\x89PNG....", 1).SerializeToString()
    path = write(tmp_path / "bad", [*(image(k) for k in range(30)), b"\xff", broken], backend)
    assert run("data", "show", path, "--out", "x.svg", "--start", 28).out == "x.svg: 4 of 32 records\n"
    text = Path("x.svg").read_text()
    assert all(each in text for each in ("is not a Datum", "cannot be", "00000029", "label 0", "no label"))
    assert run("data", "show", path, "--out", "x.png", "--count", 6).out == "x.png: 6 of 32 records\n"
    assert cv2.imread("x.png") is not None
    assert run("data", "show", path, "--out", "x.png", "--start", 32).status == 2


@pytest.mark.parametrize(
    "words",
    [("show", "db"), ("draw", "db")],
    ids=["show_without_out", "unknown"],
)
def test_invalid_arguments_of_data_have_status_2(run: Run, words: tuple[str, ...]) -> None:
    assert run("data", *words).status == 2


def test_an_unknown_image_format_is_refused(run: Run) -> None:
    assert run("data", "show", "pairs/test_lmdb", "--out", "x.html").fault.endswith(".png, .svg")

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from netspec.data.sources import Draws
from netspec.data.windows import WindowSource, read_window_file, window_mean, wrong_means
from netspec.errors import SpecError, Where
from netspec.proto.schema import TransformationParameter, message

CROP = 8
IMAGE = np.random.default_rng(0).integers(1, 256, (30, 40, 3), np.uint8)  # no zero: a zero in a top is padding
FILE = """# 0
{folder}/0.png
3
30
40
4
5 0.9 4 6 19 17
7 0.6 0 0 9 9
2 0.4 20 20 29 25
3 0.1 10 12 25 27
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    cv2.imwrite(str(tmp_path / "0.png"), IMAGE)
    (tmp_path / "windows.txt").write_text(FILE.format(folder=tmp_path))
    return tmp_path


def at(*path: str | int) -> Where:
    return Where("net.prototxt", 5, 1)


def window_param(folder: Path, **fields: object) -> Any:
    return message("WindowDataParameter")(source=str(folder / "windows.txt"), **({"batch_size": 8} | fields))


def source(folder: Path, transform: dict | None = None, **fields: object) -> WindowSource:
    param = window_param(folder, **fields)
    transform_param = TransformationParameter(crop_size=CROP, **(transform or {}))
    for fault in wrong_means(transform_param, at):
        raise fault
    file, mean = read_window_file(param, at()), window_mean(transform_param, at)
    return WindowSource(param, transform_param, file, mean, at, Draws(1, "data/TRAIN"))


def warped(x1: int, y1: int, x2: int, y2: int) -> np.ndarray:
    return cv2.resize(IMAGE[y1 : y2 + 1, x1 : x2 + 1], (CROP, CROP)).transpose(2, 0, 1).astype(np.float32)


def test_windows_are_sorted_by_their_overlap(folder: Path) -> None:
    found = read_window_file(window_param(folder, fg_threshold=0.5, bg_threshold=0.3), None)
    assert [(w.label, w.x1, w.y2) for w in found.foreground] == [(5, 4, 17), (7, 0, 9)]
    assert [(w.label, w.x1) for w in found.background] == [(0, 10)]  # 0.4 is neither


def test_background_comes_before_the_share_of_foreground(folder: Path) -> None:
    found = source(folder, bg_threshold=0.3, fg_fraction=0.3)
    labels = np.array([found.batch(i)[1] for i in range(20)])
    assert (labels[:, :6] == 0).all()  # 8 * 0.3 = 2.4 windows are foreground
    assert set(labels[:, 6:].ravel()) == {5, 7}


def test_a_window_is_warped_to_the_crop(folder: Path) -> None:
    data, labels = source(folder, bg_threshold=0.3, fg_fraction=1.0).batch(0)
    boxes = {5: (4, 6, 19, 17), 7: (0, 0, 9, 9)}
    assert all((top == warped(*boxes[int(label)])).all() for top, label in zip(data, labels, strict=True))


def test_mirror_mean_and_scale(folder: Path) -> None:
    settings = {"mirror": True, "mean_value": [10, 20, 30]}
    data, labels = source(folder, settings, bg_threshold=0.3, fg_fraction=0.0, scale=0.5, batch_size=30).batch(0)
    plain = (warped(10, 12, 25, 27) - np.array([10, 20, 30], np.float32).reshape(3, 1, 1)) * np.float32(0.5)
    mirrored = [bool((top == plain[:, :, ::-1]).all()) for top in data]
    assert all(is_mirrored or (top == plain).all() for top, is_mirrored in zip(data, mirrored, strict=True))
    assert {True, False} == set(mirrored)
    assert not labels.any()


def test_context_is_zero_outside_the_image(folder: Path) -> None:
    # Two pixels of context in a crop of 8: the box of 10 x 10 grows by 8 / 4 to 20 x 20, from -5 to 15: 21 pixels.
    # Five of them lie beyond the image: round(5 * 8 / 21) = 2 pixels of the crop, and round(16 * 8 / 21) = 6 remain.
    data, labels = source(folder, bg_threshold=0.3, fg_fraction=1.0, context_pad=2).batch(0)
    top = data[list(labels).index(7)]
    assert not top[:, :2].any()
    assert not top[:, :, :2].any()
    inside = cv2.resize(IMAGE[0:16, 0:16], (6, 6)).transpose(2, 0, 1)
    assert (top[:, 2:, 2:] == inside).all()


def test_a_square_crop_keeps_the_aspect_ratio(folder: Path) -> None:
    # The box of 16 x 12 around (12, 12) becomes one of 16 x 16, from 4 to 20 both ways.
    data, labels = source(folder, bg_threshold=0.3, fg_fraction=1.0, crop_mode="square").batch(0)
    assert (data[list(labels).index(5)] == warped(4, 4, 20, 20)).all()


def test_the_padding_of_a_mirrored_window_is_mirrored(folder: Path) -> None:
    settings = {"mirror": True}
    data, labels = source(folder, settings, bg_threshold=0.3, fg_fraction=1.0, context_pad=2, batch_size=40).batch(0)
    corner = cv2.resize(IMAGE[0:16, 0:16], (6, 6)).transpose(2, 0, 1)
    for top in data[labels == 7]:
        left = not top[:, :, :2].any()
        assert (top[:, 2:, 2:] == corner).all() if left else (top[:, 2:, :6] == corner[:, :, ::-1]).all()


def test_the_mean_is_cropped_like_the_window(folder: Path) -> None:
    from lmdb_build.mean import write_mean

    mean = np.arange(3 * 12 * 12, dtype=np.float32).reshape(3, 12, 12)
    write_mean(str(folder / "mean"), mean)
    data, _ = source(folder, {"mean_file": str(folder / "mean")}, bg_threshold=0.3, fg_fraction=0.0).batch(0)
    assert (data[0] == warped(10, 12, 25, 27) - mean[:, 2:10, 2:10]).all()


def test_images_can_be_cached(folder: Path) -> None:
    cached = source(folder, bg_threshold=0.3, cache_images=True)
    before = cached.batch(0)[0]
    (folder / "0.png").unlink()
    assert (cached.batch(0)[0] == before).all()
    with pytest.raises(SpecError, match=r'^net.prototxt:5:1: image ".*0.png" cannot be read'):
        source(folder, bg_threshold=0.3).batch(0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (FILE, "", "the window file .* is empty"),
        ("# 0", "# 1", 'windows.txt:1:1: found "# 1", expected "# 0"'),
        ("40\n4\n", "40\nfour\n", 'windows.txt:6:1: found "four", expected the number of windows'),
        ("5 0.9 4 6 19 17", "5 0.9 4 6 19", 'windows.txt:7:1: found "5 0.9 4 6 19", expected label overlap x1'),
        ("40\n4\n", "40\n5\n", 'windows.txt:10:1: found "", expected label overlap'),
        ("5 0.9", "0 0.9", "windows.txt:7:1: found label 0 for a foreground window"),
        ("5 0.9", "1.5 0.9", "windows.txt:7:1: found label 1.5, expected an integer of 32 bits"),
        ("5 0.9", "4294967296 0.9", "windows.txt:7:1: found label 4294967296, expected an integer of 32 bits"),
        ("3 0.1", "3 0.45", "has no background windows"),
    ],
)
def test_an_invalid_window_file_is_reported_with_its_line(folder: Path, old: str, new: str, message: str) -> None:
    text = FILE.replace(old, new).format(folder=folder)
    (folder / "windows.txt").write_text(text)
    with pytest.raises(SpecError, match=message):
        source(folder, bg_threshold=0.3)


def test_a_window_outside_the_image_is_reported(folder: Path) -> None:
    (folder / "windows.txt").write_text(FILE.format(folder=folder).replace("10 12 25 27", "10 12 25 30"))
    with pytest.raises(SpecError, match="is not inside image"):
        source(folder, bg_threshold=0.3, fg_fraction=0.0).batch(0)

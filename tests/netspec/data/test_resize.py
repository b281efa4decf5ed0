"""Images are resized to Caffe's pixels, also where this OpenCV computes others."""

import hashlib

import cv2
import numpy as np
import pytest

from netspec.data import resize
from netspec.data.resize import fixed_point, resized

# Of OpenCV 5.0 on x86-64.
DIGEST = "a90bdcd76e786f99"
SIZES = [(31, 47), (13, 17), (26, 34), (64, 48), (1, 5), (90, 7)]


def image(height: int, width: int, *channels: int) -> np.ndarray:
    count = int(np.prod([height, width, *channels]))
    return (np.random.Philox(count).random_raw(count) >> 56).astype(np.uint8).reshape(height, width, *channels)


def pairs() -> list[tuple[np.ndarray, tuple[int, int]]]:
    return [(image(*before, *c), after) for c in ((), (3,), (4,)) for before in SIZES for after in SIZES]


def test_the_pixels_are_those_of_opencv_on_x86() -> None:
    found = hashlib.sha256(b"".join(fixed_point(before, *after).tobytes() for before, after in pairs()))
    assert found.hexdigest()[:16] == DIGEST


@pytest.mark.skipif(not resize._is_caffes(), reason="this OpenCV computes other pixels")
def test_this_opencv_computes_the_same() -> None:
    for before, (height, width) in pairs():
        np.testing.assert_array_equal(fixed_point(before, height, width), cv2.resize(before, (width, height)))


def test_another_opencv_is_not_used(monkeypatch: pytest.MonkeyPatch) -> None:
    own = cv2.resize

    def other(pixels: np.ndarray, size: tuple[int, int], interpolation: int) -> np.ndarray:
        return np.bitwise_xor(own(pixels, size, interpolation=interpolation), 1)

    gray, floats = image(31, 47), np.ones((4, 4), np.float32)
    expected = resized(gray, 13, 17)
    monkeypatch.setattr(resize, "_is_caffes", resize._is_caffes.__wrapped__)
    monkeypatch.setattr(cv2, "resize", other)
    np.testing.assert_array_equal(resized(gray, 13, 17), expected)
    monkeypatch.setattr(cv2, "resize", own)
    np.testing.assert_array_equal(resized(floats, 2, 2), floats[:2, :2])

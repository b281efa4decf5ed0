"""Resizing of images to the pixels that Caffe's OpenCV computes, on every CPU.

OpenCV for ARM64 has another bilinear resizing, whose pixels differ by up to four gray levels. Where they differ, NumPy
computes them here, in the fixed-point arithmetic of OpenCV on x86-64.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from netspec.files.opencv import cv2

_ONE = 2048  # the weight 1: OpenCV rounds weights to 11 bits (INTER_RESIZE_COEF_BITS)
_TRIED = (((31, 47), (13, 17)), ((24, 32), (12, 16)), ((9, 11), (20, 33)))  # sizes (height, width) before and after


def resized(pixels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return an image (H, W) or (H, W, C) resized bilinearly, without low-pass filtering (cv::resize, INTER_LINEAR).

    For uint8 images of 1, 3 or 4 channels, the pixels are those of OpenCV on x86-64; for others, those of this OpenCV.
    Raises cv2.error or MemoryError for sizes that are too large.
    """
    channels = pixels.shape[2] if pixels.ndim == 3 else 1
    if pixels.dtype != np.uint8 or channels not in (1, 3, 4) or _is_caffes():
        return cv2.resize(pixels, (width, height), interpolation=cv2.INTER_LINEAR)
    return fixed_point(pixels, height, width)


@cache
def _is_caffes() -> bool:
    """Return whether this OpenCV computes the pixels of :func:`fixed_point`."""
    for channels in ((), (3,)):
        for before, (height, width) in _TRIED:
            count = int(np.prod([*before, *channels]))
            image = (
                (np.arange(count) * 2654435761 >> 13 & 255).astype(np.uint8).reshape(*before, *channels)
            )  # any values
            own = cv2.resize(image, (width, height), interpolation=cv2.INTER_LINEAR)
            if not np.array_equal(own, fixed_point(image, height, width)):
                return False
    return True


def fixed_point(pixels: np.ndarray, height: int, width: int) -> np.ndarray:
    """Resize a uint8 image (H, W) or (H, W, C) with OpenCV's integer arithmetic.

    OpenCV: modules/imgproc/src/resize.cpp (HResizeLinear, VResizeLinear, ResizeAreaFast)
    """
    rows, columns = pixels.shape[:2]
    if (rows, columns) == (height, width):
        return pixels.copy()
    image = pixels.reshape(rows, columns, -1).astype(np.int32)
    if (rows, columns) == (2 * height, 2 * width):  # OpenCV takes means of four pixels
        sums = image[::2, ::2] + image[::2, 1::2] + image[1::2, ::2] + image[1::2, 1::2]
        found = (sums + 2) >> 2
    else:
        left, right, of_left, of_right = _neighbors(columns, width)
        wide = image[:, left] * of_left[:, None] + image[:, right] * of_right[:, None]
        above, below, of_above, of_below = _neighbors(rows, height)
        found = (of_above[:, None, None] * (wide[above] >> 4)) >> 16
        found += (of_below[:, None, None] * (wide[below] >> 4)) >> 16
        found = (found + 2) >> 2
    return found.astype(np.uint8).reshape(height, width, *pixels.shape[2:])


def _neighbors(old: int, new: int) -> tuple[np.ndarray, ...]:
    """Return for each of ``new`` pixels along an axis its two neighbors among ``old`` ones, and their weights."""
    scale = 1 / (new / old)  # not old / new, which can be rounded otherwise
    place = ((np.arange(new) + 0.5) * scale - 0.5).astype(np.float32)
    first = np.floor(place)
    share = place - first
    weights = [np.rint(part * np.float32(_ONE)).astype(np.int32) for part in (1 - share, share)]
    near = first.astype(np.intp)
    return near.clip(0, old - 1), (near + 1).clip(0, old - 1), *weights

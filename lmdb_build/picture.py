"""Pictures in perspective, and pictures as files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from loopclosure.places.frames import DEPTH_PER_M, write_picture
from netspec.files.opencv import cv2

JPEG_QUALITY = 95
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)  # of a picture of size 1: x, y, clockwise


def seen_through(
    image: NDArray, quad: NDArray, corners: NDArray, size: tuple[int, int], border: int = cv2.BORDER_REFLECT
) -> NDArray:
    """Return a part of an image (H, W, 3) in perspective: a picture of ``size`` (width, height).

    ``quad`` (4, 2) are the pixels x, y of the image that come to ``corners`` (4, 2) of the picture; ``border`` is
    OpenCV's mode for what lies outside of the image.
    """
    homography = cv2.getPerspectiveTransform(quad.astype(np.float32), corners.astype(np.float32))
    return cv2.warpPerspective(image, homography, size, borderMode=border)


def write_jpeg(path: Path, picture: NDArray) -> None:
    """Write a picture (H, W, 3) uint8, BGR, as JPEG. Raises InputError where it cannot be written."""
    write_picture(path, picture, cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)


def write_depth(path: Path, depth: NDArray) -> None:
    """Write depth (H, W) in meters as TUM RGB-D does: PNG, 16 bits, 5000 per meter, 0 for not known or 13.1 m and more.

    Raises InputError where it cannot be written.
    """
    steps = np.rint(depth * DEPTH_PER_M)
    write_picture(path, np.where(steps < 1 << 16, steps, 0).astype(np.uint16))

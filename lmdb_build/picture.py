"""Files of images and of depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from loopclosure.places.frames import DEPTH_PER_M, write_picture
from netspec.files.opencv import cv2

JPEG_QUALITY = 95


def write_jpeg(path: Path, picture: NDArray) -> None:
    """Write a picture (H, W, 3) uint8, BGR, as JPEG. Raises InputError if it cannot be written."""
    write_picture(path, picture, cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)


def write_depth(path: Path, depth: NDArray) -> None:
    """Write depth (H, W) in meters in TUM RGB-D's format: PNG, 16 bits, 5000 per meter.

    Depth that is not known or above 13.1 m is written as 0. Raises InputError if the file cannot be written.
    """
    steps = np.rint(depth * DEPTH_PER_M)
    write_picture(path, np.where(steps < 1 << 16, steps, 0).astype(np.uint16))

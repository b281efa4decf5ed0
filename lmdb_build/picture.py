"""Perspective transforms, image files, and warped copies of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from loopclosure.places.frames import DEPTH_PER_M, read_bgr, write_picture
from netspec.files.opencv import cv2

JPEG_QUALITY = 95
CORNERS = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float64)  # of a picture of size 1: x, y, clockwise


def seen_through(
    image: NDArray, quad: NDArray, corners: NDArray, size: tuple[int, int], border: int = cv2.BORDER_REFLECT
) -> NDArray:
    """Return a perspective view of a part of an image (H, W, 3), of ``size`` (width, height).

    The pixels ``quad`` (4, 2), x and y, of the image are mapped to ``corners`` (4, 2) of the result. ``border`` is
    OpenCV's mode for pixels outside the image.
    """
    homography = cv2.getPerspectiveTransform(quad.astype(np.float32), corners.astype(np.float32))
    return cv2.warpPerspective(image, homography, size, borderMode=border)


def write_jpeg(path: Path, picture: NDArray) -> None:
    """Write a picture (H, W, 3) uint8, BGR, as JPEG. Raises InputError if it cannot be written."""
    write_picture(path, picture, cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY)


def write_depth(path: Path, depth: NDArray) -> None:
    """Write depth (H, W) in meters in TUM RGB-D's format: PNG, 16 bits, 5000 per meter.

    Depth that is not known or above 13.1 m is written as 0. Raises InputError if the file cannot be written.
    """
    steps = np.rint(depth * DEPTH_PER_M)
    write_picture(path, np.where(steps < 1 << 16, steps, 0).astype(np.uint16))


# Each corner of the crop is moved inward by up to this share of the picture's width and height. This crops, scales (to
# at least 0.6), shifts, rotates and changes the perspective, without a black border.
LARGEST_INSET = 0.2
GAIN = (0.6, 1.4)
GAMMA = (0.7, 1.4)
TINT = 0.08  # the gain of each color channel also varies by this much


def warp(image: NDArray, rng: np.random.Generator) -> NDArray:
    """Return the image (H, W, 3) uint8, at the same size, as a nearby camera might see it in different light."""
    height, width = image.shape[:2]
    inset = rng.uniform(0, LARGEST_INSET, (4, 2))
    whole = CORNERS * [width - 1, height - 1]
    quad = (CORNERS + inset * (1 - 2 * CORNERS)) * [width - 1, height - 1]
    seen = seen_through(image, quad, whole, (width, height), cv2.BORDER_REPLICATE)
    gain = rng.uniform(*GAIN) * rng.uniform(1 - TINT, 1 + TINT, 3)
    levels = np.linspace(0, 1, 256)[:, None] ** rng.uniform(*GAMMA) * gain
    table = np.clip(np.round(255 * levels), 0, 255).astype(np.uint8)
    return cv2.LUT(seen, table[None])


def write_warped(source: Path, target: Path, rng: np.random.Generator) -> None:
    """Write a warped copy of an image file. Raises InputError if the files cannot be read or written."""
    picture = warp(read_bgr(source), rng)
    target.parent.mkdir(parents=True, exist_ok=True)
    write_jpeg(target, picture)

"""Pairs made by warping one image: another view of a place that was seen only once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lmdb_build.picture import CORNERS, seen_through, write_jpeg
from loopclosure.places.frames import read_bgr
from netspec.files.opencv import cv2

# Each corner of the crop is moved inward by up to this share of the picture's width and height. That crops, scales (to
# at least 0.6), shifts, rotates and changes the perspective, without a black border.
LARGEST_INSET = 0.2
GAIN = (0.6, 1.4)
GAMMA = (0.7, 1.4)
TINT = 0.08  # the gain of each color channel also varies by this much


def warp(image: NDArray, rng: np.random.Generator) -> NDArray:
    """Return the image (H, W, 3) uint8, at the same size, as a nearby camera might see it in other light."""
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

"""The depth of an image at points of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from loopclosure.places.frames import DEPTH_PER_M, read_depth
from netspec.files.opencv import cv2

# Neighboring pixels are on the same surface if their depths differ by less than this factor.
ONE_SURFACE = 1.05


def read_depths(path: Path, points: np.ndarray, size: tuple[int, int], per_m: float = DEPTH_PER_M) -> np.ndarray:
    """Read the depth (N,) in meters at pixels (N, 2) of an image of ``size`` (width, height), 0 where not known.

    The depth image may have another size; its values are ``per_m`` for a meter. Raises InputError if it cannot be read.
    """
    depth = read_depth(path, per_m).astype(np.float32)
    return depth_at(cv2.resize(depth, size, interpolation=cv2.INTER_NEAREST), points)


def depth_at(depth: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the depth (N,) at pixels (N, 2); 0 where it is not known or at the edge of a surface."""
    height, width = depth.shape
    at = np.rint(points).astype(np.intp)
    at = at[:, 1].clip(0, height - 1), at[:, 0].clip(0, width - 1)
    around = np.ones((3, 3), np.uint8)
    low, high = cv2.erode(depth, around)[at], cv2.dilate(depth, around)[at]
    return np.where((low > 0) & (high < ONE_SURFACE * low), depth[at], 0)

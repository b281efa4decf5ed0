"""Region proposals of Faster R-CNN: anchors, moved by the predicted offsets, of which the best are kept.

A box is (x1, y1, x2, y2) in pixels of the image, both corners included. Arrays are float32.
Forks: Intel's caffe and PVANet, src/caffe/layers/proposal_layer.cpp; the Python layer of py-faster-rcnn
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

Array = np.ndarray


def half_up(number: float) -> float:
    """Round a number as C++ does; NumPy rounds halves to even ones."""
    return math.floor(number + 0.5)


def base_anchors(
    base_size: int,
    ratios: Sequence[float],
    scales: Sequence[float],
    rounded: Callable[[float], float] = np.round,
) -> Array:
    """Return the boxes (R S, 4) around the first pixel of the map, for each ratio and each scale.

    A ratio is height / width; sides are rounded to pixels before they are scaled.
    """
    center = (base_size - 1) / 2
    anchors = []
    for ratio in ratios:
        width = rounded(math.sqrt(base_size * base_size / ratio))
        height = rounded(width * ratio)
        for scale in scales:
            x, y = (width * scale - 1) / 2, (height * scale - 1) / 2
            anchors.append([center - x, center - y, center + x, center + y])
    return np.array(anchors, np.float32)


def all_anchors(base: Array, stride: int, height: int, width: int) -> Array:
    """Return the anchors of all pixels of a map, in row-major order: (height width A, 4)."""
    y, x = np.meshgrid(np.arange(height), np.arange(width), indexing="ij")
    shifts = np.stack([x, y, x, y], axis=2).reshape(-1, 1, 4) * stride
    return (shifts + base).reshape(-1, 4).astype(np.float32)


def moved(anchors: Array, deltas: Array, height: float, width: float) -> Array:
    """Return the anchors (n, 4) moved and scaled by the deltas (dx, dy, log dw, log dh), clipped to the image."""
    sizes = anchors[:, 2:] - anchors[:, :2] + 1
    centers = anchors[:, :2] + sizes / 2 + deltas[:, :2] * sizes
    halves = np.exp(deltas[:, 2:]) * sizes / 2
    boxes = np.concatenate([centers - halves, centers + halves], axis=1)
    return np.clip(boxes, 0, np.array([width - 1, height - 1] * 2, np.float32)).astype(np.float32)


def suppress(boxes: Array, threshold: float, most: int) -> list[int]:
    """Return the first ``most`` boxes (n, 4), in this order, that overlap no kept box by more than the threshold."""
    left, rows = np.arange(len(boxes)), np.ascontiguousarray(boxes.T)  # contiguous rows of x1, y1, x2 and y2
    areas = (rows[2] - rows[0] + 1) * (rows[3] - rows[1] + 1)
    kept: list[int] = []
    while len(left) and len(kept) < most:
        kept.append(int(left[0]))
        x1, y1, x2, y2 = rows[:, 1:]
        width = np.minimum(rows[2, 0], x2) - np.maximum(rows[0, 0], x1) + 1
        height = np.minimum(rows[3, 0], y2) - np.maximum(rows[1, 0], y1) + 1
        shared = np.maximum(width, 0) * np.maximum(height, 0)
        far = np.flatnonzero(shared / (areas[0] + areas[1:] - shared) <= np.float32(threshold)) + 1
        left, rows, areas = left[far], rows[:, far], areas[far]
    return kept

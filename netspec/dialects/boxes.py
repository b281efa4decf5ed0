"""Functions for the boxes of SSD's layers: overlap, encoding, matching and suppression.

A box is (xmin, ymin, xmax, ymax), relative to the image, so 0 to 1 inside it. Arrays are float32, as in the fork.
Fork: weiliu89/caffe (ssd), src/caffe/util/bbox_util.cpp
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch

from netspec.layers.contract.base import Layer, Shape

Array = np.ndarray

CORNER, CENTER_SIZE, CORNER_SIZE = 1, 2, 3  # ssd.py: enum PriorBoxParameter.CodeType
NO_MATCH, LEFT_OUT = -1, -2  # special values instead of the index of a matched box
LEAST_OVERLAP = 1e-6  # smaller overlaps count as none
LEAST_SIZE = 1e-5  # suppress_all ignores smaller boxes
BLOCK = 32  # boxes that are compared with all others at once


def as_array(tensor: torch.Tensor) -> Array:
    """Return the values of a tensor."""
    return tensor.detach().cpu().float().numpy()


def check_predictions(layer: Layer, bottom_shapes: Sequence[Shape], kinds: int, classes: int) -> int:
    """Return the number of priors. Raise SpecError if the sizes of boxes or confidences do not match it.

    The bottoms are boxes, confidences and priors. There are ``kinds`` boxes for each prior.
    """
    loc, conf, prior = bottom_shapes[:3]
    if prior[:2] != (1, 2) or math.prod(prior) % 8:
        raise layer.error(f"found priors of shape {prior}, expected (1, 2, 4 P)", "bottom", 2)
    priors = math.prod(prior) // 8
    for i, (shape, each, what) in enumerate(((loc, 4 * kinds, "numbers of boxes"), (conf, classes, "confidences"))):
        if math.prod(shape[1:]) != priors * each or shape[:1] != loc[:1]:
            message = f"found {what} of shape {shape}, expected (N, {priors * each}) for {priors} priors"
            raise layer.error(message, "bottom", i)
    return priors


# An untrained net can predict unbounded boxes: areas are infinite, and overlaps are NaN, as in C++.


@np.errstate(over="ignore", invalid="ignore")
def sizes(boxes: Array) -> Array:
    """Return the areas of boxes (..., 4): (...); 0 if xmax < xmin or ymax < ymin."""
    width, height = boxes[..., 2] - boxes[..., 0], boxes[..., 3] - boxes[..., 1]
    return np.where((width < 0) | (height < 0), np.float32(0), width * height)


@np.errstate(over="ignore", invalid="ignore")
def shared(first: Array, second: Array) -> Array:
    """Return the intersection areas of each pair of boxes (..., 4), broadcast against each other."""
    low = np.maximum(first[..., :2], second[..., :2])
    high = np.minimum(first[..., 2:], second[..., 2:])
    width, height = high[..., 0] - low[..., 0], high[..., 1] - low[..., 1]
    return np.where((width > 0) & (height > 0), width * height, np.float32(0))


@np.errstate(invalid="ignore")
def overlaps(first: Array, second: Array) -> Array:
    """Return the intersection over union of each pair of boxes (..., 4), broadcast against each other."""
    common = shared(first, second)
    union = sizes(first) + sizes(second) - common
    return np.divide(common, union, out=np.zeros_like(common), where=common > 0)


def coverage(first: Array, second: Array) -> Array:
    """Return the share of the first box of each pair (..., 4) that is inside the second."""
    common = shared(first, second)
    area = np.broadcast_to(sizes(first), common.shape)
    return np.divide(common, area, out=np.zeros_like(common), where=common > 0)


def encode(boxes: Array, priors: Array, variances: Array | None, code: int) -> Array:
    """Return boxes (n, 4) relative to their priors (n, 4), divided by the variances (n, 4) unless None."""
    (low, high), (extent, center) = _corners(priors), _centers(priors)
    box_low, box_high = _corners(boxes)
    if code == CENTER_SIZE:
        box_extent, box_center = _centers(boxes)
        codes = np.concatenate([(box_center - center) / extent, np.log(box_extent / extent)], axis=1)
    else:
        scale = extent if code == CORNER_SIZE else np.float32(1)
        codes = np.concatenate([(box_low - low) / scale, (box_high - high) / scale], axis=1)
    return codes if variances is None else codes / variances


@np.errstate(over="ignore", invalid="ignore")
def decode(codes: Array, priors: Array, variances: Array | None, code: int) -> Array:
    """Return the boxes (n, 4) whose :func:`encode` is ``codes``."""
    (low, high), (extent, center) = _corners(priors), _centers(priors)
    if variances is not None:
        codes = codes * variances
    first, second = _corners(codes)
    if code == CENTER_SIZE:
        return around(first * extent + center, np.exp(second) * extent)
    scale = extent if code == CORNER_SIZE else np.float32(1)
    return np.concatenate([low + first * scale, high + second * scale], axis=1)


def _corners(boxes: Array) -> tuple[Array, Array]:
    return boxes[:, :2], boxes[:, 2:]


def _centers(boxes: Array) -> tuple[Array, Array]:
    low, high = _corners(boxes)
    return high - low, (low + high) / np.float32(2)


def around(centers: Array, extents: Array) -> Array:
    """Return boxes (..., 4) with these sizes (..., 2) around these points (..., 2)."""
    half = extents / np.float32(2)
    return np.concatenate([centers - half, centers + half], axis=-1)


def sigmoid(x: Array) -> Array:
    """Return 1 / (1 + exp(-x))."""
    return 1 / (1 + np.exp(-x))


def outside(boxes: Array) -> Array:
    """Return which coordinates of boxes (..., 4) are outside the image."""
    return (boxes < 0) | (boxes > 1)


def match(boxes: Array, truth: Array, threshold: float | None, leave_out: Array) -> tuple[Array, Array]:
    """Match boxes (p, 4) with true ones (g, 4); return the true index, NO_MATCH or LEFT_OUT, and the largest overlaps.

    First match the pairs with the largest overlap, using each box and each true box once. Then, with a threshold, match
    every other box to the true box it overlaps most, if the overlap is large enough. ``leave_out`` (p,) excludes boxes.
    """
    found = np.where(leave_out, LEFT_OUT, NO_MATCH)
    table = overlaps(boxes[:, None], truth[None])
    table = np.where((table > LEAST_OVERLAP) & ~leave_out[:, None], table, np.float32(0))
    best = table.max(axis=1, initial=0)
    free = table.copy()
    for _ in range(len(truth)):
        box, true = np.unravel_index(free.argmax(), free.shape)
        if free[box, true] == 0:
            break
        found[box] = true
        free[box], free[:, true] = 0, 0
    if threshold is not None and len(truth):
        extra = (found == NO_MATCH) & (best >= threshold) & (best > 0)
        found[extra] = table[extra].argmax(axis=1)
    return found, best


def suppress(boxes: Array, threshold: float, eta: float = 1.0) -> list[int]:
    """Return which boxes (n, 4) to keep: in this order, those that overlap no kept box by more than the threshold.

    If ``eta`` is below 1, the threshold is multiplied by it after each kept box, as long as it is above 0.5.
    """
    limit = np.float32(threshold)
    kept: list[int] = []
    left, most = np.arange(len(boxes)), np.zeros(len(boxes), np.float32)
    while len(left):  # a block of rows costs little more than one row
        table = overlaps(boxes[left[:BLOCK], None], boxes[left])
        for row, covered in enumerate(table):
            if most[row] > limit:
                continue
            kept.append(int(left[row]))
            most = np.maximum(most, covered)
            if eta < 1 and limit > 0.5:
                limit *= np.float32(eta)
        stay = ~(most[BLOCK:] > limit)
        left, most = left[BLOCK:][stay], most[BLOCK:][stay]
    return kept


def highest(scores: Array, count: int) -> Array:
    """Return the indices of the ``count`` highest scores (n,), in the fork's order.

    The fork sorts with libstdc++'s std::sort, which is not stable: the order of equal scores depends on its
    partitions. They are reproduced if there are equal scores among the highest ones or at the limit.
    """
    order = np.argsort(-scores, kind="stable")
    top = scores[order[: count + 1]]
    if (top[1:] == top[:-1]).any() and not np.isnan(scores).any():
        order = np.array(_introsorted((-scores).tolist()))
    return order[:count]


def _introsorted(keys: list[float]) -> list[int]:
    """Return the order of keys in introsort, ascending.

    Ranges of more than 16 are partitioned around the median of three; insertion sort, which is stable, does the rest.
    The heap sort after 2 log2(n) bad partitions in a row is not implemented.
    """
    order, ranges = list(range(len(keys))), [(0, len(keys))]
    while ranges:
        first, last = ranges.pop()
        while last - first > 16:
            cut = _partition(keys, order, first, last)
            ranges.append((cut, last))
            last = cut
    return sorted(order, key=keys.__getitem__)


def _partition(keys: list[float], order: list[int], first: int, last: int) -> int:
    """Move keys below the median of three to the front of a range; return the start of the rest."""
    middle = first + (last - first) // 2
    # Choose among equal keys as std::__move_median_to_first does.
    a, b, c = first + 1, middle, last - 1
    ka, kb, kc = keys[order[a]], keys[order[b]], keys[order[c]]
    if ka < kb:
        median = b if kb < kc else c if ka < kc else a
    else:
        median = a if ka < kc else c if kb < kc else b
    order[first], order[median] = order[median], order[first]
    pivot, low, high = keys[order[first]], first + 1, last
    while True:
        while keys[order[low]] < pivot:
            low += 1
        high -= 1
        while pivot < keys[order[high]]:
            high -= 1
        if low >= high:
            return low
        order[low], order[high] = order[high], order[low]
        low += 1


def suppress_all(boxes: Array, scores: Array, threshold: float, top_k: int) -> Array:
    """Return the indices of the boxes that :func:`suppress` keeps among the ``top_k`` highest scores (-1: all)."""
    order = np.argsort(-scores, kind="stable")
    order = order[: top_k if top_k > -1 else None]
    order = order[sizes(boxes[order]) >= LEAST_SIZE]
    return order[suppress(boxes[order], threshold)]


def detections(rows: Sequence[Array], like: torch.Tensor) -> torch.Tensor:
    """Return the detections (d, 7) of all images as a top (1, 1, D, 7); without any, one row (image, -1, ...) each."""
    found = np.concatenate(rows)
    if not len(found):
        found = np.full((len(rows), 7), -1, np.float32)
        found[:, 0] = np.arange(len(rows))
    return torch.from_numpy(found[None, None]).to(like)

"""Hard negatives: pairs of different places whose features, by some net, are near each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lmdb_build.pairs.choose import NEGATIVE, Indices, PairSource
from loopclosure.descriptors.similarity import squared_distances

# How many nearest images of each image are examined: in a video the first hundreds may be neighbors in time.
DEEPEST = 512
ROWS_AT_ONCE = 512


def hard_negatives(source: PairSource, images: Indices, features: NDArray[np.floating], wanted: int) -> Indices:
    """Choose up to ``wanted`` negative pairs (n, 2) of ``images`` (m,) whose ``features`` (m, D) are nearest.

    Every image's nearest negative comes first, then every image's second nearest, and so on, each time with the nearer
    pairs first. So the pairs are of all places, and not only of the place that the net knows least.
    """
    count = len(images)
    depth = min(DEEPEST, count - 1)
    if wanted <= 0 or depth < 1:
        return np.zeros((0, 2), np.intp)
    features = features.astype(np.float64)
    squares = (features**2).sum(axis=1)
    keep = 2 * -(-wanted // count) + 2  # of each image; both images of a pair may find it
    parts = []
    for start in range(0, count, ROWS_AT_ONCE):
        rows = np.arange(start, min(start + ROWS_AT_ONCE, count))
        distances = squared_distances(features[rows], features, squares[rows, None], squares)
        distances[np.arange(len(rows)), rows] = np.inf
        nearest = np.argpartition(distances, depth - 1, axis=1)[:, :depth]
        near = np.take_along_axis(distances, nearest, axis=1)
        order = np.argsort(near, axis=1, kind="stable")
        nearest, near = np.take_along_axis(nearest, order, axis=1), np.take_along_axis(near, order, axis=1)
        first = np.repeat(rows, depth)
        negative = source.judge(images[first], images[nearest.ravel()]).reshape(nearest.shape) == NEGATIVE
        rank = np.cumsum(negative, axis=1)
        row, column = np.nonzero(negative & (rank <= keep))
        parts.append(np.column_stack([rank[row, column], near[row, column], rows[row], nearest[row, column]]))
    table = np.concatenate(parts)
    table = table[np.lexsort((table[:, 1], table[:, 0]))]
    pairs = np.sort(table[:, 2:].astype(np.intp), axis=1)
    _, at = np.unique(pairs @ np.array([count, 1]), return_index=True)
    return images[pairs[np.sort(at)][:wanted]]

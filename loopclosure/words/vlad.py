"""VLAD: how the local features of an image differ from their words (Jegou, Douze, Schmid and Perez, CVPR 2010)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from loopclosure.words.vocabulary import Vocabulary


def vlad(descriptors: NDArray[np.float32], vocabulary: Vocabulary) -> NDArray[np.float32]:
    """Return the sums of differences between descriptors (n, d) and their nearest words, (words d,), of unit length.

    The sum of each word has unit length too (Arandjelovic and Zisserman, CVPR 2013), so that repeated texture does not
    dominate. Without descriptors all are 0.
    """
    centers = vocabulary.centers
    sums = np.zeros(centers.shape, np.float32)
    nearest = vocabulary.nearest(descriptors)
    np.add.at(sums, nearest, descriptors - centers[nearest])
    lengths = np.linalg.norm(sums, axis=1, keepdims=True)
    sums = np.divide(sums, lengths, out=np.zeros_like(sums), where=lengths > 1e-6)
    whole = np.linalg.norm(sums)
    if whole > 0:
        sums /= whole
    return sums.reshape(-1)

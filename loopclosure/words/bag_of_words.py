"""Bag of words: tf-idf histograms of visual words (Sivic and Zisserman, ICCV 2003; DBoW2); and VLAD."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.distance import cdist

from loopclosure.errors import InputError
from loopclosure.words.vocabulary import Vocabulary

METRICS = ("l1", "cosine")


@dataclass(frozen=True)
class BagOfWords:
    """Images as weighted histograms of words, and their similarity.

    idf     (v,) weight of each word: ln(images / images that have the word)
    metric  "l1", DBoW2's score: 1 - |a/|a| - b/|b|| / 2 with sums of absolute values; or "cosine"
    """

    idf: np.ndarray
    metric: str = "l1"

    def __post_init__(self) -> None:
        check_metric(self.metric)

    @classmethod
    def learn(cls, words: np.ndarray, metric: str = "l1") -> BagOfWords:
        """Weight words by how rare they are among the training images' words (n, v).

        A word that is in no training image is treated as if it were in one.
        """
        having = (np.asarray(words) > 0).sum(axis=0)
        return cls(np.log(max(len(words), 1) / np.maximum(having, 1)), metric)

    def vectors(self, words: np.ndarray) -> np.ndarray:
        """Return the weighted histograms (n, v) of counts (n, v), of unit length (L1, or L2 for cosine).

        An image without words of positive weight gets zeros, and is similar to nothing.
        """
        weighted = np.asarray(words) * self.idf
        length = np.linalg.norm(weighted, ord=2 if self.metric == "cosine" else 1, axis=1, keepdims=True)
        return np.divide(weighted, length, out=np.zeros_like(weighted), where=length > 0)

    def similarity(self, queries: np.ndarray, references: np.ndarray) -> np.ndarray:
        """Return the similarity of images by their words (Q, v) and (R, v): (Q, R) in [0, 1], 1 for equal shares."""
        a, b = self.vectors(queries), self.vectors(references)
        if self.metric == "cosine":
            return a @ b.T
        # |a - b| = |a| + |b| - 2 sum(min(a, b)), and the lengths are 1, or 0 for images without words.
        return (a.sum(axis=1)[:, None] + b.sum(axis=1)[None, :] - cdist(a, b, "cityblock")) / 2.0


def check_metric(metric: str) -> None:
    """Raise InputError for an unknown metric."""
    if metric not in METRICS:
        raise InputError(f'unknown metric "{metric}" of the bag of words; known: {", ".join(METRICS)}')


def vlad(descriptors: NDArray[np.float32], vocabulary: Vocabulary) -> NDArray[np.float32]:
    """Return the sums of differences between descriptors (n, d) and their nearest words, (words d,), of unit length.

    The sum of each word is normalized too (Arandjelovic and Zisserman, CVPR 2013), so that repeated texture does not
    dominate. Without descriptors, the result is 0.
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

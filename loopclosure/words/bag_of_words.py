"""Bag of words: tf-idf histograms of visual words (Sivic and Zisserman, ICCV 2003; DBoW2)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.distance import cdist

from loopclosure.errors import InputError

METRICS = ("l1", "cosine")


@dataclass(frozen=True)
class BagOfWords:
    """Images as weighted histograms of words, and their similarity.

    idf     (v,) weight of each word: ln(images / images that have the word)
    metric  "l1", DBoW2's score: 1 - |a/|a| - b/|b|| / 2 with sums of absolute values; or "cosine"
    """

    idf: np.ndarray
    metric: str = "l1"

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

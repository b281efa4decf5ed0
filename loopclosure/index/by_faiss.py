"""FAISS: rows in half precision, and signs that say which of them are worth comparing. For long drives.

The signs are those of the strongest principal directions, turned at random, learned from the first rows (Douze et al.,
"The Faiss library", 2024, has the parts: PCA, LSH, refinement). All signs are compared, and of the rows only the most
promising. Adding costs as much whatever the number of rows, and nothing is built when a map is opened.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

LEARNED_FROM = 4096  # rows; up to so many all are compared
BITS = 256
EXAMINED = 1000  # rows, the most promising by their signs


class FaissIndex:
    """See :class:`loopclosure.index.index.Index`."""

    def __init__(self, metric: str) -> None:
        self._faiss = import_module("faiss")  # optional, and without types
        self._metric = metric
        self._rows: Any = None
        self._signs: Any = None

    def __len__(self) -> int:
        return 0 if self._rows is None else self._rows.ntotal

    def add(self, rows: np.ndarray) -> None:
        """See :class:`~loopclosure.index.index.Index`."""
        faiss, size = self._faiss, rows.shape[1]
        rows = np.ascontiguousarray(rows, np.float32)
        if self._rows is None:
            kind = faiss.METRIC_INNER_PRODUCT if self._metric == "cosine" else faiss.METRIC_L2
            self._rows = faiss.IndexScalarQuantizer(size, faiss.ScalarQuantizer.QT_fp16, kind)
        self._rows.add(rows)
        if self._signs is not None:
            self._signs.add(rows)
        elif len(self) >= LEARNED_FROM:
            self._learn(size)

    def _learn(self, size: int) -> None:
        faiss, bits = self._faiss, min(BITS, size)
        lsh = faiss.IndexLSH(bits, bits, True, True)
        self._signs = faiss.IndexPreTransform(faiss.PCAMatrix(size, bits), lsh)
        self._signs.metric_type = self._rows.metric_type  # that of what it helps; signs themselves differ in number
        known = self.rows(0, len(self))
        self._signs.train(known[:: max(1, len(known) // LEARNED_FROM)])
        self._signs.add(known)

    def search(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`~loopclosure.index.index.Index`."""
        query, k = np.ascontiguousarray(row[None], np.float32), min(k, len(self))
        if self._signs is None:
            scores, numbers = self._rows.search(query, k)
        else:
            two_steps = self._faiss.IndexRefine(self._signs, self._rows)
            examined = self._faiss.IndexRefineSearchParameters(k_factor=max(1.0, EXAMINED / k))
            scores, numbers = two_steps.search(query, k, params=examined)
        scores = scores[0] if self._metric == "cosine" else -np.sqrt(np.maximum(scores[0], 0))
        return numbers[0], scores

    def rows(self, start: int, stop: int) -> np.ndarray:
        """See :class:`~loopclosure.index.index.Index`."""
        return self._rows.reconstruct_n(start, stop - start)

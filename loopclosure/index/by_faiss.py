"""An approximate index with FAISS, for long drives: binary codes preselect the rows to compare.

Rows are stored in half precision. A code has the signs of a row's strongest principal components after a random
rotation, learned from the first rows (PCA, LSH and refinement: Douze et al., "The Faiss library", 2024). A search
compares all codes, and then only the rows with the best codes. The cost of adding a row does not depend on the number
of rows, and opening a map needs no index to be built.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

LEARNED_FROM = 4096  # rows; with fewer, all rows are compared
BITS = 256
EXAMINED = 1000  # rows compared after the preselection


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
        self._signs.metric_type = self._rows.metric_type  # IndexRefine expects the metric of the rows
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

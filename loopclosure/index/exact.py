"""An exact index in memory: 4 D bytes per descriptor, all of them read in every search."""

from __future__ import annotations

import numpy as np

from loopclosure.descriptors.similarity import squared_distances

FIRST_CAPACITY = 256  # descriptors; doubled when full


class ExactIndex:
    """See :class:`loopclosure.index.index.Index`."""

    def __init__(self, metric: str) -> None:
        self._metric = metric
        self._count = 0
        self._rows = np.zeros((0, 0), np.float32)
        self._squares = np.zeros(0, np.float32)

    def __len__(self) -> int:
        return self._count

    def add(self, rows: np.ndarray) -> None:
        """See :class:`~loopclosure.index.index.Index`."""
        end = self._count + len(rows)
        if end > len(self._rows):
            added = np.empty((max(FIRST_CAPACITY, end - len(self._rows), len(self._rows)), rows.shape[1]), np.float32)
            self._rows = np.concatenate([self._rows, added]) if self._count else added
            self._squares = np.append(self._squares, added[:, 0])
        self._rows[self._count : end] = rows
        self._squares[self._count : end] = np.square(rows).sum(axis=1)
        self._count = end

    def search(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`~loopclosure.index.index.Index`; of equal scores, the earlier one comes first."""
        rows = self.rows(0, self._count)
        if self._metric == "cosine":
            scores = rows @ row
        else:  # squared distances have the same order
            scores = -squared_distances(rows, row[None], self._squares[: self._count, None], np.zeros(1))[:, 0]
        k = min(k, self._count)
        best = np.argpartition(scores, self._count - k)[self._count - k :]
        # The product is fast but inaccurate for small distances, so the k returned scores are computed directly.
        values = scores[best] if self._metric == "cosine" else -np.linalg.norm(rows[best] - row, axis=1)
        order = np.lexsort((best, -values))
        return best[order], values[order]

    def rows(self, start: int, stop: int) -> np.ndarray:
        """See :class:`~loopclosure.index.index.Index`."""
        return self._rows[start:stop]

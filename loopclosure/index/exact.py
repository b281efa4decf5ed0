"""An exact index: 4 D bytes per descriptor, all of them read in every search."""

from __future__ import annotations

from tempfile import TemporaryFile

import numpy as np

from loopclosure.descriptors.similarity import squared_distances

BLOCK = 256  # descriptors, which are stored and multiplied at a time


class ExactIndex:
    """See :class:`loopclosure.index.index.Index`.

    metric     "euclidean" or "cosine"
    in_memory  keep about this many descriptors in memory, and the others in a temporary file, which the system reads
               through its cache; None: all of them
    """

    def __init__(self, metric: str, in_memory: int | None = None) -> None:
        self._metric, self._in_memory = metric, in_memory
        self._count = 0
        self._blocks: list[np.ndarray] = []  # (BLOCK, D) each; the last one may have room
        self._squares: list[np.ndarray] = []  # (BLOCK,) of each block
        self._on_disk = 0  # blocks; they are the first ones
        self._file = None if in_memory is None else TemporaryFile(prefix="loopclosure-")  # noqa: SIM115

    def __len__(self) -> int:
        return self._count

    def add(self, rows: np.ndarray) -> None:
        """See :class:`~loopclosure.index.index.Index`."""
        while len(rows):
            begin = self._count % BLOCK
            if not begin:
                self._make_room(rows.shape[1])
            some = rows[: BLOCK - begin]
            self._blocks[-1][begin : begin + len(some)] = some
            self._squares[-1][begin : begin + len(some)] = np.square(some).sum(axis=1)
            self._count += len(some)
            rows = rows[len(some) :]

    def _make_room(self, width: int) -> None:
        """Append a block, and write the oldest one in memory to the file if there are too many."""
        if self._file is not None and self._in_memory is not None:
            while self._blocks[self._on_disk :] and self._count - BLOCK * self._on_disk >= max(self._in_memory, BLOCK):
                block = self._blocks[self._on_disk]
                begin = self._on_disk * block.nbytes
                self._file.seek(begin)
                self._file.write(block.tobytes())
                self._file.flush()
                self._blocks[self._on_disk] = np.memmap(self._file, np.float32, "r", begin, block.shape)
                self._on_disk += 1
        self._blocks.append(np.empty((BLOCK, width), np.float32))
        self._squares.append(np.empty(BLOCK, np.float32))

    def search(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`~loopclosure.index.index.Index`; of equal scores, the earlier one comes first."""
        k = min(k, self._count)
        if not k:
            return np.zeros(0, np.intp), np.zeros(0, np.float32)
        scores = np.concatenate([self._products(number, row) for number in range(len(self._blocks))])
        # The product is fast but rounds: the descriptors that may be the best k are compared directly.
        near = np.flatnonzero(scores >= np.partition(scores, self._count - k)[self._count - k] - self._rounding(row))
        rows = np.array([self._blocks[number // BLOCK][number % BLOCK] for number in near], np.float64)
        values = rows @ row if self._metric == "cosine" else -np.linalg.norm(rows - row, axis=1)
        values = values.astype(np.float32)
        order = np.lexsort((near, -values))[:k]
        return near[order], values[order]

    def _products(self, number: int, row: np.ndarray) -> np.ndarray:
        """Return the scores of the descriptors of a block, rounded; for Euclidean distances, minus their squares."""
        rows = self._blocks[number][: self._count - number * BLOCK]
        if self._metric == "cosine":
            return rows @ row
        return -squared_distances(rows, row[None], self._squares[number][: len(rows), None], np.zeros(1))[:, 0]

    def _rounding(self, row: np.ndarray) -> float:
        """Return twice the largest error of a product: that of a sum of D terms."""
        longest = max(float(squares[: self._count - k * BLOCK].max()) for k, squares in enumerate(self._squares))
        error = len(row) * np.finfo(np.float32).eps * max(longest, float(row @ row))
        return 2 * error if self._metric == "cosine" else 8 * error

    def rows(self, start: int, stop: int) -> np.ndarray:
        """See :class:`~loopclosure.index.index.Index`."""
        first, last = start // BLOCK, -(-stop // BLOCK)
        parts = [block[: self._count - k * BLOCK] for k, block in enumerate(self._blocks[first:last], first)]
        return np.concatenate(parts)[start - first * BLOCK : stop - first * BLOCK]

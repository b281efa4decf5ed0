"""An exact index: 4 D bytes per descriptor, all of them read in every search."""

from __future__ import annotations

from tempfile import TemporaryFile

import numpy as np

LEAST_BLOCK, BLOCK = 64, 4096  # descriptors, which are stored and multiplied at a time


class ExactIndex:
    """See :class:`loopclosure.index.index.Index`.

    metric     "euclidean" or "cosine"
    in_memory  keep about this many descriptors in memory, and the others in a temporary file, which the system reads
               through its cache; None: all of them
    """

    def __init__(self, metric: str, in_memory: int | None = None) -> None:
        self._metric, self._in_memory = metric, in_memory
        self._block = BLOCK if in_memory is None else min(BLOCK, max(LEAST_BLOCK, in_memory // 4))
        self._count = 0
        self._blocks: list[np.ndarray] = []  # (block, D) each; the last one may have room
        self._squares = np.zeros(0, np.float32)  # the squared length of each descriptor, with room for more
        self._longest = 0.0  # the largest of them
        self._on_disk = 0  # blocks; they are the first ones
        self._file = None if in_memory is None else TemporaryFile(prefix="loopclosure-")  # noqa: SIM115

    def __len__(self) -> int:
        return self._count

    def add(self, rows: np.ndarray) -> None:
        """See :class:`~loopclosure.index.index.Index`."""
        while len(rows):
            begin = self._count % self._block
            if not begin:
                self._make_room(rows.shape[1])
            some = rows[: self._block - begin]
            self._blocks[-1][begin : begin + len(some)] = some
            squares = np.square(some).sum(axis=1)
            self._squares[self._count : self._count + len(some)] = squares
            self._longest = max(self._longest, float(squares.max()))
            self._count += len(some)
            rows = rows[len(some) :]

    def _make_room(self, width: int) -> None:
        """Append a block, and write the oldest one in memory to the file if there are too many."""
        if self._file is not None and self._in_memory is not None:
            while self._blocks[self._on_disk :] and self._count - self._block * self._on_disk >= max(
                self._in_memory, self._block
            ):
                block = self._blocks[self._on_disk]
                begin = self._on_disk * block.nbytes
                self._file.seek(begin)
                self._file.write(block.tobytes())
                self._file.flush()
                self._blocks[self._on_disk] = np.memmap(self._file, np.float32, "r", begin, block.shape)
                self._on_disk += 1
        self._blocks.append(np.empty((self._block, width), np.float32))
        if self._count == len(self._squares):
            self._squares = np.append(self._squares, np.empty(max(self._block, self._count), np.float32))

    def search(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`~loopclosure.index.index.Index`; of equal scores, the earlier one comes first."""
        return self.search_all(row, k)[:2]

    def search_all(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what ``search`` returns, and the scores (N,) of all descriptors, which are rounded."""
        k = min(k, self._count)
        if not k:
            return np.zeros(0, np.intp), np.zeros(0, np.float32), np.zeros(0, np.float32)
        scores = np.empty(self._count, np.float32)
        for number, block in enumerate(self._blocks):
            part = scores[number * self._block : (number + 1) * self._block]
            np.matmul(block[: len(part)], row, out=part)
        if self._metric != "cosine":  # minus the squared distance, without the square of ``row``, has the same order
            scores *= 2
            scores -= self._squares[: self._count]
        # The product is fast but rounds: the descriptors that may be the best k are compared directly.
        near = np.flatnonzero(scores >= np.partition(scores, self._count - k)[self._count - k] - self._rounding(row))
        rows = np.array([self._blocks[number // self._block][number % self._block] for number in near], np.float64)
        values = rows @ row if self._metric == "cosine" else -np.linalg.norm(rows - row, axis=1)
        values = values.astype(np.float32)
        order = np.lexsort((near, -values))[:k]
        if self._metric != "cosine":
            scores = -np.sqrt(np.maximum(row @ row - scores, 0))
        return near[order], values[order], scores

    def _rounding(self, row: np.ndarray) -> float:
        """Return twice the largest error of a score, a sum of D terms."""
        error = len(row) * np.finfo(np.float32).eps * max(self._longest, float(row @ row))
        return float(2 * error if self._metric == "cosine" else 8 * error)

    def rows(self, start: int, stop: int) -> np.ndarray:
        """See :class:`~loopclosure.index.index.Index`."""
        first, last = start // self._block, -(-stop // self._block)
        parts = [block[: self._count - k * self._block] for k, block in enumerate(self._blocks[first:last], first)]
        return np.concatenate(parts)[start - first * self._block : stop - first * self._block]

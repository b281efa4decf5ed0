"""An exact index: 4 D bytes per descriptor, all of them read in every search."""

from __future__ import annotations

from collections.abc import Iterator
from tempfile import TemporaryFile

import numpy as np

LEAST_BLOCK, BLOCK = 64, 4096  # descriptors, which are stored and multiplied at a time
CLEAR = 10  # standard deviations of the squared distances; the bound of the rounding is seldom reached


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
        self._blocks: list[np.ndarray] = []  # (block, D) each, those in memory; the last one may have room
        self._stored = np.zeros((0, 0), np.float32)  # the blocks before them, in one mapping of the file
        self._squares = np.zeros(0, np.float32)  # the squared length of each descriptor, with room for more
        self._longest = 0.0  # the largest of them
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
            while self._blocks and self._count - len(self._stored) >= max(self._in_memory, self._block):
                self._file.write(self._blocks.pop(0).tobytes())
                self._file.flush()
                size = len(self._stored) + self._block, width
                self._stored = np.memmap(self._file, np.float32, "r", 0, size)  # the mapping before is closed
        self._blocks.append(np.empty((self._block, width), np.float32))
        if self._count == len(self._squares):
            self._squares = np.append(self._squares, np.empty(max(self._block, self._count), np.float32))

    def _parts(self) -> Iterator[np.ndarray]:
        """Yield all blocks, those on disk first."""
        for begin in range(0, len(self._stored), self._block):
            yield self._stored[begin : begin + self._block]
        yield from self._blocks

    def search(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray]:
        """See :class:`~loopclosure.index.index.Index`; of equal scores, the earlier one comes first."""
        return self.search_all(row, k)[:2]

    def search_all(self, row: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return what ``search`` returns, and the scores (N,) of all descriptors."""
        k = min(k, self._count)
        if not k:
            return np.zeros(0, np.intp), np.zeros(0, np.float32), np.zeros(0, np.float32)
        scores = np.empty(self._count, np.float32)
        for number, block in enumerate(self._parts()):
            part = scores[number * self._block : (number + 1) * self._block]
            np.matmul(block[: len(part)], row, out=part)
        if self._metric != "cosine":  # minus the squared distance, without the square of ``row``, has the same order
            scores *= 2
            scores -= self._squares[: self._count]
        # The product is fast but rounds: the descriptors that may be the best k are compared directly.
        near = np.flatnonzero(scores >= np.partition(scores, self._count - k)[self._count - k] - self._rounding(row))
        rows = np.concatenate([self.rows(number, number + 1) for number in near.tolist()]).astype(np.float64)
        values = rows @ row if self._metric == "cosine" else -np.linalg.norm(rows - row, axis=1)
        values = values.astype(np.float32)
        order = np.lexsort((near, -values))[:k]
        if self._metric != "cosine":
            squares = np.maximum(row @ row - scores, 0)
            # Where descriptors lie far from 0 and near one another, the rounding hides how they differ.
            if self._rounding(row) > CLEAR * squares.std():
                for number, block in enumerate(self._parts()):
                    part = squares[number * self._block : (number + 1) * self._block]
                    part[:] = np.square(block[: len(part)] - row).sum(axis=1)
            scores = -np.sqrt(squares)
        return near[order], values[order], scores

    def _rounding(self, row: np.ndarray) -> float:
        """Return twice the largest error of a score, a sum of D terms."""
        error = len(row) * np.finfo(np.float32).eps * max(self._longest, float(row @ row))
        return float(2 * error if self._metric == "cosine" else 8 * error)

    def rows(self, start: int, stop: int) -> np.ndarray:
        """See :class:`~loopclosure.index.index.Index`."""
        split = len(self._stored)
        parts = [self._stored[start:stop]] if start < split else []
        for number, block in enumerate(self._blocks):
            begin = split + number * self._block
            if begin < stop and start < begin + self._block:
                parts.append(block[max(0, start - begin) : min(stop, self._count) - begin])
        return np.concatenate(parts)

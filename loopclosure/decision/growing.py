"""Arrays to which one column after another is appended."""

from __future__ import annotations

import numpy as np

FIRST = 256  # columns there is room for; doubled when full


class Growing:
    """An array (rows, n) of float64 to which columns are appended; its room doubles when it is full."""

    def __init__(self, rows: int) -> None:
        self._all, self._count = np.zeros((rows, FIRST)), 0

    def __len__(self) -> int:
        return self._count

    @property
    def array(self) -> np.ndarray:
        """The array (rows, n); a view, of which values may be set."""
        return self._all[:, : self._count]

    def append(self, columns: np.ndarray) -> None:
        """Append columns (rows, k)."""
        end = self._count + columns.shape[1]
        while end > self._all.shape[1]:
            self._all = np.concatenate([self._all, np.zeros_like(self._all)], axis=1)
        self._all[:, self._count : end] = columns
        self._count = end

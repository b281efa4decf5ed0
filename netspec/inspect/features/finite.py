"""Whether descriptors are numbers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np


def rows_not_finite(arrays: Mapping[str, np.ndarray]) -> Iterator[str]:
    """Yield one line for each of these arrays (N, D), by name, that has a NaN or an infinity."""
    for name, values in arrays.items():
        rows = np.flatnonzero(~np.all(np.isfinite(values), axis=1))
        if len(rows):
            yield f"{name}: {len(rows)} of {len(values)} rows have a NaN or an infinity, the first is row {rows[0]}"

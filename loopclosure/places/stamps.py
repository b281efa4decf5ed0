"""Mends the stamps of recorded messages: some drivers write 0, and some clocks are set back."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np

A_DATE = 1e6  # seconds; a smaller stamp is a time since the start


def mended(stamps: np.ndarray, received: np.ndarray, offset: float = 0.0) -> tuple[np.ndarray, np.ndarray, float]:
    """Replace stamps that are 0 or go back by the times of receipt.

    stamps    (N,) of the headers, in the order of receipt
    received  (N,) times of receipt, by a clock that may differ from that of the headers
    offset    the difference of the two clocks if no stamp is right

    Returns the stamps (N,), which do not decrease; which were replaced (N,) bool; and the difference of the clocks.
    """
    right = np.zeros(len(stamps), bool)
    right[_ascending(stamps)] = True
    if len(stamps) > 1 and stamps.max() == stamps.min():
        right[:] = stamps[0] > A_DATE  # a standing clock
    elif len(stamps) and stamps.max() > A_DATE:
        right &= stamps > A_DATE
    if right.all():
        return stamps, ~right, offset
    if right.any():
        offset = float(np.median(stamps[right] - received[right]))
    filled = np.where(right, stamps, received + offset)
    # Not before the last right stamp, and not after the next one.
    earliest = np.maximum.accumulate(np.where(right, stamps, -np.inf))
    latest = np.minimum.accumulate(np.where(right, stamps, np.inf)[::-1])[::-1]
    return np.maximum.accumulate(filled.clip(earliest, latest)), ~right, offset


def _ascending(values: np.ndarray) -> list[int]:
    """Return the indices of a longest part of the values that does not decrease."""
    ends: list[float] = []  # the least last value of a part with k + 1 values
    last: list[int] = []  # and its index
    before = [-1] * len(values)
    for i, value in enumerate(values.tolist()):
        k = bisect_right(ends, value)
        before[i] = last[k - 1] if k else -1
        ends[k : k + 1], last[k : k + 1] = [value], [i]
    chain, at = [], last[-1] if last else -1
    while at >= 0:
        chain.append(at)
        at = before[at]
    return chain[::-1]
